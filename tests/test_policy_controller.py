"""Policies as controllers: the commands of their training, in runs and in environments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from policies import interface, network, policy
from sdc_taichi import (
    ConfigError,
    DataCenterConfig,
    EnvOptions,
    ForecastError,
    SdcError,
    Simulator,
    StepResult,
    build_fleet,
    load_config,
    make_configs,
    make_controller,
    simulate,
    vector_env,
)
from sdc_taichi.control import PERFECT, commands_of
from sdc_taichi.learning.controller import PolicyController
from sdc_taichi.learning.interface import interface_of
from sdc_taichi.learning.policy import About, Policy

COMMANDS = ("load_command", "cooling_command", "battery_command")
SITES = ("ny", "ca", "az")


def fleet_of() -> list[DataCenterConfig]:
    return make_configs(load_config("tiny"), sites=SITES)


def run(
    configs: Sequence[DataCenterConfig], controller: Any, steps: int, **options: Any
) -> list[StepResult]:
    """Results of a run; ``controller`` is a name, a policy or a controller."""
    kept: list[StepResult] = []
    with Simulator(build_fleet(list(configs))) as sim:
        if isinstance(controller, Policy):
            controller = PolicyController(controller, sim.fleet)
        elif isinstance(controller, str):
            controller = make_controller(controller, sim.fleet)
        simulate(sim, controller, steps, 0, on_step=kept.append, **options)
    return kept


def trained(configs: Sequence[DataCenterConfig], made: Policy, steps: int) -> list[StepResult]:
    """Results of the environments of a policy, with the actions of its networks."""
    others = {} if made.about.others == "idle" else {"others": made.about.others}
    options = made.interface.options(start="fixed", **others)
    env = vector_env(config=list(configs), options=options)
    observations, _ = env.reset(seed=0)
    kept = []
    for step in range(steps):
        if step % made.decision_steps == 0:
            shapes = {agent: space.shape or () for agent, space in env.action_spaces.items()}
            chosen = made.actions({agent: np.asarray(x) for agent, x in observations.items()})
            actions = {agent: x.reshape(len(x), *shapes[agent]) for agent, x in chosen.items()}
        transition = env.core.step(actions)
        observations = transition.observations
        kept.append(transition.result)
    env.close()
    return kept


def assert_equal(
    found: Sequence[StepResult], expected: Sequence[StepResult], names: Sequence[str] = COMMANDS
) -> None:
    for name in (*names, "carbon_g"):
        mine, theirs = ([getattr(result, name) for result in of] for of in (found, expected))
        assert np.array_equal(mine, theirs), name


def varied(results: Sequence[StepResult], name: str) -> bool:
    """Whether a command takes more than one value."""
    return len(np.unique([getattr(result, name) for result in results])) > 1


def joint() -> Policy:
    """A policy whose only network acts for all agents."""
    fits = interface()
    sizes = {f.name: f.size for agent in fits.agents for f in fits.features[agent]}
    net = network(fits.agents, sum(sizes.values()), 9, seed=5)
    return Policy((net,), fits, About(algorithm="ppo"))


def of_the_battery(others: str = "load=greedy-ci,cooling=g36") -> Policy:
    made = policy(interface(agents=("agent_bat",)), seed=2)
    return replace(made, about=About(algorithm="none", others=others))


@pytest.mark.parametrize(
    "made",
    [
        policy(interface(), seed=3),
        policy(interface(actions="continuous", setpoint_change_k=1.0), seed=3),
        policy(interface(action_order="sustaindc", ci_leads_h=(1.0, 2.5)), seed=3),
        policy(interface(observations="sustaindc"), seed=3),
        policy(interface(actions="continuous"), seed=3, levels=5, decision_steps=4),
        joint(),
        of_the_battery(),
    ],
    ids=["discrete", "continuous", "order", "sustaindc", "levels", "joint", "others"],
)
def test_a_run_has_the_commands_of_the_training(made: Policy) -> None:
    configs = fleet_of()
    results = run(configs, made, 60)
    assert_equal(results, trained(configs, made, 60))
    loads = np.array([result.load_command for result in results])
    assert np.array_equal(loads, np.repeat(loads[:: made.decision_steps], made.decision_steps, 0))
    names = COMMANDS if made.decision_steps == 1 else COMMANDS[:1]
    assert all(varied(results, name) for name in names)


def test_commands_of_several_units_and_fans_are_those_of_the_training() -> None:
    units = ["hvac.crac.units=2", "hvac.crac.flow_model=controlled"]
    configs = [load_config("corrected", units)]
    options = EnvOptions(
        agents=("agent_dc",), actions="continuous", commands={"agent_dc": ("fan", "cooling")}
    )
    made = policy(interface_of(build_fleet(configs), options), seed=3)
    results = run(configs, made, 12)
    assert_equal(results, trained(configs, made, 12), ("setpoint_c", "crac_fan_w"))
    assert varied(results, "crac_fan_w")


def test_forecasts_err_as_those_that_learners_of_the_episode_see() -> None:
    error = ForecastError(ci_share=0.5, temperature_k=5.0)
    configs = fleet_of()
    made = policy(interface(agents=("agent_bat",)), seed=3)
    hold = np.ones(3, dtype=np.int64)
    batteries = PolicyController(made, build_fleet(configs))
    given: dict[str, Any] = {"config": configs, "days": 1, "start": "fixed"}
    found = []
    for errs in (error, PERFECT):
        env = vector_env(agents=("agent_ls",), others=batteries, forecast_error=errs, **given)
        env.reset(seed=0)
        found.append([env.core.step({"agent_ls": hold}).result for _ in range(40)])
        env.close()
    env = vector_env(agents=("agent_ls", "agent_bat"), forecast_error=error, **given)
    observations, _ = env.reset(seed=0)
    expected = []
    for _ in range(40):
        chosen = made.actions({"agent_bat": np.asarray(observations["agent_bat"])})
        transition = env.core.step({"agent_ls": hold, "agent_bat": chosen["agent_bat"][:, 0]})
        observations = transition.observations
        expected.append(transition.result)
    env.close()
    assert_equal(found[0], expected)
    erring, perfect = ([r.battery_command for r in results] for results in found)
    assert not np.array_equal(erring, perfect)


def test_a_second_episode_is_the_first_again() -> None:
    configs = fleet_of()
    with Simulator(build_fleet(configs)) as sim:
        controller = PolicyController(policy(interface(), seed=3), sim.fleet)
        runs: list[list[StepResult]] = [[], []]
        for kept in runs:
            simulate(sim, controller, 20, 0, on_step=kept.append)
    assert_equal(runs[0], runs[1])


# Names


def test_a_policy_is_a_controller_by_name(tmp_path: Path) -> None:
    made = policy(interface(), seed=3)
    made.save(tmp_path / "best")
    configs = fleet_of()
    expected = run(configs, made, 30)
    assert_equal(run(configs, f"policy:{tmp_path}", 30), expected)
    parts = ",".join(f"{part}=policy:{tmp_path}" for part in ("load", "cooling", "battery"))
    assert_equal(run(configs, parts, 30), expected)


def test_a_policy_may_stand_for_one_agent_beside_others(tmp_path: Path) -> None:
    of_the_battery("load=greedy-ci").save(tmp_path)
    configs = fleet_of()
    results = run(configs, f"cooling=g36,battery=policy:{tmp_path}", 30)
    assert_equal(results, run(configs, of_the_battery("cooling=g36"), 30))


def test_what_a_policy_cannot_do_is_one_error(tmp_path: Path) -> None:
    fleet = build_fleet(load_config("tiny"))
    policy(interface(agents=("agent_bat",))).save(tmp_path)
    for spec, said in (
        ("policy", "valid is policy:FOLDER"),
        (f"policy:{tmp_path}/no", "no such folder"),
        (f"load=policy:{tmp_path}", "does not act on load; it gives battery"),
    ):
        with pytest.raises(SdcError, match=said):
            make_controller(spec, fleet)
    of_the_battery("load=greedy-ci").save(tmp_path / "others")
    with pytest.raises(SdcError, match="does not act on load; it gives battery"):
        make_controller(f"load=policy:{tmp_path / 'others'}", fleet)
    with pytest.raises(ConfigError, match=r"policy .*does not fit .*step: 15 min in training, 30"):
        make_controller(
            f"policy:{tmp_path}", build_fleet(load_config("tiny", ["simulation.steps_per_hour=2"]))
        )


def test_a_policy_runs_no_code_that_its_file_names(tmp_path: Path) -> None:
    fleet = build_fleet(load_config("tiny"))
    of_the_battery("cProfile:run:1/0").save(tmp_path)
    with pytest.raises(ConfigError, match=r"others of its training: .*code that a file names"):
        make_controller(f"policy:{tmp_path}", fleet)
    assert commands_of(make_controller(f"battery=policy:{tmp_path}", fleet)) == ("battery",)


@pytest.mark.parametrize(
    ("names", "loads", "message"),
    [
        (["a"], 1, "its training had this policy for others"),
        (["a", "../x/b"], 2, "its training had this policy for others"),
        ([*"abcdefghijkl"], 8, "it is nested in 8 policies, each of which names the next"),
    ],
)
def test_policies_for_others_end(
    names: list[str],
    loads: int,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "x").mkdir()
    monkeypatch.chdir(tmp_path / "x")
    for name, others in zip(names, [*names[1:], names[0]], strict=True):
        of_the_battery(f"policy:{others}").save(Path(name))
    loaded: list[Path] = []
    load = Policy.load

    def counted(folder: Path) -> Policy:
        loaded.append(folder)
        return load(folder)

    monkeypatch.setattr(Policy, "load", counted)
    fleet = build_fleet(load_config("tiny"))
    for _ in range(2):
        loaded.clear()
        with pytest.raises(ConfigError, match=message):
            make_controller("policy:a", fleet)
        assert len(loaded) == loads


def test_a_policy_acts_for_the_agents_that_do_not_learn(tmp_path: Path) -> None:
    configs = fleet_of()
    made = policy(interface(), seed=3)
    made.save(tmp_path)
    found = []
    for others in (f"policy:{tmp_path}", PolicyController(made, build_fleet(configs))):
        env = vector_env(
            config=configs, agents=("agent_bat",), others=others, start="fixed", days=1
        )
        env.reset(seed=0)
        hold = np.ones(3, dtype=np.int64)
        found.append([env.core.step({"agent_bat": hold}).result for _ in range(30)])
        env.close()
    assert_equal(found[0], found[1])
    assert varied(found[0], "load_command")
    assert varied(found[0], "cooling_command")
    assert not varied(found[0], "battery_command")
