"""Liquid-cooled racks, coolant distribution units (CDUs) and their facility loop.

Heat goes from the chips through cold plates into the coolant of a manifold, whose CDUs pass it to
facility water. From there it goes to a heat consumer, and then to a dry cooler or tower and a trim
chiller. ``kernels/liquid.py`` computes a step; this module has the parameters, the sizes of devices
and the equations that sizing and documentation need. Parameters are arrays, or one value for all.

In shapes, B is the number of data centers, M of manifolds, C of CDUs, and L of racks with coolant.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from sdc_taichi.plant.tower import WATER_J_PER_KG_K
from sdc_taichi.types import F64, Values

Offsets = npt.NDArray[np.int64]


@dataclass(frozen=True)
class RackParameters:
    """Racks with coolant: servers with cold plates, or servers of an air-cooled rack with a door.

    The defaults are those of a GB200 NVL72 (HPE QuickSpecs a50009224enw; idle powers after RAPS),
    with cold plates as in figure 7 of the OCP OAI System Liquid Cooling Guidelines 2023.
    """

    gpus: Values = 72.0
    """Number of GPUs, (L,); 0 for a rack with a rear door."""
    gpu_idle_w: Values = 140.0
    """Power of an idle GPU at ``leak_ref_c``, in W, (L,)."""
    gpu_max_w: Values = 1200.0
    """Power of a GPU at full load and ``leak_ref_c``, in W, (L,)."""
    cpus: Values = 36.0
    """Number of CPUs, (L,)."""
    cpu_idle_w: Values = 90.0
    """Power of an idle CPU, in W, (L,)."""
    cpu_max_w: Values = 300.0
    """Power of a CPU at full load, in W, (L,)."""
    other_idle_w: Values = 16000.0
    """Power of everything else in an idle rack, in W, (L,)."""
    other_max_w: Values = 34800.0
    """Power of everything else in a rack at full load, in W, (L,)."""
    capture_chip: Values = 0.99
    """Share of the heat of GPUs and CPUs that the coolant takes, (L,)."""
    capture_other: Values = 0.539
    """Share of the heat of everything else that the coolant takes, (L,)."""
    leak_per_k: Values = 0.002
    """Growth of the power of a GPU with its junction temperature, in 1/K, (L,)."""
    leak_ref_c: Values = 70.0
    """Junction temperature to which the powers of GPUs refer, in C, (L,)."""
    r0_k_per_w: Values = 0.0164
    """Resistance of a cold plate at very large flow, in K/W, (L,)."""
    a_k_lpm_per_w: Values = 0.00807
    """Resistance of a cold plate times its flow, in K l/min per W, (L,)."""
    r_jc_k_per_w: Values = 0.010
    """Resistance between junction and case of a GPU, in K/W, (L,)."""
    throttle_c: Values = 85.0
    """Junction temperature to which GPUs limit their power, in C, (L,)."""
    trip_c: Values = 105.0
    """Junction temperature above which the rack switches off, in C, (L,)."""
    trip_flow_share: Values = 0.4
    """Flow of coolant below which a rack without a rear door switches off, as a share of design,
    (L,)."""
    lpm_per_kw: Values = 1.2
    """Design flow of coolant, in l/min per kW of ``liquid_design_w``, (L,)."""
    liquid_design_w: Values = 115e3
    """Heat that the coolant takes at full load, in W, (L,)."""
    chip_flow_share: Values = 0.75
    """Share of the coolant that flows through the cold plates of GPUs, (L,)."""
    loss_w_per_k: Values = 40.0
    """Heat that pipes lose to the room for each kelvin of return minus room temperature, in W/K,
    (L,)."""
    chip_j_per_k: Values = 300.0
    """Heat capacity of a GPU with its cold plate, in J/K, (L,)."""
    stagnant_w_per_k: Values = 0.5
    """Conductance between a GPU and its coolant without flow, in W/K, (L,)."""
    door_effectiveness: Values = 0.0
    """Share of the heat of a rack that its rear door takes with coolant at room temperature, (L,);
    0 for racks without a rear door. A rack with a door has no GPUs or CPUs; the powers of
    everything else are those of its servers without fans."""
    door_rise_k: Values = 13.0
    """Temperature rise of the air of a rack with a rear door at design, in K, (L,)."""


@dataclass(frozen=True)
class CduParameters:
    """CDUs: pump, and exchanger between the coolant of a manifold and facility water.

    Capacity and approach are those of a Vertiv XDU1350.
    """

    capacity_w: Values = np.nan
    """Heat that the CDU transfers at design, in W, (C,); nan for ``SPARE_CAPACITY`` times the
    design heat of its manifold, divided by the number of CDUs that it needs."""
    approach_k: Values = 4.0
    """Coolant that leaves minus facility water that enters at design, in K, (C,)."""
    range_k: Values = 12.0
    """Coolant that enters minus coolant that leaves at design, in K, (C,)."""
    head_kpa: Values = 250.0
    """Head of the pumps at design flow, in kPa, (C,); half of it in CDU and pipes, the other half
    in the branches to the racks."""
    pump_efficiency: Values = 0.6
    """Efficiency of the pumps, (C,)."""
    wall_share: Values = 0.1
    """Share of the walls in the thermal resistance of the exchanger at design, (C,)."""
    side_share: Values = 0.5
    """Share of the coolant's film in the resistance of both films at design, (C,)."""
    fluid_share: Values = 0.9
    """Share of the power of the pumps that heats the coolant, (C,); the rest heats the room."""
    min_valve: Values = 0.05
    """Smallest flow of facility water, as a share of design, (C,)."""
    max_valve: Values = 1.2
    """Largest flow of facility water, as a share of design, (C,)."""
    setpoint_c: Values = 40.0
    """Supply setpoint before the first step, in C, (C,)."""
    flow: Values = 1.0
    """Commanded flow before the first step, as a share of the design flow of the manifold, (C,)."""


REUSE_KINDS = ("none", "direct", "heat_pump")
"""Valid values of ``liquid.reuse.kind``; ``PlantParameters.reuse_kind`` has the index."""
REJECTION_KINDS = ("dry", "adiabatic", "tower")
"""Valid values of ``liquid.facility.rejection``; ``PlantParameters.rejection`` has the index."""


@dataclass(frozen=True)
class PlantParameters:
    """Coolant, facility loop, heat reuse and heat rejection of each data center."""

    density_kg_m3: Values = 1015.0
    """Density of the coolant, in kg/m3, (B,); 25 % propylene glycol by default."""
    heat_capacity_j_per_kg_k: Values = 3900.0
    """Specific heat capacity of the coolant, in J/(kg K), (B,)."""
    coolant_l_per_kw: Values = 1.0
    """Volume of the loop of a manifold, in l per kW of the CDUs that it needs, (B,)."""
    spare: Values = 0.0
    """Number of CDUs of each manifold that are spare, (B,)."""
    room_c: Values = 27.0
    """Air temperature around the pipes, in C, (B,)."""
    dew_margin_k: Values = 2.0
    """Smallest difference of supply setpoints and dew point of the room, in K, (B,)."""
    rejection: Values = 0.0
    """Index of the kind of heat rejection in ``REJECTION_KINDS``, (B,)."""
    head_kpa: Values = 200.0
    """Head of the facility pumps at design flow, in kPa, (B,)."""
    pump_efficiency: Values = 0.65
    """Efficiency of the facility pumps, (B,)."""
    pump_fluid_share: Values = 0.9
    """Share of the power of the facility pumps that heats the water, (B,)."""
    min_pump: Values = 0.3
    """Lowest speed of the facility pumps, as a share of design, (B,)."""
    water_l_per_kw: Values = 5.0
    """Volume of the facility loop, in l per kW of the CDUs that are needed, (B,)."""
    approach_k: Values = 7.0
    """Facility water that leaves the cooler minus air that enters at design, in K, (B,); with a
    tower, minus tower water that enters the exchanger."""
    fan_share: Values = 0.02
    """Power of the cooler's fans at full speed divided by its design heat, (B,)."""
    min_fan: Values = 0.1
    """Smallest airflow of the cooler, as a share of design, (B,)."""
    adiabatic_effectiveness: Values = 0.8
    """Share of dry minus wet bulb by which wet pads cool the air of an adiabatic cooler, (B,)."""
    cycles: Values = 5.0
    """Concentration of solids in the water of pads or tower divided by make-up water, (B,)."""
    trim_w: Values = 0.0
    """Cooling capacity of the trim chiller or of the exchanger to the plant, in W, (B,)."""
    trim_by_plant: Values = 0.0
    """1 if the chilled water of the plant of the CRAC units takes the heat that the cooler leaves,
    0 for a trim chiller, (B,)."""
    trim_cop: Values = np.nan
    """COP of the trim chiller, (B,); nan for the model ``carnot`` of ``plant/chiller.py``."""
    reuse_kind: Values = 0.0
    """Index of the kind of heat reuse in ``REUSE_KINDS``, (B,)."""
    reuse_share: Values = 0.0
    """Share of the heat that is offered to the consumer without a command, 0..1, (B,)."""
    heat_price_per_kwh: Values = 0.0
    """Price that the consumer pays for heat, per kWh, (B,)."""
    reuse_demand_w: Values = np.inf
    """Largest heat that the consumer takes, in W, (B,)."""
    reuse_effectiveness: Values = 0.8
    """Effectiveness of the exchanger of direct reuse, (B,)."""
    network_return_c: Values = 35.0
    """Temperature of the consumer's water before it is heated, in C, (B,)."""
    network_supply_c: Values = 70.0
    """Temperature of the consumer's water behind the heat pump, in C, (B,)."""
    lorenz: Values = 0.5
    """COP of the heat pump divided by that of a Lorenz process, (B,)."""
    pinch_k: Values = 5.0
    """Temperature difference in each exchanger of the heat pump, in K, (B,)."""
    substep_s: Values = 15.0
    """Length of a substep of a transient hall without failures, in s, (B,)."""


@dataclass(frozen=True)
class LiquidFleet:
    """Racks with coolant, manifolds, CDUs and facility loops of B data centers.

    Racks and CDUs of a manifold, and manifolds of a data center, follow each other.
    """

    rack_offsets: Offsets
    """First rack with coolant of each manifold, and the number of all, (M + 1,)."""
    cdu_offsets: Offsets
    """First CDU of each manifold, and the number of all, (M + 1,)."""
    manifold_offsets: Offsets
    """First manifold of each data center, and the number of all, (B + 1,)."""
    racks: RackParameters = field(default_factory=RackParameters)
    """Parameters of the racks, (L,)."""
    cdus: CduParameters = field(default_factory=CduParameters)
    """Parameters of the CDUs, (C,)."""
    plants: PlantParameters = field(default_factory=PlantParameters)
    """Parameters of the data centers, (B,)."""

    @property
    def rack_manifold(self) -> Offsets:
        """Manifold of each rack with coolant, (L,)."""
        return _items(self.rack_offsets)

    @property
    def cdu_manifold(self) -> Offsets:
        """Manifold of each CDU, (C,)."""
        return _items(self.cdu_offsets)

    @property
    def manifold_dc(self) -> Offsets:
        """Data center of each manifold, (M,)."""
        return _items(self.manifold_offsets)

    @property
    def has_plates(self) -> npt.NDArray[np.bool_]:
        """True for racks with cold plates, False for those with a rear door, (L,)."""
        doors = np.broadcast_to(self.racks.door_effectiveness, self.rack_manifold.shape)
        return np.asarray(doors == 0.0)

    @classmethod
    def of_equal(
        cls, size: int = 1, *, racks: int = 10, cdus: int = 1, manifolds: int = 1
    ) -> LiquidFleet:
        """Return B data centers with default parameters.

        Args:
            size: Number of data centers.
            racks: Number of racks of each manifold.
            cdus: Number of CDUs of each manifold.
            manifolds: Number of manifolds of each data center.
        """
        loops = np.arange(size * manifolds + 1)
        return cls(loops * racks, loops * cdus, np.arange(size + 1) * manifolds)


def _items(offsets: Offsets) -> Offsets:
    """Return the number of the range of offsets that holds each item."""
    return np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))


PLANT_APPROACH_K = 2.0
"""Facility water minus chilled water of the plant that cools it, at least, in K; usual approaches
of plate exchangers are 1 to 3 K."""
SPARE_CAPACITY = 1.13
"""Capacity of CDUs divided by the design heat of their racks, if none is configured."""
WATER_KG_M3 = 995.0
"""Density of facility water, in kg/m3."""
M3S_PER_LPM = 1.0 / 60000.0
"""Flow of 1 l/min, in m3/s."""
COOLER_WALL_SHARE, COOLER_SIDE_SHARE = 0.05, 0.2
"""Share of the walls in the resistance of a dry cooler, and of the water's film in that of both
films: most of the resistance is on the side of the air."""


def phi(x: Values) -> F64:
    """Return (1 - exp(-x)) / x, and 1 for x = 0."""
    x = np.asarray(x, dtype=np.float64)
    return np.where(x == 0.0, 1.0, -np.expm1(-x) / np.where(x == 0.0, 1.0, x))


def effectiveness(ntu: Values, capacity_ratio: Values) -> F64:
    """Return the effectiveness of a counterflow exchanger (Kays and London).

    With t = NTU phi(NTU (1 - c)) it is t / (1 + c t), which needs no case for c = 1.

    Args:
        ntu: Number of transfer units: UA divided by the smaller capacity rate.
        capacity_ratio: Smaller capacity rate divided by the larger one, c.
    """
    t = ntu * phi(ntu * (1.0 - np.asarray(capacity_ratio)))
    return np.asarray(t / (1.0 + capacity_ratio * t))


def conductance_w_per_k(ua_w_per_k: Values, c_s: Values, c_f: Values) -> F64:
    """Return the heat of an exchanger per difference of entering temperatures, in W/K.

    Args:
        ua_w_per_k: UA, in W/K.
        c_s: Capacity rate of side s, in W/K.
        c_f: Capacity rate of side f, in W/K.
    """
    low, high = np.minimum(c_s, c_f), np.maximum(c_s, c_f)
    return np.asarray(low * effectiveness(ua_w_per_k / low, low / high))


def ua_share(y_s: Values, y_f: Values, *, wall_share: Values, side_share: Values) -> F64:
    """Return the UA of an exchanger divided by that at design flows.

    Walls and the films of both sides are in series; films conduct in proportion to flow^(3/4).

    Args:
        y_s: Flow of side s, as a share of design.
        y_f: Flow of side f, as a share of design.
        wall_share: Share of the walls in the resistance at design.
        side_share: Share of side s in the resistance of both films at design.
    """
    films = side_share / np.power(y_s, 0.75) + (1.0 - side_share) / np.power(y_f, 0.75)
    return np.asarray(1.0 / (wall_share + (1.0 - wall_share) * films))


def exchanger_ua_w_per_k(heat_w: Values, c_s: Values, c_f: Values, *, approach_k: Values) -> F64:
    """Return the UA with which a counterflow exchanger transfers its design heat, in W/K.

    Args:
        heat_w: Heat at design, in W.
        c_s: Capacity rate of the side that is cooled, in W/K.
        c_f: Capacity rate of the other side, in W/K.
        approach_k: Temperature at which side s leaves minus that at which side f enters, in K.
    """
    low, ratio = np.minimum(c_s, c_f), np.minimum(c_s, c_f) / np.maximum(c_s, c_f)
    share = heat_w / (low * (heat_w / np.asarray(c_s) + approach_k))
    equal = ratio == 1.0
    ntu = np.where(
        equal,
        share / (1.0 - share),
        np.log((1.0 - share * ratio) / (1.0 - share)) / np.where(equal, 1.0, 1.0 - ratio),
    )
    return np.asarray(ntu * low)


def pump_w(head_kpa: Values, flow_m3s: Values, efficiency: Values) -> Values:
    """Return the power of pumps, in W."""
    return head_kpa * 1e3 * flow_m3s / efficiency


@dataclass(frozen=True)
class LiquidSizing:
    """Sizes of CDUs, loops and facility loops of B data centers."""

    rack_m3s: F64
    """Design flow of coolant of each rack, in m3/s, (L,)."""
    cdu_w: F64
    """Capacity of each CDU, in W, (C,)."""
    cdu_m3s: F64
    """Design flow of coolant of each CDU, in m3/s, (C,): that of its manifold divided by the number
    of CDUs that it needs."""
    cdu_ua_w_per_k: F64
    """UA of the exchanger of each CDU at design flows, in W/K, (C,)."""
    cdu_w_per_k: F64
    """Capacity rate of coolant and of facility water at which the exchanger of each CDU has its UA,
    in W/K, (C,)."""
    cdu_water_m3s: F64
    """Design flow of facility water of each CDU, in m3/s, (C,)."""
    cdu_pump_w: F64
    """Power of the pumps of each CDU at design flow, in W, (C,)."""
    loop_j_per_k: F64
    """Heat capacity of the coolant of each manifold, in J/K, (M,)."""
    heat_w: F64
    """Capacity of the CDUs that are needed, and of the cooler, in W, (B,)."""
    water_w_per_k: F64
    """Capacity rate of the facility water at design, in W/K, (B,)."""
    water_j_per_k: F64
    """Heat capacity of the facility loop, in J/K, (B,)."""
    facility_pump_w: F64
    """Power of the facility pumps at design flow, in W, (B,)."""
    cooler_ua_w_per_k: F64
    """UA of the cooler, or of the exchanger of a tower, at design flows, in W/K, (B,)."""
    fan_w: F64
    """Power of the cooler's fans at full speed, in W, (B,)."""


def _sums(of: Offsets, values: Values, count: int) -> F64:
    """Return the sum of the values of each of ``count`` parts; ``of`` has the part of each."""
    return np.bincount(of, np.asarray(values), count).astype(np.float64)


def size_liquid(fleet: LiquidFleet) -> LiquidSizing:
    """Size CDUs, loops, facility pumps and coolers.

    Coolant and facility water of a CDU have equal capacity rates at its capacity and range, as have
    the water of a cooler and its air. Pumps are sized for the flow of the racks.
    """
    racks, cdus, plants = fleet.racks, fleet.cdus, fleet.plants
    size, loops = len(fleet.manifold_offsets) - 1, len(fleet.rack_offsets) - 1
    loop_of_rack, loop_of_cdu, dc = fleet.rack_manifold, fleet.cdu_manifold, fleet.manifold_dc
    rack_w = np.broadcast_to(racks.liquid_design_w, loop_of_rack.shape)
    rack_m3s = racks.lpm_per_kw * rack_w * (1e-3 * M3S_PER_LPM)
    n_cdus = np.diff(fleet.cdu_offsets)
    needed = n_cdus - np.broadcast_to(plants.spare, size)[dc]
    loop_m3s = _sums(loop_of_rack, rack_m3s, loops)
    loop_w = _sums(loop_of_rack, rack_w, loops)
    design_w = (SPARE_CAPACITY * loop_w / needed)[loop_of_cdu]
    cdu_w = np.where(np.isnan(cdus.capacity_w), design_w, cdus.capacity_w)
    cdu_m3s = (loop_m3s / needed)[loop_of_cdu]
    c_w_per_k = cdu_w / cdus.range_k
    counted = (needed / n_cdus)[loop_of_cdu]
    of_loop_w = _sums(loop_of_cdu, counted * cdu_w, loops)
    heat_w = _sums(dc, of_loop_w, size)
    per_loop = _sums(loop_of_cdu, counted * c_w_per_k, loops)
    water_w_per_k = _sums(dc, per_loop, size)
    j_per_l = np.broadcast_to(plants.density_kg_m3 * plants.heat_capacity_j_per_kg_k * 1e-3, size)
    litres = np.broadcast_to(plants.coolant_l_per_kw, size)[dc] * of_loop_w * 1e-3
    water_m3s = water_w_per_k / (WATER_KG_M3 * WATER_J_PER_KG_K)
    return LiquidSizing(
        rack_m3s=rack_m3s,
        cdu_w=cdu_w,
        cdu_m3s=cdu_m3s,
        cdu_ua_w_per_k=exchanger_ua_w_per_k(
            cdu_w, c_w_per_k, c_w_per_k, approach_k=cdus.approach_k
        ),
        cdu_w_per_k=c_w_per_k,
        cdu_water_m3s=c_w_per_k / (WATER_KG_M3 * WATER_J_PER_KG_K),
        cdu_pump_w=np.asarray(pump_w(cdus.head_kpa, cdu_m3s, cdus.pump_efficiency)),
        loop_j_per_k=litres * j_per_l[dc],
        heat_w=heat_w,
        water_w_per_k=water_w_per_k,
        water_j_per_k=plants.water_l_per_kw * heat_w * (1e-6 * WATER_KG_M3 * WATER_J_PER_KG_K),
        facility_pump_w=np.asarray(pump_w(plants.head_kpa, water_m3s, plants.pump_efficiency)),
        # With equal capacity rates, water and air differ by the approach everywhere.
        cooler_ua_w_per_k=heat_w / plants.approach_k,
        fan_w=plants.fan_share * heat_w,
    )
