"""Air side of the plant: CRAC setpoint, airflow, return temperature and cooling load of the hall.

Setpoint, airflow and cooling load have several models each, in ``SETPOINTS``, ``CRAC_FLOWS`` and
``COOLING_LOADS``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sdc_taichi.types import F64, I64, Values, as_array

SetpointModel = Callable[..., tuple[F64, I64, F64]]


def symmetric_setpoint(
    setpoint_c: F64,
    command: F64,
    run: I64,
    last: F64,
    *,
    step_k: F64,
    low_c: F64,
    high_c: F64,
) -> tuple[F64, I64, F64]:
    """Move the setpoint by ``command`` steps within its range.

    Args:
        setpoint_c: Present setpoint, C, (B,).
        command: Steps to move, (B,).
        run: Equal commands in a row so far, (B,); not used.
        last: Last command, (B,); not used.
        step_k: Size of a step, K, (B,).
        low_c: Lowest setpoint, C, (B,).
        high_c: Highest setpoint, C, (B,).

    Returns:
        The new setpoint, C, the run unchanged, and the command, each (B,).
    """
    moved_c = np.minimum(np.maximum(setpoint_c + command * step_k, low_c), high_c)
    return moved_c, run, command


def accelerating_setpoint(
    setpoint_c: F64,
    command: F64,
    run: I64,
    last: F64,
    *,
    step_k: F64,
    low_c: F64,
    high_c: F64,
) -> tuple[F64, I64, F64]:
    """The rule of the released SustainDC: steps grow by one from the fourth equal command on.

    Lowering never accelerates there, because the code compares the action's index with the change
    it stands for; holding does count, without effect.

    Args:
        setpoint_c: Present setpoint, C, (B,).
        command: Steps to move, (B,).
        run: Equal commands in a row so far, (B,).
        last: Last command, (B,).
        step_k: Size of a step, K, (B,).
        low_c: Lowest setpoint, C, (B,).
        high_c: Highest setpoint, C, (B,).

    Returns:
        The new setpoint, C, equal commands in a row, and the command, each (B,).
    """
    continues = (command == last) & (command >= 0)
    run = run * continues + 1
    steps = command * np.maximum(run - 2, 1)
    moved_c = np.minimum(np.maximum(setpoint_c + steps * step_k, low_c), high_c)
    return moved_c, run, command


SETPOINTS: dict[str, SetpointModel] = {
    "symmetric": symmetric_setpoint,
    "accelerating": accelerating_setpoint,
}
"""Setpoint models by the names that ``hvac.setpoint.model`` takes."""


def avoid_repeats(command: F64, last: F64) -> F64:
    """Cooling commands that differ from those of the step before at least in the last bit.

    Setpoint model ``accelerating`` multiplies equal commands in a row; commands that are computed
    must not be multiplied.

    Args:
        command: setpoint changes, in steps, (n,).
        last: those of the step before, in steps, (n,); not a number before the first step.
    """
    return np.where(command == last, np.nextafter(command, 0.0), command)


class CracPoint(NamedTuple):
    """Servers and CRAC units of B data centers, whose airflow a model gives."""

    it_w: F64
    """IT power, in W, (B,)."""
    it_airflow_m3s: F64
    """Airflow through the servers, in m3/s, (B,)."""
    speed: F64
    """Fan speed that an agent commands over design speed, (B,)."""
    design_flow_m3s: F64
    """CRAC airflow at design, in m3/s, (B,)."""
    design_it_airflow_m3s: F64
    """Airflow through the servers at design, in m3/s, (B,)."""
    min_ratio: F64
    """Lowest fan speed over design speed, (B,)."""
    supply_m3s_per_w: F64
    """CRAC airflow per IT power, in m3/(s W), (B,)."""


FlowModel = Callable[[CracPoint], tuple[F64, F64]]
"""CRAC airflow, in m3/s, and fan speed over design speed, each (B,)."""


def constant_flow(point: CracPoint) -> tuple[F64, F64]:
    """Airflow of fans at fixed speed, or of fans that hold the pressure under a floor."""
    return point.design_flow_m3s, np.ones_like(point.design_flow_m3s)


def following_flow(point: CracPoint) -> tuple[F64, F64]:
    """Airflow of fans whose speed follows the servers' airflow."""
    speed = np.clip(point.it_airflow_m3s / point.design_it_airflow_m3s, point.min_ratio, 1.0)
    return point.design_flow_m3s * speed, speed


def per_watt_flow(point: CracPoint) -> tuple[F64, F64]:
    """Airflow in proportion to IT power at fixed fan speed, as in the released SustainDC."""
    return point.supply_m3s_per_w * point.it_w, np.ones_like(point.supply_m3s_per_w)


def controlled_flow(point: CracPoint) -> tuple[F64, F64]:
    """Airflow of fans whose speed an agent controls."""
    return point.design_flow_m3s * point.speed, point.speed


CRAC_FLOWS: dict[str, FlowModel] = {
    "constant": constant_flow,
    "pressure": constant_flow,
    "follow_servers": following_flow,
    "hottest_inlet": following_flow,
    "per_watt": per_watt_flow,
    "controlled": controlled_flow,
}
"""Airflow models by the names that ``hvac.crac.flow_model`` takes."""


def crac_fan_w(flow_m3s: Values, *, design_flow_m3s: Values, design_w: Values) -> F64:
    """CRAC fan power by the affinity law, W.

    The released SustainDC code applies the same cube to its flow per watt of IT load, without
    scaling it to the room: 150 W * (5.663e-5/9.438e-5)^3 = 32.4 W for the whole data center.

    Args:
        flow_m3s: Airflow, m3/s, at least 0.
        design_flow_m3s: Airflow at design power, m3/s, above 0.
        design_w: Fan power at that airflow, W.

    Returns:
        Fan power design_w * (flow/design)^3, W, (B,).
    """
    return as_array(design_w * (flow_m3s / design_flow_m3s) ** 3)


class HallPoint(NamedTuple):
    """Air of the halls of B data centers, from which a model takes the cooling load."""

    it_w: F64
    """IT power, in W, (B,)."""
    crac_fan_w: F64
    """Power of the CRAC fans, in W, (B,)."""
    crac_flow_m3s: F64
    """CRAC airflow, in m3/s, (B,)."""
    supply_c: F64
    """Supply air, in C, (B,)."""
    setpoint_c: F64
    """CRAC setpoint, in C, (B,)."""
    outlet_c: F64
    """Mean outlet of the racks, in C, (B,)."""
    air_j_per_m3_k: F64
    """Heat capacity of air per volume, in J/(m3 K), (B,)."""
    return_approach_k: F64
    """Return air less the mean outlet, in K, (B,)."""


@dataclass(frozen=True, slots=True)
class LoadModel:
    """A model of the cooling load."""

    step: Callable[[HallPoint], tuple[F64, F64]]
    """Temperature of the return air, in C, and cooling load, in W, each (B,)."""
    stores_unmet_heat: bool = False
    """Whether heat that the plant does not remove stays in the room; other models remove whatever
    load they compute."""


def heat_balance_load(point: HallPoint) -> tuple[F64, F64]:
    """Return air and cooling load from the heat balance of the hall.

    Servers and CRAC fans heat the air: T_ret = T_sup + P_it/(rho cp V_crac), Q = P_it + P_fan.
    Without airflow the return air has the temperature of the supply.
    """
    flow = point.crac_flow_m3s
    flows = flow > 0
    rise_k = np.where(flows, point.it_w, 0.0) / np.where(flows, point.air_j_per_m3_k * flow, 1.0)
    return point.supply_c + rise_k, point.it_w + point.crac_fan_w


def released_load(point: HallPoint) -> tuple[F64, F64]:
    """Return air and cooling load of the released SustainDC.

    Mean rack outlet plus mean return approach; Q = rho cp V max(0, T_ret - T_set). Heat removed
    differs from heat generated.
    """
    return_c, load_w = paper_load(point)
    return return_c, np.maximum(load_w, 0.0)


def paper_load(point: HallPoint) -> tuple[F64, F64]:
    """Return air and cooling load of the SustainDC paper, A.2.2, without a lower bound.

    Mean rack outlet plus mean return approach; Q = rho cp V (T_ret - T_set), negative where the
    return air is colder than the setpoint.
    """
    return_c = point.outlet_c + point.return_approach_k
    rise_k = return_c - point.setpoint_c
    return return_c, point.air_j_per_m3_k * point.crac_flow_m3s * rise_k


COOLING_LOADS: dict[str, LoadModel] = {
    "heat_balance": LoadModel(heat_balance_load, stores_unmet_heat=True),
    "released": LoadModel(released_load),
    "paper": LoadModel(paper_load),
}
"""Cooling load models by the names that ``hvac.cooling_load_model`` takes."""


ROUND_OFF_SHARE = 1e-12
"""Relative difference up to which two heat flows count as equal: sums over many devices have no
more valid digits, and their last bits depend on the processor."""


def balance_room_heat(
    load_w: F64, heat_removed_w: F64, room_heat_kwh: F64, step_h: float
) -> tuple[F64, F64, F64]:
    """Account for cooling load that was not removed, or removed later.

    Heat generated is heat removed plus the rise of the room heat, to round-off.

    Args:
        load_w: Heat that entered the air of the room, W, (B,).
        heat_removed_w: Heat that the plant took out, W, (B,), at most the load plus the room heat.
        room_heat_kwh: Heat that the room held at the start of the step, kWh, (B,).
        step_h: Length of the step, h.

    Returns:
        Unmet load, W, recovered heat, W, and the new room heat, kWh, each (B,).
    """
    after_kwh = np.maximum(room_heat_kwh + (load_w - heat_removed_w) * step_h / 1e3, 0.0)
    return *unmet_and_recovered(load_w, heat_removed_w), after_kwh


def unmet_and_recovered(load_w: F64, heat_removed_w: F64) -> tuple[F64, F64]:
    """Load beyond the heat removed, and heat removed beyond the load.

    Differences that are no more than rounding errors count as 0.

    Args:
        load_w: Cooling load, W, (B,).
        heat_removed_w: Heat that the plant took out, W, (B,).

    Returns:
        Unmet load and recovered heat, W, each (B,) and at least 0.
    """
    round_off_w = ROUND_OFF_SHARE * np.maximum(load_w, heat_removed_w)
    unmet_w, recovered_w = load_w - heat_removed_w, heat_removed_w - load_w
    return (
        np.where(unmet_w > round_off_w, unmet_w, 0.0),
        np.where(recovered_w > round_off_w, recovered_w, 0.0),
    )
