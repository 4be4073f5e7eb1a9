"""Air side of the plant: CRAC setpoint, airflow, return temperature and cooling load of the hall.

The models of the setpoint are in ``SETPOINTS``, those of the airflow in ``CRAC_FLOWS``, and those
of the cooling load in ``COOLING_LOADS``. Arrays of shape (B,) have one value per data center.
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
        command: Number of steps to move, (B,).
        run: Number of equal commands in a row so far, (B,); not used.
        last: Command of the previous step, (B,); not used.
        step_k: Size of a step, K, (B,).
        low_c: Lowest setpoint, C, (B,).
        high_c: Highest setpoint, C, (B,).

    Returns:
        The new setpoint, in C, the unchanged ``run``, and the command, each (B,).
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
    """Move the setpoint by the rule of the released SustainDC, which amplifies repeated commands.

    From the fourth equal command in a row on, the change grows by one step per command. Lowering
    the setpoint is never amplified, because the released code compares the index of the action
    with the change that the action stands for. Repeated zero commands count but move nothing.
    Arguments are as in ``symmetric_setpoint``.

    Returns:
        The new setpoint, in C, the number of equal commands in a row, and the command, each (B,).
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
"""Setpoint models by their names, the valid values of ``hvac.setpoint.model``."""


def avoid_repeats(command: F64, last: F64) -> F64:
    """Return cooling commands that differ from the previous ones at least in the last bit.

    The setpoint model ``accelerating`` amplifies equal commands in a row. Setpoint changes that a
    controller computes must reach the plant without this amplification.

    Args:
        command: Setpoint changes, in steps, (n,).
        last: Setpoint changes of the previous step, in steps, (n,); NaN in the first step.
    """
    return np.where(command == last, np.nextafter(command, 0.0), command)


class CracPoint(NamedTuple):
    """Servers and CRAC units of B data centers: the input of models of the CRAC airflow."""

    it_w: F64
    """IT power, in W, (B,)."""
    it_airflow_m3s: F64
    """Airflow through the servers, in m3/s, (B,)."""
    speed: F64
    """Fan speed commanded by an agent, divided by design speed, (B,)."""
    design_flow_m3s: F64
    """CRAC airflow at design, in m3/s, (B,)."""
    design_it_airflow_m3s: F64
    """Airflow through the servers at design, in m3/s, (B,)."""
    min_ratio: F64
    """Lowest fan speed divided by design speed, (B,)."""
    supply_m3s_per_w: F64
    """CRAC airflow divided by IT power, in m3/(s W), (B,)."""


FlowModel = Callable[[CracPoint], tuple[F64, F64]]
"""Function that returns CRAC airflow, in m3/s, and fan speed divided by design speed, each (B,)."""


def constant_flow(point: CracPoint) -> tuple[F64, F64]:
    """Return the design airflow, for fans at fixed speed or fans that hold a plenum pressure."""
    return point.design_flow_m3s, np.ones_like(point.design_flow_m3s)


def following_flow(point: CracPoint) -> tuple[F64, F64]:
    """Return the airflow of fans whose speed is proportional to the airflow of the servers."""
    speed = np.clip(point.it_airflow_m3s / point.design_it_airflow_m3s, point.min_ratio, 1.0)
    return point.design_flow_m3s * speed, speed


def per_watt_flow(point: CracPoint) -> tuple[F64, F64]:
    """Return an airflow proportional to IT power, at fixed fan speed, as the released SustainDC."""
    return point.supply_m3s_per_w * point.it_w, np.ones_like(point.supply_m3s_per_w)


def controlled_flow(point: CracPoint) -> tuple[F64, F64]:
    """Return the airflow of fans whose speed an agent controls."""
    return point.design_flow_m3s * point.speed, point.speed


CRAC_FLOWS: dict[str, FlowModel] = {
    "constant": constant_flow,
    "pressure": constant_flow,
    "follow_servers": following_flow,
    "hottest_inlet": following_flow,
    "per_watt": per_watt_flow,
    "controlled": controlled_flow,
}
"""Airflow models by their names, the valid values of ``hvac.crac.flow_model``."""


def crac_fan_w(flow_m3s: Values, *, design_flow_m3s: Values, design_w: Values) -> F64:
    """Compute the power of the CRAC fans by the affinity law, in W.

    The released SustainDC code applies the same cubic law to the airflow per watt of IT load
    instead of the airflow of the room, so the fans of its whole data center draw
    150 W * (5.663e-5/9.438e-5)^3 = 32.4 W.

    Args:
        flow_m3s: Airflow, m3/s, at least 0.
        design_flow_m3s: Airflow at design power, m3/s, above 0.
        design_w: Fan power at the design airflow, W.

    Returns:
        Fan power design_w * (flow_m3s / design_flow_m3s)^3, W, (B,).
    """
    return as_array(design_w * (flow_m3s / design_flow_m3s) ** 3)


class HallPoint(NamedTuple):
    """Air in the halls of B data centers: the input of models of the cooling load."""

    it_w: F64
    """IT power, in W, (B,)."""
    crac_fan_w: F64
    """Power of the CRAC fans, in W, (B,)."""
    crac_flow_m3s: F64
    """CRAC airflow, in m3/s, (B,)."""
    supply_c: F64
    """Supply air temperature, in C, (B,)."""
    setpoint_c: F64
    """CRAC supply setpoint, in C, (B,)."""
    outlet_c: F64
    """Mean outlet temperature of the racks, in C, (B,)."""
    air_j_per_m3_k: F64
    """Volumetric heat capacity of air, in J/(m3 K), (B,)."""
    return_approach_k: F64
    """Return air temperature minus the mean rack outlet temperature, in K, (B,)."""


@dataclass(frozen=True, slots=True)
class LoadModel:
    """Model of the return air temperature and the cooling load of the hall."""

    step: Callable[[HallPoint], tuple[F64, F64]]
    """Function that returns the return air temperature, in C, and the cooling load, in W, each
    (B,)."""
    stores_unmet_heat: bool = False
    """True if heat that the plant does not remove stays in the room; False if the plant always
    removes the whole load."""


def heat_balance_load(point: HallPoint) -> tuple[F64, F64]:
    """Compute return air temperature and cooling load from the heat balance of the hall.

    Servers and CRAC fans heat the air: T_ret = T_sup + P_it/(rho cp V_crac), Q = P_it + P_fan.
    Without airflow the return air has the temperature of the supply air.
    """
    flow = point.crac_flow_m3s
    flows = flow > 0
    rise_k = np.where(flows, point.it_w, 0.0) / np.where(flows, point.air_j_per_m3_k * flow, 1.0)
    return point.supply_c + rise_k, point.it_w + point.crac_fan_w


def released_load(point: HallPoint) -> tuple[F64, F64]:
    """Compute return air temperature and cooling load of the released SustainDC code.

    The return air temperature is the mean rack outlet plus the mean return approach, and the load
    is Q = rho cp V max(0, T_ret - T_set). The heat removed differs from the heat generated.
    """
    return_c, load_w = paper_load(point)
    return return_c, np.maximum(load_w, 0.0)


def paper_load(point: HallPoint) -> tuple[F64, F64]:
    """Compute return air temperature and cooling load of the SustainDC paper (A.2.2).

    The return air temperature is the mean rack outlet plus the mean return approach, and the load
    is Q = rho cp V (T_ret - T_set), negative where the return air is colder than the setpoint.
    """
    return_c = point.outlet_c + point.return_approach_k
    rise_k = return_c - point.setpoint_c
    return return_c, point.air_j_per_m3_k * point.crac_flow_m3s * rise_k


COOLING_LOADS: dict[str, LoadModel] = {
    "heat_balance": LoadModel(heat_balance_load, stores_unmet_heat=True),
    "released": LoadModel(released_load),
    "paper": LoadModel(paper_load),
}
"""Cooling load models by their names, the valid values of ``hvac.cooling_load_model``."""


ROUND_OFF_SHARE = 1e-12
"""Relative difference up to which two heat flows count as equal. Rounding errors of sums over many
devices are of this size and depend on the processor."""


def balance_room_heat(
    load_w: F64, heat_removed_w: F64, room_heat_kwh: F64, step_h: float
) -> tuple[F64, F64, F64]:
    """Update the heat stored in the room by the cooling load that the plant did not remove.

    Heat generated equals heat removed plus the rise of the stored heat, up to rounding errors.

    Args:
        load_w: Heat that entered the air of the room, W, (B,).
        heat_removed_w: Heat that the plant removed, W, (B,), at most the load plus the stored heat.
        room_heat_kwh: Heat stored in the room at the start of the step, kWh, (B,).
        step_h: Length of the step, h.

    Returns:
        Unmet load, W, stored heat removed, W, and the new stored heat, kWh, each (B,).
    """
    after_kwh = np.maximum(room_heat_kwh + (load_w - heat_removed_w) * step_h / 1e3, 0.0)
    return *unmet_and_recovered(load_w, heat_removed_w), after_kwh


def unmet_and_recovered(load_w: F64, heat_removed_w: F64) -> tuple[F64, F64]:
    """Return the unmet load and the heat removed in excess of the load.

    Differences within rounding errors count as 0.

    Args:
        load_w: Cooling load, W, (B,).
        heat_removed_w: Heat that the plant removed, W, (B,).

    Returns:
        Unmet load and heat removed in excess of the load, W, each (B,) and at least 0.
    """
    round_off_w = ROUND_OFF_SHARE * np.maximum(load_w, heat_removed_w)
    unmet_w, recovered_w = load_w - heat_removed_w, heat_removed_w - load_w
    return (
        np.where(unmet_w > round_off_w, unmet_w, 0.0),
        np.where(recovered_w > round_off_w, recovered_w, 0.0),
    )
