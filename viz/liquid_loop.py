"""Diagram of the coolant loops of a data center: devices, pipes, and the texts beside them.

Recordings and reports draw the same diagram. Places are x and y, x to the right and y downwards.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from sdc_taichi.config import DataCenterConfig
    from sdc_taichi.config.liquid_schema import LiquidConfig

LOOP_FIELDS = (
    "junction_max_c",
    "liquid_heat_w",
    "liquid_air_w",
    "cdu_return_c",
    "cdu_supply_c",
    "coolant_m3s",
    "cdu_pump_w",
    "facility_return_c",
    "facility_supply_c",
    "facility_m3s",
    "facility_pump_w",
    "reuse_w",
    "heat_pump_w",
    "liquid_rejected_w",
    "cooler_fan_w",
    "trim_load_w",
    "trim_chiller_w",
    "liquid_to_plant_w",
)
"""Fields of ``StepResult`` that the texts of the diagram show."""
SIZE = (400.0, 150.0)
"""Width and height of the diagram."""


class Box(NamedTuple):
    """Device of the diagram, drawn as a rectangle."""

    name: str
    """Name of the device."""
    left: float
    """Left edge."""
    top: float
    """Upper edge."""
    right: float
    """Right edge."""
    bottom: float
    """Lower edge."""

    @property
    def middle(self) -> tuple[float, float]:
        """Middle of the rectangle."""
        return (self.left + self.right) / 2, (self.top + self.bottom) / 2


BOXES = {
    "racks": Box("liquid-cooled racks", 4, 26, 92, 122),
    "cdus": Box("CDUs", 140, 26, 204, 122),
    "reuse": Box("heat reuse", 240, 20, 312, 60),
    "trim": Box("trim chiller", 240, 88, 312, 128),
    "cooler": Box("cooler", 336, 26, 396, 122),
}
"""Devices of the diagram; a data center may have no heat reuse and no trim chiller, or the plant of
the CRAC units in place of the latter."""
_HOT_Y, _COLD_Y = 40.0, 108.0
PLACES = {
    **{name: box.middle for name, box in BOXES.items()},
    "coolant return": (116, _HOT_Y - 9),
    "coolant supply": (116, _COLD_Y + 14),
    "facility return": (222, _HOT_Y - 9),
    "facility supply": (222, _COLD_Y + 14),
    "air": (48, 142),
    "delivered": (276, 5),
    "rejected": (366, 5),
}
"""Middle of each text of the diagram."""
Pipe = tuple[tuple[float, float], tuple[float, float]]
"""Beginning and end of a straight pipe, in the direction of the flow."""


def has_device(liquid: LiquidConfig, name: str) -> bool:
    """Return True if a data center has a device of ``BOXES``."""
    has = {"reuse": liquid.reuse.kind != "none", "trim": liquid.facility.trim_kw > 0}
    return has.get(name, True)


def loop_pipes(liquid: LiquidConfig) -> dict[str, list[Pipe]]:
    """Return the pipes with hot and with cold water, and the heat that leaves the loops."""
    racks, cdus, reuse, trim, cooler = BOXES.values()
    hot, cold = [(racks.right, cdus.left)], [(cdus.left, racks.right)]
    heat = [(PLACES["air"][0], racks.bottom, 135), (PLACES["rejected"][0], cooler.top, 12)]
    if has_device(liquid, "reuse"):
        hot += [(cdus.right, reuse.left), (reuse.right, cooler.left)]
        heat.append((PLACES["delivered"][0], reuse.top, 12))
    else:
        hot.append((cdus.right, cooler.left))
    if has_device(liquid, "trim"):
        cold += [(cooler.left, trim.right), (trim.left, cdus.right)]
    else:
        cold.append((cooler.left, cdus.right))
    return {
        "hot": [((begin, _HOT_Y), (end, _HOT_Y)) for begin, end in hot],
        "cold": [((begin, _COLD_Y), (end, _COLD_Y)) for begin, end in cold],
        "heat": [((x, begin), (x, end)) for x, begin, end in heat],
    }


def loop_texts(
    values: Mapping[str, float], liquid: LiquidConfig, degree: str = "°C"
) -> dict[str, str]:
    """Return the texts of the diagram by their place; a line break separates lines.

    Args:
        values: value of each of ``LOOP_FIELDS``, in its unit.
        liquid: config of the loops.
        degree: unit of temperatures.
    """

    def kw(name: str) -> str:
        value_kw = values[name] / 1e3
        return f"{value_kw:,.0f} kW" if abs(value_kw) >= 100 else f"{value_kw:z.1f} kW"

    def water(temperature: str, flow: str = "") -> str:
        text = f"{values[temperature]:.1f} {degree}"
        return f"{text}\n{1e3 * values[flow]:.1f} l/s" if flow else text

    heat_pump = f"\nheat pump {kw('heat_pump_w')}" * (liquid.reuse.kind == "heat_pump")
    # Racks with rear doors alone have no junctions.
    hottest = f"junction {water('junction_max_c')}" if values["junction_max_c"] else "rear doors"
    by_plant = liquid.facility.trim_by == "plant"
    texts = {
        "racks": f"\n{hottest}\nto coolant {kw('liquid_heat_w')}",
        "cdus": f"\npumps {kw('cdu_pump_w')}",
        "reuse": heat_pump,
        "trim": f"\ntakes {kw('liquid_to_plant_w')}"
        if by_plant
        else f"\ntakes {kw('trim_load_w')}\npower {kw('trim_chiller_w')}",
        "cooler": f"\nfans {kw('cooler_fan_w')}\npump {kw('facility_pump_w')}",
        "coolant return": water("cdu_return_c"),
        "coolant supply": water("cdu_supply_c", "coolant_m3s"),
        "facility return": water("facility_return_c"),
        "facility supply": water("facility_supply_c", "facility_m3s"),
        "air": f"to hall air {kw('liquid_air_w')}",
        "delivered": f"delivered {kw('reuse_w')}",
        "rejected": f"rejected {kw('liquid_rejected_w')}",
    }
    if not has_device(liquid, "reuse"):
        del texts["delivered"]
    names = {place: box.name for place, box in BOXES.items()}
    names |= {"trim": "CRAC plant"} if by_plant else {}
    named = {place: names[place] + text for place, text in texts.items() if place in BOXES}
    return {place: text for place, text in (texts | named).items() if has_device(liquid, place)}


def junction_limits_c(config: DataCenterConfig) -> tuple[float, float] | None:
    """Return the lowest junction temperatures at which GPUs throttle and at which racks trip, in C.

    The result is None for a data center without cold plates.
    """
    racks = config.plate_racks().values()
    if not racks:
        return None
    return min(rack.throttle_c for rack in racks), min(rack.trip_c for rack in racks)
