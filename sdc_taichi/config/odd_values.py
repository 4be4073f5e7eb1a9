"""Warnings about values of a configuration that are valid, but probably a mistake."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from sdc_taichi.config.liquid_schema import POWER_CAP_LIMITS, W_CLASS_LIMITS_C
from sdc_taichi.config.schema import DataCenterConfig
from sdc_taichi.errors import OddInputWarning
from sdc_taichi.plant.plants import PLANTS

LEAST_USUAL_SERVER_W = 20.0
"""Smallest usual power of a server at full load, in W. Smaller values are probably in kW."""
MOST_USUAL_RACK_W = 60e3
"""Largest usual power of an air-cooled rack, in W; with a temperature rise of 15 K, its airflow is
about 3 m3/s."""
MOST_USUAL_COP = 15.0
"""Largest usual reference COP of water-cooled chillers; the best ones, with magnetic bearings,
reach about 12."""
MOST_USUAL_AIR_COOLED_COP = 4.5
"""Largest usual reference COP of air-cooled chillers; the best ones reach about 4 at 35 C."""
USUAL_SETPOINTS_C = {"supply": (10.0, 35.0), "return": (18.0, 50.0)}
"""Lowest and highest usual setpoint of supply air and of return air, in C. Colder supply air causes
condensation, and 35 C is the limit of ASHRAE class A2. Return air is 10 to 15 K warmer."""
LEAST_USUAL_PUMP_EFFICIENCY = 0.2
"""Smallest usual pump efficiency, which even small circulators reach."""
LEAST_USUAL_GRID_RATIO = 0.5
"""Smallest usual grid limit divided by the design power of the facility; a smaller limit would be
exceeded in most hours."""


MOST_USUAL_LIFT_K = 60.0
"""Largest usual difference of the temperatures between which a heat pump of one stage works, in
K."""
TOWER_APPROACH_K = 4.0
"""Water of a tower minus wet bulb at its design point, in K."""


def odd_values(config: DataCenterConfig) -> Iterator[str]:
    """Yield messages about unusual values: each names field, value and usual values."""
    yield from _odd_servers(config)
    chiller, setpoint, pumps = config.hvac.chiller, config.hvac.setpoint, config.hvac.pumps
    dry = PLANTS[config.hvac.plant_in_use].dry
    most, reached = (MOST_USUAL_AIR_COOLED_COP, 4) if dry else (MOST_USUAL_COP, 12)
    if chiller.reference_cop is not None and chiller.reference_cop > most:
        yield (
            f"hvac.chiller.reference_cop {chiller.reference_cop:g}: the best "
            f"{'air-cooled ' if dry else ''}chillers reach about {reached}"
        )
    controlled = config.hvac.crac.temperature_control
    for name, air, value in (
        ("hvac.setpoint.min_c", controlled, setpoint.min_c),
        ("hvac.setpoint.max_c", controlled, setpoint.max_c),
        ("hall.design_supply_c", "supply", config.hall.design_supply_c),
    ):
        low, high = USUAL_SETPOINTS_C[air]
        if not low <= value <= high:
            yield f"{name} {value:g}: {air} air is usually {low:g}..{high:g} C"
    if pumps.model == "sized" and pumps.efficiency < LEAST_USUAL_PUMP_EFFICIENCY:
        yield (
            f"hvac.pumps.efficiency {pumps.efficiency:g}: even small pumps reach "
            f"{LEAST_USUAL_PUMP_EFFICIENCY:g}"
        )
    tank_m3 = config.hvac.chilled_water.tank_m3
    if tank_m3 > 0 and config.simulation.thermal == "quasi_steady":
        yield (
            f"hvac.chilled_water.tank_m3 {tank_m3:g}: a tank acts only with simulation.thermal "
            "transient"
        )
    ratio = config.electrical.grid_limit_ratio
    if config.electrical.grid_limit_kw is None and (ratio or 1.0) < LEAST_USUAL_GRID_RATIO:
        yield (
            f"electrical.grid_limit_ratio {ratio:g}: less than half of the design power overloads "
            "the connection in most hours"
        )
    yield from _odd_liquid(config)


def _odd_liquid(config: DataCenterConfig) -> Iterator[str]:
    """Yield messages about unusual values of liquid cooling."""
    liquid = config.liquid
    if liquid is None:
        return
    cdus, reuse, racks = liquid.cdus, liquid.reuse, config.liquid_racks()
    needed = cdus.manifolds * (cdus.per_manifold - cdus.spare)
    design_kw = sum(rack.design_liquid_w for rack in racks.values()) / 1e3
    if cdus.capacity_kw is not None and cdus.capacity_kw * needed < design_kw:
        yield (
            f"liquid.cdus.capacity_kw {cdus.capacity_kw:g}: {needed} CDUs for {design_kw:.4g} kW "
            f"of liquid-cooled racks; without spare ones they need {design_kw / needed:.4g} kW each"
        )
    if liquid.dew_point_c is not None:
        least_c = liquid.dew_point_c + liquid.dew_margin_k
        if liquid.setpoint_c < least_c:
            yield (
                f"liquid.setpoint_c {liquid.setpoint_c:g}: the dew point of the room keeps the "
                f"coolant at {least_c:g} C or above"
            )
    source_c = liquid.setpoint_c - cdus.approach_k
    lift_k = reuse.network_supply_c - source_c
    if reuse.kind == "heat_pump" and lift_k > MOST_USUAL_LIFT_K:
        yield (
            f"liquid.reuse.network_supply_c {reuse.network_supply_c:g}: {lift_k:.3g} K above the "
            f"facility water; heat pumps of one stage lift by up to {MOST_USUAL_LIFT_K:g} K"
        )
    if reuse.kind == "direct" and reuse.network_return_c >= source_c + cdus.range_k:
        yield (
            f"liquid.reuse.network_return_c {reuse.network_return_c:g}: the facility water returns "
            f"at about {source_c + cdus.range_k:g} C, so it gives no heat"
        )
    if reuse.price_per_kwh_heat < 0.0 and reuse.kind != "none":
        yield (
            f"liquid.reuse.price_per_kwh_heat {reuse.price_per_kwh_heat:g}: the data center pays "
            "for the heat that it delivers"
        )
    for rack in dict.fromkeys(racks.values()):
        least_w = POWER_CAP_LIMITS[0] * rack.gpu_max_w
        if rack.gpu_idle_w > least_w:
            yield (
                f"gpu_idle_w {rack.gpu_idle_w:g}: power caps below "
                f"{rack.gpu_idle_w / rack.gpu_max_w:.2g} have no effect, since idle GPUs draw more"
            )
        if liquid.setpoint_c >= rack.throttle_c:
            yield f"liquid.setpoint_c {liquid.setpoint_c:g}: GPUs throttle at {rack.throttle_c:g} C"


def odd_w_class(config: DataCenterConfig, outdoor_c: float, wet_bulb_c: float) -> str | None:
    """Return a message if the facility water exceeds its W class on the design day, else None.

    Args:
        config: The data center.
        outdoor_c: Design dry bulb, in C.
        wet_bulb_c: Design wet bulb, in C.
    """
    liquid = config.liquid
    if liquid is None or liquid.facility.w_class not in W_CLASS_LIMITS_C:
        return None
    facility, most_c = liquid.facility, W_CLASS_LIMITS_C[str(liquid.facility.w_class)]
    air_c = outdoor_c
    if facility.rejection == "tower":
        air_c = wet_bulb_c + TOWER_APPROACH_K
    elif facility.rejection == "adiabatic":
        air_c -= facility.adiabatic_effectiveness * (outdoor_c - wet_bulb_c)
    reached_c = air_c + facility.approach_k
    if reached_c <= most_c or facility.trim_kw > 0.0:
        return None
    return (
        f"liquid.facility.w_class {facility.w_class}: the {facility.rejection} cooler gives water "
        f"of {reached_c:.1f} C on the design day; valid for the class are up to {most_c:g} C, so "
        "it needs trim_kw or another cooler"
    )


def warn_of_odd_values(configs: Iterable[DataCenterConfig]) -> None:
    """Warn about unusual values of data centers, once for each value that several of them share.

    Warns:
        OddInputWarning: One warning for each unusual value.
    """
    texts_of: dict[tuple[int, ...], list[str]] = {}
    messages: list[tuple[str, list[str]]] = []
    for config in configs:
        # Copies of a data center share section objects, so each section is checked only once.
        parts = config.hall, config.servers, config.hvac, config.electrical, config.liquid
        sections = tuple(map(id, parts))
        sections += (config.simulation.thermal == "transient",)
        if sections not in texts_of:
            texts_of[sections] = [*odd_values(config)]
        messages.append((config.name, texts_of[sections]))
    warn_of(messages)


def warn_of(messages: Iterable[tuple[str, Sequence[str]]]) -> None:
    """Warn about data centers with unusual values, once for each message that several share.

    Args:
        messages: Name of each data center, and the messages about it.

    Warns:
        OddInputWarning: One warning for each message.
    """
    names: dict[str, list[str]] = {}
    for name, texts in messages:
        for text in texts:
            names.setdefault(text, []).append(name)
    for text, odd in names.items():
        more = f" and {len(odd) - 1} more" if len(odd) > 1 else ""
        warnings.warn(f"{odd[0]}{more}: {text}", OddInputWarning, stacklevel=4)


def _odd_servers(config: DataCenterConfig) -> Iterator[str]:
    """Yield messages about servers and racks of unusual power."""
    servers, types = config.servers, config.hall.rack_types
    listed_w, field = [full_w for full_w, _ in servers.power_pairs], "servers.power_w"
    if types:
        listed_w = [group.full_w for rack in types.values() for group in rack.servers or ()]
        field = "hall.rack_types"
    elif servers.groups is not None:
        listed_w = [group.full_w for rack in servers.groups for group in rack]
        field = "servers.groups"
    least_w = min(listed_w, default=np.inf)
    if least_w < LEAST_USUAL_SERVER_W:
        yield f"{field}: a server of {least_w:g} W at full load; power is in W, not in kW"
    rack_w = config.rack_nameplate_w()
    rack = int(np.argmax(rack_w))
    if rack_w[rack] > MOST_USUAL_RACK_W:
        yield (
            f"hall: rack {rack} has servers of {rack_w[rack] / 1e3:.4g} kW; racks of more than "
            f"{MOST_USUAL_RACK_W / 1e3:g} kW are rarely cooled by air alone"
        )
