"""CRAC setpoint, airflow, return temperature and the cooling load of the hall."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sdc_taichi.types import F64, I64

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
        setpoint_c: present setpoint, (B,).
        command: steps to move, (B,).
        run: unused by this model, carried on, (B,).
        last: last command, (B,).
        step_k: size of a step, (B,).
        low_c: lowest setpoint, (B,).
        high_c: highest setpoint, (B,).

    Returns:
        The new setpoint, run and last command, each (B,).
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
    """The released SustainDC rule: from the fourth equal command in a row each step grows by one.

    Lowering never accelerates there, because the code compares the action's index with the change
    it stands for; holding does count, without effect. Arguments as in ``symmetric_setpoint``.
    """
    goes_on = (command == last) & (command >= 0)
    run = run * goes_on + 1
    steps = command * np.maximum(run - 2, 1)
    moved_c = np.minimum(np.maximum(setpoint_c + steps * step_k, low_c), high_c)
    return moved_c, run, command


SETPOINTS: dict[str, SetpointModel] = {
    "symmetric": symmetric_setpoint,
    "accelerating": accelerating_setpoint,
}


def constant_flow(
    it_w: F64, airflow_m3s: F64, *, design_flow_m3s: F64, **_: F64
) -> tuple[F64, F64]:
    """CRAC airflow of fixed-speed fans.

    Args:
        it_w: IT power, (B,).
        airflow_m3s: airflow through the servers, (B,).
        design_flow_m3s: CRAC airflow at design, (B,).

    Returns:
        Airflow m3/s and fan speed over design speed, each (B,).
    """
    return design_flow_m3s, np.ones_like(design_flow_m3s)


def following_flow(
    it_w: F64,
    airflow_m3s: F64,
    *,
    design_flow_m3s: F64,
    design_it_airflow_m3s: F64,
    min_ratio: F64,
    **_: F64,
) -> tuple[F64, F64]:
    """CRAC airflow of fans that keep pace with the servers' airflow; see ``constant_flow``.

    The ratio to design flow follows the ratio of the servers' airflow to theirs, not below
    ``min_ratio``.
    """
    speed = np.clip(airflow_m3s / design_it_airflow_m3s, min_ratio, 1.0)
    return design_flow_m3s * speed, speed


def per_watt_flow(
    it_w: F64, airflow_m3s: F64, *, supply_m3s_per_w: F64, **_: F64
) -> tuple[F64, F64]:
    """Airflow in proportion to IT power, fan speed fixed, as in the released SustainDC.

    See ``constant_flow``.
    """
    return supply_m3s_per_w * it_w, np.ones_like(supply_m3s_per_w)


def controlled_flow(
    it_w: F64, airflow_m3s: F64, *, design_flow_m3s: F64, speed: F64, **_: F64
) -> tuple[F64, F64]:
    """CRAC airflow of fans that an agent controls, at ``speed`` over design speed.

    See ``constant_flow``.
    """
    return design_flow_m3s * speed, speed


FLOWS: dict[str, Callable[..., tuple[F64, F64]]] = {
    "constant": constant_flow,
    "follow_servers": following_flow,
    "per_watt": per_watt_flow,
    "controlled": controlled_flow,
}


def balanced_load(
    it_w: F64, crac_fan_w: F64, crac_flow_m3s: F64, supply_c: F64, setpoint_c: F64, outlet_c: F64,
    *, air_j_per_m3_k: F64, return_approach_k: F64,
) -> tuple[F64, F64]:  # fmt: skip
    """Return air and cooling load from the heat balance of the hall.

    Servers and CRAC fans heat the air: T_ret = T_sup + P_it/(rho cp V_crac), Q = P_it + P_fan.

    Returns:
        Return temperature C, that of the supply without airflow, and cooling load W, each (B,).
    """
    flows = crac_flow_m3s > 0
    rise_k = np.where(flows, it_w, 0.0) / np.where(flows, air_j_per_m3_k * crac_flow_m3s, 1.0)
    return supply_c + rise_k, it_w + crac_fan_w


def released_load(
    it_w: F64, crac_fan_w: F64, crac_flow_m3s: F64, supply_c: F64, setpoint_c: F64, outlet_c: F64,
    *, air_j_per_m3_k: F64, return_approach_k: F64,
) -> tuple[F64, F64]:  # fmt: skip
    """Mean rack outlet plus mean return approach; Q = rho cp V max(0, T_ret - T_set).

    With V in proportion to IT power this is the released SustainDC; heat removed differs from heat
    generated. Returns as ``balanced_load``.
    """
    return_c = outlet_c + return_approach_k
    return return_c, air_j_per_m3_k * crac_flow_m3s * np.maximum(return_c - setpoint_c, 0.0)


def printed_load(
    it_w: F64, crac_fan_w: F64, crac_flow_m3s: F64, supply_c: F64, setpoint_c: F64, outlet_c: F64,
    *, air_j_per_m3_k: F64, return_approach_k: F64,
) -> tuple[F64, F64]:  # fmt: skip
    """As ``released_load`` without the lower bound (paper, A.2.2)."""
    return_c = outlet_c + return_approach_k
    return return_c, air_j_per_m3_k * crac_flow_m3s * (return_c - setpoint_c)


LOADS: dict[str, Callable[..., tuple[F64, F64]]] = {
    "heat_balance": balanced_load,
    "released": released_load,
    "paper": printed_load,
}


STORES_UNMET_HEAT = frozenset({"heat_balance"})
"""Load models whose heat is conserved; the others remove whatever load they compute."""


def hold_heat(
    load_w: F64, removed_w: F64, room_heat_kwh: F64, step_h: float
) -> tuple[F64, F64, F64]:
    """Account for cooling load that was not removed, or removed later.

    generated = removed + change of stored heat, to round-off.

    Args:
        load_w: heat that entered the air of the room, (B,).
        removed_w: heat that the plant took out, at most load plus what was stored, (B,).
        room_heat_kwh: heat stored at the start of the step, (B,).
        step_h: length of the step.

    Returns:
        Unmet W, recovered W and the new stored heat kWh, each (B,).
    """
    stored = np.maximum(room_heat_kwh + (load_w - removed_w) * step_h / 1e3, 0.0)
    return *unmet_and_recovered(load_w, removed_w), stored


def unmet_and_recovered(load_w: F64, removed_w: F64) -> tuple[F64, F64]:
    """Load beyond what is removed, and what is removed beyond the load, each (B,)."""
    return np.maximum(load_w - removed_w, 0.0), np.maximum(removed_w - load_w, 0.0)
