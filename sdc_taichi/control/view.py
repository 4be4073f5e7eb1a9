"""Views of data centers for controllers, and forecasts whose errors are random walks.

A forecast issued at time t for time t + h has the error ``s (W(t + h) - W(t))``, with a random walk
W of unit variance per 24 h and the standard deviation s of the error at 24 h. The error is zero for
the present and grows with the square root of the lead h. Environments and controllers use the same
walks, which depend only on the key of the data center and on the step.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from sdc_taichi.control.coolant_loops import CoolantLoops, LoopReadings, lowest
from sdc_taichi.control.unit_zones import UnitZones, ZoneReadings
from sdc_taichi.errors import ConfigError, RuntimeStateError, suggestion
from sdc_taichi.exogenous.year_clock import HOURS_PER_YEAR
from sdc_taichi.number_text import parse_number
from sdc_taichi.plant.battery import round_trip_efficiency
from sdc_taichi.sim.drivers import Drivers, FleetSeries
from sdc_taichi.sim.facility import battery_parameters
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_state import Precision
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.sim.sizing import Sizing
from sdc_taichi.sim.zone_loads import RackLoads, ZoneLoads
from sdc_taichi.types import F64, I64, Exogenous, State, StepResult

MOST_CI_SHARE = 10.0
"""Largest valid standard deviation of carbon intensity errors, divided by the true value."""
MOST_TEMPERATURE_K = 40.0
"""Largest valid standard deviation of temperature errors, in K; the largest recorded deviation from
the climate is 39 K."""
CI_WALK, TEMPERATURE_WALK = 0, 1
"""Indices of the random walks of carbon intensity and of temperatures."""
_FIELD_OF_NAME = {"ci": "ci_share", "temperature": "temperature_k"}
"""Fields of ``ForecastError`` by their names in its text form."""
_DRAWN_STEPS = 128
"""Number of steps of the random walks that are drawn at once."""


@dataclass(frozen=True, slots=True)
class ForecastError:
    """Standard deviations of forecast errors at a lead of 24 h; zero means perfect foresight.

    Raises:
        ConfigError: A value is not a number or out of bounds.
    """

    ci_share: Annotated[float, Field(ge=0, le=MOST_CI_SHARE)] = 0.0
    """Standard deviation of the error of carbon intensity at 24 h, as a share of the true value,
    0..10; negative forecasts are set to zero."""
    temperature_k: Annotated[float, Field(ge=0, le=MOST_TEMPERATURE_K)] = 0.0
    """Standard deviation of the error of outdoor temperatures at 24 h, in K, 0..40. Dry bulb and
    wet bulb have the same error, so the wet bulb stays below the dry bulb."""

    def __post_init__(self) -> None:
        """Check the values."""
        for name, most in (("ci_share", MOST_CI_SHARE), ("temperature_k", MOST_TEMPERATURE_K)):
            value: Any = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float | np.number):
                raise ConfigError(f"forecast error {name}: {value!r} is no number")
            if not 0.0 <= value <= most:
                raise ConfigError(f"forecast error {name}: {value:g}; valid is 0..{most:g}")

    @classmethod
    def parse(cls, text: str) -> ForecastError:
        """Parse forecast errors from a text such as ``ci=0.1,temperature=1``.

        Args:
            text: Assignments of ``ci``, as a share, and ``temperature``, in K; either may be
                missing.

        Raises:
            ConfigError: A name is unknown or appears twice, or a value is not valid.
        """
        values: dict[str, float] = {}
        for part in text.split(","):
            name, sign, value = (piece.strip() for piece in part.partition("="))
            if not sign or name not in _FIELD_OF_NAME:
                meant = suggestion(name, _FIELD_OF_NAME, " (did you mean {!r}?)")
                raise ConfigError(
                    f"forecast error {text!r}: {part.strip()!r}; valid is ci=SHARE, temperature=K, "
                    f"or both, such as ci=0.1,temperature=1{meant}"
                )
            if _FIELD_OF_NAME[name] in values:
                raise ConfigError(
                    f"forecast error {text!r}: {name} is given twice; valid is each once"
                )
            try:
                values[_FIELD_OF_NAME[name]] = parse_number(value)
            except ValueError:
                raise ConfigError(
                    f"forecast error {text!r}: {name} {value!r} is no number"
                ) from None
        return cls(**values)


PERFECT = ForecastError()
"""Perfect foresight."""


class RandomWalks:
    """Two random walks for each data center, of unit variance per 24 h, that start at reset.

    Args:
        keys: Seed of the walks of each data center, (B,).
        step_h: Length of a step, h.
    """

    def __init__(self, keys: Sequence[int] | I64, step_h: float) -> None:
        self._generators = [np.random.Generator(np.random.PCG64(int(key))) for key in keys]
        self._scale = np.sqrt(step_h / 24.0)
        self._first = 0
        self._walk: F64 = np.zeros((2, 1, len(keys)))

    def increments(self, which: int, step: int, leads: I64) -> F64:
        """Return the increments of a walk between ``step`` and each lead, (k, B).

        This call discards the walk before ``step``.

        Args:
            which: ``CI_WALK`` or ``TEMPERATURE_WALK``.
            step: Number of steps since reset.
            leads: Leads, in steps, (k,).

        Raises:
            RuntimeStateError: ``step`` is before the step of an earlier call.
        """
        self._extend(step, int(leads.max()))
        now = step - self._first
        walk = self._walk[which]
        return np.asarray(walk[now + leads] - walk[now])

    def _extend(self, step: int, ahead: int) -> None:
        if step < self._first:
            raise RuntimeStateError(
                f"forecasts of step {step} after those of a later one; reset starts again"
            )
        while self._first + self._walk.shape[1] <= step + ahead:
            keep = min(step - self._first, self._walk.shape[1] - 1)
            drawn = np.stack(
                [rng.standard_normal((2, _DRAWN_STEPS)) for rng in self._generators], axis=2
            )
            more = self._walk[:, -1:] + np.cumsum(drawn * self._scale, axis=1)
            self._walk = np.concatenate([self._walk[:, keep:], more], axis=1)
            self._first += keep


def walk_keys(seeds: I64, names: Sequence[str]) -> I64:
    """Return seeds of the random walks of a run, (B,), independent of events and controllers.

    Args:
        seeds: Seed of each data center, (B,).
        names: Names of the B data centers; data centers with equal seeds but different names have
            different errors.
    """
    drawn = [
        np.random.SeedSequence([int(seed), zlib.crc32(name.encode())]).generate_state(1, np.uint64)
        for seed, name in zip(seeds, names, strict=True)
    ]
    return np.asarray(np.concatenate(drawn) >> 1, dtype=np.int64)


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of setpoint and battery from the configs of a fleet."""

    setpoint_low_c: F64
    """Lowest setpoint of the CRAC supply air, in C, (B,)."""
    setpoint_high_c: F64
    """Highest setpoint of the CRAC supply air, in C, (B,)."""
    setpoint_step_k: F64
    """Change of the setpoint by a cooling command of 1, in K, (B,)."""
    battery_round_trip: F64
    """Battery round-trip efficiency at full power: energy delivered divided by energy drawn, 0..1,
    (B,)."""


@dataclass(frozen=True, slots=True)
class Forecast:
    """Forecast of weather, carbon intensity and price for n coming steps.

    Column 0 is the next step, which is known exactly. Prices are exact for all steps.
    """

    drivers: Drivers
    """Inputs of all steps."""
    index: I64
    """Coming steps, counted from the beginning of the year, (B, n)."""
    ci_error: F64 | None = None
    """Error of the carbon intensity as a share of its true value, (B, n); None means no error."""
    temperature_error_k: F64 | None = None
    """Error of dry bulb and wet bulb, in K, (B, n); None means no error."""

    @property
    def ci_g_per_kwh(self) -> F64:
        """Carbon intensity of the grid, in g CO2e/kWh, (B, n)."""
        true = self.drivers.ci_g_per_kwh.at(self.index)
        return true if self.ci_error is None else np.maximum(true * (1.0 + self.ci_error), 0.0)

    @property
    def price_per_kwh(self) -> F64:
        """Price of a kWh from the grid, in the currency of the tariff, (B, n)."""
        assert self.drivers.price_per_kwh is not None, "a simulator has filled it in"
        return self.drivers.price_per_kwh.at(self.index)

    @property
    def outdoor_c(self) -> F64:
        """Outdoor dry-bulb temperature, in C, (B, n)."""
        return self._temperature_c(self.drivers.outdoor_c)

    @property
    def wet_bulb_c(self) -> F64:
        """Outdoor wet-bulb temperature, in C, (B, n)."""
        return self._temperature_c(self.drivers.wet_bulb_c)

    def _temperature_c(self, series: FleetSeries) -> F64:
        true = series.at(self.index)
        return true if self.temperature_error_k is None else true + self.temperature_error_k


@dataclass(frozen=True, slots=True)
class View:
    """Data that a controller may see before a step of a fleet of B data centers."""

    last: StepResult | None
    """Result of the previous step; None before the first step."""
    state: State
    """State before the next step."""
    drivers: Drivers
    """True inputs of all steps, including future ones; ``forecast`` returns them with errors."""
    fleet: Fleet
    """The data centers, with their configs."""
    sizing: Sizing
    """Capacities of the devices."""
    limits: Limits
    """Limits of setpoint and battery."""
    step_h: float
    """Length of a step, in h."""
    precision: Precision
    """Floating-point precision of the hall kernels: ``f32`` or ``f64``."""
    zones: UnitZones
    """Zones of the CRAC units, shared by all views of an episode."""
    zone_supply_ratio: F64
    """Supply air of each CRAC unit divided by what the racks need of it, 0..10, (U,), at the end of
    the last step: the pressure before its tiles as a multiple of that which just meets the need. 1
    before the first step, and unless fans are controlled."""
    flows_tasks: F64
    """Work that sites of each fleet sent to each other in the last step, in tasks, by fleet, sender
    and receiver, (F, S, S)."""
    link_up: F64
    """1 for sites of fleets whose links worked in the last step, 0 for those that could neither
    send nor get work, (B,)."""
    zone_loads: ZoneLoads | None
    """Loads of the zones of halls, see ``workload.zone_loads``; None without any."""
    loops: CoolantLoops | None
    """Racks and CDUs of the coolant loops, shared by all views of an episode; None without any."""
    forecast_error: ForecastError = PERFECT
    """Standard deviations of the forecast errors."""
    walks: RandomWalks | None = None
    """Random walks of the forecast errors, shared by all views of an episode; None for perfect
    forecasts."""

    @property
    def now(self) -> Exogenous:
        """Inputs of the next step, each (B,)."""
        exogenous = self.drivers.at(self.state.step)
        if self.zone_loads is None:
            return exogenous
        return replace(exogenous, demand=self._loads(self.zone_loads, exogenous).demand)

    @property
    def rack_load(self) -> F64:
        """Arriving work of each rack in the next step as a share of its capacity, 0..1, (R,)."""
        exogenous = self.drivers.at(self.state.step)
        if self.zone_loads is None:
            return exogenous.demand[self.fleet.rack_dc]
        return self._loads(self.zone_loads, exogenous).rack_load

    def _loads(self, zone_loads: ZoneLoads, exogenous: Exogenous) -> RackLoads:
        return zone_loads.at(self.state.step, exogenous.demand)

    @property
    def zone_hottest_c(self) -> F64:
        """Hottest server inlet of each CRAC unit's zone as its sensors measure it, in C, (U,)."""
        return self._zone_readings.hottest_c

    @property
    def zone_mean_c(self) -> F64:
        """Mean rack inlet of each CRAC unit's zone as its sensors measure it, in C, (U,)."""
        return self._zone_readings.mean_c

    @property
    def zone_hottest_true_c(self) -> F64:
        """Hottest server inlet of each CRAC unit's zone, in C, (U,)."""
        return self._zone_readings.hottest_true_c

    @property
    def unit_running(self) -> F64:
        """1 for CRAC units that ran in the last step, 0 for units that were down, (U,)."""
        return self._zone_readings.unit_running

    @property
    def cdu_running(self) -> F64:
        """1 for CDUs through which coolant flowed in the last step, else 0, (C,); before it 1."""
        return self._loop_readings.running

    @property
    def cdu_return_c(self) -> F64:
        """Temperature of the coolant from the racks to each CDU in the last step, in C, (C,)."""
        return self._loop_readings.return_c

    @property
    def cdu_junction_c(self) -> F64:
        """Hottest GPU junction of the racks that each CDU serves, in C, (C,); 0 without GPUs."""
        return self._loop_readings.junction_c

    @property
    def cdu_headroom_k(self) -> F64:
        """Smallest throttling limit minus junction of the racks that each CDU serves, in K, (C,).

        It is inf for CDUs that serve no GPUs.
        """
        return self._loop_readings.headroom_k

    @property
    def junction_headroom_k(self) -> F64:
        """Smallest throttling limit minus junction of the GPUs, in K, (B,); inf without GPUs."""
        return lowest(self.cdu_headroom_k, self.fleet.cdu_offsets)

    @property
    def _loop_readings(self) -> LoopReadings:
        assert self.loops is not None
        return self.loops.readings(self.last, self.state)

    @property
    def nearest_units(self) -> I64:
        """Units that feed most of the racks of each CRAC unit, the most first, (8, U).

        In data centers with fewer than nine units, the unit itself fills the last places.
        """
        return self.zones.nearest

    @property
    def _zone_readings(self) -> ZoneReadings:
        return self.zones.readings(self.last, self.state.setpoint_c, self.state.seed)

    def forecast(self, hours: float) -> Forecast:
        """Return a forecast of the coming hours, with the errors of ``forecast_error``.

        Args:
            hours: Length of the forecast, h, rounded to whole steps.

        Raises:
            ConfigError: The forecast is shorter than a step, or longer than a year.
            RuntimeStateError: Forecasts have errors, and one of a later step was requested before.
        """
        if not self.step_h / 2 < hours <= HOURS_PER_YEAR:
            raise ConfigError(
                f"forecast of {hours:g} h: valid is {self.step_h:g}..{HOURS_PER_YEAR:,} h"
            )
        steps = round(hours / self.step_h)
        first, leads = self.drivers.start + self.state.step, np.arange(steps)
        ci_error = self._error(CI_WALK, self.forecast_error.ci_share, leads)
        error_k = self._error(TEMPERATURE_WALK, self.forecast_error.temperature_k, leads)
        return Forecast(self.drivers, first[:, None] + leads, ci_error, error_k)

    def _error(self, walk: int, deviation: float, leads: I64) -> F64 | None:
        """Return the errors of a forecast at each lead, (B, n), or None if there are none."""
        if self.walks is None or deviation == 0.0:
            return None
        walked = self.walks.increments(walk, self.state.step, leads)
        # Use the memory order of input series, because it affects the rounding errors of means.
        return float(deviation) * np.ascontiguousarray(walked.T)

    @property
    def setpoint_c(self) -> F64:
        """Setpoint of the first CRAC unit of each data center, in C, (B,).

        The controllers of this package give all units the same command.
        """
        return _first_of_units(self.state.setpoint_c, self.fleet)

    @property
    def cooling_last(self) -> F64:
        """Last cooling command of the first CRAC unit of each data center, in steps, (B,)."""
        return _first_of_units(self.state.cooling_last, self.fleet)

    @property
    def size(self) -> int:
        """Number of data centers, B."""
        return self.fleet.size


def limits_of(fleet: Fleet) -> Limits:
    """Return the limits of setpoint and battery from the configurations of a fleet."""
    return Limits(
        setpoint_low_c=fleet.values("hvac.setpoint.min_c"),
        setpoint_high_c=fleet.values("hvac.setpoint.max_c"),
        setpoint_step_k=fleet.values("hvac.setpoint.step_k"),
        battery_round_trip=np.asarray(round_trip_efficiency(battery_parameters(fleet))),
    )


def view_maker(
    sim: Simulator, forecast_error: ForecastError = PERFECT, keys: I64 | None = None
) -> Callable[[StepResult | None], View]:
    """Return a function that makes the view before each step of an episode.

    Args:
        sim: Simulator that has been reset.
        forecast_error: Standard deviations of the forecast errors.
        keys: Seeds of the errors, (B,); None computes them from the seeds of the simulator's reset
            and the names of its data centers.

    Returns:
        Function from the previous step's result, or None before the first step, to a view.
    """
    step_h = sim.step_h
    limits, sizing = limits_of(sim.fleet), sim.sizing
    walks: RandomWalks | None = None
    zones, even = UnitZones(sim.fleet), np.ones(sim.fleet.units)
    loops = CoolantLoops(sim.fleet) if sim.fleet.cdus else None
    has_fans = sim.fleet.models["crac_flow"] == "controlled"
    sites = sim.fleet.sites_per_fleet
    no_flows, all_up = np.zeros((sim.size // sites, sites, sites)), np.ones(sim.size)
    if forecast_error != PERFECT:
        seeds = walk_keys(sim.state.seed, sim.fleet.names) if keys is None else keys
        walks = RandomWalks(seeds, step_h)

    def view_after(last: StepResult | None) -> View:
        return View(
            last,
            sim.state,
            sim.drivers,
            sim.fleet,
            sizing,
            limits,
            step_h,
            sim.precision,
            zones,
            sim.supply_ratio() if last is not None and has_fans else even,
            sim.flows_tasks().copy() if last is not None and sites > 1 else no_flows,
            sim.link_up() if sites > 1 else all_up,
            sim.zone_loads,
            loops,
            forecast_error,
            walks,
        )

    return view_after


def mean_setpoint_c(view: View) -> F64:
    """Return the mean setpoint of the CRAC units of each data center, in C, (B,)."""
    fleet = view.fleet
    return np.asarray(fleet.unit_sums(view.state.setpoint_c) / np.diff(fleet.unit_offsets))


def _first_of_units(per_unit: F64, fleet: Fleet) -> F64:
    return per_unit[fleet.unit_offsets[:-1]]
