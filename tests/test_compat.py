"""The class SustainDC against recorded runs of the released one; its keys, rewards and infos."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sdc_taichi
from sdc_taichi import load_config
from sdc_taichi.compat import SustainDC
from sdc_taichi.compat.keys import KEYS, EnvConfig, config_of, read_keys
from sdc_taichi.envs.agents import AGENTS
from sdc_taichi.errors import ConfigError, SdcError
from sdc_taichi.sim.drivers import FleetSeries
from sdc_taichi.types import F64
from test_envs_released import RECORDED, VECTORS
from test_reference import read_trajectory, recorded_drivers

KEYS_OF_HARL: dict[str, Any] = {
    "location": "ny",
    "month": 6,
    "days_per_episode": 1,
    "partial_obs": True,
    "nonoverlapping_shared_obs_space": True,
}
DOCS = Path(__file__).parents[1] / "docs" / "coming-from-sustaindc.md"

INFO_COLUMNS = {
    "bat_SOC": "soc",
    "bat_CO2_footprint": "co2_g",
    "bat_avg_CI": "ci_g_per_kwh",
    "bat_total_energy_without_battery_KWh": "dc_kwh",
    "bat_total_energy_with_battery_KWh": "grid_kwh",
    "bat_action": "action_bat",
    "ls_original_workload": "workload",
    "ls_shifted_workload": "shifted_workload",
    "ls_action": "action_ls",
    "ls_tasks_in_queue": "tasks_in_queue",
    "ls_tasks_dropped": "tasks_dropped",
    "ls_tasks_processed": "tasks_processed",
    "ls_overdue_penalty": "overdue",
    "ls_oldest_task_age": "oldest_age_days",
    "ls_average_task_age": "average_age_days",
    "ls_current_hour": "hour",
    "dc_ITE_total_power_kW": "it_kw",
    "dc_CT_total_power_kW": "ct_kw",
    "dc_Compressor_total_power_kW": "compressor_kw",
    "dc_crac_setpoint": "setpoint_c",
    "dc_cpu_workload_fraction": "shifted_workload",
    "dc_int_temperature": "mean_outlet_c",
    "dc_exterior_ambient_temp": "dry_bulb_c",
    "dc_CW_pump_power_kW": "cw_pump_w",
    "dc_CT_pump_power_kW": "ct_pump_w",
    "dc_water_usage": "water_l",
}
"""Recorded column of each info that a recording contains as such."""


def hall_of(racks: list[dict[str, Any]]) -> dict[str, Any]:
    """The racks of a recorded run in its order, which differs from run to run."""
    return {
        "hall.servers_per_rack": [rack["servers"] for rack in racks],
        "servers.power_w": [[rack["full_w"], rack["idle_w"]] for rack in racks],
    }


@pytest.mark.parametrize(("name", "path"), RECORDED, ids=[name for name, _ in RECORDED])
def test_recorded_runs(name: str, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = read_trajectory(path.with_name(path.name.replace("_features.npz", ".csv")))
    with np.load(path) as recorded:
        data = dict(recorded)
    columns, steps, first = run.columns, len(run.columns["step"]), int(data["first_step"])
    day, hour = int(columns["day"][0]), int(columns["hour"][0])
    env = SustainDC(
        run.about["config"],
        overrides=hall_of(run.about["racks"]),
        precision="f64",
    )
    # The recorded inputs begin at a midnight; the year repeats them around the recorded days.
    offset = day * 96 + hour * 4 - first

    def year(series: F64) -> F64:
        return np.roll(np.resize(series, 35040), offset)

    inputs = recorded_drivers(
        *(year(data[key]) for key in ("temperature_c", "temperature_c", "ci_g_per_kwh", "workload"))
    )
    wet_bulb = inputs.wet_bulb_c.values.copy()
    wet_bulb[offset + first :][:steps] = columns["wet_bulb_c"]
    whole = (np.array([0]), np.array([35040]))
    inputs = replace(inputs, wet_bulb_c=FleetSeries(wet_bulb, *whole))
    reset = env.core.sim.reset
    start = np.array([offset + first])
    monkeypatch.setattr(
        env.core.sim, "reset", lambda events, _start, _inputs: reset(events, start, inputs)
    )
    seen, shared = [env.reset()], [env.state()]
    infos: list[dict[str, Any]] = []
    rewards: list[dict[str, float]] = []
    for action in data["actions"]:
        observations, reward, ended, cut, by_agent = env.step(
            dict(zip(AGENTS, action, strict=True))
        )
        seen.append(observations)
        shared.append(env.state())
        infos.append(by_agent["agent_dc"])
        rewards.append(reward)
        assert not any(ended.values())
        assert not any(cut.values())

    for agent, key in VECTORS.items():
        found = np.array([row[agent] for row in seen])
        # The recorded vectors are of a run with another order of racks, and so another battery.
        limit = np.maximum(2e-5, 2e-7 * np.abs(data[key]))
        assert np.all(np.abs(found - data[key]) <= limit), (name, agent)
    expected = np.concatenate(
        [data["obs_ls"], data["obs_dc"][:, [11, 13]], data["obs_bat"][:, [-1]]], axis=1
    )
    assert np.allclose(shared, expected, rtol=2e-7, atol=2e-5)
    for key, column in INFO_COLUMNS.items():
        values = np.array([info[key] for info in infos])
        assert values == pytest.approx(columns[column], rel=1e-6, abs=1e-9), (name, key)
    sizing = run.about["sizing"]
    assert infos[0]["bat_max_bat_cap"] == pytest.approx(sizing["battery_capacity_mwh"])
    assert infos[0]["ls_queue_max_len"] == sizing["queue_max"]
    bounds = [infos[0][f"dc_power_{end}_kW"] for end in ("lb", "ub")]
    assert bounds == pytest.approx([sizing["power_lb_kw"], sizing["power_ub_kw"]])

    # Infos of the step to come, and those that follow from others.
    for key, column in (("outside_temp", "dry_bulb_c"), ("day", "day"), ("hour", "hour")):
        after = [info[key] for info in infos[:-1]]
        assert after == pytest.approx(columns[column][1:], rel=1e-9), key
    for k, info in enumerate(infos):
        assert info["norm_CI"] == info["forecast_CI"][0]
        assert np.mean(info["forecast_CI"]) == pytest.approx(data["obs_ls"][k + 1, 5], abs=1e-5)
        assert info["ls_task_age_histogram"] == pytest.approx(data["obs_ls"][k + 1, -5:])
        power_kw = info["dc_total_power_kW"]
        assert power_kw == info["dc_ITE_total_power_kW"] + info["dc_HVAC_total_power_kW"]
        share = (power_kw - bounds[0]) / (bounds[1] - bounds[0])
        assert rewards[k]["agent_dc"] == pytest.approx(-share)
    assert {info["bat_a_t"] for info in infos} <= {"charge", "discharge", "idle"}
    env.close()


class HarlWrapper:
    """Calls of the released class in the order in which the wrappers of HARL make them."""

    def __init__(self, keys: dict[str, Any]) -> None:
        self.env = SustainDC(keys)
        self.agents = self.env.agents
        self.spaces: dict[str, Any] = dict(
            zip(self.agents, self.env.observation_space, strict=True)
        )
        self.width = max(space.shape[0] for space in self.spaces.values())
        action_spaces: list[Any] = self.env.action_space
        self.choices = [space.n for space in action_spaces]

    def reset(self, seed: int) -> np.ndarray[Any, Any]:
        np.random.seed(seed)  # noqa: NPY002
        return self._padded(self.env.reset())

    def step(self, actions: np.ndarray[Any, Any]) -> tuple[Any, ...]:
        by_agent = {agent: actions.flatten()[i] for i, agent in enumerate(self.agents)}
        seen, rewards, ended, cut, infos = self.env.step(by_agent)
        dones = [ended[agent] or cut[agent] for agent in self.agents]
        assert {*self.env.infos} == {*AGENTS, "__common__"}
        return (
            self._padded(seen),
            [[rewards[agent]] for agent in self.agents],
            dones,
            [infos[agent] for agent in self.agents],
        )

    def _padded(self, seen: dict[str, Any]) -> np.ndarray[Any, Any]:
        assert all(self.spaces[agent].contains(values) for agent, values in seen.items())
        return np.array([np.pad(x, (0, self.width - len(x))) for x in seen.values()])


def test_episodes_under_the_wrappers_of_harl() -> None:
    wrapper = HarlWrapper(KEYS_OF_HARL)
    assert wrapper.choices == [3, 3, 3]
    firsts = [wrapper.reset(seed) for seed in (4, 4, 5)]
    assert firsts[0].shape == (3, 26)
    assert np.array_equal(firsts[0], firsts[1])
    assert not np.array_equal(firsts[0], firsts[2])
    starts = set()
    for seed in range(30):
        wrapper.reset(seed)
        starts.add(int(wrapper.env.core.view.drivers.start[0]))
    days, quarters = {start // 96 for start in starts}, {start % 96 for start in starts}
    assert min(days) >= 181 - 7
    assert max(days) <= 181 + 7
    assert len(days) > 5
    assert len(quarters) > 10
    assert all(quarter % 4 == 0 for quarter in quarters)
    actions = np.array([[[2.0], [0.0], [1.0]]], dtype=np.float32)
    steps, done = 0, [False]
    while not all(done):
        seen, rewards, done, infos = wrapper.step(actions)
        steps += 1
    assert steps == 96
    assert seen.shape == (3, 26)
    assert np.shape(rewards) == (3, 1)
    assert all(len(info) == 49 for info in infos)
    assert infos[0]["isterminal"] is True
    with pytest.raises(SdcError, match=r"action of agent_dc: 0\.5; valid is 0, 1 or 2"):
        wrapper.env.step({"agent_ls": 1, "agent_dc": 0.5, "agent_bat": 2})


def test_seeds_of_its_own() -> None:
    env = SustainDC(KEYS_OF_HARL)
    env.seed(3)
    first = env.reset(), env.reset()
    again = env.reset(seed=3), env.reset()
    for one, other in zip(first, again, strict=True):
        assert all(np.array_equal(one[agent], other[agent]) for agent in AGENTS)
    assert not np.array_equal(first[0]["agent_ls"], first[1]["agent_ls"])


def test_the_clock_of_a_time_zone() -> None:
    """The clock of the infos is ``timezone_shift`` hours behind that of the site."""
    shifted, plain = (SustainDC(KEYS_OF_HARL | {"timezone_shift": h}) for h in (8, 0))
    starts = []
    for env in (shifted, plain):
        env.reset(seed=1)
        starts.append(int(env.core.view.drivers.start[0]))
    assert starts[0] - starts[1] == 32
    infos = [
        env.step({"agent_ls": 1, "agent_dc": 1, "agent_bat": 2})[4] for env in (shifted, plain)
    ]
    clocks = [(info["__common__"]["day"], info["__common__"]["hour"]) for info in infos]
    assert clocks[0] == clocks[1]
    times = [env.infos["__common__"]["time"] for env in (shifted, plain)]
    assert times[0] == times[1]


def mine(params: dict[str, Any]) -> float:
    return -float(params["dc_water_usage"])


def test_rewards_by_function_by_name_and_shared() -> None:
    seen: list[set[str]] = []

    def load(params: dict[str, Any]) -> float:
        seen.append(set(params))
        return 10.0 * float(params["ls_tasks_in_queue"])

    keys = {"ls_reward": load, "dc_reward": f"{__name__}:mine", "bat_reward": "tou_reward"}
    env = SustainDC(KEYS_OF_HARL | keys)
    shared = SustainDC(KEYS_OF_HARL | keys | {"individual_reward_weight": 0.8})
    for each in (env, shared):
        each.reset(seed=1)
    action = {"agent_ls": 0, "agent_dc": 2, "agent_bat": 0}
    (_, own, _, _, info), (_, mixed, _, _, _) = env.step(action), shared.step(action)
    params = info["__common__"]
    assert seen[0] == set(params)
    prices = [0.25] * 6 + [0.41] * 5 + [0.30] * 5 + [0.27] * 6 + [0.25] * 2
    cost = params["bat_total_energy_with_battery_KWh"] * prices[int(params["hour"])]
    assert params["ls_tasks_in_queue"] > 0
    assert own == pytest.approx(
        {
            "agent_ls": 10.0 * params["ls_tasks_in_queue"],
            "agent_dc": -params["dc_water_usage"],
            "agent_bat": -cost,
        }
    )
    total = sum(own.values())
    for agent in AGENTS:
        assert mixed[agent] == pytest.approx(0.8 * own[agent] + 0.1 * (total - own[agent]))
    broken = SustainDC(KEYS_OF_HARL | {"dc_reward": lambda params: float("nan")})
    broken.reset(seed=1)
    with pytest.raises(SdcError, match=r"dc_reward: returned .* for agent_dc"):
        broken.step(action)


def test_agents_that_do_not_learn_stay_neutral() -> None:
    env = SustainDC(KEYS_OF_HARL | {"agents": ["agent_dc"]})
    assert env.agents == ["agent_dc"]
    assert len(env.observation_space) == len(env.action_space) == 1
    assert set(env.reset(seed=1)) == {"agent_dc"}
    seen, rewards, ended, cut, infos = env.step({"agent_dc": 2})
    assert set(seen) == set(rewards) == {"agent_dc"}
    assert set(ended) == set(cut) == {"agent_dc", "__all__"}
    info = infos["agent_dc"]
    assert (info["ls_action"], info["dc_crac_setpoint_delta"], info["bat_a_t"]) == (1, 1, "idle")
    assert env.state().shape == env.state_space.shape == (29,)


def test_keys_become_fields(tmp_path: Path) -> None:
    def made(**keys: Any) -> Any:
        return config_of(read_keys({"month": 0} | keys), {})

    plain = made()
    assert plain == load_config("sustaindc", ["site.location=ny"])
    changed = made(
        location="az",
        flexible_load=0.4,
        max_bat_cap_Mw=1.5,
        workload_file="GoogleClusteData_CPU_Data_Hourly_1.csv",
        weather_file="USA_AZ_Phoenix-Sky.Harbor.epw",
        cintensity_file="AZPS_NG_&_avgCI.csv",
        datacenter_capacity_mw=1,
    )
    assert changed.site.location == "az"
    assert changed.workload.flexible_share == 0.4
    assert changed.battery.capacity_kwh == 1500.0
    assert changed.workload.trace == "google_1"
    assert (changed.site.weather_file, changed.site.carbon_file) == (None, None)
    trace = tmp_path / "load.csv"
    trace.write_text("cpu_load\n0.5\n")
    assert made(workload_file=str(trace)).site.workload_file == str(trace)
    assert made(workload_file="alibaba_2").workload.trace == "alibaba_2"

    class EnvContext(dict[str, Any]):
        worker_index = 8

    assert read_keys(EnvContext(location="wa")).month == 7


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"locaton": "ny"}, "unknown key 'locaton'; did you mean 'location', here site.location?"),
        ({"hru": True}, "unknown key 'hru'; valid: agents, location, "),
        ({"month": 12}, "month: should be less than or equal to 11"),
        ({"location": "xx"}, "site 'xx': expected one of"),
        ({"partial_obs": False}, "partial_obs: should be True"),
        ({"actions_are_logits": True}, "actions_are_logits: should be False"),
        ({"agents": ["agent_ls", "agent_ls"]}, "agents: .*valid is one or more, each once"),
        ({"weather_file": "USA_AZ_X.epw"}, "is that of AZ, and location is 'ny'; valid is"),
        ({"cintensity_file": "ci.csv"}, "cintensity_file 'ci.csv': no such file; valid is"),
        ({"dc_config_file": "dc_config_dc1.json"}, "no such file; valid is the path of a file"),
        ({"datacenter_capacity_mw": 0.5}, "the racks need 0.68; valid is that or more"),
        ({"ls_reward": "tou"}, "ls_reward 'tou': unknown; valid: default_ls_reward"),
        ({"bat_reward": 3}, "bat_reward 3: valid is a name, a function or its path"),
    ],
)
def test_keys_that_are_not_valid(keys: dict[str, Any], message: str) -> None:
    with pytest.raises(SdcError, match=message):
        SustainDC(KEYS_OF_HARL | keys)


def test_a_month_is_needed() -> None:
    with pytest.raises(ConfigError, match="env_config: month: missing"):
        read_keys({"location": "ny"})


@pytest.mark.repo
def test_the_page_lists_every_key_and_info() -> None:
    assert set(EnvConfig.model_fields) == set(KEYS)
    text = DOCS.read_text(encoding="utf-8")

    def first_column(heading: str) -> list[str]:
        section = re.split(r"^## ", text.split(f"## {heading}\n", 1)[1], maxsplit=1, flags=re.M)[0]
        cells = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
        return re.findall(r"`(\w+)`", " ".join(cells))

    assert sorted(first_column("Keys")) == sorted(KEYS)
    env = SustainDC(KEYS_OF_HARL)
    env.reset(seed=1)
    infos = env.step({"agent_ls": 1, "agent_dc": 1, "agent_bat": 2})[4]
    assert sorted(first_column("Infos")) == sorted(infos["agent_ls"])
    assert len(infos["__common__"]) == 49
    assert sdc_taichi.compat.SustainDC is SustainDC
