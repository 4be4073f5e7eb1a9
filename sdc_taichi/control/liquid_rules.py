"""Rules for the supply setpoints and flows of the CDUs of liquid-cooled racks."""

from __future__ import annotations

import numpy as np

from sdc_taichi.config.liquid_schema import SETPOINT_LIMITS_C
from sdc_taichi.control.rules import WithoutMemory
from sdc_taichi.control.view import View
from sdc_taichi.errors import ConfigError
from sdc_taichi.optimum.loop_map import LOOP_COMMANDS, LoopCommands
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import Actions

WET_BULB_APPROACH_K = 5.56
"""Facility water minus wet bulb, in K: the 10 F of the baseline of LC-Opt (arXiv 2511.00116)."""
TARGET_HEADROOM_K = 10.0
"""Headroom of the hottest junction below its throttling limit that the reset keeps, in K."""
TRIM_K, RESPOND_PER_K = 0.2, 0.5
"""Rise of the setpoint in each step of the reset while there is headroom, in K, and its fall for
each kelvin of missing headroom."""


class WetBulbApproach(WithoutMemory):
    """Facility water 5.56 K warmer than the wet bulb, as the baseline of LC-Opt sets its towers.

    The supply setpoint of all CDUs is that of the facility water plus the configured approach, in
    the range of setpoints. Flows stay at design.
    """

    commands = ("cdu_setpoint_c", "cdu_flow")
    """Fields of ``Actions`` that it gives."""

    def act(self, view: View) -> Actions:
        """Return commands for setpoints and flows."""
        approach_k = view.fleet.values("liquid.cdus.approach_k")
        target_c = view.now.wet_bulb_c + WET_BULB_APPROACH_K + approach_k
        return Actions(
            cdu_setpoint_c=np.clip(target_c, *SETPOINT_LIMITS_C),
            cdu_flow=np.ones(view.fleet.cdus),
        )


class JunctionReset(WithoutMemory):
    """Supply setpoints by trim and respond on the hottest junction of the racks of each CDU.

    In each step the setpoint of a CDU rises by 0.2 K while its racks have more than 10 K of
    headroom to throttling, and falls by half of what is missing of them. CDUs without GPUs, such as
    those of rear doors, hold theirs.
    """

    commands = ("cdu_setpoint_c",)
    """Fields of ``Actions`` that it gives."""

    def act(self, view: View) -> Actions:
        """Return commands for setpoints alone."""
        missing_k = np.maximum(TARGET_HEADROOM_K - view.cdu_headroom_k, 0.0)
        change_k = np.where(missing_k > 0.0, -RESPOND_PER_K * missing_k, TRIM_K)
        change_k[np.isinf(view.cdu_headroom_k)] = 0.0
        if view.last is None:
            change_k = np.zeros_like(change_k)
        return Actions(
            cdu_setpoint_c=np.clip(view.state.cdu_setpoint_c + change_k, *SETPOINT_LIMITS_C)
        )


class GreedyLoops(WithoutMemory):
    """Setpoints, flows and facility water of least power in the steady state of the coming step.

    They come from a ``LoopMap``, tables of steady states by weather and utilisation. Setpoints
    move towards them by up to 2 K in each step. All CDUs of a data center get the same commands.
    """

    commands = LOOP_COMMANDS
    """Fields of ``Actions`` that it gives."""

    def __init__(self) -> None:
        self._loops: LoopCommands | None = None

    def act(self, view: View) -> Actions:
        """Return commands for setpoints, flows and facility water."""
        if self._loops is None or self._loops.fleet is not view.fleet:
            self._loops = LoopCommands(view.fleet, view.drivers)
        now = view.now
        best = self._loops.at(now.outdoor_c, now.wet_bulb_c, now.demand)
        of_cdus = view.fleet.cdu_dc
        return Actions(
            cdu_setpoint_c=best[0][of_cdus],
            cdu_flow=best[1][of_cdus],
            facility_approach_k=best[2],
        )


def require_liquid(name: str, fleet: Fleet) -> None:
    """Refuse a controller of liquid-cooled racks for data centers without them.

    Raises:
        ConfigError: a data center has no liquid-cooled racks.
    """
    for config in fleet.configs:
        if config.liquid is None:
            raise ConfigError(
                f"controller {name!r}: {config.name} has no liquid-cooled racks; valid with "
                "section liquid, such as preset ai_hall_2026"
            )
