"""Controllers that are not learned: rules, registry, and what they may see."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from policies import policy
from sdc_taichi import (
    Actions,
    ConfigError,
    DataCenterConfig,
    Drivers,
    Fleet,
    Simulator,
    StepResult,
    build_fleet,
    drivers_from_arrays,
    load_config,
    make_configs,
    with_values,
)
from sdc_taichi.control import (
    Controller,
    View,
    commands_of,
    controller_names,
    make_controller,
    parts_of,
    register_controller,
    registry,
    trim_and_respond,
    view_maker,
)
from sdc_taichi.control.hall_rules import HALL_RULES
from sdc_taichi.control.registry import RULE_OF_AGENT, RULES
from sdc_taichi.control.rules import FixedSetpoint, rank_command, slots_in_step
from sdc_taichi.envs.options import make_options
from sdc_taichi.learning.interface import interface_of
from sdc_taichi.run.loop import simulate

CHECKS = json.loads((Path(__file__).parent / "reference" / "physics_checks.json").read_text())
TRIM = next(c for c in CHECKS["checks"] if c["id"] == "G36-TR")
TINY = load_config("tiny")
SITES = ("ny", "ca", "az")


def fleet_of(count: int, **changes: Any) -> list[DataCenterConfig]:
    return make_configs(load_config("tiny", **changes), count=count, sites=SITES[:count])


@pytest.fixture
def sim() -> Iterator[Simulator]:
    with Simulator(fleet_of(3)) as made:
        made.reset(0)
        yield made


def results(sim: Simulator, controller: Controller, steps: int, seed: int = 0) -> list[StepResult]:
    kept: list[StepResult] = []
    simulate(sim, controller, steps, seed, on_step=kept.append)
    return kept


def one_with(ci: np.ndarray) -> tuple[DataCenterConfig, Drivers]:
    n = len(ci)
    return TINY, drivers_from_arrays(np.full(n, 20.0), np.full(n, 15.0), ci, np.full(n, 0.5))


class AlwaysCharge:
    """A controller of a user's own."""

    commands = ("battery",)

    def __init__(self) -> None:
        self.steps = 0

    def reset(self, seed: Any) -> None:
        self.steps = 0

    def act(self, view: View) -> Actions:
        self.steps += 1
        return Actions(battery=1.0)


def make_setpoint(text: str, fleet: Fleet, parts: tuple[str, ...]) -> Controller:
    """A maker of a user's own, with a text."""
    assert fleet.size == 3
    assert parts == ("cooling",)
    return FixedSetpoint(float(text))


# Trim and respond


@pytest.mark.parametrize("steps_per_hour", [1, 2, 3, 4, 5, 6, 10, 12, 15, 20, 30, 60])
def test_twelve_slots_an_hour_whatever_the_step(steps_per_hour: int) -> None:
    slots = [slots_in_step(step, 1 / steps_per_hour) for step in range(3 * steps_per_hour)]
    assert sum(slots) == 36
    assert max(slots) - min(slots) <= 1


@pytest.mark.parametrize("model", ["symmetric", "accelerating"])
def test_g36_trims_up_without_requests_at_the_same_rate_under_any_model(model: str) -> None:
    config = load_config("tiny", [f"hvac.setpoint.model={model}"])
    with Simulator(config) as sim:
        setpoints = [float(r.setpoint_c[0]) for r in results(sim, g36(sim), 9)]
    assert setpoints == pytest.approx([18.0 + 0.3 * (i + 1) for i in range(9)])


def test_g36_lowers_the_setpoint_when_more_than_two_racks_are_hot() -> None:
    config = load_config("tiny", ["hvac.setpoint.initial_c=23", "hall.supply_approach_k=5"])
    with Simulator(config) as sim:
        kept = results(sim, g36(sim), 60)
    hot = np.array([np.count_nonzero(r.rack_inlet_max_c > 27.0) for r in kept])
    moved = np.diff([23.0, *(float(r.setpoint_c[0]) for r in kept)])
    assert hot[0] == 4
    for requests, change in zip(hot[:-1], moved[1:], strict=True):
        counted = max(requests - 2, 0)
        slot = 0.1 + max(-0.6, -0.2 * counted)
        assert change == pytest.approx(3 * slot, abs=1e-9)
    assert {0.3, -0.9} <= set(np.round(moved, 6))


def test_g36_counts_the_racks_of_each_data_center() -> None:
    with Simulator(fleet_of(2)) as sim:
        sim.reset(0)
        look, last = view_maker(sim), sim.step()
        racks = np.where(sim.fleet.rack_dc == 0, 26.0, 28.0)
        hot = replace(last, rack_inlet_max_c=racks)
        command = np.asarray(g36(sim).act(look(hot)).cooling)
    assert command == pytest.approx([0.3, 3 * (0.1 - 0.4)])


def g36(sim: Simulator) -> Controller:
    return make_controller("g36", sim.fleet)


# Other rules


def test_random_is_reproducible_and_independent_of_the_batch() -> None:
    def drawn(count: int, seed: int, steps: int = 600) -> np.ndarray:
        with Simulator(fleet_of(count)) as sim:
            kept = results(sim, make_controller("random", sim.fleet), steps, seed)
        return np.array([[r.load_command, r.cooling_command, r.battery_command] for r in kept])

    three = drawn(3, 7)
    assert np.array_equal(drawn(3, 7), three)
    assert np.array_equal(drawn(1, 7)[..., 0], three[..., 0])
    assert not np.array_equal(drawn(1, 8)[..., 0], three[..., 0])
    assert not np.array_equal(three[..., 0], three[..., 1])
    expected = np.random.Generator(np.random.PCG64(np.random.SeedSequence([7, 1])))
    assert np.array_equal(three[:256, :, 1], expected.integers(-1, 2, size=(256, 3)))
    values, counts = np.unique(three, return_counts=True)
    assert values.tolist() == [-1.0, 0.0, 1.0]
    assert counts == pytest.approx(np.full(3, three.size / 3), rel=0.1)


@pytest.mark.parametrize("model", ["symmetric", "accelerating"])
@pytest.mark.parametrize(
    ("name", "setpoint_c"), [("coldest", 16.0), ("warmest", 23.0), ("constant:19.5", 19.5)]
)
def test_fixed_setpoints_are_reached_at_once_and_kept(
    name: str, setpoint_c: float, model: str
) -> None:
    with Simulator(load_config("tiny", [f"hvac.setpoint.model={model}"])) as sim:
        kept = results(sim, make_controller(name, sim.fleet), 12)
    assert [float(r.setpoint_c[0]) for r in kept] == [setpoint_c] * 12
    assert not any(np.any(r.load_command) or np.any(r.battery_command) for r in kept)


def test_quarters_of_a_window() -> None:
    rising = np.arange(12.0)
    rows = [rising, rising[::-1], np.ones(12), np.r_[5.0, np.zeros(6), np.full(5, 9.0)]]
    assert rank_command(np.array(rows), 0.25).tolist() == [1.0, -1.0, 0.0, 0.0]
    # Two of eight are lower: no longer in the lowest quarter.
    assert rank_command(np.array([[2.0, 0, 1, 3, 3, 3, 3, 3]]), 0.25).tolist() == [0.0]
    assert rank_command(np.array([[2.0, 0, 3, 3, 3, 3, 3, 3]]), 0.25).tolist() == [1.0]


@pytest.mark.parametrize("name", ["lookahead-3h", "lookahead-24h"])
def test_lookahead_saves_carbon_by_the_battery_alone(name: str) -> None:
    emitted = {}
    with Simulator(fleet_of(3)) as sim:
        for controller in ("idle", name):
            kept = results(sim, make_controller(controller, sim.fleet), 14 * 96)
            emitted[controller] = np.sum([r.carbon_g for r in kept], axis=0)
            assert not any(np.any(r.load_command) or np.any(r.cooling_command) for r in kept)
    # A rule of thumb: a single site can lose over some weeks, as a full battery outlasts a peak.
    assert emitted[name].sum() < 0.995 * emitted["idle"].sum()


@pytest.mark.parametrize(
    ("wave_g", "trades"), [(0.0, False), (10.0, False), (100.0, True)], ids=["flat", "low", "high"]
)
def test_lookahead_trades_only_for_more_than_the_battery_loses(wave_g: float, trades: bool) -> None:
    hours = np.arange(4 * 96) / 4
    config, drivers = one_with(300.0 + wave_g * np.sin(2 * np.pi * hours / 24))
    with Simulator(config, drivers=drivers) as sim:
        kept = results(sim, make_controller("lookahead-24h", sim.fleet), 200)
    assert any(np.any(r.battery_command) for r in kept) is trades


def test_rank_ranks_work_and_battery_by_the_objective() -> None:
    with Simulator(load_config("corrected", ["site.location=CA"])) as sim:
        sim.reset()
        views = view_maker(sim)
        controllers = {
            name: make_controller(name, sim.fleet)
            for name in (
                "rank-24h:0.3",
                "rank-24h:0.3:cost",
                "battery=rank-24h:0.25",
                "lookahead-24h",
            )
        }
        result = None
        for _ in range(96):
            view = views(result)
            acts = {name: controller.act(view) for name, controller in controllers.items()}
            forecast = view.forecast(24)
            for name, values in (
                ("rank-24h:0.3", forecast.ci_g_per_kwh),
                ("rank-24h:0.3:cost", forecast.price_per_kwh),
            ):
                assert acts[name].load == rank_command(values, 0.3)
                assert acts[name].battery in (0.0, acts[name].load)
            assert acts["battery=rank-24h:0.25"].battery == acts["lookahead-24h"].battery
            assert (
                acts["lookahead-24h"].load == acts["battery=rank-24h:0.25"].load == Actions().load
            )
            result = sim.step(acts["rank-24h:0.3"])


@pytest.mark.parametrize(
    "name", ["rank-24h:0.6", "rank-0h", "rank-h", "rank-24h:0.3:water", "rank-24h:0.3:nothing"]
)
def test_rank_refuses_what_it_cannot_rank(name: str) -> None:
    with Simulator(load_config("tiny")) as sim, pytest.raises(ConfigError, match="valid"):
        make_controller(name, sim.fleet)
    with Simulator(load_config("tiny")) as sim, pytest.raises(ConfigError, match="not act on cool"):
        make_controller("cooling=rank-24h", sim.fleet)


def test_rules_stand_for_a_rule_for_each_agent() -> None:
    with Simulator(load_config("tiny")) as sim:
        sim.reset()
        view = view_maker(sim)(None)
        spec = ",".join(f"{agent}={name}" for agent, name in RULE_OF_AGENT.items())
        acts = [make_controller(name, sim.fleet).act(view) for name in (RULES, spec)]
        alone = make_controller("load=rules", sim.fleet).act(view)
        with pytest.raises(ConfigError, match="'rules': does not act on geo; valid for geo"):
            make_controller("geo=rules", sim.fleet)
    assert acts[0] == acts[1]
    assert {*parts_of(RULES)} == {"load", "cooling", "battery"}
    assert alone == Actions(load=acts[0].load)


def test_greedy_follows_the_mean_of_the_coming_day() -> None:
    ci = np.r_[np.full(96, 500.0), np.full(192, 100.0), np.full(192, 500.0)]
    config, drivers = one_with(ci)
    with Simulator(config, drivers=drivers) as sim:
        kept = results(sim, make_controller("greedy-ci", sim.fleet), 480)
    command = np.array([float(r.load_command[0]) for r in kept])
    assert np.array_equal(command, [float(r.battery_command[0]) for r in kept])
    # High before the drop defers; low before the rise drains; a constant window moves nothing.
    assert command[1:96].tolist() == [-1.0] * 95
    assert command[192 + 1 : 288].tolist() == [1.0] * 95
    assert command[96:192].tolist() == [0.0] * 96
    assert kept[95].queue_tasks[0] > 0
    assert kept[-1].queue_tasks[0] == 0


# What a controller sees


def test_forecast_is_what_comes_also_over_the_turn_of_the_year() -> None:
    configs = fleet_of(3, overrides=["site.start=12-31"])
    configs[1] = load_config("tiny", ["name=other", "site.location=CA", "site.start=06-01"])
    with Simulator(configs) as sim:
        sim.reset(0)
        for _ in range(5):
            last = sim.step()
        forecast = view_maker(sim)(last).forecast(30.0)
        coming = [sim.step() for _ in range(120)]
    for name in ("ci_g_per_kwh", "outdoor_c", "wet_bulb_c"):
        seen = np.array([getattr(r, name) for r in coming]).T
        assert np.array_equal(getattr(forecast, name), seen), name


# Names


@pytest.mark.parametrize("name", controller_names())
def test_every_name_runs(name: str, sim: Simulator, tmp_path: Path) -> None:
    if name == "policy:FOLDER":
        policy(interface_of(sim.fleet, make_options())).save(tmp_path)
    names = name.replace(":C", ":20").replace("FOLDER", str(tmp_path))
    if name.startswith("liquid-"):
        with pytest.raises(ConfigError, match="no liquid-cooled racks; valid with section liquid"):
            make_controller(name, sim.fleet)
        return
    if name.startswith("geo-"):
        with pytest.raises(ConfigError, match="data centers share no work; valid with a config"):
            make_controller(name, sim.fleet)
        sites = {"fleet": {"sites": ["AZ", "WA"]}, "workload.flexible_share": 0.5}
        with Simulator(with_values(TINY, sites)) as fleet:
            sent = simulate(fleet, make_controller(name, fleet.fleet), 8, 1).sums["sent_tasks"]
            assert sent.sum() > 0
        return
    if name in HALL_RULES:
        with pytest.raises(ConfigError, match="commands fans, but hvac"):
            make_controller(name, sim.fleet)
        return
    controller = make_controller(names, sim.fleet)
    assert simulate(sim, controller, 8, 1).steps == 8


def test_each_agent_may_have_its_own(sim: Simulator) -> None:
    spec = "load=greedy-ci, cooling=constant:20 ,battery=random"
    mixed = results(sim, make_controller(spec, sim.fleet), 50, 4)
    alone = {
        "load_command": results(sim, make_controller("greedy-ci", sim.fleet), 50, 4),
        "cooling_command": results(sim, make_controller("constant:20", sim.fleet), 50, 4),
        "battery_command": results(sim, make_controller("random", sim.fleet), 50, 4),
    }
    for command, kept in alone.items():
        found = [getattr(r, command).tolist() for r in mixed]
        assert found == [getattr(r, command).tolist() for r in kept], command


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("g37", r"controller 'g37': unknown; valid: idle, .*did you mean 'g36'\?"),
        ("lookahead", "did you mean 'lookahead-3h'"),
        ("load=g36", "'g36': does not act on load; valid for load: idle, random, drain, greedy-ci"),
        ("battery=constant:20", "'constant:20': does not act on battery"),
        ("cool=g36", "'cool=g36': valid is agent=name .*did you mean 'cooling'"),
        ("geo=mpc-24h", "'mpc-24h': does not act on geo; valid for geo: idle, geo-all-to-cleanest"),
        ("load=idle,load=random", "load is given twice"),
        ("load=idle,", "valid is agent=name"),
        ("constant:24", r"'constant:24': valid is a setpoint of 16\.\.23 C \(hvac\.setpoint of dc"),
        ("constant:nan", r"valid is a setpoint of 16\.\.23 C"),
        ("constant", r"valid is a setpoint of 16\.\.23 C"),
        ("", "unknown; valid: idle"),
    ],
)
def test_wrong_names(spec: str, message: str) -> None:
    fleet = build_fleet(TINY.model_copy(update={"name": "dc"}))
    with pytest.raises(ConfigError, match=message):
        make_controller(spec, fleet)


def test_a_constant_must_suit_every_data_center() -> None:
    narrow = load_config("tiny", ["name=narrow", "hvac.setpoint.max_c=20"])
    with pytest.raises(ConfigError, match=r"16\.\.20 C \(hvac\.setpoint of narrow\)"):
        make_controller("constant:21", build_fleet([TINY, narrow]))


# Controllers of the user's own


@pytest.fixture
def registered() -> Iterator[None]:
    before = dict(registry._registered)
    yield
    registry._registered.clear()
    registry._registered.update(before)


@pytest.mark.usefixtures("registered")
def test_a_registered_controller_has_a_name(sim: Simulator) -> None:
    register_controller("always_charge", AlwaysCharge)
    assert "always_charge" in controller_names()
    for name in ("always_charge", "battery=always_charge", f"{__name__}:AlwaysCharge"):
        controller = make_controller(name, sim.fleet)
        assert commands_of(controller) == ("battery",)
        assert np.all(results(sim, controller, 2)[1].battery_command == 1.0)


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize("maker", [make_setpoint, f"{__name__}:make_setpoint"])
def test_a_maker_gets_the_text_after_its_name(maker: Any, sim: Simulator) -> None:
    register_controller("my_setpoint", maker)
    for name in ("my_setpoint", f"{__name__}:make_setpoint"):
        mine = results(sim, make_controller(f"cooling={name}:19.5", sim.fleet), 3)
        theirs = results(sim, make_controller("constant:19.5", sim.fleet), 3)
        assert np.array_equal(mine[2].setpoint_c, theirs[2].setpoint_c)


@pytest.mark.usefixtures("registered")
def test_a_name_is_registered_once() -> None:
    register_controller("mine", AlwaysCharge)
    register_controller("mine", AlwaysCharge)
    for name, maker in (
        ("mine", make_setpoint),
        ("idle", AlwaysCharge),
        ("policy", "module:name"),
        ("two words", AlwaysCharge),
        ("constant", AlwaysCharge),
    ):
        with pytest.raises(ConfigError, match="valid is a name that is not taken"):
            register_controller(name, maker)
    with pytest.raises(ConfigError, match="controller 'other': is a int; valid is a function"):
        register_controller("other", 3)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (f"{__name__}:AlwaysCharge:20", "AlwaysCharge takes no text"),
        (f"load={__name__}:AlwaysCharge", "does not act on load; it gives battery"),
        (
            "sdc_taichi.control:FixedSetpoint",
            "missing 1 .*a class that needs no arguments",
        ),
        (f"{__name__}:Missing", "cannot be imported .*Missing"),
        ("no_such_module:name", "unknown; valid: idle, .*or an import path module:name"),
        ("json.no_such:name", "cannot be imported"),
        ("math:pi", "valid is a function"),
        ("collections:OrderedDict", r"has no reset\(\); valid is the name of a controller, or an"),
        ("lookahead:3", "unknown"),
    ],
)
def test_import_paths_that_lead_nowhere_are_errors(spec: str, message: str, sim: Simulator) -> None:
    with pytest.raises(ConfigError, match=message):
        make_controller(spec, sim.fleet)


def test_code_that_a_file_names_is_not_run(sim: Simulator) -> None:
    with pytest.raises(ConfigError, match="is an import path, and code that a file names is not"):
        make_controller(f"{__name__}:AlwaysCharge", sim.fleet, allow_code=False)


def test_an_object_is_copied(sim: Simulator) -> None:
    mine = AlwaysCharge()
    made = make_controller(mine, sim.fleet)
    results(sim, made, 3)
    assert mine.steps == 0
    with pytest.raises(ConfigError, match=r"AlwaysCharge is a class; valid is an object of it"):
        make_controller(AlwaysCharge, sim.fleet)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"3 has no reset\(\)"):
        make_controller(3, sim.fleet)  # type: ignore[arg-type]
    mine.commands = ("batery",)
    with pytest.raises(ConfigError, match="gives 'batery'; did you mean 'battery'"):
        make_controller(mine, sim.fleet)
    mine.commands = ("battery",)
    mine.lock = threading.Lock()  # type: ignore[attr-defined]
    with pytest.raises(ConfigError, match=r"AlwaysCharge: cannot be copied .*copy\.deepcopy"):
        make_controller(mine, sim.fleet)


def test_trim_and_respond_gives_the_reference_sequence() -> None:
    inputs = TRIM["inputs"]
    names = {"trim_k": "trim", "respond_k": "res", "max_respond_k": "maxres", "ignored": "I"}
    spelled = {name: inputs[key] for name, key in names.items()}
    for parameters in ({}, spelled):
        setpoint, sequence = np.array([inputs["SP0"]]), []
        for requests in inputs["requests"]:
            setpoint = trim_and_respond(
                setpoint, [requests], low_c=inputs["SPmin"], high_c=inputs["SPmax"], **parameters
            )
            sequence.append(float(setpoint[0]))
        assert sequence == pytest.approx(TRIM["expected"]["sp"], **TRIM["tolerance"])
