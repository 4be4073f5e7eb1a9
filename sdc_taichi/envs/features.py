"""Features: the named entries of observations, scaled by fixed ranges.

A value v is scaled to ``(v - low) / (high - low)``, 0..1. If the range is symmetric about zero, v
is scaled to ``v / high``, -1..1. Values outside the range are clipped. Features contain no
information about the future except forecasts and the demand of the coming step.

To add a feature, write a function in this module. Its argument is ``TimeInputs``, ``Measurements``
or, for features that exist only in some environments and for those of CRAC units, the ``View``. The
function's name is the name of the feature, its docstring is the description in the documentation,
and its decorator sets unit and range. No other module needs a change.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Annotated, Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box
from pydantic import Field

from sdc_taichi.control.view import View, mean_setpoint_c
from sdc_taichi.envs.agents import AGENT_DEFINITIONS, AGENTS, ALL_AGENTS
from sdc_taichi.envs.site_order import cleaner_first
from sdc_taichi.errors import ConfigError, suggestion_or_valid
from sdc_taichi.exogenous.year_clock import HOURS_PER_YEAR
from sdc_taichi.plant.workload import NEGLIGIBLE_TASKS, TASKS_PER_STEP
from sdc_taichi.types import CDUS, CRAC_UNITS, F32, F64

CI_LEADS_H = (1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 20.0, 24.0)
"""Default leads of the forecasts of carbon intensity and price, in h."""
WEATHER_LEADS_H = (3.0, 6.0, 12.0, 24.0)
"""Default leads of the weather forecasts, in h."""
LONGEST_LEAD_H = float(HOURS_PER_YEAR)
"""Longest valid lead, in h."""
LeadH = Annotated[float, Field(gt=0, le=LONGEST_LEAD_H, allow_inf_nan=False)]
"""Lead of a forecast, above 0 and at most a year of 8,760 h."""
AGE_EDGES_H = (0.0, 6.0, 12.0, 18.0, 24.0)
"""Lower edges of the age bins of queued work, in h, as in the released SustainDC code
(``carbon_ls.py``). The last bin has no upper edge."""
UNLIMITED_QUEUE_H = 10.0
"""Hours of work at full capacity that count as a full queue if the queue has no limit."""


_Value = TypeVar("_Value", bound=Callable[..., Any])


@dataclass(frozen=True, slots=True)
class Feature:
    """A named quantity in an observation, with one or several adjacent entries."""

    name: str
    """Name of the feature in the option ``features``."""
    unit: str
    """Unit of the value before scaling."""
    low: float
    """Lower end of the range, in ``unit``; lower values are clipped to it."""
    high: float
    """Upper end of the range, in ``unit``; higher values are clipped to it."""
    description: str
    """Meaning of the value, for the documentation."""
    size: int = 1
    """Number of adjacent entries."""
    value: Callable[[Any], Any] = field(default=lambda _: (), compare=False, repr=False)
    """Function that returns the entries in ``unit``, (size, n) or a list of arrays (n,). Its
    argument is ``TimeInputs``, ``Measurements`` or ``View``, by the kind of the feature."""

    @property
    def signed(self) -> bool:
        """True if the range is symmetric about zero, so that values are scaled to -1..1."""
        return self.low == -self.high


@dataclass(frozen=True, slots=True)
class Layout:
    """Numbers of leads, CRAC units, fans and racks, which determine the sizes of features."""

    ci_leads_h: Sequence[float] = CI_LEADS_H
    """Leads of the forecasts of carbon intensity and price, in h."""
    weather_leads_h: Sequence[float] = WEATHER_LEADS_H
    """Leads of the weather forecasts, in h."""
    units: int = 1
    """Number of CRAC units with an observed setpoint each."""
    fans: int = 0
    """Number of CRAC fans whose speeds agents decide; 0 if agents do not control fans."""
    racks: int = 0
    """Number of racks on which agents place work; 0 if agents do not place work."""
    hall: int = 0
    """1 if agents ``crac`` or ``plant`` learn, else 0."""
    liquid: int = 0
    """1 if racks are liquid-cooled, else 0."""
    neighbours: int = 0
    """Number of neighbouring CRAC units that an agent ``crac`` observes."""
    other_sites: int = 0
    """Number of other sites of a fleet if ``agent_geo`` learns, else 0."""


DEFAULT_LAYOUT = Layout()
"""Layout with one CRAC unit and the default leads."""


@dataclass(frozen=True)
class TimeInputs:
    """Inputs of features that depend on time alone, for n pairs of data center and step."""

    time_of_day: F32
    """Sine and cosine of the local time of day, (2, n)."""
    time_of_year: F32
    """Sine and cosine of the time of year, (2, n)."""
    ci: F32
    """Carbon intensity now and at each lead, in g/kWh, (1 + leads, n)."""
    outdoor_c: F32
    """Dry bulb now and at each lead, in C, (1 + leads, n)."""
    wet_bulb_c: F32
    """Wet bulb now and at each lead, in C, (1 + leads, n)."""
    price: F32
    """Price divided by its mean, now and at each lead of ``ci``, (1 + leads, n)."""
    workload: F32
    """Work that arrives in the step, as a share of capacity, (1, n)."""

    @cached_property
    def lowest_ci(self) -> F32:
        """Minimum of the current and forecast carbon intensities, in g/kWh, (n,)."""
        return np.asarray(self.ci.min(axis=0))

    @cached_property
    def ci_swing(self) -> F32:
        """Maximum minus minimum of current and forecast carbon intensities, in g/kWh, (n,)."""
        return np.asarray(self.ci.max(axis=0) - self.lowest_ci)


class Design(NamedTuple):
    """Reciprocals of design quantities, which make measured features relative, (B,) each.

    The reciprocal of a quantity that is 0 is set to 0.
    """

    per_full_queue: F64
    """Reciprocal of the size of a full queue, per task."""
    per_it_kwh: F64
    """Reciprocal of the IT energy of a step at the design point, per kWh."""
    per_hvac_kwh: F64
    """Reciprocal of the HVAC energy of a step at the design point, per kWh."""
    per_facility_kwh: F64
    """Reciprocal of the facility energy of a step at the design point, per kWh."""
    per_battery_kwh: F64
    """Reciprocal of the battery's capacity, per kWh."""


class Measurements(NamedTuple):
    """Inputs of features that are measured in the data center, (B,) each.

    Functions of ``Measurements`` are compiled. They may use arithmetic, the NumPy functions of
    ``kernels/compiler/stage.py``, and ``np.where`` in place of branches.
    """

    last: Any
    """Result of the last step with all (B,) fields of ``StepResult``. Before the first step all
    temperatures equal the setpoint, and all other fields are 0."""
    waiting_tasks: F64
    """Tasks in the queue."""
    at_least_tasks: list[F64]
    """Tasks in the queue that are at least as old as an age, for each age of ``AGE_EDGES_H``."""
    setpoints_c: list[F64]
    """Setpoint of each CRAC unit, in C."""
    fan_speeds: list[F64]
    """Speed of each CRAC fan that agents decide, as a share of its design speed."""
    stored_kwh: F64
    """Energy in the battery, in kWh."""
    design: Design
    """Reciprocals of design quantities."""


FEATURE_OF_COMMAND = {"fan": "fan_speed", "placement": "rack_inlets"}
"""Additional default feature of an agent that decides a command, by command."""


_Size = int | Callable[[Layout], int]
"""Number of entries of a feature, or a function that computes it from a ``Layout``. A feature of
size 0 is left out."""
_Kind = dict[str, tuple[Feature, _Size]]
"""Features whose functions share one type of argument, by name, each with its declared size."""
_TIME: _Kind = {}
_MEASURED: _Kind = {}
_OF_VIEW: _Kind = {}
_OF_UNITS: _Kind = {}
_OF_CDUS: _Kind = {}
_OF_AXIS = {CRAC_UNITS: _OF_UNITS, CDUS: _OF_CDUS}
"""Features of units by kind of unit."""


def _feature(
    kind: _Kind, unit: str, low: float, high: float, size: _Size = 1
) -> Callable[[_Value], _Value]:
    """Declare the decorated function as a feature with its name and its docstring as description.

    Args:
        kind: features of the same argument type, to which the new feature is added.
        unit: unit of the value.
        low: lower end of the range, in ``unit``.
        high: upper end of the range, in ``unit``.
        size: number of entries, or a function that computes it from the layout.
    """

    def declare(function: _Value) -> _Value:
        name, text = function.__name__, function.__doc__ or ""
        kind[name] = Feature(name, unit, low, high, text, value=function), size
        return function

    return declare


def _features_of(kind: _Kind, layout: Layout) -> tuple[Feature, ...]:
    ci, weather = (
        ", ".join(f"{h:g}" for h in leads) for leads in (layout.ci_leads_h, layout.weather_leads_h)
    )
    features = []
    for feature, size in kind.values():
        entries = size(layout) if callable(size) else size
        if entries:
            text = feature.description.format(ci_leads=ci, weather_leads=weather)
            features.append(replace(feature, size=entries, description=text))
    return tuple(features)


def time_features(layout: Layout) -> tuple[Feature, ...]:
    """Return the features that depend on time alone: functions of ``TimeInputs``."""
    return _features_of(_TIME, layout)


def measured_features(layout: Layout) -> tuple[Feature, ...]:
    """Return the features that are measured in the data center: functions of ``Measurements``."""
    return _features_of(_MEASURED, layout)


def view_features(layout: Layout) -> tuple[Feature, ...]:
    """Return the features of data centers that are functions of the view, not compiled."""
    return _features_of(_OF_VIEW, layout)


def unit_features(layout: Layout, axis: str) -> tuple[Feature, ...]:
    """Return the features of a kind of units: functions of the view, not compiled, (size, U).

    Args:
        layout: numbers of entries.
        axis: kind of units: ``CRAC_UNITS`` or ``CDUS``.
    """
    return _features_of(_OF_AXIS[axis], layout)


def all_features(layout: Layout = DEFAULT_LAYOUT) -> tuple[Feature, ...]:
    """Return all features of data centers in the order of the shared state."""
    return (*time_features(layout), *measured_features(layout), *view_features(layout))


def _ci_leads(layout: Layout) -> int:
    return len(layout.ci_leads_h)


def _weather_leads(layout: Layout) -> int:
    return len(layout.weather_leads_h)


def _one_with_leads(layout: Layout) -> int:
    return 1 if layout.ci_leads_h else 0


@_feature(_TIME, "1", -1.0, 1.0, 2)
def time_of_day(t: TimeInputs) -> F32:
    """Sine and cosine of the local time of day."""
    return t.time_of_day


@_feature(_TIME, "1", -1.0, 1.0, 2)
def time_of_year(t: TimeInputs) -> F32:
    """Sine and cosine of the time of year."""
    return t.time_of_year


@_feature(_TIME, "g/kWh", 0.0, 1000.0)
def ci(t: TimeInputs) -> F32:
    """Carbon intensity (CI) of the coming step."""
    return t.ci[:1]


@_feature(_TIME, "g/kWh", 0.0, 1000.0, _ci_leads)
def ci_forecast(t: TimeInputs) -> F32:
    """Forecast of the CI in {ci_leads} h."""
    return t.ci[1:]


@_feature(_TIME, "g/kWh", -300.0, 300.0, _ci_leads)
def ci_change(t: TimeInputs) -> F32:
    """Forecast of the CI in {ci_leads} h, minus `ci`."""
    return np.asarray(t.ci[1:] - t.ci[:1])


@_feature(_TIME, "share", 0.0, 1.0, _one_with_leads)
def ci_rank(t: TimeInputs) -> F32:
    """Share of the CI forecasts for {ci_leads} h that are below `ci`."""
    is_below = t.ci[1:] < t.ci[:1]
    return np.asarray(is_below.mean(axis=0, keepdims=True, dtype=np.float32))


@_feature(_TIME, "share", 0.0, 1.0, lambda x: 1 + len(x.ci_leads_h) if x.ci_leads_h else 0)
def ci_relative(t: TimeInputs) -> F32:
    """`ci` and the CI in {ci_leads} h, scaled from 0 at their minimum to 1 at their maximum."""
    return np.asarray((t.ci - t.lowest_ci) / np.where(t.ci_swing > 0, t.ci_swing, 1.0))


@_feature(_TIME, "1", 0.0, 2.0, _one_with_leads)
def ci_swing(t: TimeInputs) -> F32:
    """Maximum minus minimum of `ci` and the CI in {ci_leads} h, relative to `ci`."""
    return np.asarray((t.ci_swing / np.where(t.ci[0] > 0, t.ci[0], 1.0))[None])


@_feature(_TIME, "C", -30.0, 50.0)
def outdoor(t: TimeInputs) -> F32:
    """Dry-bulb temperature of the coming step."""
    return t.outdoor_c[:1]


@_feature(_TIME, "C", -30.0, 50.0, _weather_leads)
def outdoor_forecast(t: TimeInputs) -> F32:
    """Forecast of the dry-bulb temperature in {weather_leads} h."""
    return t.outdoor_c[1:]


@_feature(_TIME, "C", -30.0, 40.0)
def wet_bulb(t: TimeInputs) -> F32:
    """Wet-bulb temperature of the coming step."""
    return t.wet_bulb_c[:1]


@_feature(_TIME, "C", -30.0, 40.0, _weather_leads)
def wet_bulb_forecast(t: TimeInputs) -> F32:
    """Forecast of the wet-bulb temperature in {weather_leads} h."""
    return t.wet_bulb_c[1:]


@_feature(_TIME, "share", 0.0, 1.0)
def workload(t: TimeInputs) -> F32:
    """Work that arrives in the coming step."""
    return t.workload


@_feature(_TIME, "1", 0.0, 3.0)
def price(t: TimeInputs) -> F32:
    """Electricity price of the coming step, relative to its mean."""
    return t.price[:1]


@_feature(_TIME, "1", 0.0, 3.0, _ci_leads)
def price_forecast(t: TimeInputs) -> F32:
    """Electricity price in {ci_leads} h, relative to its mean."""
    return t.price[1:]


@_feature(_MEASURED, "share", 0.0, 1.0)
def queue(m: Measurements) -> list[F64]:
    """Queued work as a share of `workload.queue_limit_h`, or of 10 h of full load if unlimited."""
    return [m.waiting_tasks * m.design.per_full_queue]


@_feature(_MEASURED, "h", 0.0, 24.0)
def oldest_age(m: Measurements) -> list[F64]:
    """Age of the oldest work in the queue."""
    return [m.last.oldest_age_h]


@_feature(_MEASURED, "h", 0.0, 24.0)
def mean_age(m: Measurements) -> list[F64]:
    """Mean age of the work in the queue."""
    return [m.last.mean_age_h]


@_feature(_MEASURED, "share", 0.0, 1.0, len(AGE_EDGES_H))
def age_histogram(m: Measurements) -> list[F64]:
    """Share of the queue aged 0-6, 6-12, 12-18, 18-24 and over 24 h."""
    counts = m.waiting_tasks > NEGLIGIBLE_TASKS
    per_task = np.where(counts, 1.0 / np.where(counts, m.waiting_tasks, 1.0), 0.0)
    at_least: list[Any] = [*m.at_least_tasks, 0.0]
    return [(a - b) * per_task for a, b in pairwise(at_least)]


@_feature(_MEASURED, "C", 10.0, 60.0)
def room(m: Measurements) -> list[F64]:
    """Return-air temperature in the last step."""
    return [m.last.return_c]


@_feature(_MEASURED, "C", 10.0, 50.0)
def hottest_inlet(m: Measurements) -> list[F64]:
    """Temperature of the hottest server inlet in the last step."""
    return [m.last.inlet_max_c]


@_feature(_MEASURED, "C", 10.0, 30.0, lambda x: x.units)
def setpoint(m: Measurements) -> list[F64]:
    """Supply-air setpoint of each CRAC unit; the mean if the fleet differs in numbers of units."""
    return m.setpoints_c


@_feature(_MEASURED, "share", 0.0, 1.2)
def it_energy(m: Measurements) -> list[F64]:
    """IT energy of the last step, relative to the IT energy of a step at the design point."""
    return [m.last.it_kwh * m.design.per_it_kwh]


@_feature(_MEASURED, "share", 0.0, 1.2)
def hvac_energy(m: Measurements) -> list[F64]:
    """HVAC energy of the last step, relative to the HVAC energy of a step at the design point."""
    return [m.last.hvac_kwh * m.design.per_hvac_kwh]


@_feature(_MEASURED, "share", 0.0, 1.2)
def dc_load(m: Measurements) -> list[F64]:
    """Facility power in the last step, relative to the facility power at the design point."""
    return [m.last.facility_kwh * m.design.per_facility_kwh]


@_feature(_MEASURED, "share", 0.0, 1.0)
def soc(m: Measurements) -> list[F64]:
    """State of charge of the battery; 0 without a battery."""
    return [m.stored_kwh * m.design.per_battery_kwh]


@_feature(_MEASURED, "share", 0.0, 1.0, lambda x: x.fans)
def fan_speed(m: Measurements) -> list[F64]:
    """Speed of each CRAC fan, relative to its design speed."""
    return m.fan_speeds


@_feature(_OF_VIEW, "C", 10.0, 50.0, lambda x: x.racks)
def rack_inlets(view: View) -> F64:
    """Hottest inlet temperature of each rack in the last step."""
    if view.last is None:
        return np.tile(mean_setpoint_c(view), (int(view.fleet.rack_offsets[1]), 1))
    return np.asarray(view.last.rack_inlet_max_c.reshape(view.size, -1).T)


def _of_hall(layout: Layout) -> int:
    return layout.hall


@_feature(_OF_VIEW, "C", 5.0, 30.0, _of_hall)
def chilled_water(view: View) -> F64:
    """Temperature of the chilled water in the last step."""
    water_c = mean_setpoint_c(view) if view.last is None else view.last.chilled_water_c
    return np.asarray(water_c[None])


@_feature(_OF_VIEW, "C", 10.0, 30.0, _of_hall)
def setpoint_mean(view: View) -> F64:
    """Supply-air setpoint, mean over the CRAC units."""
    return mean_setpoint_c(view)[None]


@_feature(_OF_VIEW, "C", 15.0, 40.0, _of_hall)
def zone_hottest_highest(view: View) -> F64:
    """Highest `zone_hottest` of the CRAC units that run."""
    return _highest_of_running(view, view.zone_hottest_c)


@_feature(_OF_VIEW, "share", 0.0, 1.0, _of_hall)
def unit_speed_highest(view: View) -> F64:
    """Highest `unit_speed` of the CRAC units that run."""
    return _highest_of_running(view, view.state.fan_speed)


@_feature(_OF_VIEW, "share", 0.0, 1.0, _of_hall)
def unit_speed_mean(view: View) -> F64:
    """Mean `unit_speed` of the CRAC units that run."""
    running = view.fleet.unit_sums(view.unit_running)
    speeds = view.fleet.unit_sums(view.state.fan_speed * view.unit_running)
    return np.asarray((speeds / np.maximum(running, 1.0))[None])


@_feature(_OF_UNITS, "share", 0.0, 1.0)
def unit_speed(view: View) -> F64:
    """Speed of the own fan, relative to full speed."""
    return view.state.fan_speed[None]


@_feature(_OF_UNITS, "C", 10.0, 35.0)
def unit_supply(view: View) -> F64:
    """Supply-air temperature of the own unit in the last step."""
    supply_c = view.state.setpoint_c if view.last is None else view.last.unit_supply_c
    return np.asarray(supply_c[None])


@_feature(_OF_UNITS, "C", 15.0, 60.0)
def unit_return(view: View) -> F64:
    """Temperature of the air that returns to the own unit; in quasi-steady halls to all units."""
    own_c = view.state.return_air_c
    if not len(own_c):
        of_hall_c = mean_setpoint_c(view) if view.last is None else view.last.return_c
        own_c = of_hall_c[view.fleet.unit_dc]
    return own_c[None]


@_feature(_OF_UNITS, "share", 0.0, 1.0)
def unit_running(view: View) -> F64:
    """1 if the own unit ran in the last step, 0 if it was down."""
    return view.unit_running[None]


@_feature(_OF_UNITS, "C", 15.0, 40.0)
def zone_hottest(view: View) -> F64:
    """Hottest inlet of the own zone in the last step, with the error of its sensors."""
    return view.zone_hottest_c[None]


@_feature(_OF_UNITS, "C", 15.0, 40.0)
def zone_mean(view: View) -> F64:
    """Mean inlet temperature of the own zone in the last step, with the error of its sensors."""
    return view.zone_mean_c[None]


@_feature(_OF_UNITS, "1", 0.0, 2.0)
def tile_pressure(view: View) -> F64:
    """Supply air of the own zone divided by the supply air that its racks need."""
    return view.zone_supply_ratio[None]


@_feature(_OF_UNITS, "1", 0.0, 1.0, lambda x: 2 * x.neighbours)
def neighbours(view: View) -> F64:
    """`unit_speed` and scaled `zone_hottest` of each of the nearest units, nearest first."""
    nearest, (hottest, _) = view.nearest_units, _OF_UNITS["zone_hottest"]
    inlets = scale(view.zone_hottest_c.astype(np.float32), hottest)
    pairs = np.stack([view.state.fan_speed[nearest], inlets[nearest]], axis=1)
    return pairs.reshape(-1, pairs.shape[-1])


def _of_liquid(layout: Layout) -> int:
    return layout.liquid


@_feature(_OF_VIEW, "C", 5.0, 60.0, _of_liquid)
def facility_supply(view: View) -> F64:
    """Temperature of the facility water to the CDUs in the last step."""
    return _of_loop(view, "facility_supply_c")


@_feature(_OF_VIEW, "C", 5.0, 80.0, _of_liquid)
def facility_return(view: View) -> F64:
    """Temperature of the facility water from the CDUs in the last step."""
    return _of_loop(view, "facility_return_c")


@_feature(_OF_VIEW, "share", 0.0, 1.0, _of_liquid)
def trim_load(view: View) -> F64:
    """Heat taken by trim chiller or plant in the last step, divided by ``trim_kw``."""
    capacity_w = view.fleet.values("liquid.facility.trim_kw") * 1e3
    taken_w = _of_loop(view, "trim_load_w") + _of_loop(view, "liquid_to_plant_w")
    return taken_w / np.maximum(capacity_w, 1.0)


@_feature(_OF_VIEW, "share", 0.0, 1.0, _of_liquid)
def heat_delivered(view: View) -> F64:
    """Heat delivered for reuse in the last step, divided by the IT power at the design point."""
    return _of_loop(view, "reuse_w") / view.sizing.it_w


@_feature(_OF_VIEW, "share", 0.0, 1.0, _of_liquid)
def heat_demand(view: View) -> F64:
    """Most heat that is taken for reuse, divided by the IT power at the design point."""
    reuse = [config.liquid.reuse for config in view.fleet.configs if config.liquid is not None]
    demand_w = [
        0.0 if x.kind == "none" else np.inf if x.demand_kw is None else x.demand_kw * 1e3
        for x in reuse
    ]
    return np.array(demand_w)[None] / view.sizing.it_w


@_feature(_OF_VIEW, "currency/kWh", -0.2, 0.2, _of_liquid)
def heat_price(view: View) -> F64:
    """Price of delivered heat."""
    return view.fleet.values("liquid.reuse.price_per_kwh_heat")[None]


@_feature(_OF_VIEW, "K", 0.0, 50.0, _of_liquid)
def junction_headroom(view: View) -> F64:
    """Smallest difference of the throttling limit and the junction temperature of GPUs."""
    return view.junction_headroom_k[None]


def _of_loop(view: View, name: str) -> F64:
    """Return a quantity of the last step, (1, B).

    Before the first step temperatures equal the setpoint of the first CDU; other quantities are 0.
    """
    if view.last is not None:
        return np.asarray(getattr(view.last, name)[None])
    if name.endswith("_c"):
        return view.state.cdu_setpoint_c[view.fleet.cdu_offsets[:-1]][None]
    return np.zeros((1, view.size))


@_feature(_OF_CDUS, "C", 20.0, 45.0)
def cdu_setpoint(view: View) -> F64:
    """Supply setpoint of the own CDU."""
    return view.state.cdu_setpoint_c[None]


@_feature(_OF_CDUS, "C", 15.0, 70.0)
def cdu_supply(view: View) -> F64:
    """Temperature of the coolant to the racks from the own CDU in the last step."""
    supply_c = view.state.cdu_setpoint_c if view.last is None else view.last.cdu_supply_each_c
    return supply_c[None]


@_feature(_OF_CDUS, "C", 15.0, 90.0)
def cdu_return(view: View) -> F64:
    """Temperature of the coolant from the racks to the own CDU in the last step."""
    return view.cdu_return_c[None]


@_feature(_OF_CDUS, "share", 0.0, 1.2)
def cdu_flow(view: View) -> F64:
    """Commanded flow of the own CDU, relative to its design flow."""
    return view.state.cdu_flow[None]


@_feature(_OF_CDUS, "share", 0.0, 1.2)
def cdu_valve(view: View) -> F64:
    """Facility water through the own CDU in the last step, relative to its design flow."""
    return (view.state.cdu_flow * 0.0 if view.last is None else view.last.cdu_valve)[None]


@_feature(_OF_CDUS, "share", 0.0, 1.0)
def cdu_running(view: View) -> F64:
    """1 if coolant flowed through the own CDU in the last step, else 0."""
    return view.cdu_running[None]


@_feature(_OF_CDUS, "C", 20.0, 110.0)
def cdu_junction(view: View) -> F64:
    """Hottest GPU junction of the racks that the own CDU serves, in the last step."""
    return view.cdu_junction_c[None]


@_feature(_OF_CDUS, "K", 0.0, 50.0)
def cdu_headroom(view: View) -> F64:
    """Smallest difference of the throttling limit and the junction temperature of these racks."""
    return view.cdu_headroom_k[None]


SITE_LEADS_H = (6.0, 24.0)
"""Leads of the forecast of the carbon intensity of other sites, in h."""


@_feature(_OF_VIEW, "g/kWh", 0.0, 1000.0, lambda x: x.other_sites)
def site_ci(view: View) -> F64:
    """CI of the other sites in the coming step, cleanest first."""
    return _of_others(view, view.now.ci_g_per_kwh)


@_feature(_OF_VIEW, "g/kWh", 0.0, 1000.0, lambda x: len(SITE_LEADS_H) * x.other_sites)
def site_ci_forecast(view: View) -> F64:
    """Forecasts of the CI of the other sites in 6 and 24 h, in the order of `site_ci`."""
    ahead = [round(lead_h / view.step_h) for lead_h in SITE_LEADS_H]
    forecast = view.forecast(SITE_LEADS_H[-1] + view.step_h).ci_g_per_kwh
    of_leads = _of_others(view, forecast[:, ahead].T)
    return np.concatenate(np.moveaxis(of_leads, 1, 0))


@_feature(_OF_VIEW, "share", 0.0, 1.0, lambda x: x.other_sites)
def site_room(view: View) -> F64:
    """Room at the other sites, as a share of a full queue; 0 while the links of a site are down."""
    limit_h = view.fleet.values("workload.queue_limit_h")
    limit_h = np.where(np.isnan(limit_h), UNLIMITED_QUEUE_H, limit_h)
    waiting = view.state.queue[:, -1] + view.state.in_flight.sum(axis=1)
    room = 1.0 - waiting * view.step_h / (limit_h * TASKS_PER_STEP)
    return _of_others(view, np.where(view.link_up > 0, room, 0.0))


@_feature(_OF_VIEW, "share", 0.0, 1.0, lambda x: min(x.other_sites, 1))
def site_link(view: View) -> F64:
    """Most work that the own site can send in a step, as a share of its capacity."""
    assert view.fleet.shared_work is not None
    tasks = np.where(view.link_up > 0, view.fleet.shared_work.link_tasks, 0.0)
    return np.asarray(tasks[None] / TASKS_PER_STEP)


@_feature(_OF_VIEW, "share", 0.0, 1.0, lambda x: 3 * min(x.other_sites, 1))
def transfers(view: View) -> F64:
    """Work sent, landed and refused in the last step, as shares of the capacity of a step."""
    if view.last is None:
        return np.zeros((3, view.size))
    last = view.last
    tasks = np.stack([last.sent_tasks, last.landed_tasks, last.refused_tasks])
    return np.asarray(tasks / TASKS_PER_STEP)


def _of_others(view: View, of_sites: F64) -> F64:
    """Return values of the other sites, (..., B), that with the cleanest grid first.

    Returns:
        Values of shape (S - 1, ..., B).
    """
    sites = view.fleet.sites_per_fleet
    first = np.repeat(np.arange(0, view.size, sites), sites)[:, None]
    return np.moveaxis(of_sites[..., first + cleaner_first(view)], -1, 0)


def _highest_of_running(view: View, per_unit: F64) -> F64:
    """Return the highest value of the units that run, of all units if none runs, (1, B)."""
    first = view.fleet.unit_offsets[:-1]
    running = np.where(view.unit_running > 0, per_unit, -np.inf)
    highest = np.maximum.reduceat(running, first)
    return np.where(np.isinf(highest), np.maximum.reduceat(per_unit, first), highest)[None]


def features_by_agent(
    chosen: Mapping[str, Sequence[str]],
    known: Sequence[Feature],
    of_units: Mapping[str, Sequence[Feature]],
    commands: Mapping[str, Sequence[str]],
) -> dict[str, tuple[Feature, ...]]:
    """Return the features that each agent observes.

    An agent without an entry in ``chosen`` observes its default features, and in addition the fan
    speeds or rack inlets if it decides the command ``fan`` or ``placement``.

    Args:
        chosen: names of features by agent.
        known: all features of data centers.
        of_units: all features of units by kind, which agents of these units can observe too.
        commands: commands that each observing agent decides.

    Raises:
        ConfigError: an agent or feature is unknown, a feature is named twice, or an agent has no
            features.
    """
    for agent in chosen:
        if agent not in AGENT_DEFINITIONS:
            raise ConfigError(
                f"features: unknown agent {agent!r}{suggestion_or_valid(agent, AGENT_DEFINITIONS)}"
            )
    out: dict[str, tuple[Feature, ...]] = {}
    for agent, decided in commands.items():
        of_agent = (*known, *of_units.get(AGENT_DEFINITIONS[agent].axis, ()))
        by_name = {feature.name: feature for feature in of_agent}
        acted_on = [FEATURE_OF_COMMAND.get(name, "") for name in decided]
        default = [n for n in (*AGENT_DEFINITIONS[agent].features, *acted_on) if n in by_name]
        names = chosen.get(agent, default)
        if not names:
            raise ConfigError(f"features of {agent}: {names!r}; valid is a list of names")
        for name in names:
            if name not in by_name:
                raise ConfigError(
                    f"features of {agent}: unknown {name!r}{suggestion_or_valid(name, by_name)}"
                )
        twice = next((name for name in names if list(names).count(name) > 1), None)
        if twice is not None:
            raise ConfigError(f"features of {agent}: {twice!r} is named twice")
        out[agent] = tuple(by_name[name] for name in names)
    return out


def features_space(features: Sequence[Feature]) -> Box:
    """Return the space of an observation that concatenates scaled ``features``, (n,)."""
    low = np.concatenate([np.full(f.size, -1.0 if f.signed else 0.0) for f in features])
    return Box(low.astype(np.float32), np.ones(len(low), dtype=np.float32), dtype=np.float32)


def scale(values: F32, feature: Feature) -> F32:
    """Scale values of a feature, of any shape, to 0..1 or -1..1, and clip them to its range."""
    if feature.signed:
        return np.asarray(np.clip(values / feature.high, -1.0, 1.0))
    return np.asarray(np.clip((values - feature.low) / (feature.high - feature.low), 0.0, 1.0))


def feature_slices(features: Sequence[Feature]) -> dict[str, slice]:
    """Return the slice of each feature, by name, in the concatenation of ``features``."""
    ends = np.cumsum([0, *(f.size for f in features)]).tolist()
    return {f.name: slice(first, first + f.size) for f, first in zip(features, ends, strict=False)}


def entries_of_new_features(
    features_of: Mapping[str, Sequence[Any]],
) -> dict[str, npt.NDArray[np.int64] | slice]:
    """Return the indices in each agent's observation of features that no earlier agent observes.

    The selected entries of all agents together contain each feature once.

    Args:
        features_of: features of each agent, in the order of its observation. Each feature has a
            ``name`` and a ``size``. Equal objects count as the same feature, except features of
            units, and of different sites in names such as ``NY/agent_dc``.
    """
    known: set[Any] = set()
    out: dict[str, npt.NDArray[np.int64] | slice] = {}
    for agent, features in features_of.items():
        site = agent.rpartition("/")[0]
        is_new = [
            any(f.name in kind for kind in _OF_AXIS.values()) or (site, f) not in known
            for f in features
        ]
        new = np.repeat(is_new, [f.size for f in features])
        entries = np.flatnonzero(new)
        # Indexing with a slice copies nothing, unlike indexing with an array.
        contiguous = len(entries) > 0 and entries[-1] - entries[0] == len(entries) - 1
        out[agent] = slice(int(entries[0]), int(entries[-1]) + 1) if contiguous else entries
        known.update((site, f) for f in features)
    return out


def features_markdown() -> str:
    """Return the Markdown table of features for docs/observations.md; dots mark the defaults."""
    titles = ("load", "cooling", "battery")
    return _markdown(all_features(), dict(zip(titles, AGENTS, strict=True)))


def group_features_markdown() -> str:
    """Return the Markdown table of the features of all groups but those of ``AGENTS``."""
    layout = Layout(hall=1, liquid=1, neighbours=1, other_sites=1)
    of_view = [*view_features(layout), *(f for x in _OF_AXIS for f in unit_features(layout, x))]
    return _markdown(of_view, {name: name for name in ALL_AGENTS[len(AGENTS) :]})


def _markdown(features: Sequence[Feature], agents: Mapping[str, str]) -> str:
    """Return the Markdown table of features, with a column for each agent, by its title."""
    lines = [
        f"| feature | entries | what it is | unit | range | {' | '.join(agents)} |",
        f"|{'---|' * (5 + len(agents))}",
    ]
    for f in features:
        seen = ["●" if f.name in AGENT_DEFINITIONS[a].features else " " for a in agents.values()]
        cells = (f"`{f.name}`", str(f.size), f.description, f.unit, f"{f.low:g}..{f.high:g}", *seen)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"
