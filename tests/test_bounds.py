"""Bounds of inputs: every number has both, and what no machine can do is refused."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from pydantic import BaseModel
from typer.testing import CliRunner

from sdc_taichi import (
    Actions,
    ConfigError,
    DataCenterConfig,
    DataError,
    EndedBy,
    EnvOptions,
    SdcError,
    Simulator,
    aec_env,
    drivers_from_arrays,
    load_config,
    make_configs,
    parallel_env,
    simulate,
    vector_env,
)
from sdc_taichi.cli.app import app
from sdc_taichi.config.odd_values import odd_values
from sdc_taichi.control import make_controller, view_maker
from sdc_taichi.envs.core import REWARD_BEYOND_LIMITS
from sdc_taichi.envs.vector import SdcVectorEnv
from sdc_taichi.errors import OddInputWarning, PhysicalLimitError
from sdc_taichi.exogenous.series import Series, Weather
from sdc_taichi.sim.fleet import build_fleet
from sdc_taichi.sim.hall_state import Conditions
from sdc_taichi.sim.physical_limits import LIMITS
from simulated import assert_same, part_of

BOUNDS = (("minimum", "exclusiveMinimum"), ("maximum", "exclusiveMaximum"))


def numbers(schema: Any, path: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Path and schema of every number in a JSON schema."""
    if isinstance(schema, dict):
        if schema.get("type") in ("number", "integer"):
            yield path, schema
        for key, value in schema.items():
            yield from numbers(value, f"{path}.{key}")
    elif isinstance(schema, list):
        for index, value in enumerate(schema):
            yield from numbers(value, f"{path}.{index}")


@pytest.mark.parametrize("model", [DataCenterConfig, EnvOptions])
def test_every_number_has_bounds_at_both_ends(model: type[BaseModel]) -> None:
    by_path = dict(numbers(model.model_json_schema()))
    assert len(by_path) > 5
    without = [
        path
        for path, schema in by_path.items()
        if not all(any(name in schema for name in names) for names in BOUNDS)
    ]
    assert without == [], "fields take a type of config/fields.py, or Field(ge=..., le=...)"


@pytest.mark.parametrize(
    ("preset", "override"),
    [
        ("tiny", "hvac.chiller.reference_cop=1e-12"),
        ("tiny", "hvac.chiller.reference_cop=1000"),
        ("tiny", "hvac.pumps.efficiency=1e-30"),
        ("tiny", "hvac.crac.supply_m3s_per_w=1e-30"),
        ("corrected", "hvac.crac.coasting_flow_ratio=1e-6"),
        ("corrected", "servers.power_w=[0.2, 0.06]"),
        ("corrected", "servers.power_w=[1e308, 1e308]"),
        ("corrected", "hall.layout.rack_pitch_m=1e-300"),
        ("tiny", "servers.groups.0.0.full_w=1e9"),
        ("tiny", "hall.supply_approach_k=[5, 5, 5, 400]"),
        ("tiny", "servers.inlet_range_c=[60, 82]"),
        ("tiny", "hvac.setpoint.max_c=73"),
        ("tiny", "hall.air_density_kg_m3=1225"),
        ("tiny", "hvac.sizing.design_wet_bulb_c=95"),
        ("tiny", "battery.charge_efficiency=97"),
        ("tiny", "simulation.steps_per_hour=3600"),
    ],
)
def test_what_no_machine_can_do_is_refused(preset: str, override: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(preset, [override])
    field = override.partition("=")[0]
    assert field in str(caught.value)
    assert "should be" in str(caught.value)


@pytest.mark.parametrize(
    ("preset", "overrides", "message"),
    [
        (
            "tiny",
            ["hvac.sizing.design_outdoor_c=30", "hvac.sizing.design_wet_bulb_c=31"],
            "design_wet_bulb_c 31 must not be above",
        ),
        (
            "corrected",
            ["servers.power_w=[1600, 20]"],
            "rack 0 has servers of 320 kW; valid is at most 200 kW",
        ),
        ("corrected", ["hall.capacity_mw=5"], r"rack 0 has servers of 306\.9 kW"),
        *(
            ("tiny", [f"events.{name}=[{{kind: heat_wave, {when}, offset_k: {offset_k}}}]"],
             rf"events\.{name}\.0\.offset_k")
            for name, when in (
                ("scheduled", "start_h: 1, duration_h: 2"),
                ("sampled", "per_year: 1, duration_h: [2, 3]"),
            )
            for offset_k in (-300, 1e6)
        ),
    ],
)  # fmt: skip
def test_what_nature_does_not_do_is_refused(
    preset: str, overrides: list[str], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        load_config(preset, overrides)


@pytest.mark.parametrize(
    ("override", "part"),
    [
        ("servers.power_w=[8, 2]", "a server of 8 W at full load; power is in W, not in kW"),
        ("servers.power_w=[400, 40]", "rack 0 has servers of 80 kW"),
        ("hvac.chiller.reference_cop=20", "reference_cop 20"),
        ("hvac.setpoint.max_c=40", "max_c 40: supply air is usually 10..35 C"),
        ("hall.design_supply_c=40", "design_supply_c 40: supply air is usually 10..35 C"),
        ("hvac.pumps.efficiency=0.1", "efficiency 0.1"),
        ("electrical.grid_limit_ratio=0.4", "electrical.grid_limit_ratio 0.4"),
    ],
)
def test_what_is_odd_is_warned_of_once(override: str, part: str) -> None:
    chiller = [] if "chiller" in override else ["hvac.chiller.model=eir_york"]
    first = load_config("corrected", [override, *chiller])
    again = [first.model_copy(update={"name": name}) for name in "ab"]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        build_fleet([first, *again])
    assert [w.category for w in caught] == [OddInputWarning]
    assert str(caught[0].message).startswith("corrected and 2 more: ")
    assert part in str(caught[0].message)


@pytest.mark.parametrize(("design_c", "odd"), [(17, False), (40, True)])
def test_design_air_is_of_the_supply_where_setpoints_are_of_the_return(
    design_c: float, odd: bool
) -> None:
    overrides = ["hvac.crac.temperature_control=return", f"hall.design_supply_c={design_c}",
             "hvac.setpoint={min_c: 28, max_c: 38, initial_c: 33}"]  # fmt: skip
    messages = [*odd_values(load_config("corrected", overrides))]
    assert any("design_supply_c" in text for text in messages) == odd


def test_a_result_beyond_physics_ends_the_run_and_changes_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(LIMITS, "it_w", (0.0, 1.0))
    with Simulator([load_config("tiny")] * 2) as sim:
        sim.reset()
        before = sim.state
        with pytest.raises(PhysicalLimitError, match=r"^tiny: it_w is .* in step 0; physical is"):
            sim.step()
        assert sim.state is before


UNIT_DOWN = ["hvac.crac.coasting_flow_ratio=0.01", "servers.curve_limit_c=null",
             "events.scheduled=[{kind: crac_down, start_h: 0.5, duration_h: 1}]"]  # fmt: skip
RACK_3 = "{kind: rack_fan_failure, rack: 3, start_h: %g, duration_h: 0.5, share: 0.01}"

FORMS: dict[str, Callable[..., Any]] = {
    "single": partial(gymnasium.make, "sdc_taichi/Joint-v0"),
    "parallel": parallel_env,
    "aec": aec_env,
    "batch": partial(gymnasium.make_vec, "sdc_taichi/Joint-v0", num_envs=1),
    "batch SameStep": partial(
        gymnasium.make_vec, "sdc_taichi/Joint-v0", num_envs=1, autoreset_mode="SameStep"
    ),
    "agents": partial(vector_env, 1),
}


@pytest.mark.parametrize("form", FORMS)
def test_an_episode_terminates_at_a_limit(form: str) -> None:
    overrides = [f"events.scheduled=[{RACK_3 % 0.25}]"]
    env: Any = FORMS[form](config="corrected", days=1, overrides=overrides)
    first: Any = env.reset(seed=0)
    if form == "aec":
        first = None, env.infos
    infos = [first[1]]
    ends: list[Any] = []
    for _ in range(2):
        if form == "aec":
            for agent in list(env.agents):
                env.step(env.action_space(agent).sample())
            ends.append((env.rewards, env.terminations, env.truncations))
            infos.append(env.infos)
            continue
        if form in ("parallel", "agents"):
            actions = {a: env.action_space(a).sample() for a in env.agents}
            if form == "agents":
                actions = {a: np.array([action]) for a, action in actions.items()}
        else:
            actions = env.action_space.sample()
        _, *end, info = env.step(actions)
        ends.append(end)
        infos.append(info)

    def values(of: Any) -> set[float]:
        return set(np.ravel([*of.values()] if isinstance(of, dict) else of).tolist())

    assert all(values(end[1]) == values(end[2]) == {False} for end in ends[:1])
    rewards, terminated, truncated = ends[1]
    assert (values(rewards), values(terminated)) == ({REWARD_BEYOND_LIMITS}, {True})
    assert values(truncated) == {False}
    if form in ("parallel", "aec"):
        infos = [info["agent_ls"] for info in infos]
    if form == "batch SameStep":
        infos[-1] = infos[-1]["final_info"]
    reasons = [np.ravel(info["ended_by"]).tolist() for info in infos]
    assert reasons == [[EndedBy.NOT_ENDED], [EndedBy.NOT_ENDED], [EndedBy.PHYSICAL_LIMITS]]
    assert [*infos[0]] == [*infos[1]] == [*infos[2]]
    env.reset(seed=1)
    env.close()


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_one_episode_of_a_batch_terminates_and_the_others_go_on(mode: str) -> None:
    good = load_config("corrected", ["name=a"])
    bad = load_config("corrected", ["name=b", f"events.scheduled=[{RACK_3 % 0.25}]"])
    actions = np.random.default_rng(0).integers(0, 3, (96, 3, 3))
    runs: list[Any] = []
    for configs in ([good, bad, good], [good, good, good]):
        env = SdcVectorEnv(3, configs, days=1, autoreset_mode=mode)
        first: Any = env.reset(seed=5)[0]
        played = [env.step(action) for action in actions]
        observed = np.array([first, *(each[0] for each in played)])
        flags = (np.array([each[k] for each in played]) for k in (1, 2, 3))
        runs.append((observed, *flags, played))
        env.close()
    (seen, rewards, terminated, truncated, steps), expected = runs
    for ours, others in zip((seen, rewards, terminated, truncated), expected, strict=False):
        np.testing.assert_array_equal(ours[:, [0, 2]], others[:, [0, 2]])
    reasons = {"NextStep": [1], "SameStep": [1, 2], "Disabled": range(1, 96)}[mode]
    assert np.flatnonzero(terminated[:, 1]).tolist() == [*reasons]
    assert rewards[1, 1] == REWARD_BEYOND_LIMITS
    assert truncated[-1].tolist() == [True, mode != "Disabled", True]
    if mode == "NextStep":
        assert rewards[2, 1] == 0.0
    if mode == "SameStep":
        info = steps[1][-1]
        assert info["_final_obs"].tolist() == [False, True, False]
        assert (info["final_obs"][0], info["final_obs"][1].shape) == (None, seen[0, 0].shape)
        assert info["final_info"]["ended_by"][1] == EndedBy.PHYSICAL_LIMITS
        assert info["ended_by"].tolist() == [0, 0, 0]
    assert np.all(np.isfinite(seen))
    assert np.all(np.isfinite(rewards))


def test_servers_without_air_end_the_run() -> None:
    still = [f"servers.fan_airflow_ratio_{end}=[1e-6, 1]" for end in ("lb", "ub")]
    still += ["name=still", "servers.fan_airflow_ratio_limits=null"]
    idle = drivers_from_arrays([20.0], [15.0], [300.0], [0.0], size=2)
    with Simulator([load_config("tiny"), load_config("tiny", still)], drivers=idle) as sim:
        sim.reset()
        with pytest.raises(PhysicalLimitError, match=r"^still: outlet_mean_c is .* in step 0; "):
            sim.step()


HOT = [
    "hvac.tower.economiser=false",
    "servers.heat_capacity_kj_per_k=0.5",
    "hall.room_heat_capacity_kj_per_k_per_server=0.5",
    "hvac.pumps.efficiency=0.1",
    "events.scheduled=[{kind: chiller_derate, share: 0, start_h: 0.5, duration_h: 9}]",
]


def test_a_run_that_ends_at_a_limit_keeps_the_steps_before(tmp_path: Path) -> None:
    out = tmp_path / "run"
    done = CliRunner().invoke(
        app, ["simulate", "tiny", *HOT, "--days", "1", "--quiet", "--out", str(out)]
    )
    assert done.exit_code == 2
    warning, error = done.stderr.splitlines()
    assert ": hvac.pumps.efficiency 0.1: even small pumps" in warning
    steps = json.loads((out / "metrics.json").read_text())["steps_done"]
    assert 2 < steps < 20
    assert re.match(rf"error: \w+: [a-z].* is .* in step {steps}; physical is", error)
    assert error.endswith(f"{out} holds the {steps} steps before")


def test_the_outlet_of_a_rack_has_a_limit_too() -> None:
    failure = "{kind: rack_fan_failure, rack: 3, start_h: 0, duration_h: 9, share: 0.01}"
    changes = ["name=b", f"events.scheduled=[{failure}]"]
    with Simulator([load_config("corrected"), load_config("corrected", changes)]) as sim:
        sim.reset()
        with pytest.raises(PhysicalLimitError, match=r"^b: outlet of rack 3 is .* C in step 0; "):
            sim.step()


def test_air_that_finds_no_steady_state_ends_the_run_in_a_step_that_is_named() -> None:
    down = "events.scheduled=[{kind: crac_down, start_h: 0.25, duration_h: 9}]"
    changes = ["hvac.crac.coasting_flow_ratio=0.01", "servers.curve_limit_c=null", down]
    with Simulator(load_config("corrected", changes)) as sim:
        sim.reset()
        sim.step()
        cause = r"CRAC units move 0\.\d+ m3/s, the most in this step, and the racks draw \d\.\d"
        message = rf"^corrected: no steady .*{cause}.* \(step 1\)$"
        with pytest.raises(PhysicalLimitError, match=message):
            sim.step()


@pytest.mark.parametrize(
    ("common", "impossible", "limit_c", "flagged"),
    [
        ([], UNIT_DOWN, 400.0, [2, 3, 4, 5]),
        ([], [f"events.scheduled=[{RACK_3 % 0.5}]"], 400.0, [2, 3]),
        ([], [f"events.scheduled=[{RACK_3 % 0.0}]"], 400.0, [0, 1]),
        (["simulation.thermal=transient"], [f"events.scheduled=[{RACK_3 % 0.5}]"], 40.0, [2, 3]),
    ],
)
def test_one_hall_beyond_its_limits_keeps_its_last_air_and_stops_no_other(
    common: list[str],
    impossible: list[str],
    limit_c: float,
    flagged: list[int],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("sdc_taichi.sim.simulator.AIR_LIMITS_C", (-100.0, limit_c))
    a, c = (load_config("corrected", [f"name={name}", *common]) for name in "ac")
    b = load_config("corrected", ["name=b", *common, *impossible])
    without = b.model_copy(update={"events": a.events})
    configs, others = [a, b, c], [a, without, c]
    with Simulator(configs, limits="flag") as sim, Simulator(others) as twin:
        sim.reset(seed=0)
        twin.reset(seed=0)
        results = [sim.step() for _ in range(8)]
        expected = [twin.step() for _ in range(8)]
        layers = sim.servers()
    for index in (0, 2):
        assert_same(
            [part_of(result, configs, index) for result in results],
            [part_of(result, others, index) for result in expected],
        )
    within = np.array([result.within_limits for result in results])
    assert np.flatnonzero(within[:, 1] == 0.0).tolist() == flagged
    assert np.all(within[:, [0, 2]] == 1.0)
    for result in results:
        assert all(np.all(np.isfinite(getattr(result, f.name))) for f in fields(result))
    assert np.all(np.isfinite([layers.inlet_c, layers.outlet_c, layers.power_w]))
    before = results[flagged[0] - 1] if flagged[0] else None
    for step in flagged:
        held = part_of(results[step], configs, 1)
        if before is None:
            assert np.all(held.rack_outlet_c == held.supply_c)
            assert held.it_w == 0.0
        else:
            last = part_of(before, configs, 1)
            np.testing.assert_array_equal(held.rack_outlet_c, last.rack_outlet_c)
            np.testing.assert_array_equal(held.it_w, last.it_w)


def test_transient_halls_without_a_steady_state_can_be_reset() -> None:
    changes = ["simulation.thermal=transient", "servers.curve_limit_c=null"]
    with Simulator(load_config("corrected", changes), limits="flag") as sim:
        sim.reset()
        hall = sim._started().hall
        still = np.full(sim.fleet.units, 1e-3)
        state = hall.steady_state(
            Conditions(np.full(sim.fleet.units, 20.0), np.ones(1), unit_low=still, unit_high=still)
        )
    np.testing.assert_array_equal(state.server_c, np.float32(20.0))


def test_unknown_treatment_of_limits_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"^limits 'ignore': valid are raise and flag$"):
        Simulator(load_config("tiny"), limits="ignore")  # type: ignore[arg-type]


def test_an_event_starts_before_the_end_of_the_run() -> None:
    event = "events.scheduled=[{kind: grid_outage, start_h: 24, duration_h: 1}]"
    config = load_config("tiny", [event])
    with Simulator(config) as sim:
        with pytest.raises(ConfigError, match=r"tiny: events\.scheduled\.0\.start_h 24: the run"):
            simulate(sim, make_controller("idle", sim.fleet), 96)
        simulate(sim, make_controller("idle", sim.fleet), 97)
    with pytest.raises(ConfigError, match=r"events\.scheduled\.0\.start_h 24: the episode ends"):
        parallel_env(config, days=1)


def test_weather_is_one_of_a_place_on_earth() -> None:
    def weather(low: float, high: float) -> Weather:
        values = np.linspace(low, high, 8760)
        series = Series(values, 60.0, "outdoor_c", "C", "x.epw", synthetic=False)
        return Weather("X", 0.0, 0.0, 0.0, 0.0, outdoor_c=series, wet_bulb_c=series)

    weather(-68.0, 37.0)
    with pytest.raises(DataError, match=r"x\.epw: mean dry bulb 50\.0 C.*Fahrenheit"):
        weather(42.0, 58.0)
    with pytest.raises(DataError, match=r"differ by 120\.0 K"):
        weather(-70.0, 50.0)
    year = [20.0], [15.0], [300.0], [0.5]
    drivers_from_arrays(*year)
    with pytest.raises(DataError, match=r"outdoor_c of data center 0 at step 0 is 68"):
        drivers_from_arrays([68.0], *year[1:])
    with pytest.raises(DataError, match=r"ci_g_per_kwh .* is 5000"):
        drivers_from_arrays(*year[:2], [5000.0], year[3])


@pytest.mark.parametrize(
    "values",
    [
        ["battery.capacity_kwh=0"],
        ["workload.flexible_share=0", "workload.queue_limit_h=0.001"],
        ["servers.power_w=[150, 0]"],
        ["hall.layout.containment=1", "hall.rows=1", "hall.racks_per_row=2"],
    ],
    ids=" ".join,
)
def test_odd_but_valid_halls_run(values: list[str]) -> None:
    base = ["hall.supply_approach_k=4", "hall.return_approach_k=-3", "servers.power_w=[150, 10]"]
    with Simulator(load_config("corrected", base + values)) as sim:
        sim.reset(0)
        for command in (-1.0, 1.0):
            sim.step(Actions(load=command, cooling=command, battery=-command))


@pytest.mark.parametrize("bad", [-1, 2.5, True, "3", 10**18])
def test_numbers_of_steps_copies_and_environments_have_bounds(bad: Any) -> None:
    config = load_config("tiny")
    with pytest.raises(ConfigError, match=r"fleet: count .*whole number of 1"):
        make_configs(config, count=bad)
    with pytest.raises(ConfigError, match=r"num_envs .*whole number of 1"):
        vector_env(bad, config)
    with Simulator(config) as sim:
        controller = make_controller("idle", sim.fleet)
        with pytest.raises(ConfigError, match=r"steps .*whole number of 0"):
            simulate(sim, controller, bad)


@pytest.mark.parametrize("days", ["40000", "1e300", "inf"])
def test_a_run_ends_within_a_century(days: str) -> None:
    done = CliRunner().invoke(app, ["simulate", "tiny", "--days", days])
    assert done.exit_code == 2
    assert "at most 36,500" in done.stderr


def test_commands_and_forecasts_have_bounds() -> None:
    with Simulator(load_config("tiny")) as sim:
        sim.reset()
        with pytest.raises(SdcError, match=r"action cooling: 1e\+300; valid"):
            sim.step(Actions(cooling=1e300))
        view = view_maker(sim)(None)
        for hours in (np.nan, np.inf, -1.0, 0.1, 1e9):
            with pytest.raises(ConfigError, match=r"valid is 0\.25\.\.8,760 h"):
                view.forecast(hours)
        with pytest.raises(ConfigError, match="start"):
            sim.reset(start=np.array([2**62]))
