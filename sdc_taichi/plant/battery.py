"""Batteries: energy stored, drawn and delivered in one step, each model a pure function by name.

Every model has the same signature, so a caller can look it up in `BATTERIES` and pass all of:

    stored_kwh             energy in the store, kWh
    command                -1..1: 1 charges at the limit power, -1 discharges at it, 0 idles; the
                           power is this share of the limit
    capacity_kwh           capacity, kWh (0 is a battery that is not there)
    load_kw                facility load, kW; a discharge never delivers more
    dt_h                   length of the step, h
    charge_efficiency      energy stored per energy drawn from the bus
    discharge_factor       energy taken from the store per energy delivered
    charge_limit_c_rate    largest rate into the store, in capacities per hour
    discharge_limit_c_rate largest rate out of the store, in capacities per hour
    upper_u_h, upper_v     highest stored energy at charge power P, u*P + v*capacity; u in h
    lower_u_h, lower_v     lowest stored energy at discharge power P, u*P + v*capacity; u in h
    grid_limit_kw          most power that the grid connection carries, kW; None is no limit

Arguments are float64 arrays of shape (B,), or anything that broadcasts to it; a model reads only
what its equations need. Energy at the bus: charge_kwh is drawn, discharge_kwh delivered, and

    stored' = stored + charge_efficiency*charge_kwh - discharge_factor*discharge_kwh

to rounding; the released model has no losses and rounds its store to 8 decimals of a MWh.

Every battery guards the grid connection: it charges with what the limit leaves beside the load,
and where the load alone exceeds the limit it discharges to make up the difference, as far as its
own limits allow and whatever the command says.

Sources: F. Kazhamiaka, C. Rosenberg, S. Keshav, "Tractable lithium-ion storage models for
optimizing energy systems", Energy Informatics 2 (2019); SustainDC, appendix A.3.4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sdc_taichi.types import F64, Values

_ROUND_OFF_SHARE = 1e-12
"""Share of the stored energy that rounding may leave in a battery that is emptied exactly."""


@dataclass(frozen=True, slots=True)
class BatteryResult:
    """One step of the batteries of B data centers."""

    stored_kwh: F64
    """Energy in the battery at the end of the step, in kWh, (B,)."""
    charge_kwh: F64
    """Energy drawn from the bus into the battery, in kWh, (B,)."""
    discharge_kwh: F64
    """Energy that the battery delivers to the load, in kWh, (B,)."""
    battery_loss_kwh: F64
    """Energy lost, charge minus discharge minus the rise of the stored energy, in kWh, (B,)."""
    grid_kwh: F64
    """Energy bought, load plus charge minus discharge, in kWh, (B,), at least 0."""


def clc(
    stored_kwh: Values,
    command: Values,
    *,
    capacity_kwh: Values,
    load_kw: Values,
    dt_h: Values,
    charge_efficiency: Values = 0.97,
    discharge_factor: Values = 1.04,
    charge_limit_c_rate: Values = 3.0,
    discharge_limit_c_rate: Values = 3.0,
    upper_u_h: Values = -0.04,
    upper_v: Values = 1.0,
    lower_u_h: Values = 0.01,
    lower_v: Values = 0.0,
    grid_limit_kw: Values | None = None,
) -> BatteryResult:
    """C/L/C: constant efficiencies, linear limits of the stored energy, constant rate limits.

    P_c <= min(alpha_c*C/eta_c, (v*C - b)/(eta_c*dt - u)),
    P_d <= min(alpha_d*C/eta_d, (b - v'*C)/(u' + eta_d*dt), load), with the true step length, so
    the limits of the stored energy hold at the end of the step.

    Args:
        stored_kwh: Energy in the store b, kWh.
        command: Share of the limit power, -1..1.
        capacity_kwh: Capacity C, kWh.
        load_kw: Facility load, kW.
        dt_h: Length of the step, h.
        charge_efficiency: Energy stored per energy drawn eta_c, 0..1.
        discharge_factor: Energy taken from the store per energy delivered eta_d, 1 or more.
        charge_limit_c_rate: Largest rate into the store alpha_c, 1/h.
        discharge_limit_c_rate: Largest rate out of the store alpha_d, 1/h.
        upper_u_h: Rise u of the highest stored energy with the charge power, h, at most 0.
        upper_v: Highest stored energy v without charge power, over capacity.
        lower_u_h: Rise u' of the lowest stored energy with the discharge power, h, at least 0.
        lower_v: Lowest stored energy v' without discharge power, over capacity.
        grid_limit_kw: Most power of the grid connection, kW; None is no limit.

    Returns:
        The battery's step.
    """
    room_kwh = np.maximum(upper_v * capacity_kwh - stored_kwh, 0.0)
    content_kwh = np.maximum(stored_kwh - lower_v * capacity_kwh, 0.0)
    return _step(
        stored_kwh,
        command,
        capacity_kwh=capacity_kwh,
        load_kw=load_kw,
        dt_h=dt_h,
        charge_limit_kw=np.minimum(
            charge_limit_c_rate * capacity_kwh / charge_efficiency,
            room_kwh / (charge_efficiency * dt_h - upper_u_h),
        ),
        discharge_limit_kw=np.minimum(
            discharge_limit_c_rate * capacity_kwh / discharge_factor,
            content_kwh / (lower_u_h + discharge_factor * dt_h),
        ),
        charge_efficiency=charge_efficiency,
        discharge_factor=discharge_factor,
        grid_limit_kw=grid_limit_kw,
    )


def released(
    stored_kwh: Values,
    command: Values,
    *,
    capacity_kwh: Values,
    load_kw: Values,
    dt_h: Values,
    charge_efficiency: Values = 1.0,
    discharge_factor: Values = 1.0,
    charge_limit_c_rate: Values = 0.1,
    discharge_limit_c_rate: Values = 1.0,
    upper_u_h: Values = -0.04,
    upper_v: Values = 1.0,
    lower_u_h: Values = 0.01,
    lower_v: Values = 0.0,
    grid_limit_kw: Values | None = None,
) -> BatteryResult:
    """The battery of the released SustainDC code, as identified from its recorded runs.

    The limits use a step length T that depends on the state of charge s instead of dt: charging
    T = dt*round(sigmoid(5 - 10*s)/2, 4) and energy min(0.1*C, (C - b)/(T + 0.04))*T; discharging
    T = dt*max(4*sigmoid(10*(s - 0.25)), 0.5) and energy min(C, b/(T + 0.01), load/4)*T. The
    quarter comes from passing the energy of a quarter hour where a power belongs, so even a full
    battery carries less than the load. No losses. The store is kept in MWh with 8 decimals.

    Args:
        stored_kwh: Energy in the store b, kWh.
        command: Share of the limit power, -1..1.
        capacity_kwh: Capacity C, kWh.
        load_kw: Facility load, kW.
        dt_h: Length of the step, h; the code was only used with 0.25.
        charge_efficiency: Not used; the model has 1.
        discharge_factor: Not used; the model has 1.
        charge_limit_c_rate: Not used; the model has 0.1 per hour.
        discharge_limit_c_rate: Not used; the model has 1 per hour.
        upper_u_h: Not used; the model has -0.04 h.
        upper_v: Not used; the model has 1.
        lower_u_h: Not used; the model has 0.01 h.
        lower_v: Not used; the model has 0.
        grid_limit_kw: Most power of the grid connection, kW; None is no limit.

    Returns:
        The battery's step. Its loss is what the rounding takes or gives, 5e-6 kWh at most.
    """
    exists = np.greater(capacity_kwh, 0.0)
    soc = np.where(exists, stored_kwh / np.where(exists, capacity_kwh, 1.0), 0.0)

    charge_h = dt_h * np.round(0.5 * _sigmoid(5.0 - 10.0 * soc), 4)
    charge_kw = np.minimum(0.1 * capacity_kwh, (capacity_kwh - stored_kwh) / (charge_h + 0.04))
    discharge_h = dt_h * np.maximum(4.0 * _sigmoid(10.0 * (soc - 0.25)), 0.5)
    discharge_kw = np.minimum(
        np.minimum(capacity_kwh, stored_kwh / (discharge_h + 0.01)), 0.25 * load_kw
    )

    charge_kwh, discharge_kwh = _within_grid_limit(
        np.maximum(command, 0.0) * charge_kw * charge_h,
        np.maximum(-command, 0.0) * discharge_kw * discharge_h,
        most_discharge_kwh=discharge_kw * discharge_h,
        load_kw=load_kw,
        grid_limit_kw=grid_limit_kw,
        dt_h=dt_h,
    )
    change_kwh = charge_kwh - discharge_kwh
    rounded_kwh = np.clip(np.round((stored_kwh + change_kwh) / 1e3, 8) * 1e3, 0.0, capacity_kwh)
    return _battery(
        stored_kwh,
        np.where(np.equal(change_kwh, 0.0), stored_kwh, rounded_kwh),
        charge_kwh=charge_kwh,
        discharge_kwh=discharge_kwh,
        load_kwh=load_kw * dt_h,
    )


def paper(
    stored_kwh: Values,
    command: Values,
    *,
    capacity_kwh: Values,
    load_kw: Values,
    dt_h: Values,
    charge_efficiency: Values = 0.97,
    discharge_factor: Values = 1.04,
    charge_limit_c_rate: Values = 0.5,
    discharge_limit_c_rate: Values = 0.5,
    upper_u_h: Values = -0.04,
    upper_v: Values = 1.0,
    lower_u_h: Values = 0.01,
    lower_v: Values = 0.0,
    grid_limit_kw: Values | None = None,
) -> BatteryResult:
    """Appendix A.3.4: the rates are limited by the energy that fits and by a largest power.

    r_charge = min((C - E)/(eta_c*dt), P_max), r_discharge = min(E/(eta_d*dt), P_max, load). The
    paper puts P_max in terms of the rate it limits (P_charge,max = u*P_charge + v), so it is taken
    as a share of the capacity. It writes E for both the state and the flow; the latter is read as
    the change of the state, +eta_c*r*dt when charging and -eta_d*r*dt when discharging.

    Args:
        stored_kwh: Energy in the store E, kWh.
        command: Share of the limit power, -1..1.
        capacity_kwh: Capacity C, kWh.
        load_kw: Facility load, kW.
        dt_h: Length of the step, h.
        charge_efficiency: Energy stored per energy drawn eta_c, 0..1.
        discharge_factor: eta_d, energy taken from the store per energy delivered.
        charge_limit_c_rate: P_max over capacity when charging, 1/h.
        discharge_limit_c_rate: P_max over capacity when discharging, 1/h.
        upper_u_h: Not used.
        upper_v: Not used.
        lower_u_h: Not used.
        lower_v: Not used.
        grid_limit_kw: Most power of the grid connection, kW; None is no limit.

    Returns:
        The battery's step.
    """
    return _step(
        stored_kwh,
        command,
        capacity_kwh=capacity_kwh,
        load_kw=load_kw,
        dt_h=dt_h,
        charge_limit_kw=np.minimum(
            (capacity_kwh - stored_kwh) / (charge_efficiency * dt_h),
            charge_limit_c_rate * capacity_kwh,
        ),
        discharge_limit_kw=np.minimum(
            stored_kwh / (discharge_factor * dt_h), discharge_limit_c_rate * capacity_kwh
        ),
        charge_efficiency=charge_efficiency,
        discharge_factor=discharge_factor,
        grid_limit_kw=grid_limit_kw,
    )


BATTERIES: dict[str, Callable[..., BatteryResult]] = {
    "clc": clc,
    "released": released,
    "paper": paper,
}
"""Battery models by the names that ``battery.model`` takes."""


def _step(
    stored_kwh: Values,
    command: Values,
    *,
    capacity_kwh: Values,
    load_kw: Values,
    dt_h: Values,
    charge_limit_kw: Values,
    discharge_limit_kw: Values,
    charge_efficiency: Values,
    discharge_factor: Values,
    grid_limit_kw: Values | None,
) -> BatteryResult:
    """Charge or discharge at a share of the limit powers; a discharge never exceeds the load."""
    discharge_kw = np.minimum(discharge_limit_kw, load_kw)
    charge_kwh, discharge_kwh = _within_grid_limit(
        np.maximum(command, 0.0) * charge_limit_kw * dt_h,
        np.maximum(-command, 0.0) * discharge_kw * dt_h,
        most_discharge_kwh=discharge_kw * dt_h,
        load_kw=load_kw,
        grid_limit_kw=grid_limit_kw,
        dt_h=dt_h,
    )
    after_kwh = stored_kwh + charge_efficiency * charge_kwh - discharge_factor * discharge_kwh
    # Emptying or filling exactly can miss by the last bits, and an empty battery carries nothing.
    after_kwh = np.where(after_kwh > _ROUND_OFF_SHARE * stored_kwh, after_kwh, 0.0)
    return _battery(
        stored_kwh,
        np.minimum(after_kwh, capacity_kwh),
        charge_kwh=charge_kwh,
        discharge_kwh=discharge_kwh,
        load_kwh=load_kw * dt_h,
    )


def _within_grid_limit(
    charge_kwh: Values,
    discharge_kwh: Values,
    *,
    most_discharge_kwh: Values,
    load_kw: Values,
    grid_limit_kw: Values | None,
    dt_h: Values,
) -> tuple[Values, Values]:
    """Charge and discharge, kWh, that keep the grid connection within its limit if they can."""
    if grid_limit_kw is None:
        return charge_kwh, discharge_kwh
    load_kwh, limit_kwh = load_kw * dt_h, grid_limit_kw * dt_h
    missing_kwh = np.maximum(load_kwh - limit_kwh, 0.0)
    return (
        np.minimum(charge_kwh, np.maximum(limit_kwh - load_kwh, 0.0)),
        np.maximum(discharge_kwh, np.minimum(missing_kwh, most_discharge_kwh)),
    )


def _battery(
    before_kwh: Values,
    after_kwh: Values,
    *,
    charge_kwh: Values,
    discharge_kwh: Values,
    load_kwh: Values,
) -> BatteryResult:
    """Result of a step, with loss and grid energy from the energies before and after it."""
    return BatteryResult(
        *np.broadcast_arrays(
            after_kwh,
            charge_kwh,
            discharge_kwh,
            charge_kwh - discharge_kwh - (after_kwh - before_kwh),
            load_kwh + charge_kwh - discharge_kwh,
        )
    )


def _sigmoid(x: Values) -> Values:
    """Logistic function 1/(1 + exp(-x))."""
    return 1.0 / (1.0 + np.exp(-x))
