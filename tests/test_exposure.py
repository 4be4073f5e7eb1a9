"""Which racks of a row breathe more exhaust: by the layout, by a matrix, and as given."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from random_halls import at_design
from sdc_taichi import ConfigError, DataCenterConfig, build_fleet, load_config
from sdc_taichi.hall.recirculation import calibrate, exposure
from sdc_taichi.layout_solver.solve import solve_at_design_point
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
    assert np.ptp(found.design.approach_k) > 5


def test_default_hall_differs_within_rows_and_keeps_their_means() -> None:
    found = at_design([load_config("corrected")]).rack_inlet_c.reshape(4, 5) - 23.0
    np.testing.assert_allclose(found.mean(axis=1), [5.3, 5.0, 5.0, 5.3], rtol=0, atol=1e-9)
    assert np.all(np.ptp(found, axis=1) > 2.9)
    # Warmest at the ends, where air comes round the row.
    assert np.all(np.argmin(found, axis=1) == 2)
    whole = at_design([load_config("corrected", ["hall.recirculation.calibrate=hall"])])
    assert np.mean(whole.rack_inlet_c) == pytest.approx(28.15, abs=1e-9)


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
        found = exposure(hall, airflow.reshape(-1)).reshape(3, 30)
        assert np.all(found > 0)
        np.testing.assert_allclose(found[2], found[2, ::-1], rtol=1e-12)
        assert found[0, 1] > 3 * found[0, 28]


def test_means_that_exhaust_cannot_bring_about_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"approach_k of row . is 14 K on the mean, but the exh"):
        build_fleet(hall_of(2, 3, "hall.supply_approach_k=14", "hall.return_approach_k=0"))
