"""Section ``liquid`` and liquid-cooled racks: cold plates, CDUs, facility loop, and heat reuse."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from sdc_taichi.config.fields import (
    Count,
    DewPointC,
    ExchangerK,
    RiseK,
    Section,
    Share,
    WaterRangeK,
    WorkingShare,
)
from sdc_taichi.config.plain_values import load_yaml
from sdc_taichi.errors import shortened, suggestion_or_valid

SETPOINT_LIMITS_C = (20.0, 45.0)
"""Lowest and highest supply temperature of a CDU that may be set, in C."""
FLOW_LIMITS = (0.4, 1.1)
"""Lowest and highest flow of a CDU that may be set, divided by its design flow."""
APPROACH_LIMITS_K = (2.0, 15.0)
"""Smallest and largest supply setpoint of the CDUs minus setpoint of the facility water, in K."""
POWER_CAP_LIMITS = (0.5, 1.0)
"""Lowest and highest power cap of the GPUs, divided by their highest power."""
W_CLASS_LIMITS_C: dict[str, float] = {
    "W17": 17.0,
    "W27": 27.0,
    "W32": 32.0,
    "W40": 40.0,
    "W45": 45.0,
}
"""Highest facility water temperature of each ASHRAE TC 9.9 (2021) class, in C."""
WARMEST_CLASS = "W+"
"""ASHRAE class of facility water that is warmer than any of ``W_CLASS_LIMITS_C``."""
MOST_LEAKAGE_GAIN = 0.5
"""Largest gain of the loop of leakage and junction temperature that is still accepted; at 1 the
junction temperature runs away."""

ChipW = Annotated[float, Field(ge=0, le=1e4)]
"""Power of one chip, 0..10,000 W; the largest wafer-scale chips draw more, but have cooling of
their own."""
RackPartW = Annotated[float, Field(ge=0, le=1e6)]
"""Power of parts of a rack, 0..1e6 W; the densest racks that are announced have 600 kW."""
JunctionC = Annotated[float, Field(ge=50, le=150)]
"""Junction temperature of a chip, 50..150 C: from usual operation to damage of any silicon."""
SupplySetpointC = Annotated[float, Field(ge=SETPOINT_LIMITS_C[0], le=SETPOINT_LIMITS_C[1])]
"""Supply setpoint of a CDU, 20..45 C: from above the dew point of rooms to the water of class
W45."""
HeadKpa = Annotated[float, Field(ge=1, le=2000)]
"""Pressure difference of a pump, 1..2,000 kPa."""
LitresPerKw = Annotated[float, Field(ge=0.01, le=1000)]
"""Volume of a loop divided by its design heat, 0.01..1,000 l/kW; large values stand for a tank."""


def water_class(water_c: float) -> str:
    """Return the coolest ASHRAE class that facility water of a temperature in C fulfils."""
    # Water held at the limit of a class is within it, despite rounding.
    kept = (name for name, limit_c in W_CLASS_LIMITS_C.items() if water_c <= limit_c + 1e-6)
    return next(kept, WARMEST_CLASS)


class LiquidRack(Section):
    """Rack whose chips are cooled by cold plates; the rest of its heat goes to the air of the hall.

    The defaults are a rack of 72 GPUs and 132 kW, of which 115 kW go into the liquid.
    """

    gpus: Count = 72
    """Number of GPUs; of racks without GPUs, of their largest chips."""
    gpu_idle_w: ChipW = 140.0
    """Power of one GPU without work, in W."""
    gpu_max_w: Annotated[float, Field(ge=1, le=1e4)] = 1200.0
    """Power of one GPU at full load and ``leak_ref_c``, in W, 1..10,000."""
    cpus: Annotated[int, Field(ge=0, le=10_000)] = 36
    """Number of CPUs on cold plates, 0..10,000."""
    cpu_idle_w: ChipW = 90.0
    """Power of one CPU without work, in W."""
    cpu_max_w: ChipW = 300.0
    """Power of one CPU at full load, in W."""
    other_idle_w: RackPartW = 16000.0
    """Power of switches, network cards, storage and conversion without work, in W."""
    other_max_w: RackPartW = 34800.0
    """Power of switches, network cards, storage and conversion at full load, in W."""
    capture_chip: Share = 0.99
    """Share of the heat of GPUs and CPUs that goes into the liquid, 0..1."""
    capture_other: Share = 0.539
    """Share of the heat of all other parts that goes into the liquid, 0..1."""
    leak_per_k: Annotated[float, Field(ge=0, le=0.02)] = 0.002
    """Growth of a GPU's power with its junction temperature by leakage, in 1/K, 0..0.02: from no
    leakage to twice the power 50 K warmer."""
    leak_ref_c: JunctionC = 70.0
    """Junction temperature at which a GPU draws its given power, in C."""
    r0_k_per_w: Annotated[float, Field(ge=0, le=1)] = 0.0164
    """Thermal resistance from the case of a GPU to the coolant at unlimited flow, in K/W, 0..1."""
    a_k_lpm_per_w: Annotated[float, Field(ge=0, le=1)] = 0.00807
    """Part of that resistance that is inversely proportional to the flow, in K/W at a flow of one
    litre per minute and GPU, 0..1."""
    r_jc_k_per_w: Annotated[float, Field(ge=0, le=1)] = 0.010
    """Thermal resistance from the junction of a GPU to its case, in K/W, 0..1."""
    throttle_c: JunctionC = 85.0
    """Junction temperature at which a GPU lowers its clock, in C."""
    trip_c: JunctionC = 105.0
    """Junction temperature at which the rack switches off, in C."""
    lpm_per_kw: Annotated[float, Field(ge=0.1, le=10)] = 1.2
    """Design flow of coolant divided by the heat in the liquid at full load, in l/min per kW,
    0.1..10: the coolant warms by about 150 K at the lower and 1.5 K at the upper bound."""
    chip_flow_share: WorkingShare = 0.75
    """Share of the coolant of the rack that flows past the GPUs, 0.01..1."""
    loss_w_per_k: Annotated[float, Field(ge=0, le=1e4)] = 40.0
    """Heat that lines and manifolds of the rack lose to the room, in W per K of coolant temperature
    above the room, 0..10,000."""
    chip_j_per_k: Annotated[float, Field(ge=10, le=1e5)] = 300.0
    """Heat capacity of one GPU with its cold plate and the coolant in it, in J/K, 10..1e5: from a
    bare die with its lid to 25 l of water."""
    stagnant_w_per_k: Annotated[float, Field(ge=0.001, le=100)] = 0.5
    """Conductance from the junction of one GPU to coolant that stands still, in W/K, 0.001..100."""
    trays: Count = 18
    """Number of servers; they have equal heat in the air, and equal height in the rack."""
    air_rise_k: Annotated[float, Field(ge=2, le=40)] = 15.0
    """Temperature rise of the air through the rack at the design point, in K, 2..40."""

    @property
    def design_liquid_w(self) -> float:
        """Heat that goes into the liquid at full load and ``leak_ref_c``, in W."""
        return self._parts_w(1.0)[0]

    @property
    def design_it_w(self) -> float:
        """Power at full load and ``leak_ref_c``, in W."""
        return sum(self._parts_w(1.0))

    @property
    def design_lpm(self) -> float:
        """Design flow of coolant, in l/min."""
        return self.lpm_per_kw * self.design_liquid_w / 1e3

    def air_w(self, load: float) -> float:
        """Return the heat of the servers in the air at a load of 0..1 and ``leak_ref_c``, in W."""
        return self._parts_w(load)[1]

    def _parts_w(self, load: float) -> tuple[float, float]:
        """Return the heat in liquid and in air at a load of 0..1 and ``leak_ref_c``, in W."""

        def at(idle_w: float, max_w: float) -> float:
            return idle_w + (max_w - idle_w) * load

        chips_w = self.gpus * at(self.gpu_idle_w, self.gpu_max_w)
        chips_w += self.cpus * at(self.cpu_idle_w, self.cpu_max_w)
        other_w = at(self.other_idle_w, self.other_max_w)
        liquid_w = self.capture_chip * chips_w + self.capture_other * other_w
        return liquid_w, chips_w + other_w - liquid_w

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        for part in ("gpu", "cpu", "other"):
            idle_w, max_w = getattr(self, f"{part}_idle_w"), getattr(self, f"{part}_max_w")
            if idle_w > max_w:
                raise ValueError(f"{part}_idle_w {idle_w:g} must not exceed {part}_max_w {max_w:g}")
        if self.throttle_c >= self.trip_c:
            raise ValueError(f"throttle_c {self.throttle_c:g} must be below trip_c {self.trip_c:g}")
        if self.design_liquid_w < 1.0:
            raise ValueError(
                f"capture_chip {self.capture_chip:g} and capture_other {self.capture_other:g} "
                "leave no heat for the liquid; valid without liquid is servers, a rack in air"
            )
        gpu_lpm = FLOW_LIMITS[0] * self.design_lpm * self.chip_flow_share / self.gpus
        resistance = self.r_jc_k_per_w + self.r0_k_per_w + self.a_k_lpm_per_w / gpu_lpm
        gain = self.leak_per_k * self.gpu_max_w * self.capture_chip * resistance
        if gain > MOST_LEAKAGE_GAIN:
            raise ValueError(
                f"leak_per_k {self.leak_per_k:g} with {resistance:.3g} K/W at the lowest flow: a "
                f"kelvin more warms the junction by {gain:.3g} K again; valid is at most "
                f"{MOST_LEAKAGE_GAIN:g} K"
            )
        return self


class DoorRack(LiquidRack):
    """Air-cooled rack with a rear door, as a rack without chips on cold plates."""

    door_effectiveness: WorkingShare
    """Share of the heat that the door takes with coolant at room temperature, 0.01..1."""


class RearDoor(Section):
    """Heat exchanger behind the servers of an air-cooled rack, with coolant from the CDUs.

    The power of servers with a rear door depends on their load alone, not on the inlet temperature.
    """

    effectiveness: WorkingShare = 0.6
    """Share of the heat of the servers that the door takes with coolant at ``liquid.room_c``,
    0.01..1; assumed. Colder coolant takes more."""
    lpm_per_kw: Annotated[float, Field(ge=0.1, le=10)] = 2.0
    """Design flow of coolant divided by the heat that the door takes at full load, in l/min per
    kW, 0.1..10; assumed."""
    loss_w_per_k: Annotated[float, Field(ge=0, le=1e4)] = 10.0
    """Heat that lines of the door lose to the room, in W per K of coolant temperature above the
    room, 0..10,000; assumed."""

    def as_liquid(self, idle_w: float, full_w: float, rise_k: float) -> LiquidRack:
        """Return the rack as one without chips on cold plates.

        Args:
            idle_w: Power of its servers without work, in W.
            full_w: Power of its servers at full load, in W.
            rise_k: Temperature rise of the air through the rack at the design point, in K.
        """
        return DoorRack.model_construct(
            gpus=0,
            cpus=0,
            other_idle_w=idle_w,
            other_max_w=full_w,
            capture_other=self.effectiveness,
            lpm_per_kw=self.lpm_per_kw,
            loss_w_per_k=self.loss_w_per_k,
            air_rise_k=rise_k,
            door_effectiveness=self.effectiveness,
        )


class CduConfig(Section):
    """Coolant distribution units: exchangers and pumps between racks and facility water."""

    manifolds: Annotated[int, Field(ge=1, le=10_000)] = 1
    """Number of secondary loops, 1..10,000; each serves an equal number of consecutive
    liquid-cooled racks, up to one."""
    per_manifold: Annotated[int, Field(ge=1, le=100)] = 2
    """Number of CDUs of each manifold, 1..100."""
    spare: Annotated[int, Field(ge=0, le=99)] = 1
    """Number of CDUs of each manifold beyond those that its design load needs, 0..99."""
    capacity_kw: Annotated[float, Field(ge=1, le=1e5)] | None = None
    """Heat that one CDU transfers at ``approach_k`` and ``range_k``, in kW, 1..100,000; None sizes
    the CDUs for the design load without the spare ones."""
    approach_k: ExchangerK = 4.0
    """Coolant to the racks minus facility water to the CDU at the design point, in K."""
    range_k: WaterRangeK = 12.0
    """Temperature rise of the coolant through the racks at the design point, in K."""
    head_kpa: HeadKpa = 250.0
    """Pressure difference of the pumps at design flow, in kPa."""
    pump_efficiency: WorkingShare = 0.6
    """Efficiency of pumps with motor and drive, 0.01..1."""
    wall_share: Share = 0.1
    """Share of the plates in the thermal resistance of the exchanger at the design point, 0..1."""
    side_share: Share = 0.5
    """Share of the film on the side of the racks in the resistance of both films, 0..1."""
    fluid_share: Share = 0.9
    """Share of the pumps' power that warms the coolant, 0..1; the rest warms the room."""
    pumps: Annotated[int, Field(ge=1, le=10)] = 2
    """Number of pumps of a CDU, 1..10."""
    pump_share: Share = 0.6
    """Share of the flow of a CDU that remains without one of its pumps, 0..1; a single pump leaves
    none."""
    min_valve: WorkingShare = 0.05
    """Smallest flow of facility water through a CDU, divided by its design flow, 0.01..1."""

    @property
    def count(self) -> int:
        """Number of CDUs of all manifolds."""
        return self.manifolds * self.per_manifold

    @model_validator(mode="after")
    def _some_are_needed(self) -> Self:
        if self.spare >= self.per_manifold:
            raise ValueError(
                f"spare {self.spare} with per_manifold {self.per_manifold}: valid is at most "
                f"{self.per_manifold - 1}, so that one CDU carries the load"
            )
        return self


class CoolantConfig(Section):
    """Coolant between CDUs and racks; the default is water with 25 % of propylene glycol."""

    density_kg_m3: Annotated[float, Field(ge=500, le=2500)] = 1015.0
    """Density, in kg/m3, 500..2,500: from light oils to fluorinated liquids."""
    heat_capacity_j_per_kg_k: Annotated[float, Field(ge=500, le=5000)] = 3900.0
    """Specific heat capacity, in J/(kg K), 500..5,000: from fluorinated liquids to water."""


class LiquidFacilityConfig(Section):
    """Facility water between CDUs and outdoors: pumps, cooler and trim chiller."""

    rejection: Literal["dry", "adiabatic", "tower"] = "dry"
    """Cooler: dry, with water that evaporates into its air (adiabatic), or a cooling tower."""
    head_kpa: HeadKpa = 200.0
    """Pressure difference of the pumps at design flow, in kPa."""
    pump_efficiency: WorkingShare = 0.65
    """Efficiency of pumps with motor and drive, 0.01..1."""
    min_pump: WorkingShare = 0.3
    """Lowest speed of the pumps, as a share of full speed, 0.01..1."""
    litres_per_kw: LitresPerKw = 5.0
    """Volume of the loop divided by the design heat, in l/kW, 0.01..1,000, with that of a tank."""
    approach_k: ExchangerK = 7.0
    """Water that leaves the cooler minus air that enters it at the design point, in K; for a tower
    the approach to the wet bulb."""
    fan_share: Annotated[float, Field(ge=0, le=1)] = 0.02
    """Power of the fans at full speed divided by the design heat, 0..1."""
    min_fan: WorkingShare = 0.1
    """Lowest airflow of the cooler, as a share of full airflow, 0.01..1."""
    adiabatic_effectiveness: Share = 0.8
    """Cooling of the air by evaporation divided by dry bulb minus wet bulb, 0..1; only for
    rejection ``adiabatic``."""
    cycles: Annotated[float, Field(ge=1.1, le=100)] = 5.0
    """Concentration of salts in the water of adiabatic coolers and towers divided by that of the
    make-up water, 1.1..100; it defines the blowdown."""
    trim_kw: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    """Capacity to remove the heat that the cooler leaves in the water, in kW, 0..1e6; 0 means
    none."""
    trim_by: Literal["chiller", "plant"] = "chiller"
    """Device with the capacity ``trim_kw``: ``chiller`` is a trim chiller of the facility loop;
    ``plant`` is an exchanger to the chilled water of the CRAC units, whose plant is sized for the
    heat of both."""
    w_class: Literal["W17", "W27", "W32", "W40", "W45", "W+"] | None = None
    """ASHRAE TC 9.9 (2021) class of the facility water, which names its highest temperature in C;
    ``W+`` has none. Devices that cannot keep it on the design day raise a warning. None means no
    class."""

    @model_validator(mode="after")
    def _plant_has_a_capacity(self) -> Self:
        if self.trim_by == "plant" and self.trim_kw == 0.0:
            raise ValueError("trim_by plant needs trim_kw above 0, the heat that the plant takes")
        return self


class ReuseConfig(Section):
    """Reuse of heat of the returning facility water, by a district heating network for example."""

    kind: Literal["none", "direct", "heat_pump"] = "none"
    """No reuse, an exchanger to the network, or a heat pump."""
    share: Share = 0.0
    """Share of the heat that may be reused at reset, 0..1; an action changes it."""
    demand_kw: Annotated[float, Field(ge=0, le=1e6)] | None = None
    """Most heat that the network takes, in kW, 0..1e6; None means all."""
    price_per_kwh_heat: Annotated[float, Field(ge=-10, le=10)] = 0.0
    """Price of delivered heat in the currency of the tariff per kWh, -10..10; below 0 the data
    center pays for delivery."""
    effectiveness: WorkingShare = 0.8
    """Effectiveness of the exchanger to the network, 0.01..1."""
    network_return_c: Annotated[float, Field(ge=0, le=90)] = 35.0
    """Temperature of the water that the network brings, in C, 0..90."""
    network_supply_c: Annotated[float, Field(ge=20, le=130)] = 70.0
    """Temperature of the water that a heat pump gives to the network, in C, 20..130: from floors to
    old steam networks."""
    lorenz: Annotated[float, Field(ge=0.1, le=0.9)] = 0.5
    """COP of the heat pump divided by that of the ideal process, 0.1..0.9."""
    pinch_k: RiseK = 5.0
    """Temperature difference in either exchanger of the heat pump, in K."""

    @model_validator(mode="after")
    def _network_is_heated(self) -> Self:
        if self.network_supply_c <= self.network_return_c:
            raise ValueError(
                f"network_supply_c {self.network_supply_c:g} must be above network_return_c "
                f"{self.network_return_c:g}"
            )
        if self.kind == "none" and self.share > 0.0:
            raise ValueError(f"share {self.share:g} needs kind direct or heat_pump, not none")
        return self


class LiquidConfig(Section):
    """Liquid cooling of a data center, from its CDUs to the outdoors."""

    cdus: CduConfig = CduConfig()
    """Coolant distribution units (CDUs) and their loops."""
    coolant: CoolantConfig = CoolantConfig()
    """Coolant of the racks."""
    setpoint_c: SupplySetpointC = 40.0
    """Temperature of the coolant to the racks at reset, in C, 20..45; actions change it."""
    flow: Annotated[float, Field(ge=FLOW_LIMITS[0], le=FLOW_LIMITS[1])] = 1.0
    """Flow of the coolant at reset, divided by its design flow, 0.4..1.1; actions change it."""
    dew_point_c: DewPointC | None = 15.0
    """Dew point of the room, in C; None means that of the outdoor air."""
    dew_margin_k: RiseK = 2.0
    """Lowest coolant temperature minus dew point of the room, in K."""
    room_c: Annotated[float, Field(ge=0, le=60)] = 27.0
    """Temperature of the air around the lines, in C, 0..60."""
    litres_per_kw: LitresPerKw = 1.0
    """Volume of each secondary loop divided by its design heat, in l/kW, 0.01..1,000."""
    facility: LiquidFacilityConfig = LiquidFacilityConfig()
    """Facility water and its cooler."""
    reuse: ReuseConfig = ReuseConfig()
    """Reuse of heat."""
    substep_s: Annotated[float, Field(ge=1, le=60)] = 15.0
    """Longest substep of the loops in transient halls, in s, 1..60; substeps are at most 5 s in
    steps with a failure, and 1 s if pumps fail."""


@cache
def _library() -> dict[str, dict[str, Any]]:
    """Return the library of racks, plain values by name."""
    text = resources.files("sdc_taichi.configs").joinpath("racks.yaml").read_text("utf-8")
    return dict(load_yaml(text))


def with_model(values: Any) -> Any:
    """Return values of a rack type, completed by those of the library entry that they name.

    Args:
        values: Plain values; those that name no ``model`` are returned unchanged.

    Raises:
        ValueError: The library has no such rack.
    """
    if not isinstance(values, Mapping) or values.get("model") is None:
        return values
    name = values["model"]
    if not isinstance(name, str) or name not in _library():
        raise ValueError(
            f"model {shortened(name)} is no rack of the library"
            f"{suggestion_or_valid(str(name), list(_library()))}"
        )
    base = _library()[name]
    completed = {**base, **values}
    if isinstance(base.get("liquid"), Mapping) and isinstance(values.get("liquid"), Mapping):
        completed["liquid"] = {**base["liquid"], **values["liquid"]}
    return completed
