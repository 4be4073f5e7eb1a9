"""Batteries: energy stored, drawn and delivered in one step, by the models in ``BATTERIES``.

Arguments are float64 arrays of shape (B,), B data centers, or anything that broadcasts to it.
charge_kwh is the energy drawn from the electric bus and discharge_kwh the energy delivered to it,
both on the AC side of the inverter. With the energy S = standby_per_h*capacity*dt that the battery
draws at all times, its inverter converts the energy x = charge_kwh - discharge_kwh - S. Up to
rounding errors, the stored energy after a step is

    stored' = stored + charge_efficiency*(x - k x^2)     if x >= 0
    stored' = stored - discharge_factor*(|x| + k x^2)    if x < 0,   k = square_loss_h/(capacity*dt)

(``Conversion``). S and k are 0 but in the model ``clc``. The model ``released`` has no losses and
rounds the stored energy to 8 decimals of a MWh.

Every battery protects the grid connection, whatever the command is: it charges only with the power
that the limit leaves beside the load, and where the load alone exceeds the limit it discharges to
cover the difference, as far as its own limits allow.

Sources: F. Kazhamiaka, C. Rosenberg, S. Keshav, "Tractable lithium-ion storage models for
optimizing energy systems", Energy Informatics 2 (2019); SustainDC, appendix A.3.4. Losses by load:
G. Notton, V. Lazarov, L. Stoyanov, "Optimal sizing of a grid-connected PV system", Renewable
Energy 35 (2010), whose inverters lose a constant power, and a power that rises with the square of
the load.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sdc_taichi.types import F64, BatteryResult, Values

_ROUND_OFF_SHARE = 1e-12
"""Largest rounding error of the stored energy, as a share of it; a smaller rest counts as empty."""


class BatteryParameters(NamedTuple):
    """Parameters of a battery, named like the fields of the configuration section ``battery``."""

    charge_efficiency: Values = 0.97
    """Energy stored divided by energy drawn from the bus, 0..1, (B,)."""
    discharge_factor: Values = 1.04
    """Energy taken from the store divided by energy delivered to the bus, 1 or more, (B,)."""
    charge_limit_c_rate: Values = 3.0
    """Largest rate at which the stored energy rises, in capacities per hour, (B,)."""
    discharge_limit_c_rate: Values = 3.0
    """Largest rate at which the stored energy falls, in capacities per hour, (B,)."""
    upper_u_h: Values = -0.04
    """Slope of the highest stored energy against the charge power, in h, at most 0, (B,)."""
    upper_v: Values = 1.0
    """Highest stored energy at zero charge power, as a share of the capacity, (B,)."""
    lower_u_h: Values = 0.01
    """Slope of the lowest stored energy against the discharge power, in h, at least 0, (B,)."""
    lower_v: Values = 0.0
    """Lowest stored energy at zero discharge power, as a share of the capacity, (B,)."""
    square_loss_h: Values = 0.0
    """Loss of conversion that rises with the square of the power, times the capacity and divided by
    this square, in h, (B,)."""
    standby_per_h: Values = 0.0
    """Power drawn from the bus at all times, divided by the capacity, in 1/h, (B,)."""


class BatteryPoint(NamedTuple):
    """Battery sizes and facility loads of B data centers in one step."""

    capacity_kwh: Values
    """Battery capacity, in kWh, (B,); 0 means no battery."""
    load_kw: Values
    """Facility load, in kW, (B,); the battery never delivers more power than this."""
    dt_h: Values
    """Length of the step, in h."""
    parameters: BatteryParameters = BatteryParameters()
    """Battery parameters from the configuration."""
    grid_limit_kw: Values | None = None
    """Largest power of the grid connection, in kW, (B,); None means that no limit applies."""


class Conversion(NamedTuple):
    """Conversion between the energy of the bus and the stored energy in a step."""

    charge_efficiency: Values
    """Energy stored divided by energy drawn, without the square loss, (B,)."""
    discharge_factor: Values
    """Energy taken from the store divided by energy delivered, without the square loss, (B,)."""
    square_per_kwh: Values = 0.0
    """Loss divided by the square of the energy that is converted, k, in 1/kWh, (B,)."""
    standby_kwh: Values = 0.0
    """Energy drawn from the bus beside the energy that is converted, in kWh, (B,)."""

    def rise_kwh(self, drawn_kwh: Values, delivered_kwh: Values) -> Values:
        """Return the rise of the stored energy, in kWh, (B,).

        Args:
            drawn_kwh: Energy drawn from the bus without standby, in kWh, at least 0, (B,).
            delivered_kwh: Energy delivered to the bus and to standby, in kWh, at least 0, (B,).
        """
        return self.charge_efficiency * (
            drawn_kwh - self.square_per_kwh * drawn_kwh * drawn_kwh
        ) - self.discharge_factor * (
            delivered_kwh + self.square_per_kwh * delivered_kwh * delivered_kwh
        )

    def drawn_kwh(self, rise_kwh: Values) -> F64:
        """Return the energy drawn from the bus, without standby, for a rise of the store, in kWh.

        Args:
            rise_kwh: Rise of the stored energy, in kWh, at least 0, (B,). A rise that the square
                loss makes impossible counts as the largest possible one.
        """
        linear_kwh = rise_kwh / self.charge_efficiency
        root = np.sqrt(np.maximum(1.0 - 4.0 * self.square_per_kwh * linear_kwh, 0.0))
        return 2.0 * linear_kwh / (1.0 + root)

    def delivered_kwh(self, fall_kwh: Values) -> F64:
        """Return the energy delivered to bus and standby for a fall of the store, in kWh.

        Args:
            fall_kwh: Fall of the stored energy, in kWh, at least 0, (B,).
        """
        linear_kwh = fall_kwh / self.discharge_factor
        return 2.0 * linear_kwh / (1.0 + np.sqrt(1.0 + 4.0 * self.square_per_kwh * linear_kwh))


def conversion(
    model: str, parameters: BatteryParameters, capacity_kwh: Values, dt_h: Values
) -> Conversion:
    """Return the conversion of a battery in a step.

    Args:
        model: Name of the model, see ``BATTERIES``.
        parameters: Battery parameters, (B,) each.
        capacity_kwh: Battery capacity, in kWh, (B,).
        dt_h: Length of the step, in h.
    """
    if model == "released":
        return Conversion(1.0, 1.0)
    linear = Conversion(parameters.charge_efficiency, parameters.discharge_factor)
    if model == "paper":
        return linear
    exists = np.greater(capacity_kwh, 0.0)
    per_kwh = parameters.square_loss_h / (np.where(exists, capacity_kwh, 1.0) * dt_h)
    return linear._replace(
        square_per_kwh=np.where(exists, per_kwh, 0.0),
        standby_kwh=parameters.standby_per_h * capacity_kwh * dt_h,
    )


def round_trip_efficiency(parameters: BatteryParameters) -> F64:
    """Return the energy delivered divided by the energy drawn, both at full power, (B,).

    Args:
        parameters: Battery parameters of the model ``clc``, (B,) each.
    """
    # Per capacity and hour; standby counts for the time that a full cycle takes.
    per_hour = conversion("clc", parameters, 1.0, 1.0)
    drawn = per_hour.drawn_kwh(parameters.charge_limit_c_rate)
    delivered = per_hour.delivered_kwh(parameters.discharge_limit_c_rate)
    charge_h = 1.0 / parameters.charge_limit_c_rate
    discharge_h = 1.0 / parameters.discharge_limit_c_rate
    return ((delivered - per_hour.standby_kwh) * discharge_h) / (
        (drawn + per_hour.standby_kwh) * charge_h
    )


@dataclass(frozen=True, slots=True)
class BatteryModel:
    """Battery model: its step function and the meaning of its discharge limit."""

    step: Callable[[Values, Values, BatteryPoint], BatteryResult]
    """Function that computes one step from the stored energy, in kWh, (B,), the command, (B,), and
    a ``BatteryPoint``. The command is the share of the limit power at which the battery charges
    (0..1) or discharges (-1..0)."""
    by_rate_of_store: bool = False
    """True if ``discharge_limit_c_rate`` limits the power taken from the store, losses included;
    False if it limits the power delivered to the bus."""


def clc(stored_kwh: Values, command: Values, point: BatteryPoint) -> BatteryResult:
    """Step the C/L/C model: linear energy limits, constant rate limits, losses by load.

    The charge power P_c and the discharge power P_d obey, without square loss and standby and for
    the stored energy b,

    P_c <= min(alpha_c*C/eta_c, (v*C - b)/(eta_c*dt - u)),
    P_d <= min(alpha_d*C/eta_d, (b - v'*C)/(u' + eta_d*dt), load).

    Since dt is the true step length, the energy limits hold at the end of the step. The square loss
    raises the first limit and lowers the second, such that the store changes at the same rate.
    Standby is a load beside that of the facility.
    """
    capacity_kwh, dt_h, battery = point.capacity_kwh, point.dt_h, point.parameters
    efficiency, factor = battery.charge_efficiency, battery.discharge_factor
    converted = conversion("clc", battery, capacity_kwh, dt_h)
    standby_kwh = converted.standby_kwh
    room_kwh = np.maximum(battery.upper_v * capacity_kwh - stored_kwh, 0.0)
    content_kwh = np.maximum(stored_kwh - battery.lower_v * capacity_kwh, 0.0)
    most_rise_kwh = np.minimum(
        battery.charge_limit_c_rate * capacity_kwh / efficiency,
        room_kwh / (efficiency * dt_h - battery.upper_u_h),
    ) * (efficiency * dt_h)
    most_fall_kwh = np.minimum(
        battery.discharge_limit_c_rate * capacity_kwh / factor,
        content_kwh / (battery.lower_u_h + factor * dt_h),
    ) * (factor * dt_h)
    result = _step(
        stored_kwh,
        command,
        point._replace(load_kw=point.load_kw + standby_kwh / dt_h),
        converted,
        charge_limit_kw=converted.drawn_kwh(most_rise_kwh) / dt_h,
        discharge_limit_kw=converted.delivered_kwh(most_fall_kwh) / dt_h,
    )
    bus_kwh = result.charge_kwh - result.discharge_kwh + standby_kwh
    return BatteryResult(
        stored_kwh=result.stored_kwh,
        charge_kwh=np.maximum(bus_kwh, 0.0),
        discharge_kwh=np.maximum(-bus_kwh, 0.0),
        battery_loss_kwh=result.battery_loss_kwh + standby_kwh,
        grid_kwh=point.load_kw * dt_h + bus_kwh,
    )


def released(stored_kwh: Values, command: Values, point: BatteryPoint) -> BatteryResult:
    """Step the battery of the released SustainDC code, as identified from its recorded runs.

    Its limits replace dt by a time T that depends on the state of charge s. For charging,
    T = dt*round(sigmoid(5 - 10*s)/2, 4) and the energy is min(0.1*C, (C - b)/(T + 0.04))*T. For
    discharging, T = dt*max(4*sigmoid(10*(s - 0.25)), 0.5) and the energy is
    min(C, b/(T + 0.01), load/4)*T. The factor 1/4 arises because the code passes the energy of a
    quarter hour where a power belongs; therefore even a full battery cannot cover the load. The
    code was only used with dt = 0.25 h. The model has no losses, but it rounds the stored energy
    to 8 decimals of a MWh, which changes it by at most 5e-6 kWh.
    """
    capacity_kwh, dt_h = point.capacity_kwh, point.dt_h
    exists = np.greater(capacity_kwh, 0.0)
    soc = np.where(exists, stored_kwh / np.where(exists, capacity_kwh, 1.0), 0.0)

    charge_h = dt_h * np.round(0.5 * _sigmoid(5.0 - 10.0 * soc), 4)
    charge_kw = np.minimum(0.1 * capacity_kwh, (capacity_kwh - stored_kwh) / (charge_h + 0.04))
    discharge_h = dt_h * np.maximum(4.0 * _sigmoid(10.0 * (soc - 0.25)), 0.5)
    discharge_kw = np.minimum(
        np.minimum(capacity_kwh, stored_kwh / (discharge_h + 0.01)), 0.25 * point.load_kw
    )

    charge_kwh, discharge_kwh = _within_grid_limit(
        np.maximum(command, 0.0) * charge_kw * charge_h,
        np.maximum(-command, 0.0) * discharge_kw * discharge_h,
        discharge_kw * discharge_h,
        point,
    )
    change_kwh = charge_kwh - discharge_kwh
    rounded_kwh = np.clip(np.round((stored_kwh + change_kwh) / 1e3, 8) * 1e3, 0.0, capacity_kwh)
    after_kwh = np.where(np.equal(change_kwh, 0.0), stored_kwh, rounded_kwh)
    return _battery(stored_kwh, after_kwh, charge_kwh, discharge_kwh, point)


def paper(stored_kwh: Values, command: Values, point: BatteryPoint) -> BatteryResult:
    """Step the battery of the paper (appendix A.3.4): energy limits and a largest power.

    r_charge = min((C - E)/(eta_c*dt), P_max), r_discharge = min(E/(eta_d*dt), P_max, load). The
    paper defines P_max by the very rate that it limits (P_charge,max = u*P_charge + v), so this
    model uses a constant share of the capacity instead. The paper writes E for both the stored
    energy and its flow; this model takes the flow as the change of the stored energy,
    +eta_c*r*dt when charging and -eta_d*r*dt when discharging.
    """
    capacity_kwh, dt_h, battery = point.capacity_kwh, point.dt_h, point.parameters
    return _step(
        stored_kwh,
        command,
        point,
        conversion("paper", battery, capacity_kwh, dt_h),
        charge_limit_kw=np.minimum(
            (capacity_kwh - stored_kwh) / (battery.charge_efficiency * dt_h),
            battery.charge_limit_c_rate * capacity_kwh,
        ),
        discharge_limit_kw=np.minimum(
            stored_kwh / (battery.discharge_factor * dt_h),
            battery.discharge_limit_c_rate * capacity_kwh,
        ),
    )


BATTERIES: dict[str, BatteryModel] = {
    "clc": BatteryModel(clc, by_rate_of_store=True),
    "released": BatteryModel(released),
    "paper": BatteryModel(paper),
}
"""Battery models by their names, the valid values of ``battery.model``."""


def _step(
    stored_kwh: Values,
    command: Values,
    point: BatteryPoint,
    converted: Conversion,
    *,
    charge_limit_kw: Values,
    discharge_limit_kw: Values,
) -> BatteryResult:
    """Charge or discharge at ``command`` times the limit power, and at most at the load."""
    discharge_kw = np.minimum(discharge_limit_kw, point.load_kw)
    charge_kwh, discharge_kwh = _within_grid_limit(
        np.maximum(command, 0.0) * charge_limit_kw * point.dt_h,
        np.maximum(-command, 0.0) * discharge_kw * point.dt_h,
        discharge_kw * point.dt_h,
        point,
    )
    after_kwh = stored_kwh + converted.rise_kwh(charge_kwh, discharge_kwh)
    # Rounding errors must neither leave energy in an emptied battery nor overfill a full one.
    after_kwh = np.where(after_kwh > _ROUND_OFF_SHARE * stored_kwh, after_kwh, 0.0)
    after_kwh = np.minimum(after_kwh, point.capacity_kwh)
    return _battery(stored_kwh, after_kwh, charge_kwh, discharge_kwh, point)


def _within_grid_limit(
    charge_kwh: Values, discharge_kwh: Values, max_discharge_kwh: Values, point: BatteryPoint
) -> tuple[Values, Values]:
    """Adjust charge and discharge, in kWh, so that the grid limit holds where possible."""
    if point.grid_limit_kw is None:
        return charge_kwh, discharge_kwh
    load_kwh, limit_kwh = point.load_kw * point.dt_h, point.grid_limit_kw * point.dt_h
    missing_kwh = np.maximum(load_kwh - limit_kwh, 0.0)
    return (
        np.minimum(charge_kwh, np.maximum(limit_kwh - load_kwh, 0.0)),
        np.maximum(discharge_kwh, np.minimum(missing_kwh, max_discharge_kwh)),
    )


def _battery(
    before_kwh: Values,
    after_kwh: Values,
    charge_kwh: Values,
    discharge_kwh: Values,
    point: BatteryPoint,
) -> BatteryResult:
    """Build the result of a step: losses and grid energy follow from the stored energies."""
    return BatteryResult(
        *np.broadcast_arrays(
            after_kwh,
            charge_kwh,
            discharge_kwh,
            charge_kwh - discharge_kwh - (after_kwh - before_kwh),
            point.load_kw * point.dt_h + charge_kwh - discharge_kwh,
        )
    )


def _sigmoid(x: Values) -> Values:
    """Return the logistic function 1/(1 + exp(-x))."""
    return 1.0 / (1.0 + np.exp(-x))
