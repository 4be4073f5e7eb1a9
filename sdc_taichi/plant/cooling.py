"""Air side of the plant: CRAC setpoint, airflow, return temperature and cooling load of the hall.

Setpoint, airflow and cooling load each have several models with one signature, so that a caller can
look a model up by name in ``SETPOINTS``, ``CRAC_FLOWS`` and ``COOLING_LOADS`` and pass all
arguments; a model reads only what its equations need.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sdc_taichi.types import F64, I64

SetpointModel = Callable[..., tuple[F64, I64, F64]]
FlowModel = Callable[..., tuple[F64, F64]]
LoadModel = Callable[..., tuple[F64, F64]]


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
    """Cooling commands that differ from those of the step before, if only in the last bit.

    Setpoint model ``accelerating`` takes equal commands in a row for a wish to go faster and
    multiplies them; a command that is computed means what it says.

    Args:
        command: setpoint changes, in steps, (n,).
        last: those of the step before, in steps, (n,); not a number before the first step.
    """
    return np.where(command == last, np.nextafter(command, 0.0), command)


def constant_flow(
    it_w: F64, airflow_m3s: F64, *, design_flow_m3s: F64, **_: F64
) -> tuple[F64, F64]:
    """CRAC airflow of fans at fixed speed, or of fans that hold the pressure under a floor.

    Args:
        it_w: IT power, W, (B,); not used.
        airflow_m3s: Airflow through the servers, m3/s, (B,); not used.
        design_flow_m3s: CRAC airflow at design, m3/s, (B,).

    Returns:
        CRAC airflow, m3/s, and fan speed over design speed, each (B,).
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
    """CRAC airflow of fans that keep pace with the servers' airflow.

    Args:
        it_w: IT power, W, (B,); not used.
        airflow_m3s: Airflow through the servers, m3/s, (B,).
        design_flow_m3s: CRAC airflow at design, m3/s, (B,).
        design_it_airflow_m3s: Airflow through the servers at design, m3/s, (B,).
        min_ratio: Lowest fan speed over design speed, (B,).

    Returns:
        CRAC airflow, m3/s, and fan speed over design speed, each (B,).
    """
    speed = np.clip(airflow_m3s / design_it_airflow_m3s, min_ratio, 1.0)
    return design_flow_m3s * speed, speed


def per_watt_flow(
    it_w: F64, airflow_m3s: F64, *, supply_m3s_per_w: F64, **_: F64
) -> tuple[F64, F64]:
    """CRAC airflow in proportion to IT power at fixed fan speed, as in the released SustainDC.

    Args:
        it_w: IT power, W, (B,).
        airflow_m3s: Airflow through the servers, m3/s, (B,); not used.
        supply_m3s_per_w: CRAC airflow per IT power, m3/(s W), (B,).

    Returns:
        CRAC airflow, m3/s, and fan speed over design speed, each (B,).
    """
    return supply_m3s_per_w * it_w, np.ones_like(supply_m3s_per_w)


def controlled_flow(
    it_w: F64, airflow_m3s: F64, *, design_flow_m3s: F64, speed: F64, **_: F64
) -> tuple[F64, F64]:
    """CRAC airflow of fans whose speed an agent controls.

    Args:
        it_w: IT power, W, (B,); not used.
        airflow_m3s: Airflow through the servers, m3/s, (B,); not used.
        design_flow_m3s: CRAC airflow at design, m3/s, (B,).
        speed: Fan speed over design speed, (B,).

    Returns:
        CRAC airflow, m3/s, and fan speed over design speed, each (B,).
    """
    return design_flow_m3s * speed, speed


CRAC_FLOWS: dict[str, FlowModel] = {
    "constant": constant_flow,
    "pressure": constant_flow,
    "follow_servers": following_flow,
    "hottest_inlet": following_flow,
    "per_watt": per_watt_flow,
    "controlled": controlled_flow,
}
"""Airflow models by the names that ``hvac.crac.flow_model`` takes."""


def heat_balance_load(
    it_w: F64, crac_fan_w: F64, crac_flow_m3s: F64, supply_c: F64, setpoint_c: F64, outlet_c: F64,
    *, air_j_per_m3_k: F64, return_approach_k: F64,
) -> tuple[F64, F64]:  # fmt: skip
    """Return air and cooling load from the heat balance of the hall.

    Servers and CRAC fans heat the air: T_ret = T_sup + P_it/(rho cp V_crac), Q = P_it + P_fan.

    Args:
        it_w: IT power, W, (B,).
        crac_fan_w: Power of the CRAC fans, W, (B,).
        crac_flow_m3s: CRAC airflow, m3/s, (B,).
        supply_c: Supply air, C, (B,).
        setpoint_c: CRAC setpoint, C, (B,); not used.
        outlet_c: Mean outlet of the racks, C, (B,); not used.
        air_j_per_m3_k: Heat capacity of air per volume, J/(m3 K), (B,).
        return_approach_k: Return air over the mean outlet, K, (B,); not used.

    Returns:
        Return temperature, C, that of the supply without airflow, and cooling load, W, each (B,).
    """
    flows = crac_flow_m3s > 0
    rise_k = np.where(flows, it_w, 0.0) / np.where(flows, air_j_per_m3_k * crac_flow_m3s, 1.0)
    return supply_c + rise_k, it_w + crac_fan_w


def released_load(
    it_w: F64, crac_fan_w: F64, crac_flow_m3s: F64, supply_c: F64, setpoint_c: F64, outlet_c: F64,
    *, air_j_per_m3_k: F64, return_approach_k: F64,
) -> tuple[F64, F64]:  # fmt: skip
    """Return air and cooling load of the released SustainDC.

    Mean rack outlet plus mean return approach; Q = rho cp V max(0, T_ret - T_set). Heat removed
    differs from heat generated.

    Args:
        it_w: IT power, W, (B,); not used.
        crac_fan_w: Power of the CRAC fans, W, (B,); not used.
        crac_flow_m3s: CRAC airflow, m3/s, (B,).
        supply_c: Supply air, C, (B,); not used.
        setpoint_c: CRAC setpoint, C, (B,).
        outlet_c: Mean outlet of the racks, C, (B,).
        air_j_per_m3_k: Heat capacity of air per volume, J/(m3 K), (B,).
        return_approach_k: Return air over the mean outlet, K, (B,).

    Returns:
        Return temperature, C, and cooling load, W, each (B,).
    """
    return_c = outlet_c + return_approach_k
    return return_c, air_j_per_m3_k * crac_flow_m3s * np.maximum(return_c - setpoint_c, 0.0)


def paper_load(
    it_w: F64, crac_fan_w: F64, crac_flow_m3s: F64, supply_c: F64, setpoint_c: F64, outlet_c: F64,
    *, air_j_per_m3_k: F64, return_approach_k: F64,
) -> tuple[F64, F64]:  # fmt: skip
    """Return air and cooling load of the SustainDC paper, A.2.2, without a lower bound.

    Mean rack outlet plus mean return approach; Q = rho cp V (T_ret - T_set), negative where the
    return air is colder than the setpoint.

    Args:
        it_w: IT power, W, (B,); not used.
        crac_fan_w: Power of the CRAC fans, W, (B,); not used.
        crac_flow_m3s: CRAC airflow, m3/s, (B,).
        supply_c: Supply air, C, (B,); not used.
        setpoint_c: CRAC setpoint, C, (B,).
        outlet_c: Mean outlet of the racks, C, (B,).
        air_j_per_m3_k: Heat capacity of air per volume, J/(m3 K), (B,).
        return_approach_k: Return air over the mean outlet, K, (B,).

    Returns:
        Return temperature, C, and cooling load, W, each (B,).
    """
    return_c = outlet_c + return_approach_k
    return return_c, air_j_per_m3_k * crac_flow_m3s * (return_c - setpoint_c)


COOLING_LOADS: dict[str, LoadModel] = {
    "heat_balance": heat_balance_load,
    "released": released_load,
    "paper": paper_load,
}
"""Cooling load models by the names that ``hvac.cooling_load_model`` takes."""


STORES_UNMET_HEAT = frozenset({"heat_balance"})
"""Load models whose heat is conserved; the others remove whatever load they compute."""


ROUND_OFF_SHARE = 1e-12
"""Heat that differs by no more than this share is the same: sums of many devices hold no more
digits, and their last bits depend on the processor."""


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

    Both are differences of sums that may agree; what rounding leaves of them is none.

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
