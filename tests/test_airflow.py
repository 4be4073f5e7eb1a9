"""The layout solver: conservation, limits, symmetry, grid convergence, and bad input."""

from __future__ import annotations

import json
import re
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from sdc_taichi import DataCenterConfig, load_config
from sdc_taichi.cli import hall as hall_commands
from sdc_taichi.cli.app import app
from sdc_taichi.errors import ConfigError
from sdc_taichi.hall.floor_plan import floor_plan
from sdc_taichi.hall.rack_servers import air_properties
from sdc_taichi.kernels import airflow as kernels
from sdc_taichi.kernels.compiler import runtime
from sdc_taichi.layout_solver import solve as airflow
from sdc_taichi.layout_solver.grid import MOST_CELLS, Grid, build_grid
from sdc_taichi.layout_solver.solve import LayoutSolution, solve, solve_at_design_point
from sdc_taichi.types import F64

COARSE_M = 0.6


def hall_of(rows: int, racks_per_row: int, **layout: Any) -> DataCenterConfig:
    return load_config(
        "corrected",
        [
            f"hall.rows={rows}",
            f"hall.racks_per_row={racks_per_row}",
            "hall.supply_approach_k=5",
            "hall.return_approach_k=-3",
            "servers.power_w=[130, 10]",
            *(f"hall.layout.{name}={value}" for name, value in layout.items()),
        ],
    )


def solved(
    config: DataCenterConfig,
    *,
    supply: float = 0.86,
    airflow_m3s: F64 | None = None,
    rise_k: float | F64 = 12.0,
    cell_m: float = COARSE_M,
) -> LayoutSolution:
    """Solve with ``supply`` as a share of what the racks draw."""
    flow = np.full(config.hall.racks, 1.8) if airflow_m3s is None else airflow_m3s
    return solve(
        config,
        airflow_m3s=flow,
        power_w=air_properties(config).j_per_m3_k * flow * rise_k,
        supply_m3s=supply * float(flow.sum()),
        supply_c=20.0,
        cell_m=cell_m,
    )


def dense(grid: Grid, off: F64, diagonal: F64) -> F64:
    matrix = np.zeros((grid.cells + 1, grid.cells + 1))
    for face in range(6):
        matrix[np.arange(grid.cells), grid.beyond[:-1, face]] -= off[: grid.cells, face]
    matrix[np.arange(grid.cells), np.arange(grid.cells)] += diagonal
    return matrix[:-1, :-1]


# Grid


@pytest.mark.parametrize("cell_m", [0.3, 0.45, 0.6, 1.0])
@pytest.mark.parametrize("rows", [1, 2, 3, 4])
def test_faces_of_racks_lie_on_faces_of_cells(rows: int, cell_m: float) -> None:
    config = hall_of(rows, 3, hot_aisle_m=1.7, cold_aisle_m=1.25, side_margin_m=0.9)
    hall, plan = config.hall, floor_plan(config.hall)
    x, y, z = build_grid(hall, np.ones(hall.racks), 1.0, cell_m).widths_m
    lines = [np.concatenate([[0.0], np.cumsum(w)]) for w in (x, y, z)]
    np.testing.assert_allclose(
        [line[-1] for line in lines], [plan.length_m, plan.width_m, hall.layout.ceiling_m]
    )

    def off_the_lines(places: F64, line: F64) -> float:
        return float(np.abs(places[:, None] - line).min(axis=1).max())

    half = hall.layout.rack_pitch_m / 2
    assert off_the_lines(np.concatenate([plan.front_m, plan.back_m])[:, 1], lines[1]) < 1e-12
    assert off_the_lines(plan.centre_m[:, 0] - half, lines[0]) < 1e-12
    assert off_the_lines(plan.centre_m[:, 0] + half, lines[0]) < 1e-12
    assert off_the_lines(np.array([hall.layout.rack_height_m]), lines[2]) < 1e-12
    assert max(x.max(), y.max(), 2 * z.max()) <= cell_m + 1e-12


@pytest.mark.parametrize("returns", ["ceiling", "end_wall"])
def test_given_flows_balance(returns: str) -> None:
    config = hall_of(3, 2, returns=returns)
    flow = np.linspace(1.0, 2.0, 6)
    grid = build_grid(config.hall, flow, 7.0, 0.6)
    for runs in (grid.fronts, grid.backs):
        np.testing.assert_allclose(np.add.reduceat(runs.m3s, runs.face_offsets[:-1]), flow)
    assert grid.supply_m3s.sum() == pytest.approx(7.0)
    assert grid.return_m3s.sum() == pytest.approx(7.0)
    assert abs(grid.boundary_m3s.sum()) < 1e-12
    volume = np.prod([w.sum() for w in grid.widths_m])
    layout = config.hall.layout
    racks = 6 * layout.rack_pitch_m * layout.rack_depth_m * layout.rack_height_m
    cells = np.sqrt(np.prod(grid.area_m2[:-1], axis=1)).sum()
    assert cells == pytest.approx(volume - racks)


# Flow and tags


@settings(max_examples=15)
@given(
    rows=st.integers(1, 4),
    racks=st.integers(1, 3),
    returns=st.sampled_from(["ceiling", "end_wall"]),
    containment=st.sampled_from([0.0, 0.5, 1.0]),
    end_margin_m=st.sampled_from([0.0, 0.7, 1.8]),
    hot_aisle_m=st.floats(0.5, 2.5),
    ceiling_m=st.floats(2.3, 4.5),
    supply=st.floats(0.4, 1.8),
    seed=st.integers(0, 1000),
)
def test_air_and_heat_are_conserved_in_any_hall(
    rows: int,
    racks: int,
    returns: str,
    containment: float,
    end_margin_m: float,
    hot_aisle_m: float,
    ceiling_m: float,
    supply: float,
    seed: int,
) -> None:
    config = hall_of(
        rows,
        racks,
        returns=returns,
        containment=containment,
        end_margin_m=end_margin_m,
        hot_aisle_m=hot_aisle_m,
        ceiling_m=ceiling_m,
    )
    rng = np.random.default_rng(seed)
    flow = rng.uniform(0.5, 2.5, config.hall.racks)
    rise_k = rng.uniform(2.0, 20.0, config.hall.racks)
    found = solved(config, supply=supply, airflow_m3s=flow, rise_k=rise_k, cell_m=0.9)
    assert found.mass_residual < 1e-10
    assert found.energy_residual < 1e-9
    assert found.share_residual < 1e-10
    assert found.direct_difference_k < 1e-8
    assert found.R.min() >= 0
    assert found.supply_share.min() >= 0
    # What racks take of an exhaust is at most that exhaust; the rest returns.
    assert np.all(flow @ found.R <= flow * (1 + 1e-10))
    # T_ret - T_sup = P/(rho*cp*V_crac) whatever R is.
    heat_k = float(flow @ rise_k) / (supply * float(flow.sum()))
    assert found.return_c - found.supply_c == pytest.approx(heat_k, rel=1e-9)
    assert found.rti_pct == pytest.approx(100.0 / supply, rel=1e-9)
    assert found.shi + found.rhi == pytest.approx(1.0)
    assert np.all(found.approach_k >= 0)


def test_kernels_solve_what_a_dense_solver_solves() -> None:
    """Flow, tags and temperatures against NumPy, with the equations written anew."""
    config = hall_of(2, 1, end_margin_m=0.6, side_margin_m=0.6, ceiling_m=2.7)
    flow = np.array([1.5, 2.0])
    rise_k = np.array([10.0, 14.0])
    found = solved(config, airflow_m3s=flow, rise_k=rise_k, cell_m=1.0)
    grid = build_grid(config.hall, flow, 0.86 * float(flow.sum()), 1.0)
    n = grid.cells
    conductance, boundary = grid.conductance_m, grid.boundary_m3s[:-1]
    laplace = dense(grid, conductance, conductance[:-1].sum(axis=1))
    potential = np.zeros(n + 1)
    potential[1:-1] = np.linalg.solve(laplace[1:, 1:], -boundary.sum(axis=1)[1:])
    drop = potential[:-1, None] - np.where(grid.beyond[:-1] < n, potential[grid.beyond[:-1]], 0.0)
    out = conductance[:-1] * drop
    through = out + boundary
    velocity = (through[:, 3:] - through[:, :3]) / (2.0 * grid.area_m2[:-1])
    speed = np.append(np.linalg.norm(velocity, axis=1), 0.0)
    mixing = airflow.MIXING_M * (speed[:-1, None] + speed[grid.beyond[:-1]]) / 2.0
    spread = np.maximum(mixing * conductance[:-1], np.abs(out) / 2.0)
    diagonal = (spread + out / 2.0).sum(axis=1) + np.maximum(boundary, 0.0).sum(axis=1)
    transport = dense(grid, spread - out / 2.0, diagonal)

    entering = np.zeros((n, 3))
    for rack in range(2):
        run = slice(grid.backs.face_offsets[rack], grid.backs.face_offsets[rack + 1])
        np.add.at(entering[:, rack], grid.backs.cell[run], grid.backs.m3s[run])
    np.add.at(entering[:, 2], grid.supply_cell, grid.supply_m3s)
    tags = np.linalg.solve(transport, entering)
    intake = np.zeros((2, n))
    for rack in range(2):
        run = slice(grid.fronts.face_offsets[rack], grid.fronts.face_offsets[rack + 1])
        np.add.at(intake[rack], grid.fronts.cell[run], grid.fronts.m3s[run] / flow[rack])
    np.testing.assert_allclose(found.R, (intake @ tags)[:, :2], rtol=1e-9)
    np.testing.assert_allclose(found.supply_share, (intake @ tags)[:, 2], rtol=1e-9)
    passing = transport - entering[:, :2] @ intake
    inlet_k = intake @ np.linalg.solve(passing, entering[:, :2] @ rise_k)
    np.testing.assert_allclose(found.approach_k, inlet_k, rtol=1e-9)


def test_symmetric_hall_gives_symmetric_shares() -> None:
    found = solved(hall_of(4, 4))
    place = np.arange(16).reshape(4, 4)
    for mirror in (place[:, ::-1].ravel(), place[::-1].ravel()):
        mirrored = found.R[np.ix_(mirror, mirror)]
        np.testing.assert_allclose(mirrored, found.R, rtol=1e-8, atol=1e-12)
    assert not np.allclose(found.R, found.R[0, 0])


def test_containment_lowers_recirculation() -> None:
    shares = [
        solved(hall_of(4, 3, containment=c), supply=1.1).R.sum(axis=1) for c in (0.0, 0.5, 0.9, 1.0)
    ]
    for open_, closed in pairwise(shares):
        assert np.all(closed < open_)
    assert shares[-1].max() < 1e-6


def test_threads_change_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    config = hall_of(2, 3)
    first = solved(config)
    started = runtime.ensure_started()
    monkeypatch.setattr(runtime, "ensure_started", lambda: started + 3)
    second = solved(config)
    assert first.R.tobytes() == second.R.tobytes()
    assert first.provenance == second.provenance


def test_lanes_change_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    config = hall_of(2, 5)
    first = solved(config)
    monkeypatch.setattr(kernels, "LANES", 4)
    assert solved(config).R.tobytes() == first.R.tobytes()


def test_progress_begins_with_an_estimate_and_ends_with_the_last_tag() -> None:
    told: list[tuple[int, int, float]] = []

    def tell(done: int, total: int, expected_s: float) -> None:
        told.append((done, total, expected_s))

    for config in (hall_of(2, 10), hall_of(4, 10)):
        solve_at_design_point(config, 0.6, tell)
    ends = [i for i, (done, total, _) in enumerate(told) if done == total]
    assert ends == [ends[0], len(told) - 1]
    assert [told[0][:2], told[ends[0] + 1][:2]] == [(0, 21), (0, 41)]
    done = [each[0] for each in told[: ends[0] + 1]]
    assert done == sorted(set(done))
    # Twice the racks and about twice the cells take up to four times as long.
    assert 2.0 < told[-1][2] / told[0][2] < 5.0


def test_command_says_how_long_it_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hall_commands, "LEAST_TOLD_S", 0.0)
    done = CliRunner().invoke(app, ["hall", "solve", "--cell", "0.9", "--json"])
    assert done.exit_code == 0, done.output
    assert re.search(r"^about \d+:\d\d of computing for 21 tags$", done.stderr, re.MULTILINE)
    assert json.loads(done.stdout)["share_residual"] < 1e-10


def test_default_hall_is_converged_in_the_grid() -> None:
    config = load_config("corrected")
    solutions = {cell_m: solve_at_design_point(config, cell_m) for cell_m in (0.6, 0.45, 0.3)}
    fine = solutions[0.3].R.sum(axis=1)
    for solution in solutions.values():
        np.testing.assert_allclose(solution.R.sum(axis=1), fine, rtol=0.02)
        np.testing.assert_allclose(solution.approach_k, solutions[0.3].approach_k, rtol=0.02)
        assert solution.mass_residual < 1e-10
        assert solution.energy_residual < 1e-8
        assert solution.share_residual < 1e-10
        assert solution.direct_difference_k < 1e-8
        assert solution.seconds < 60
    assert len({solution.cells for solution in solutions.values()}) == 3


# Bad input


@pytest.mark.parametrize(
    ("shape", "cell_m", "message"),
    [
        *(((1, 1), cell_m, r"cell_m .*valid is 0\.05\.\.2 m") for cell_m in (-0.3, 5.0, np.nan)),
        ((10, 100), 0.1, rf"makes [0-9,]+ cells; valid is at most {MOST_CELLS:,}"),
        ((100, 100), 2.0, "10,000 racks; the layout solver takes at most"),
    ],
)
def test_bad_grids(shape: tuple[int, int], cell_m: float, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        solved(hall_of(*shape), cell_m=cell_m)
