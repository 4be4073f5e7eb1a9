"""Sections ``hall`` and ``servers``: racks, layout, recirculation, and power of the servers."""

from __future__ import annotations

import re
from itertools import pairwise
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, field_validator, model_validator

from sdc_taichi.config.fields import (
    AirC,
    Count,
    DifferenceK,
    FileName,
    FlowRatio,
    IdleW,
    LengthM,
    Name,
    Ordered,
    PowerRatio,
    RiseK,
    Section,
    ServerW,
    Share,
    Text,
    WorkingShare,
    check_one_per_rack,
)
from sdc_taichi.config.hvac_schema import USUAL_AIR_J_PER_M3_K
from sdc_taichi.config.liquid_schema import LiquidRack, RearDoor, with_model
from sdc_taichi.errors import shortened, suggestion_or_valid
from sdc_taichi.plant.servers import Knee, ServerCurves, curve_through, linear_curve

MOST_RACKS = 10_000_000
"""Largest number of racks of a hall."""
SERVER_J_PER_K_W = 30.0
"""Heat capacity of servers divided by their power at full load, in J/(K W). The measured heat
capacity of a two-unit server of about 400 W is 12 kJ/K (Ibrahim, Shrivastava, Sammakia, Ghose 2012,
"Thermal mass characterization of a server at different fan speeds", ITherm)."""
MOST_RACK_J_PER_K = 410e3
"""Largest heat capacity of the servers of a rack, in J/K, unless it is configured: 42 units of 16.3
kg at 0.6 kJ/(kg K), as of a server of 130.5 kg, 8 units and 10.2 kW (NVIDIA DGX H100). Servers that
draw more power for their height are not heavier."""
ROOM_J_PER_K_W = 15.0
"""Heat capacity of coils, water in the coils and raised floor, whose temperatures follow the supply
air, divided by the servers' power at full load, in J/(K W)."""
DOOR_RISE_K = 13.0
"""Design rise of the air through servers with a rear door that give neither rise nor airflow, in
K."""
LEAST_SHARE_IN_AIR = 0.05
"""Smallest share of the heat of servers with a rear door for which the air of the hall is sized."""
MOST_RACK_U = 58.0
"""Height of the tallest racks, in units of 44.45 mm."""
LEAST_INLET_RANGE_K = 5.0
"""Smallest difference of the two inlet temperatures that define the server curves, in K. Real fans
reach full speed over about 10 K. With a difference of 1 K, the curves extrapolated by a few kelvins
would give a hundred times the fan power."""
LEAST_POINTS_APART_K = 0.1
"""Smallest difference of inlet temperature of two points of a server curve, in K."""
OVERSUPPLY_DECAY = {"ceiling": 4.0, "end_wall": 2.6}
"""Decay of the exhaust shares with oversupply by the position of the return air openings, fitted to
halls that ``sdc-taichi hall solve`` computes with more supply air than servers draw."""
RackCount = Annotated[int, Field(ge=1, le=MOST_RACKS)]
"""Number of rows or racks, 1..10,000,000."""
PowerPair = tuple[ServerW, IdleW]
"""CPU power of a server at full load, and when idle, in W."""
FullAirflow = Annotated[float, Field(ge=1e-4, le=100)]
"""Airflow of a server at full speed, in m3/s, 1e-4..100."""
DesignRiseK = Annotated[float, Field(ge=2, le=40)]
"""Temperature rise of the air through a server at the design point, in K, 2..40."""
PowerPoint = tuple[AirC, PowerRatio, PowerRatio]
"""Inlet temperature, in C, and power divided by full power at no load and at full load."""
AirflowRatio = Annotated[float, Field(ge=0, le=10)]
"""Airflow of a server divided by its full airflow, 0..10."""
AirflowPoint = tuple[AirC, AirflowRatio, AirflowRatio]
"""Inlet temperature, in C, and airflow ratio at no load and at full load."""
RackLength = Annotated[float, Field(ge=0.1, le=5)]
"""Dimension of a rack, in m, 0.1..5; usual racks are about 0.6 m wide, 1.2 m deep and 2.1 m
high."""


class LayoutConfig(Section):
    """Dimensions of a hall with parallel rows, whose fronts face each other across cold aisles.

    Row 0 is next to the first wall and faces away from it, row 1 faces row 0, and so on.
    """

    rack_pitch_m: RackLength = 0.6
    """Distance between the centres of neighbouring racks of a row, in m."""
    rack_depth_m: RackLength = 1.2
    """Depth of a rack, from front to back, in m."""
    rack_height_m: RackLength = 2.1
    """Height of a rack, in m."""
    cold_aisle_m: LengthM = 1.2
    """Width of a cold aisle, between the fronts of two rows, in m."""
    hot_aisle_m: LengthM = 1.2
    """Width of a hot aisle, between the backs of two rows, in m."""
    end_margin_m: Annotated[float, Field(ge=0, le=1000)] = 1.8
    """Distance between the ends of the rows and the walls, in m, 0..1,000."""
    side_margin_m: LengthM = 1.2
    """Distance between the outer rows and the walls, in m."""
    ceiling_m: Annotated[float, Field(ge=0.1, le=100)] = 3.6
    """Height of the hall, in m, 0.1..100; taller buildings have storeys."""
    containment: Share = 0.0
    """Share of the air paths between hot and cold aisles that containment closes, 0..1."""
    returns: Literal["ceiling", "end_wall"] = "ceiling"
    """Position of the return air openings: in the ceiling above the hot aisles, or in the walls at
    the row ends."""

    @model_validator(mode="after")
    def _racks_fit(self) -> Self:
        if self.ceiling_m <= self.rack_height_m:
            raise ValueError(
                f"ceiling_m {self.ceiling_m:g} must be above rack_height_m {self.rack_height_m:g}"
            )
        return self


class RecirculationConfig(Section):
    """Recirculation of exhaust air to the inlets of the racks."""

    decay_m: LengthM = 3.0
    """Path length at which the weight of another rack's exhaust falls to 1/e, in m."""
    cutoff: Annotated[float, Field(ge=0, le=0.01)] = 1e-4
    """Smallest weight of a source, as a share of the sum of weights of a rack in the middle of the
    hall, in halls of more than 64 racks; 0 keeps all sources."""
    matrix_file: FileName | None = None
    """File (.npz, .csv) with the matrix R or D of a CFD study, which replaces the weights of the
    layout; None uses the layout."""
    matrix_kind: Literal["R", "D"] | None = None
    """Kind of the matrix in a .csv file; None for .npz files, which contain the kind."""
    oversupply_decay: Annotated[float, Field(ge=0, le=20)] | None = None
    """Decay of the exhaust shares with oversupply: supply air of a multiple 1 + x of the need of a
    rack lowers its exhaust share by exp(-x times this value), 0..20; 0 leaves it unchanged. None
    means what the layout solver gives, 4 with returns in the ceiling and 2.6 with returns in the
    end walls, or 0 with one CRAC unit or a matrix file."""
    calibrate: Literal["rack", "row", "hall", "none"] | None = None
    """Approach temperatures to which recirculation is scaled: those of each ``rack``, or the means
    of each ``row`` or of the ``hall``, within which racks differ by the layout or the matrix file.
    ``none`` does not scale a matrix file. None means ``none`` with a matrix file and ``row``
    without one."""
    approach_of: Literal["open_hall", "hall"] | None = None
    """Hall that the approach temperatures describe: the ``open_hall`` without containment, in which
    containment then reduces them, or the ``hall`` as it stands, where they were measured. None
    means ``hall`` with ``calibrate: rack``, and ``open_hall`` otherwise."""

    reference_rack_kw: Annotated[float, Field(ge=0.01, le=1000)] | None = None
    """Power of the servers of a rack in the reference hall of ``calibrate`` ``row`` and ``hall``,
    at full load and without fans, in kW, 0.01..1,000. Its racks are alike, and the approach
    temperatures hold in it. Floor and CRAC units of the hall are made for it: racks of more power
    lack air. None means the mean of the hall, with floor and units made for the racks as they
    are."""

    @property
    def approach_text(self) -> str:
        """Text on whether approach temperatures are imposed or computed, and in which hall."""
        hall = "open hall" if self.is_of_open_hall else "hall as it stands"
        if self.scaled_to == "none":
            return "computed from the matrix file"
        if self.scaled_to == "rack":
            return f"imposed rack by rack by the config, in the {hall}"
        if self.matrix_file is not None:
            return f"mean of the {self.scaled_to} imposed by the config, racks by the matrix file"
        return f"computed; the config gives means of a reference hall of even racks, {hall}"

    @property
    def is_of_open_hall(self) -> bool:
        """True if the approach temperatures are those without containment."""
        of_hall = "hall" if self.scaled_to == "rack" else "open_hall"
        return (self.approach_of or of_hall) == "open_hall"

    @property
    def scaled_to(self) -> Literal["rack", "row", "hall", "none"]:
        """Approach temperatures to which recirculation is scaled, see ``calibrate``."""
        return self.calibrate or ("row" if self.matrix_file is None else "none")

    @model_validator(mode="after")
    def _magnitude_is_known(self) -> Self:
        if self.calibrate == "none" and self.matrix_file is None:
            raise ValueError(
                "calibrate none needs a matrix_file, since the layout alone tells no magnitude; "
                "valid without one are rack, row and hall"
            )
        computed = self.matrix_file is None and self.scaled_to in ("row", "hall")
        if self.reference_rack_kw is not None and not computed:
            raise ValueError(
                f"reference_rack_kw {self.reference_rack_kw:g} needs calibrate row or hall and no "
                "matrix_file; other approach temperatures are those of the racks as they are"
            )
        if self.matrix_kind is not None and self.matrix_file is None:
            raise ValueError(
                f"matrix_kind {self.matrix_kind} needs a matrix_file; valid without one is null"
            )
        return self


class ServerGroup(Section):
    """Group of equal servers in a rack, whose state is computed once."""

    count: Count
    """Number of servers."""
    full_w: ServerW
    """CPU power of one server at full load where its power curve has the value 1, in W."""
    idle_w: IdleW
    """Lowest CPU power of one server, in W."""
    load_weight: Annotated[float, Field(ge=0, le=1000)] = 1.0
    """Relative load of a server at low load of its rack. It must be at most twice the mean of all
    servers of the rack."""
    inlet_offset_k: DifferenceK = 0.0
    """Inlet temperature of a server minus that of its rack, due to its height in the rack, in K."""
    full_airflow_m3s: FullAirflow | None = None
    """Airflow of one server at an airflow ratio of 1, in m3/s, 1e-4..100: from the fan of a laptop
    to ten racks; None uses ``servers.fan_full_airflow_m3s``."""
    design_rise_k: DesignRiseK | None = None
    """Temperature rise of the air through the server at the design point, in K, 2..40, as an
    alternative to ``full_airflow_m3s``. A smaller rise needs extreme airflow, a larger one damages
    the server."""
    fan_w: IdleW | None = None
    """Fan power of one server at ``servers.fan_reference_ratio``, in W; None uses the values of
    section ``servers``."""
    height_u: Annotated[float, Field(ge=0.1, le=58)] | None = None
    """Height of one server in units of 44.45 mm, 0.1..58: from a card in a chassis to the tallest
    racks; None means one unit."""

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if self.idle_w > self.full_w:
            raise ValueError(f"idle_w {self.idle_w:g} must not exceed full_w {self.full_w:g}")
        if self.full_airflow_m3s is not None and self.design_rise_k is not None:
            raise ValueError(
                "full_airflow_m3s and design_rise_k are both given; valid is one, null for the "
                "other"
            )
        return self


def _airflow_m3s(group: ServerGroup) -> float:
    """Return the airflow of a server in front of a rear door at full load, in m3/s."""
    if group.full_airflow_m3s is not None:
        return group.full_airflow_m3s
    return group.full_w / (USUAL_AIR_J_PER_M3_K * (group.design_rise_k or DOOR_RISE_K))


class RackType(Section):
    """Type of rack, defined by its servers in air, or by its liquid-cooled chips."""

    model: Name | None = None
    """Name of a rack of the library (``configs/racks.yaml``), whose values hold for all fields
    that are not set; None means no such rack."""
    servers: Annotated[tuple[ServerGroup, ...], Field(min_length=1)] | None = None
    """Server groups of an air-cooled rack, from the floor up."""
    liquid: LiquidRack | None = None
    """Chips and cold plates of a liquid-cooled rack, as an alternative to ``servers``."""
    rear_door: RearDoor | None = None
    """Heat exchanger behind the servers of an air-cooled rack; None without one."""

    @model_validator(mode="before")
    @classmethod
    def _completed_by_its_model(cls, values: Any) -> Any:
        return with_model(values)

    @field_validator("servers", mode="before")
    @classmethod
    def _one_group_is_a_list_of_one(cls, value: Any) -> Any:
        return [value] if isinstance(value, dict | ServerGroup) else value

    @model_validator(mode="after")
    def _is_of_one_kind(self) -> Self:
        if (self.servers is None) == (self.liquid is None):
            number = "neither is" if self.servers is None else "both are"
            raise ValueError(f"servers and liquid: {number} given; valid is one of them")
        if self.rear_door is not None and self.liquid is not None:
            raise ValueError("rear_door with liquid: valid is a rear_door behind servers in air")
        return self

    @property
    def liquid_rack(self) -> LiquidRack | None:
        """Rack as the coolant sees it; None for racks without coolant."""
        if self.rear_door is None or self.servers is None:
            return self.liquid
        idle_w = sum(group.count * group.idle_w for group in self.servers)
        full_w = sum(group.count * group.full_w for group in self.servers)
        airflow_m3s = sum(g.count * _airflow_m3s(g) for g in self.servers)
        return self.rear_door.as_liquid(
            idle_w, full_w, full_w / (airflow_m3s * USUAL_AIR_J_PER_M3_K)
        )

    @property
    def air_servers(self) -> tuple[ServerGroup, ...]:
        """Server groups whose heat goes to the air.

        A liquid-cooled rack has equal trays with the heat that its liquid leaves.
        """
        if (rack := self.liquid) is None:
            assert self.servers is not None
            if self.rear_door is None:
                return self.servers
            left = max(1.0 - self.rear_door.effectiveness, LEAST_SHARE_IN_AIR)
            return tuple(
                group.model_copy(
                    update={
                        "full_w": left * group.full_w,
                        "idle_w": left * group.idle_w,
                        "full_airflow_m3s": _airflow_m3s(group),
                        "design_rise_k": None,
                    }
                )
                for group in self.servers
            )
        tray = ServerGroup(
            count=rack.trays,
            full_w=max(rack.air_w(1.0) / rack.trays, 1.0),
            idle_w=min(rack.air_w(0.0), rack.air_w(1.0)) / rack.trays,
            design_rise_k=rack.air_rise_k,
            fan_w=0.0,
        )
        return (tray,)


class RackRange(Section):
    """Range of rows and places whose racks are of one type."""

    type: Name
    """Name of the type, one of ``rack_types``."""
    rows: Text | None = None
    """Rows, counted from 0, such as 3, 0-5 or "0-2, 6"; None means all rows."""
    racks: Text | None = None
    """Places in these rows, counted from 0, such as 3, 0-5 or "0-2, 6"; None means all places."""

    @field_validator("rows", "racks", mode="before")
    @classmethod
    def _numbers_as_text(cls, value: Any) -> Any:
        if isinstance(value, list | tuple):
            return ", ".join(map(str, value))
        return str(value) if isinstance(value, int) else value

    @field_validator("rows", "racks")
    @classmethod
    def _numbers_and_ranges(cls, value: str | None) -> str | None:
        if value is not None and not re.fullmatch(r"\d+(-\d+)?( *, *\d+(-\d+)?)*", value):
            raise ValueError("valid are numbers and ranges, such as 3, 0-5 or 0-2, 6")
        return value


def _is_in(shape: tuple[int, ...], part: tuple[np.ndarray, ...]) -> np.ndarray:
    """Return a mask of the given shape that is True at the places that ``part`` selects."""
    out = np.zeros(shape, bool)
    out[part] = True
    return out


def _listed(field: str, text: str | None, count: int) -> list[int]:
    """Return the numbers in a text such as "0-2, 6"; None means 0..count - 1.

    Raises:
        ValueError: A number is not in 0..count - 1; the message names the field.
    """
    numbers: list[int] = []
    for part in (text or f"0-{count - 1}").split(","):
        first, _, last = part.partition("-")
        low, high = int(first), int(last or first)
        if not low <= high < count:
            raise ValueError(
                f"{field} {part.strip()}: valid are 0..{count - 1}, the lower number first"
            )
        numbers += range(low, high + 1)
    return numbers


class HallConfig(Section):
    """Rows of racks, their number of servers, and their approach temperatures."""

    rows: RackCount
    """Number of rows of racks."""
    racks_per_row: RackCount
    """Number of racks of each row."""
    servers_per_rack: Count | tuple[Count, ...] = 200
    """Number of servers of a rack: one value for all racks, or one per rack. ``rack_types`` and
    ``servers.groups`` have their own numbers of servers."""
    rack_types: dict[Name, RackType] = Field(default={})
    """Types of racks by name, as an alternative to ``servers.power_w`` and ``servers.groups``."""
    rack_plan: tuple[RackRange, ...] = ()
    """Rows and places of each type of rack; not required for a single type."""
    capacity_mw: Annotated[float, Field(ge=1e-6, le=1e5)] | None = None
    """IT nameplate power to which the number of servers is scaled, in MW, 1e-6..1e5: from a server
    of 1 W to more than all data centers of the world; None does not scale it."""
    inlet_model: Literal["approach", "recirculation"] = "approach"
    """Model of rack inlet temperatures: constant approach temperatures, or mixing of supply air
    with recirculated exhaust air."""
    supply_approach_k: RiseK | tuple[RiseK, ...]
    """Rack inlet minus CRAC supply temperature at the design point, in K: one value for all racks,
    or one per rack."""
    supply_approach_limits_k: Annotated[tuple[RiseK, RiseK], Ordered] | None = None
    """Lowest and highest supply approach, to which ``supply_approach_k`` is clipped, in K; None
    does not clip it."""
    return_approach_k: DifferenceK | tuple[DifferenceK, ...]
    """CRAC return air minus rack outlet temperature, in K: one value for all racks, or one per
    rack. It is negative where supply air bypasses the racks."""
    design_supply_c: AirC = 23.0
    """Supply air temperature at the design point, in C, for which approach temperatures are defined
    and devices are sized; the limits of the setpoint apply to actions only. With approach
    temperatures of 5 K, the default gives inlets of 28 C, the warm end of
    ``servers.inlet_range_c``."""
    layout: LayoutConfig = LayoutConfig()
    """Dimensions of the hall."""
    most_face_velocity_m_s: Annotated[float, Field(ge=0.1, le=100)] | None = 2.5
    """Largest velocity of the air at the front of a rack at the design point, in m/s, 0.1..100:
    airflow of its servers, at a temperature rise of 25 K if they move more air, divided by
    ``layout.rack_pitch_m`` times ``layout.rack_height_m``. Racks that need more air are refused.
    The default is 3.2 m3/s and 95 kW for a rack of 0.6 m, fans included; None allows any
    velocity."""
    recirculation: RecirculationConfig = RecirculationConfig()
    """Recirculation of exhaust air, for inlet model ``recirculation``."""
    sensor_error_k: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Largest error of the inlet temperatures that a CRAC unit measures, in K, 0..10: that of each
    unit and run is uniformly distributed between its negative and itself. It affects controllers
    that read the zones of the units, not the air."""
    height_zones: Annotated[int, Field(ge=1, le=100)] = 5
    """Number of zones over the height of a rack, each with its own inlet temperature, for inlet
    model ``recirculation``, 1..100; the tallest racks have 58 units."""
    height_gradient: Annotated[float, Field(ge=0, lt=1)] = 0.4
    """Relative increase of the exhaust share of the intake from the middle of a rack to its top,
    and equal decrease from the middle to the floor, 0..1."""
    room_heat_capacity_kj_per_k_per_server: Annotated[float, Field(ge=0.01, le=1e5)] | None = None
    """Heat capacity of coils, floor and other parts whose temperature follows the supply air, in
    kJ/K per server, 0.01..1e5: from 10 l of air to 100 t of concrete; None means 15 J/K per W of
    the servers' power at full load."""
    air_density_kg_m3: Annotated[float, Field(ge=0.4, le=1.6)] | None = None
    """Density of the air at all temperatures, in kg/m3, 0.4..1.6: from the summit of Mount Everest
    to sea level at -50 C; None computes it from the height of the site above sea level and the
    temperature of the air."""
    air_heat_capacity_j_per_kg_k: Annotated[float, Field(ge=990, le=1200)] = 1006.0
    """Specific heat capacity of the air, in J/(kg K), 990..1,200: from dry air to air with 100 g of
    water per kg."""

    @property
    def racks(self) -> int:
        """Number of racks, rows x racks per row."""
        return self.rows * self.racks_per_row

    @property
    def remaining_paths(self) -> float:
        """Air paths that remain, as a share of those in the hall of the approach temperatures."""
        return 1.0 - self.layout.containment if self.recirculation.is_of_open_hall else 1.0

    def __hash__(self) -> int:
        """Return a hash of all fields; ``rack_types`` enters as a tuple of names and types."""
        values = {**self.__dict__, "rack_types": tuple(self.rack_types.items())}
        return hash(tuple(values.items()))

    def rack_type_names(self) -> tuple[str, ...]:
        """Return the name of the type of every rack, (R,); empty without ``rack_types``.

        Raises:
            ValueError: A type is unknown, or a rack has two types or none.
        """
        names, plan = list(self.rack_types), self.rack_plan
        if len(names) == 1 and not plan:
            plan = (RackRange(type=names[0]),)
        at = np.full((self.rows, self.racks_per_row), -1)
        for index, entry in enumerate(plan):
            where = f"rack_plan.{index}"
            if entry.type not in self.rack_types:
                raise ValueError(
                    f"{where}.type: {shortened(entry.type)} is not in rack_types"
                    f"{suggestion_or_valid(entry.type, names)}"
                )
            part = np.ix_(
                _listed(f"{where}.rows", entry.rows, self.rows),
                _listed(f"{where}.racks", entry.racks, self.racks_per_row),
            )
            if np.any(at[part] >= 0):
                row, rack = np.argwhere((at >= 0) & _is_in(at.shape, part))[0]
                raise ValueError(
                    f"{where}: rack {rack} of row {row} has a type already, "
                    f"{names[at[row, rack]]}; valid is one"
                )
            at[part] = names.index(entry.type)
        if names and np.any(at < 0):
            row, rack = np.argwhere(at < 0)[0]
            raise ValueError(
                f"rack_plan: rack {rack} of row {row} has no type, as {np.sum(at < 0):,} of "
                f"{at.size:,} racks; valid is one for each"
            )
        return tuple(names[i] for i in at.reshape(-1)) if names else ()

    def rack_approach_k(self) -> np.ndarray:
        """Return the supply approach temperature of every rack, clipped to its limits, K, (R,)."""
        approach_k = np.broadcast_to(np.asarray(self.supply_approach_k, np.float64), (self.racks,))
        limits = self.supply_approach_limits_k
        return approach_k.copy() if limits is None else np.asarray(np.clip(approach_k, *limits))

    @model_validator(mode="after")
    def _not_too_many_racks(self) -> Self:
        if self.racks > MOST_RACKS:
            raise ValueError(
                f"rows x racks_per_row is {self.racks:,}; valid is at most {MOST_RACKS:,} racks"
            )
        return self

    @model_validator(mode="after")
    def _every_rack_has_one_type(self) -> Self:
        self.rack_type_names()
        return self

    @model_validator(mode="after")
    def _containment_acts_once(self) -> Self:
        if self.layout.containment > 0 and self.recirculation.matrix_file is not None:
            raise ValueError(
                f"layout.containment {self.layout.containment:g} with recirculation.matrix_file: "
                "a matrix holds what containment does; valid is containment 0"
            )
        return self

    @model_validator(mode="after")
    def _one_entry_per_rack(self) -> Self:
        for name in ("servers_per_rack", "supply_approach_k", "return_approach_k"):
            check_one_per_rack(name, getattr(self, name), self.racks)
        return self

    @model_validator(mode="after")
    def _closed_hall_has_no_approach(self) -> Self:
        closed = self.layout.containment == 1.0 and self.inlet_model == "recirculation"
        if closed and not self.recirculation.is_of_open_hall and np.any(self.rack_approach_k() > 0):
            raise ValueError(
                "layout.containment 1 leaves no path for the exhaust air that the measured "
                "supply_approach_k needs; valid is containment below 1, supply_approach_k 0, or "
                "recirculation.approach_of open_hall"
            )
        return self


class ServerConfig(Section):
    """Power and airflow of the servers (ITE:AirCooled form of EnergyPlus, curves of Sun 2021)."""

    power_w: tuple[PowerPair, ...] | None = None
    """(full, idle) CPU power of one server, in W: one pair for all racks, or one per rack. If
    neither ``power_w`` nor ``groups`` is set, it is 150 W at full load and 10 W when idle."""
    groups: tuple[tuple[ServerGroup, ...], ...] | None = None
    """Server groups, which replace ``power_w`` and ``hall.servers_per_rack``: one entry for all
    racks, or one per rack. ``hall.rack_types`` is an alternative with named types."""
    cpu_power_ratio_lb: tuple[PowerRatio, PowerRatio] = (0.01, 1.00)
    """CPU power divided by full power at the coldest inlet of ``inlet_range_c``: at no load, and at
    full load."""
    cpu_power_ratio_ub: tuple[PowerRatio, PowerRatio] = (0.03, 1.02)
    """CPU power divided by full power at the warmest inlet of ``inlet_range_c``: at no load, and at
    full load."""
    cpu_power_points: tuple[PowerPoint, ...] | None = None
    """Points (inlet temperature in C, CPU power divided by full power at no load, at full load) by
    rising temperature. The curve is linear between them and constant beyond. It replaces
    ``cpu_power_ratio_lb`` and ``cpu_power_ratio_ub``; None means the straight line of these."""
    cpu_slope_offset_per_k: Annotated[float, Field(ge=-1, le=1)] = 0.0
    """Addition to the slope of CPU power divided by full power against the inlet temperature, in
    1/K, -1..1: no real server is as sensitive as the bounds."""
    inlet_range_c: Annotated[tuple[AirC, AirC], Ordered] = (16.0, 28.0)
    """Coldest and warmest inlet temperature, at which the ratios of power and airflow are defined,
    in C. They must differ by at least 5 K, because curves are extrapolated linearly."""
    curve_limit_c: AirC | None = 45.0
    """Inlet temperature above which power and airflow no longer rise, in C; the default is the
    upper limit of ASHRAE class A4. None means no limit; the power in a room without cooling then
    grows without bound."""
    fan_airflow_ratio_lb: tuple[FlowRatio, FlowRatio] = (0.01, 0.225)
    """Server airflow divided by full airflow at the coldest inlet of ``inlet_range_c``: at no load,
    and at full load."""
    fan_airflow_ratio_ub: tuple[FlowRatio, FlowRatio] = (0.225, 1.0)
    """Server airflow divided by full airflow at the warmest inlet of ``inlet_range_c``: at no load,
    and at full load."""
    fan_airflow_points: tuple[AirflowPoint, ...] | None = None
    """Points (inlet temperature in C, airflow ratio at no load, at full load) by rising
    temperature. The curve is linear between them and constant beyond. It replaces
    ``fan_airflow_ratio_lb`` and ``fan_airflow_ratio_ub``; None means the straight line of these."""
    fan_model: Literal["linear", "released"] = "linear"
    """Airflow ratio as a function of inlet temperature and load: linear between the points or
    ratios above, or the line of the ratios scaled as in the released SustainDC."""
    fan_airflow_ratio_limits: Annotated[tuple[FlowRatio, FlowRatio], Ordered] | None = None
    """Lowest and highest airflow ratio. None sets only the lower limit 0, because fans never blow
    backwards."""
    fan_power_exponent: Annotated[float, Field(ge=1, le=3)] = 3.0
    """Exponent of the airflow ratio in the fan power, 1..3."""
    fan_full_airflow_m3s: FullAirflow | None = 0.051
    """Airflow of one server at an airflow ratio of 1, in m3/s, 1e-4..100: from the fan of a laptop
    to ten racks. None makes it proportional to the power of a server, such that the heat balance of
    the hall is satisfied at the design point."""
    fan_reference_ratio: Annotated[float, Field(ge=0.01, le=10)] = 1.0
    """Airflow ratio at which the fans of a server draw ``fan_reference_w``, 0.01..10: from fans
    that hardly turn to ten times full airflow."""
    fan_reference_w: IdleW | None = 10.0
    """Fan power of one server at the reference airflow ratio, in W; None uses
    ``fan_reference_share``."""
    fan_reference_share: Annotated[float, Field(ge=0, le=1)] | None = None
    """Fan power of a server at the reference airflow ratio divided by its CPU power at full load,
    0..1, as an alternative to ``fan_reference_w``; at 1, fans draw as much power as the CPUs."""
    outlet_model: Literal["server", "rack", "released"] = "server"
    """Model of outlet temperatures: heat balance of each server, heat balance of each rack, or the
    fit of the released SustainDC."""
    heat_capacity_kj_per_k: Annotated[float, Field(ge=0.01, le=1e4)] | None = None
    """Heat capacity of one server, in kJ/K, 0.01..10,000: from 10 g to 10 t of metal; None means 30
    J/K per W of its power at full load, and at most 410 kJ/K for all servers of a rack."""
    heat_exchange_effectiveness: WorkingShare = 0.95
    """Effectiveness of the heat exchange between a server and the air that flows through it,
    0.01..1."""

    @property
    def power_pairs(self) -> tuple[PowerPair, ...]:
        """(full, idle) CPU power of one server, in W: one pair for all racks, or one per rack."""
        return self.power_w or ((150.0, 10.0),)

    @property
    def curves(self) -> ServerCurves:
        """Coefficients of power and airflow as functions of inlet temperature and load.

        As in the released SustainDC code, fan model ``released`` multiplies the slope by 10 and the
        offset by 5. It also multiplies the load shift by 5, as if it were per 20 % of load.
        """
        cpu_slope, cpu_offset, cpu_shift = linear_curve(
            self.inlet_range_c, self.cpu_power_ratio_lb, self.cpu_power_ratio_ub
        )
        fan_slope, fan_offset, fan_shift = linear_curve(
            self.inlet_range_c, self.fan_airflow_ratio_lb, self.fan_airflow_ratio_ub
        )
        if self.fan_model == "released":
            fan_slope, fan_offset, fan_shift = 10 * fan_slope, 5 * fan_offset, 5 * fan_shift
        curve_limit_c = np.inf if self.curve_limit_c is None else self.curve_limit_c
        cpu_knees: tuple[Knee, ...] = ()
        fan_knees: tuple[Knee, ...] = ()
        if self.cpu_power_points is not None:
            line = curve_through(self.cpu_power_points, curve_limit_c)
            cpu_slope, (cpu_offset, cpu_shift, cpu_knees) = 0.0, line
        if self.fan_airflow_points is not None:
            line = curve_through(self.fan_airflow_points, curve_limit_c)
            fan_slope, (fan_offset, fan_shift, fan_knees) = 0.0, line
        fan_low, fan_high = self.fan_airflow_ratio_limits or (0.0, np.inf)
        return ServerCurves(
            cpu_slope_per_k=cpu_slope + self.cpu_slope_offset_per_k,
            cpu_offset=cpu_offset,
            cpu_shift=cpu_shift,
            fan_slope_per_k=fan_slope,
            fan_offset=fan_offset,
            fan_shift=fan_shift,
            # Fans never blow backwards.
            fan_low=max(fan_low, 0.0),
            fan_high=fan_high,
            fan_reference_ratio=self.fan_reference_ratio,
            fan_exponent=self.fan_power_exponent,
            curve_limit_c=curve_limit_c,
            cpu_knees=cpu_knees,
            fan_knees=fan_knees,
        )

    @field_validator("power_w", mode="before")
    @classmethod
    def _one_pair_is_a_list_of_one(cls, value: Any) -> Any:
        if isinstance(value, list | tuple) and not value:
            raise ValueError("should have at least 1 pair")
        flat = isinstance(value, list | tuple) and not any(
            isinstance(x, list | tuple) for x in value
        )
        return [value] if flat else value

    @field_validator("cpu_power_points", "fan_airflow_points")
    @classmethod
    def _by_rising_temperature(cls, value: tuple[PowerPoint, ...] | None) -> Any:
        if value == ():
            raise ValueError("no point; valid is null, or one point or more")
        for (low_c, *_), (high_c, *_) in pairwise(value or ()):
            if high_c - low_c < LEAST_POINTS_APART_K:
                raise ValueError(
                    f"a point at {high_c:g} C follows one at {low_c:g} C; valid are inlet "
                    f"temperatures that rise by at least {LEAST_POINTS_APART_K:g} K"
                )
        return value

    @field_validator("inlet_range_c")
    @classmethod
    def _wide_enough(cls, value: tuple[float, float]) -> tuple[float, float]:
        if value[1] - value[0] < LEAST_INLET_RANGE_K:
            raise ValueError(
                f"({value[0]:g}, {value[1]:g}) must be at least {LEAST_INLET_RANGE_K:g} K apart"
            )
        return value

    @model_validator(mode="after")
    def _one_airflow_curve(self) -> Self:
        if self.fan_model == "released" and self.fan_airflow_points is not None:
            raise ValueError(
                "fan_model released and fan_airflow_points are both given; valid is null for "
                "fan_airflow_points, because the model scales a straight line"
            )
        return self

    @model_validator(mode="after")
    def _idle_below_full(self) -> Self:
        if self.power_w is not None and self.groups is not None:
            raise ValueError("power_w and groups are both given; valid is one, null for the other")
        if (self.fan_reference_w is None) == (self.fan_reference_share is None):
            number = "neither" if self.fan_reference_w is None else "both"
            raise ValueError(
                f"fan_reference_w and fan_reference_share: {number} given; valid is one, null for "
                "the other"
            )
        for rack, (full_w, idle_w) in enumerate(self.power_pairs):
            if idle_w > full_w:
                raise ValueError(
                    f"power_w entry {rack} is ({full_w:g}, {idle_w:g}); "
                    "valid is (full, idle) with idle <= full"
                )
        return self
