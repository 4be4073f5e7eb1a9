"""Weights of the exhaust mix: against the paths they follow from, and what must hold for all."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings

import reference_twin
from random_halls import (
    AS_FOUND,
    LONG,
    MERGED,
    SEEDS,
    SMALL,
    assert_close,
    random_hall,
    random_values,
)
from sdc_taichi import ConfigError
from sdc_taichi.config import config_from_dict
from sdc_taichi.hall.mix_weights import layout_weights
from sdc_taichi.hall.recirculation import calibrate


@pytest.mark.parametrize("shape", SMALL + MERGED + LONG)
def test_weights_are_those_of_the_paths(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(shape[0] * shape[1])
    hall = config_from_dict(random_values(rng, "dc", shape)).hall
    flow = rng.uniform(0.5, 2.0, hall.racks)
    weights = layout_weights(hall, flow)
    dense, expected = weights.dense(), reference_twin.layout_weights(hall, flow)
    assert_close(dense, expected, 1e-12, "weights", scale=1.0)
    assert_close(dense.sum(axis=1), np.ones(hall.racks), 1e-12, "rows sum to 1")
    assert np.all(dense >= 0)
    values = rng.uniform(-3, 30, hall.racks)
    assert_close(weights.apply(values), expected @ values, 1e-11, "apply", scale=1.0)
    found = weights.apply_transposed(values)
    assert_close(found, expected.T @ values, 1e-11, "transposed", scale=1.0)


@pytest.mark.parametrize("shape", [(14, 8), (5, 70)])
@pytest.mark.parametrize("cutoff", [0.0, 1e-3, 4e-3])
def test_rows_of_deep_racks_are_within_reach(shape: tuple[int, int], cutoff: float) -> None:
    values = random_values(np.random.default_rng(6), "dc", shape)
    values["hall"]["layout"] |= {"rack_depth_m": 5.0, "cold_aisle_m": 1.0, "hot_aisle_m": 1.0}
    values["hall"]["recirculation"] = {"decay_m": 3.0, "cutoff": cutoff}
    hall = config_from_dict(values).hall
    expected = reference_twin.layout_weights(hall, np.ones(hall.racks))
    assert_close(layout_weights(hall).dense(), expected, 1e-12, "weights", scale=1.0)
    assert np.all(expected > 0) == (cutoff == 0)


@pytest.mark.parametrize("shape", [(4, 5), *MERGED, *LONG])
def test_paths_of_many_decay_lengths_leave_weights(shape: tuple[int, int]) -> None:
    # The shortest decay length that is valid: exp(-path / decay) is below any number.
    values = random_values(np.random.default_rng(7), "dc", shape, even=True)
    values["hall"]["recirculation"] = {"decay_m": 0.01}
    config = config_from_dict(values)
    dense = layout_weights(config.hall).dense()
    assert_close(dense.sum(axis=1), np.ones(config.hall.racks), 1e-12, "rows sum to 1")


def test_a_cutoff_that_leaves_no_source_is_refused() -> None:
    for shape, cutoff in (((10, 100), 0.01), ((200, 500), 1e-4)):
        values = random_values(np.random.default_rng(8), "dc", (10, 100), even=True)
        values["hall"] |= {
            "rows": shape[0], "racks_per_row": shape[1], "layout": {},
            "supply_approach_k": 5.0, "return_approach_k": -3.0,
            "recirculation": {"decay_m": 50.0, "cutoff": cutoff},
        }  # fmt: skip
        values["hvac"]["crac"]["unit_shares"] = None
        hall = config_from_dict(values).hall
        with pytest.raises(ConfigError, match="without any source: their largest") as error:
            layout_weights(hall)
        assert f"hall.recirculation.cutoff {cutoff:g} with decay_m 50" in str(error.value)
        largest = float(str(error.value).split("weight is ")[1].split(";")[0])
        if shape == (10, 100):
            smaller = hall.recirculation.model_copy(update={"cutoff": 0.5 * largest})
            weights = layout_weights(hall.model_copy(update={"recirculation": smaller}))
            assert np.all(np.isfinite(weights.norm))


def test_more_weights_than_fit_are_refused() -> None:
    values = random_values(np.random.default_rng(8), "dc", (1, 2), even=True)
    values["hall"] |= {
        "rows": 400, "racks_per_row": 2000, "layout": {}, "supply_approach_k": 5.0,
        "return_approach_k": -3.0, "recirculation": {"cutoff": 0.0},
    }  # fmt: skip
    values["hvac"]["crac"]["unit_shares"] = None
    with pytest.raises(ConfigError, match=r"keeps 6.39e.09 weights for 800,000 racks; valid is at"):
        layout_weights(config_from_dict(values).hall)


@settings(phases=AS_FOUND, max_examples=20)
@given(seed=SEEDS)
def test_recirculation_takes_less_than_there_is(seed: int) -> None:
    rng = np.random.default_rng(seed)
    flows = calibrate(random_hall(rng, "dc", SMALL[int(rng.integers(len(SMALL)))]))
    matrix = flows.matrix()
    assert np.all(matrix >= 0)
    assert np.all(matrix.sum(axis=1) <= 1.0)
    assert np.all((flows.group_exhaust_share >= 0) & (flows.group_exhaust_share < 1))
    assert np.max(np.abs(np.linalg.eigvals(matrix))) < 1.0
    airflow = flows.design.airflow_m3s
    assert np.all(airflow - matrix.T @ airflow >= 0), "a rack gives more air than it exhausts"
