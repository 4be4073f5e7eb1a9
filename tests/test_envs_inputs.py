"""Years and workload traces that episodes draw."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence

import sdc_taichi
from sdc_taichi import ConfigError, SdcError, Simulator, load_config, load_drivers
from sdc_taichi.envs import time_rows
from sdc_taichi.envs.agents import AGENTS

STEPS = 96
TRACES = ("alibaba_1", "alibaba_2")
DRAWN: dict[str, Any] = {"config": "tiny", "days": 1, "years": 5, "traces": TRACES}
IDLE = dict.fromkeys(AGENTS, 1)


@pytest.fixture
def trace_file(tmp_path: Path) -> Path:
    path = tmp_path / "flat.csv"
    hours = np.tile([0.25, 0.5], 4380)
    path.write_text("hour,cpu_load\n" + "\n".join(f"{i},{x}" for i, x in enumerate(hours)))
    return path


def run_episode(env: Any, steps: int = STEPS) -> dict[str, Any]:
    """Weather, carbon intensity and arriving work of each step of a PettingZoo environment."""
    seen = [env.step(IDLE)[4]["agent_dc"] for _ in range(steps)]
    return {n: [info[n] for info in seen] for n in ("outdoor_c", "ci_g_per_kwh", "demand")}


def test_an_episode_has_the_inputs_of_what_it_drew() -> None:
    env = sdc_taichi.parallel_env(**DRAWN)
    found = set()
    for seed in range(2):
        info = env.reset(seed=seed)[1]["agent_dc"]
        assert {"start_day", "year", "trace"} <= info.keys()
        assert info["year"] in range(5)
        assert info["trace"] in TRACES
        found.add((info["year"], info["trace"]))
        config = load_config(
            "tiny", [f"site.seed={info['year']}", f"workload.trace={info['trace']}"]
        )
        expected = load_drivers([config])
        index = np.array([info["start_day"] * STEPS + np.arange(10)])
        for name, values in run_episode(env, 10).items():
            assert values == getattr(expected, name).at(index)[0].tolist(), name
        # Recordings and descriptions tell the year by this.
        assert f"seed {info['year']}," in env.core.sim.drivers.sources[0]["weather"]
        # What learners see is computed from these inputs too.
        plain = sdc_taichi.parallel_env(config, days=1)
        plain.reset(options={"start_day": info["start_day"]})
        for _ in range(10):
            plain.step(IDLE)
        assert np.array_equal(plain.state()[:36], env.state()[:36])
    assert len(found) > 1


def test_the_seed_decides_and_episodes_differ() -> None:
    env = sdc_taichi.parallel_env(**{**DRAWN, "years": 50})

    def episodes() -> list[tuple[int, str, int]]:
        infos = [env.reset(seed=3)[1], *(env.reset()[1] for _ in range(4))]
        of_agent = [info["agent_bat"] for info in infos]
        return [(info["start_day"], info["trace"], info["year"]) for info in of_agent]

    first = episodes()
    assert first == episodes()
    assert len({year for _, _, year in first}) > 2
    # Days are those that the same seed gives without the options, in the first episode.
    plain = sdc_taichi.parallel_env("tiny", days=1)
    assert plain.reset(seed=3)[1]["agent_bat"]["start_day"] == first[0][0]


def test_without_a_choice_results_are_those_without_the_option() -> None:
    config = load_config("tiny")
    drawn = sdc_taichi.parallel_env(
        "tiny", days=1, years=[config.site.seed], traces=[config.workload.trace]
    )
    plain = sdc_taichi.parallel_env("tiny", days=1)
    assert drawn.reset(seed=0)[0].keys() == plain.reset(seed=0)[0].keys()
    for _ in range(STEPS):
        *drawn_step, drawn_infos = drawn.step(IDLE)
        *plain_step, plain_infos = plain.step(IDLE)
        assert data_equivalence(drawn_step, plain_step, exact=True)
        # Only drawn environments tell year and trace.
        for agent, info in plain_infos.items():
            assert data_equivalence(info, {key: drawn_infos[agent][key] for key in info})


@pytest.mark.parametrize(("seen", "stretch_bytes"), [("default", 2**15), ("sustaindc", 2**23)])
def test_every_kind_of_environment_draws_the_same(
    seen: str, stretch_bytes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time_rows, "STRETCH_BYTES", stretch_bytes)
    options = {**DRAWN, "observations": seen}
    mode = "SameStep"
    multi: Any = sdc_taichi.vector_env(3, autoreset_mode=mode, **options)
    batch: Any = gymnasium.make_vec(
        "sdc_taichi/Joint-v0", num_envs=3, autoreset_mode=mode, **options
    )
    singles: list[Any] = [sdc_taichi.parallel_env(**options) for _ in range(3)]
    found, infos = multi.reset(seed=8)
    of_batch = batch.reset(seed=8)[1]
    assert infos["year"].dtype == np.int64
    for step in range(STEPS + 4):
        for name in ("year", "trace", "start_day") if step in (0, STEPS) else ():
            assert of_batch[name].tolist() == infos[name].tolist()
            assert of_batch[f"_{name}"].all()
        for i, env in enumerate(singles):
            if step in (0, STEPS):
                alone, info = env.reset(seed=8 + i) if step == 0 else env.reset()
                drawn = ("year", "trace", "start_day")
                assert [info["agent_ls"][n] for n in drawn] == [infos[n][i] for n in drawn]
            else:
                alone = env.step(IDLE)[0]
            for agent in AGENTS:
                assert np.array_equal(found[agent][i], alone[agent]), (step, agent)
        found, *_, infos = multi.step({a: np.ones(3, dtype=int) for a in AGENTS})
        of_batch = batch.step(np.ones((3, 3), dtype=int))[4]
    years = multi.core.start_info()["year"]
    assert len(set(years.tolist())) > 1


def test_states_of_other_draws_are_refused_and_change_nothing() -> None:
    env = sdc_taichi.parallel_env(**DRAWN)
    env.reset(seed=0)
    saved = env.state_dict()
    before = env.core.start_info()
    for inputs, message in (
        (None, "valid is what state_dict"),
        ({"years": (1,)}, "KeyError: 'traces'"),
        ({"years": (7,), "traces": ("alibaba_1",)}, "years (7,): not drawn by these"),
        ({"years": (1, 2), "traces": ("alibaba_1",)}, "years (1, 2): not drawn"),
        ({"years": None, "traces": ("alibaba_1",)}, "years None: not drawn"),
        ({"years": (1,), "traces": ("other",)}, "traces ('other',): not drawn"),
    ):
        with pytest.raises(SdcError, match=re.escape(message)):
            env.load_state_dict({**saved, "inputs": inputs})
        assert env.core.start_info() == before
    other = {**saved["inputs"], "years": ((saved["inputs"]["years"][0] + 1) % 5,)}
    with pytest.raises(SdcError, match="another fleet, inputs"):
        env.load_state_dict({**saved, "inputs": other})


def test_traces_from_files(trace_file: Path) -> None:
    env = sdc_taichi.parallel_env("tiny", days=1, traces=[trace_file])
    _, infos = env.reset(seed=0)
    assert infos["agent_ls"]["trace"] == str(trace_file)
    assert set(run_episode(env)["demand"]) <= {0.25, 0.5} | set(
        np.round(np.linspace(0.25, 0.5, 9), 12)
    )
    # It carries into a spec that can be written.
    made = gymnasium.make("sdc_taichi/Load-v0", config="tiny", years=3, traces=[str(trace_file)])
    assert made.spec is not None
    assert json.loads(made.spec.to_json())["kwargs"]["years"] == 3


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"years": 0}, "years"),
    ({"years": []}, "valid is one or more, each once"),
    ({"years": [1, 1]}, "valid is one or more, each once"),
    ({"years": [-1]}, "years"),
    ({"years": 1.5}, "years"),
    ({"years": True}, "years"),
    ({"traces": []}, "valid is one or more, each once"),
    ({"traces": "alibaba_1"}, "traces"),
]


@pytest.mark.parametrize(("options", "message"), WRONG)
def test_options_that_are_not_valid(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        sdc_taichi.parallel_env("tiny", **options)


def test_a_simulator_takes_other_inputs_at_reset() -> None:
    config = load_config("tiny")
    other = load_drivers([load_config("tiny", ["site.seed=3"])])
    with Simulator(config) as sim:
        first = sim.reset(seed=0)
        mine = sim.drivers
        sim.reset(drivers=other)
        result = sim.step()
        assert result.outdoor_c == other.at(0).outdoor_c != mine.at(0).outdoor_c
        saved = sim.state_dict()
        sim.reset(drivers=mine)
        with pytest.raises(SdcError, match="made by another fleet, inputs"):
            sim.load_state_dict(saved)
        sim.load_state_dict(saved, other)
        assert sim.step().outdoor_c == other.at(1).outdoor_c
        assert first.step == 0
        with pytest.raises(ConfigError, match="drivers of 2 data centers for a fleet of 1"):
            sim.reset(drivers=load_drivers([config] * 2))
