"""Rewards of the released SustainDC at the time of the paper (NeurIPS 2024, 4.5 and F), batched.

Source: github.com/HewlettPackard/dc-rl (``utils/reward_creator.py``, ``utils/make_envs_pyenv.py``).
"""

from __future__ import annotations

import numpy as np

from sdc_taichi.control.view import View
from sdc_taichi.errors import DataError, RuntimeStateError
from sdc_taichi.sim.fleet import Fleet, build_fleet
from sdc_taichi.sim.hall_solver import Hall, Precision
from sdc_taichi.sim.sizing import Sizing, released_ranges
from sdc_taichi.types import F64, StepResult

DROPPED_TASK_REWARD = -10.0
"""Reward of a dropped task (paper, F.2)."""
QUEUED_TASK_REWARD = -0.1
"""Reward of a queued task at full factor, one over 10 (paper, F.2)."""
END_OF_DAY_H = 23.0
"""Hour of the day from which queued tasks cost (paper, F.2)."""
END_OF_DAY_FACTORS = (0.95833, 0.98935)
"""Shares of the day at which the factor is 0 and 1, as printed (paper, F.2): 23:00 and, by its
digits, just before 23:45, the start of the last quarter hour, where the factor is 1.0075."""
LOWEST_POWER_FACTOR = 0.9
"""Lower bound of the facility's power over the lowest IT power (``make_envs_pyenv.py``)."""


def footprint_reward(norm_ci: F64, grid_kwh: F64, low_kwh: F64, high_kwh: F64) -> F64:
    """Reward of the battery agent, and the energy part of the load agent's (paper, F.2), (B,).

    Args:
        norm_ci: carbon intensity over its range, 0..1, (B,).
        grid_kwh: energy of the step with the battery, in kWh, (B,).
        low_kwh: least energy of a step, in kWh, (B,).
        high_kwh: greatest energy of a step, in kWh, (B,).
    """
    return -norm_ci * (grid_kwh - low_kwh) / (high_kwh - low_kwh)


def load_penalty(dropped_tasks: F64, queue_tasks: F64, day_share: F64) -> F64:
    """Penalty of the load agent for dropped tasks and a queue at the end of the day, (B,).

    Paper, F.1 and F.2: the factor of the queue rises linearly from 23:00 on.

    Args:
        dropped_tasks: tasks dropped in the step, (B,).
        queue_tasks: tasks queued at the end of the step, (B,).
        day_share: start of the step as a share of the day, 0..1, (B,).
    """
    low, high = END_OF_DAY_FACTORS
    factor = np.where(day_share >= END_OF_DAY_H / 24.0, (day_share - low) / (high - low), 0.0)
    return DROPPED_TASK_REWARD * dropped_tasks + QUEUED_TASK_REWARD * factor * queue_tasks


def cooling_reward(facility_kw: F64, low_kw: F64, high_kw: F64) -> F64:
    """Reward of the cooling agent, IT and HVAC power over its range (``reward_creator.py``), (B,).

    Args:
        facility_kw: IT and HVAC power of the step, in kW, (B,).
        low_kw: lower bound of the power, in kW, (B,).
        high_kw: upper bound of the power, in kW, (B,).
    """
    return -(facility_kw - low_kw) / (high_kw - low_kw)


def power_bounds_kw(fleet: Fleet, sizing: Sizing, precision: Precision) -> tuple[F64, F64]:
    """Bounds of IT and HVAC power, in kW, (B,) each.

    The range goes from 0.9 times the lowest IT power of 15..22 C and 0..100 % load to the design
    power of the facility, which is 1.1 times highest IT, rated tower and chiller power under
    ``released`` sizing (``make_envs_pyenv.py``). Energies of a step are these times its length.
    """
    halls = [(c.hall, c.servers, c.hvac) for c in fleet.configs]
    distinct = dict(zip(halls, fleet.configs, strict=True))
    distinct_fleet = build_fleet(distinct.values())
    low_w, _ = released_ranges(distinct_fleet, Hall(distinct_fleet, precision))["it_w"]
    position = {hall: i for i, hall in enumerate(distinct)}
    lowest_w = low_w[[position[hall] for hall in halls]]
    return LOWEST_POWER_FACTOR * lowest_w / 1e3, sizing.facility_w / 1e3


class ReleasedRewards:
    """Rewards of the released code at the time of the paper, before agents share them.

    Carbon intensity counts as its place between the minimum and maximum of its series, a year as a
    rule (``CI_Manager`` of that time), in the step that the reward is for.
    """

    def __init__(self) -> None:
        self._fleet: Fleet | None = None
        self._bounds_kw = (np.zeros(0), np.zeros(0))
        self._low_ci = self._ci_span = np.zeros(0)

    def reset(self, view: View) -> None:
        """Take the ranges of the fleet and its inputs.

        Args:
            view: the view before the first step.

        Raises:
            DataError: a carbon intensity that never changes, so has no range.
        """
        if self._fleet is not view.fleet:
            self._bounds_kw = power_bounds_kw(view.fleet, view.sizing, view.precision)
            self._fleet = view.fleet
        series, which = view.drivers.ci_g_per_kwh.distinct()
        low = np.array([values.min() for values in series])[which]
        high = np.array([values.max() for values in series])[which]
        flat = np.flatnonzero(high == low)
        if len(flat):
            raise DataError(
                f"rewards sustaindc: the carbon intensity of data center {flat[0]} is "
                f"{low[flat[0]]:g} g/kWh throughout; valid is one that varies, as its range scales "
                "the rewards"
            )
        self._low_ci, self._ci_span = low, high - low

    def rewards(self, result: StepResult, view: View) -> dict[str, F64]:
        """Rewards of a step.

        Args:
            result: the step.
            view: the view after it.

        Returns:
            r_LS, r_DC and r_BAT by agent, (B,) each.

        Raises:
            RuntimeStateError: before ``reset``.
        """
        if self._fleet is None:
            raise RuntimeStateError("the rewards have not been reset; call reset() first")
        low_kw, high_kw = self._bounds_kw
        footprint = footprint_reward(
            (result.ci_g_per_kwh - self._low_ci) / self._ci_span,
            result.grid_kwh,
            low_kw * result.step_h,
            high_kw * result.step_h,
        )
        steps_per_day = 24 * view.fleet.steps_per_hour
        day_share = (view.drivers.start + result.step) % steps_per_day / steps_per_day
        return {
            "agent_ls": footprint
            + load_penalty(result.dropped_tasks, result.queue_tasks, day_share),
            "agent_dc": cooling_reward((result.it_w + result.hvac_w) / 1e3, low_kw, high_kw),
            "agent_bat": footprint,
        }
