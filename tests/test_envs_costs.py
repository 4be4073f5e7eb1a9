"""Costs of environments: what safe reinforcement learning holds below a limit."""

from __future__ import annotations

import re
from typing import Any

import gymnasium
import numpy as np
import pytest

import sdc_taichi
from sdc_taichi import ConfigError, SdcError, StepResult, load_config, register_cost
from sdc_taichi.control import View
from sdc_taichi.envs.agents import AGENTS
from sdc_taichi.envs.costs import COSTS, LIQUID_COSTS
from sdc_taichi.types import F64

HOT = load_config(
    "corrected",
    [
        "protection.ashrae_class=A1",
        "hvac.setpoint.initial_c=24",
        "hvac.setpoint.max_c=24",
        "events.scheduled=[{kind: crac_down, start_h: 1, duration_h: 2}]",
    ],
)
DEFER = np.array([0, 1, 1])


def grid_kwh(result: StepResult, view: View) -> F64:
    assert view.last is result
    return result.grid_kwh


def options(**more: Any) -> dict[str, Any]:
    return {"config": HOT, "days": 1, "start": "fixed", **more}


def test_costs_are_what_their_names_say() -> None:
    of_liquid = {function.__name__ for function in LIQUID_COSTS}
    names = [name for name in COSTS if not name.startswith("fleet_") and name not in of_liquid]
    env = sdc_taichi.vector_env(2, **options(costs=names))
    env.reset(seed=0)
    sums = dict.fromkeys(names, 0.0)
    for _ in range(20):
        *_, infos = env.step({a: np.array([0, 2]) for a in AGENTS})
        tasks = infos["overdue_tasks"] + infos["dropped_tasks"] + infos["lost_tasks"]
        expected = {
            "hot_inlets": infos["over_27_mean_k"] / 4,
            "hottest_inlet": np.maximum(infos["inlet_max_c"] - 27.0, 0.0) / 4,
            "throttled_racks": (infos["throttled_racks"] + infos["tripped_racks"]) / 4,
            "overdue_work": tasks,
            "grid_overload": infos["grid_overload_kwh"],
        }
        for name, values in expected.items():
            np.testing.assert_array_equal(infos[f"cost_{name}"], values, name)
            sums[name] += values.sum()
        np.testing.assert_allclose(infos["cost"], sum(expected.values()), rtol=1e-12)
        assert np.all(infos["cost"] >= 0)
    assert sums["hot_inlets"] > 0
    assert sums["throttled_racks"] > 0


def test_every_kind_of_environment_tells_the_same_costs() -> None:
    chosen = options(costs={"hot_inlets": 2.0, grid_kwh: 0.5, f"{__name__}:grid_kwh_twice": 0})
    parallel = sdc_taichi.parallel_env(**chosen)
    single: Any = gymnasium.make("sdc_taichi/Joint-v0", **chosen)
    batch: Any = gymnasium.make_vec("sdc_taichi/Joint-v0", num_envs=2, **chosen)
    for env in (parallel, single, batch):
        env.reset(seed=3)
    for _ in range(3):
        *_, infos = parallel.step(dict(zip(AGENTS, DEFER, strict=True)))
        of_single = single.step(DEFER)[4]
        of_batch = batch.step(np.array([DEFER, DEFER]))[4]
    for agent in AGENTS:
        assert infos[agent] == of_single
    names = ("cost", "cost_hot_inlets", "cost_grid_kwh", "cost_grid_kwh_twice")
    assert [name for name in of_single if name.startswith("cost")] == list(names)
    for name in names:
        assert isinstance(of_single[name], float)
        assert of_batch[name].tolist() == [of_single[name]] * 2
        assert of_batch[f"_{name}"].all()
    assert of_single["cost"] == pytest.approx(
        2 * of_single["cost_hot_inlets"] + 0.5 * of_single["grid_kwh"], rel=1e-12
    )
    assert of_single["cost_grid_kwh_twice"] == 2 * of_single["grid_kwh"] > 0


def grid_kwh_twice(result: StepResult, view: View) -> list[float]:
    return (2 * result.grid_kwh).tolist()  # type: ignore[no-any-return]


def test_costs_change_nothing_else() -> None:
    plain, with_costs = (sdc_taichi.parallel_env(**options(costs=c)) for c in (None, [grid_kwh]))
    actions = dict.fromkeys(AGENTS, 2)
    infos = [env.reset(seed=1)[1] for env in (plain, with_costs)]
    a, b = plain.step(actions), with_costs.step(actions)
    assert a[1] == b[1]
    for without, added in (infos, (a[4], b[4])):
        assert set(added["agent_dc"]) - set(without["agent_dc"]) == {"cost", "cost_grid_kwh"}
    # A state goes on with other costs.
    with_costs.load_state_dict(plain.state_dict())


def test_registered_costs() -> None:
    for factor in (1.0, 3.0):  # A notebook cell may run twice, with changes.

        def carbon_kg(result: StepResult, view: View, factor: float = factor) -> F64:
            return factor * result.carbon_g / 1e3

        register_cost("carbon_kg", carbon_kg)
    env = sdc_taichi.parallel_env(**options(costs=["carbon_kg"]))
    env.reset(seed=0)
    info = env.step(dict.fromkeys(AGENTS, 1))[4]["agent_bat"]
    assert info["cost"] == info["cost_carbon_kg"] == 3.0 * info["carbon_g"] / 1e3
    for name in ("carbon_kg", "hot_inlets", "not a name"):
        with pytest.raises(ConfigError, match=f"cost {name!r}: valid is a name that is not taken"):
            register_cost(name, grid_kwh)


WRONG: list[tuple[Any, str]] = [
    ("hot_inlets", "costs 'hot_inlets': valid is None, a list of costs, or a dict"),
    ([], "costs []: valid is None, a list"),
    (["hot_inlet"], "cost 'hot_inlet': unknown; valid: hot_inlets, hottest_inlet"),
    ([None], "cost None: unknown"),
    (["hot_inlets", "hot_inlets"], "'hot_inlets' is named twice"),
    ({"hot_inlets": -1}, "hot_inlets has weight -1; valid is a number of at least 0"),
    ({"hot_inlets": True}, "hot_inlets has weight True"),
    ({"hot_inlets": float("nan")}, "hot_inlets has weight nan"),
    ([lambda result, view: 0.0], "has no name; valid is a function with a name"),
    (["no_such_module:x"], "cost 'no_such_module:x': cannot be imported"),
    (["throttled_racks"], "throttled_racks is always 0 without protection"),
    (["grid_overload"], "grid_overload is always 0 without a limit"),
]


@pytest.mark.parametrize(("costs", "message"), WRONG)
def test_costs_that_are_not_valid(costs: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        sdc_taichi.parallel_env("paper", costs=costs)


@pytest.mark.parametrize(
    ("returned", "message"),
    [(-1.0, "cost own: returned -1; valid is at least 0"), (np.nan, "with nan"), ([1, 2], "(2,)")],
)
def test_what_a_cost_function_returns_is_checked(returned: Any, message: str) -> None:
    def own(result: StepResult, view: View) -> Any:
        return returned

    env = sdc_taichi.parallel_env(**options(costs=[own]))
    env.reset(seed=0)
    with pytest.raises(SdcError, match=re.escape(message)):
        env.step(dict.fromkeys(AGENTS, 1))
