"""Setpoints by hour and month, and how cooling commands go before them."""

from __future__ import annotations

import numpy as np
import pytest

import sdc_taichi
from sdc_taichi import Actions, CoolAction, Simulator, load_config, make_controller, simulate
from sdc_taichi.errors import ConfigError
from sdc_taichi.types import F64

NIGHTS_WARM = [22.0] * 6 + [18.0] * 12 + [20.0] * 6
BY_HOUR = f"hvac.setpoint.schedule_c={NIGHTS_WARM}"
BY_MONTH = f"hvac.setpoint.schedule_c={[16 + 0.5 * month for month in range(12)]}"


def run(overrides: list[str], controller: str, steps: int = 96) -> F64:
    """Setpoints of a run, (steps,)."""
    found: list[float] = []
    with Simulator(load_config("tiny", overrides)) as sim:
        chosen = make_controller(controller, sim.fleet)
        simulate(sim, chosen, steps, on_step=lambda r: found.append(float(r.setpoint_c[0])))
    return np.array(found)


@pytest.mark.parametrize("controller", ["idle", "lookahead-3h", "load=greedy-ci", "cooling=idle"])
def test_who_does_not_act_on_cooling_follows_the_schedule(controller: str) -> None:
    found = run([BY_HOUR, "site.start=07-01"], controller)
    np.testing.assert_array_equal(found, np.repeat(NIGHTS_WARM, 4))


def test_months_and_both_together() -> None:
    found = run([BY_MONTH, "site.start=01-31"], "idle", 2 * 96)
    np.testing.assert_array_equal(found, np.repeat([16.0, 16.5], 96))
    table = [[16.0 + 0.5 * month] * 12 + [16.25 + 0.5 * month] * 12 for month in range(12)]
    found = run([f"hvac.setpoint.schedule_c={table}", "site.start=12-31"], "idle", 2 * 96)
    np.testing.assert_array_equal(found, np.repeat([21.5, 21.75, 16.0, 16.25], 48))


def test_a_cooling_command_goes_before_the_schedule() -> None:
    np.testing.assert_allclose(run([BY_HOUR], "constant:19.5"), 19.5)
    with Simulator(load_config("tiny", [BY_HOUR])) as sim:
        sim.reset()
        assert sim.step().setpoint_c == 22.0
        held = [sim.step(Actions(cooling=CoolAction.HOLD)) for _ in range(26)]
        assert {float(r.setpoint_c[0]) for r in held} == {22.0}
        assert sim.step(Actions(cooling=CoolAction.LOWER)).setpoint_c == 21.0
        result = sim.step()
    assert result.setpoint_c == 18.0
    assert result.cooling_command == 0.0


def test_each_data_center_of_a_fleet_has_its_own_schedule() -> None:
    configs = [
        load_config("tiny", ["name=a", BY_HOUR]),
        load_config("tiny", ["name=b", "hvac.setpoint.initial_c=17"]),
        load_config("tiny", ["name=c", BY_MONTH, "site.start=03-01"]),
    ]
    with Simulator(configs) as sim:
        sim.reset()
        found = [sim.step().setpoint_c.tolist() for _ in range(30)]
    assert found[0] == [22.0, 17.0, 17.0]
    assert found[-1] == [18.0, 17.0, 17.0]


def test_environments_follow_it_where_cooling_is_not_learned() -> None:
    env = sdc_taichi.parallel_env(
        "tiny", overrides=[BY_HOUR], agents=["agent_bat"], days=1, start="fixed"
    )
    env.reset(seed=0)
    seen = []
    for _ in range(40):
        env.step({"agent_bat": 1})
        seen.append(float(env.unwrapped.core.view.state.setpoint_c[0]))
    np.testing.assert_array_equal(seen, np.repeat(NIGHTS_WARM, 4)[:40])
    learned = sdc_taichi.parallel_env(
        "tiny", overrides=[BY_HOUR], agents=["agent_dc"], days=1, start="fixed"
    )
    learned.reset(seed=0)
    for _ in range(40):
        learned.step({"agent_dc": 1})
    assert learned.unwrapped.core.view.state.setpoint_c == 18.0, "held as the agent says"


@pytest.mark.parametrize(
    ("schedule", "named"),
    [
        ("[18, 19]", "2 entries; valid is 12"),
        ("[]", "0 entries"),
        ("[[18, 19]]", "12 lists of 24"),
        (str([30.0] * 24), "30 must lie within min_c 16"),
        (str([[18.0] * 24] * 11), "11 entries"),
        ("[a]", "schedule_c"),
    ],
)
def test_bad_schedules_are_named(schedule: str, named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        load_config("tiny", [f"hvac.setpoint.schedule_c={schedule}"])
