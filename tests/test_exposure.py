"""Which racks of a row breathe more exhaust: by the layout, by a matrix, and as given."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from random_halls import at_design
from sdc_taichi import ConfigError, DataCenterConfig, build_fleet, load_config
from sdc_taichi.hall.exposure import exposure, with_lack
from sdc_taichi.hall.recirculation import calibrate
from sdc_taichi.layout_solver.solve import solve_at_design_point
from sdc_taichi.sim.hall_solver import Hall
from sdc_taichi.sim.hall_state import Conditions
from sdc_taichi.types import F64

ALIKE = ["hall.supply_approach_k=5.15", "hall.return_approach_k=-3.1", "servers.power_w=[130, 10]"]


def hall_of(rows: int, racks_per_row: int, *more: str) -> DataCenterConfig:
    return load_config(
        "corrected", [f"hall.rows={rows}", f"hall.racks_per_row={racks_per_row}", *ALIKE, *more]
    )


def ranks(values: F64) -> F64:
    """Ranks of values, those within a millikelvin alike."""
    found, place, count = np.unique(np.round(values, 3), return_inverse=True, return_counts=True)
    assert len(found)
    return np.asarray((np.cumsum(count) - (count - 1) / 2)[place])


def rank_correlation(first: F64, second: F64) -> float:
    """Mean over the rows of Spearman's rank correlation of values by row, (rows, P)."""
    return float(
        np.mean([np.corrcoef(ranks(a), ranks(b))[0, 1] for a, b in zip(first, second, strict=True)])
    )


@pytest.mark.parametrize("containment", [0.0, 0.7])
@pytest.mark.parametrize("returns", ["ceiling", "end_wall"])
@pytest.mark.parametrize("shape", [(4, 5), (2, 10)])
def test_racks_of_a_row_rank_as_in_a_solve_of_the_layout(
    shape: tuple[int, int], returns: str, containment: float
) -> None:
    config = hall_of(
        *shape, f"hall.layout.returns={returns}", f"hall.layout.containment={containment}"
    )
    solved = solve_at_design_point(config, 0.6).approach_k.reshape(shape)
    found = calibrate(config).design.approach_k.reshape(shape)
    assert rank_correlation(found, solved) >= 0.8


@pytest.mark.parametrize("returns", ["ceiling", "end_wall"])
def test_unlike_racks_rank_as_in_a_solve_of_the_layout(returns: str) -> None:
    servers = [60, 60, 400, 400, 150, 150, 60, 60] * 2 + [150, 150, 60, 400, 60, 60, 150, 150] * 2
    config = hall_of(
        4, 8, f"hall.layout.returns={returns}", f"hall.servers_per_rack={servers}",
        "hall.supply_approach_k=4",
    )  # fmt: skip
    solved = solve_at_design_point(config, 0.6).approach_k.reshape(4, 8)
    found = calibrate(config)
    assert rank_correlation(found.design.approach_k.reshape(4, 8), solved) >= 0.8
    assert found.group_exhaust_share.max() < 1
    # Racks that draw more than the floor gives them breathe many times more exhaust than others.
    assert np.ptp(found.design.approach_k) > 4


def test_default_hall_differs_within_rows_and_keeps_their_means() -> None:
    found = at_design([load_config("corrected")]).rack_inlet_c.reshape(4, 5) - 23.0
    # The means are those of the reference hall, whose racks are alike.
    np.testing.assert_allclose(found.mean(axis=1), [5.3, 5.0, 5.0, 5.3], rtol=0, atol=0.2)
    assert np.all(np.ptp(found, axis=1) > 2.9)
    # Warmest at the ends, where air comes round the row.
    assert np.all(np.abs(np.argmin(found, axis=1) - 2) <= 1)
    whole = at_design([load_config("corrected", ["hall.recirculation.calibrate=hall"])])
    assert np.mean(whole.rack_inlet_c) == pytest.approx(28.15, abs=0.1)
    even = "servers.power_w=[130, 10]"
    alike = at_design([load_config("corrected", [even])]).rack_inlet_c.reshape(4, 5) - 23.0
    np.testing.assert_allclose(alike.mean(axis=1), [5.3, 5.0, 5.0, 5.3], rtol=0, atol=1e-9)


def test_matrix_of_a_study_is_taken_as_it_is_unless_asked(tmp_path: Path) -> None:
    rng, path = np.random.default_rng(0), tmp_path / "cfd.npz"
    matrix = rng.dirichlet(np.ones(20), 20) * rng.uniform(0.05, 0.3, (20, 1))
    np.savez(path, R=matrix)
    named = f"hall.recirculation.matrix_file={json.dumps(str(path))}"
    as_given, by_rack, by_row = (
        at_design([hall_of(4, 5, named, *more)]).rack_inlet_c
        for more in (
            [],
            ["hall.recirculation.calibrate=rack"],
            ["hall.recirculation.calibrate=row"],
        )
    )
    assert np.ptp(as_given) > 2.5
    np.testing.assert_allclose(by_rack, 28.15, atol=1e-9)
    # The file tells racks of a row apart, the approach temperatures how warm the row is.
    np.testing.assert_allclose(by_row.reshape(4, 5).mean(axis=1), 28.15, atol=1e-9)
    for row, shares in zip(by_row.reshape(4, 5), matrix.sum(axis=1).reshape(4, 5), strict=True):
        assert np.array_equal(np.argsort(row), np.argsort(shares))


def test_exposure_is_above_zero_and_the_same_from_both_ends() -> None:
    for returns in ("ceiling", "end_wall"):
        hall = hall_of(3, 30, f"hall.layout.returns={returns}").hall
        airflow = np.ones((3, 30))
        airflow[:2, :4] = 9.0
        found = exposure(hall, airflow.reshape(-1), 0.86).reshape(3, 30)
        assert np.all(found > 0)
        even = exposure(hall, np.ones(90), 0.86).reshape(3, 30)
        np.testing.assert_allclose(even, even[:, ::-1], rtol=1e-9)


def test_means_that_exhaust_cannot_bring_about_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"approach_k is 14 K on the mean, but the exh"):
        build_fleet(hall_of(2, 3, "hall.supply_approach_k=14", "hall.return_approach_k=0"))


def dense_hall(dense: list[int], rows: int, per_row: int, *more: str) -> DataCenterConfig:
    """A hall of racks of 8 kW, of which some have 40 kW."""
    servers = [100 if rack in dense else 20 for rack in range(rows * per_row)]
    return load_config(
        "corrected",
        [f"hall.rows={rows}", f"hall.racks_per_row={per_row}", f"hall.servers_per_rack={servers}",
         "hall.supply_approach_k=5", "hall.return_approach_k=-3", "servers.power_w=[400, 120]",
         *more],
    )  # fmt: skip


SOLVED_ROWS_K = {
    "ceiling": [4.832, 6.930, 6.914, 6.947, 6.942, 6.947, 6.947],
    "end_wall": [7.350, 7.920, 6.919, 7.420, 6.429, 6.836, 6.169],
}
"""Hottest inlets over supply of ``hall solve --cell 0.6``, in K: 14 rows of 12 racks, of which row
0 to 6 has racks of 40 kW; the other seven are mirrored."""
SOLVED_PLACES_K = {
    "ceiling": [6.9, 8.5, 10.7, 8.6, 8.2, 9.2, 11.0, 7.7, 9.6, 9.9,
                9.5, 7.8, 6.2, 8.3, 7.1, 8.8, 7.0, 9.6, 8.1, 6.9],
    "end_wall": [6.9, 7.3, 8.4, 7.0, 7.6, 7.4, 8.6, 7.3, 8.3, 8.0,
                 7.2, 6.3, 6.0, 6.2, 5.8, 7.6, 5.9, 8.2, 7.1, 6.3],
}  # fmt: skip
"""Hottest inlet above supply air, in K, of 8 rows of 10 racks, of which 8 racks have 40 kW. Each
figure is that of other random places of these racks, with the seeds 0 to 19."""


def hottest_k(config: DataCenterConfig) -> float:
    return float(calibrate(config).design.approach_k.max())


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("returns", ["ceiling", "end_wall"])
def test_hottest_inlets_of_places_rank_as_in_solves_of_the_layout(returns: str) -> None:
    layout = f"hall.layout.returns={returns}"
    rows = [dense_hall([*range(12 * r, 12 * r + 12)], 14, 12, layout) for r in range(7)]
    solved = np.array([SOLVED_ROWS_K[returns]])
    assert rank_correlation(np.array([[hottest_k(c) for c in rows]]), solved) >= 0.8
    places = [
        np.random.default_rng(seed).choice(80, 8, replace=False).tolist() for seed in range(20)
    ]
    found = np.array([[hottest_k(dense_hall(at, 8, 10, layout)) for at in places]])
    assert rank_correlation(found, np.array([SOLVED_PLACES_K[returns]])) >= 0.8


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("returns", ["ceiling", "end_wall"])
@pytest.mark.parametrize("containment", [0.0, 0.75])
def test_dense_rack_warms_itself_most_by_design_and_in_a_step(
    returns: str, containment: float
) -> None:
    layout = [f"hall.layout.returns={returns}", f"hall.layout.containment={containment}"]
    even, dense = (calibrate(dense_hall(at, 4, 10, *layout)).design.approach_k for at in ([], [14]))
    warming_k = dense - even
    assert warming_k[14] > 1.0
    assert warming_k[14] > 1.1 * max(warming_k[12], warming_k[16])
    # Racks at the far end of the aisle get air that the dense rack's tiles give for it.
    assert warming_k[14] > warming_k[19]
    fleet = build_fleet(dense_hall([], 4, 10, *layout))
    load = np.full(40, 0.3)
    before = Hall(fleet, "f64").solve(Conditions(np.array([20.0]), np.ones(1), rack_load=load))
    load[14] = 1.0
    after = Hall(fleet, "f64").solve(Conditions(np.array([20.0]), np.ones(1), rack_load=load))
    step_k = after.rack_inlet_c - before.rack_inlet_c
    assert step_k[14] > 0.05
    assert step_k[14] > max(step_k[12], step_k[16])


def test_floor_made_for_less_power_gives_the_same_air() -> None:
    even = dense_hall([], 4, 10)
    reference = calibrate(even)
    kw = 20 * 0.4
    same = calibrate(dense_hall([], 4, 10, f"hall.recirculation.reference_rack_kw={kw}"))
    np.testing.assert_allclose(same.exhaust_share, reference.exhaust_share, rtol=1e-3)
    double = calibrate(dense_hall([], 4, 10, f"hall.recirculation.reference_rack_kw={kw / 2}"))
    # Twice the density takes in the same supply air, so that its share halves (mass balance).
    np.testing.assert_allclose(
        np.mean(1.0 - double.exhaust_share), np.mean(1.0 - reference.exhaust_share) / 2, rtol=0.1
    )
    ample = calibrate(dense_hall([], 4, 10, f"hall.recirculation.reference_rack_kw={1.25 * kw}"))
    assert np.all(ample.exhaust_share < reference.exhaust_share)
    assert ample.design.airflow_m3s.sum() < ample.design.crac_flow_m3s


def test_lack_is_continuous_and_keeps_odds_above_zero() -> None:
    odds, lack = np.full(2001, 0.3), np.linspace(-2.0, 2.0, 2001)
    found = with_lack(odds, lack)
    assert np.all(found > 0)
    assert np.all(np.diff(found) > 0)
    assert np.max(np.abs(np.diff(found, 2))) < 1e-4
    assert found[1000] == pytest.approx(0.3)
    np.testing.assert_array_equal(with_lack(np.zeros(2), np.array([-1.0, 0.5])), [0.0, 0.5])
