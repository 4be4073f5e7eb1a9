"""Warnings about values of a configuration that are valid, but probably a mistake."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

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


def warn_of_odd_values(configs: Iterable[DataCenterConfig]) -> None:
    """Warn about unusual values of data centers, once for each value that several of them share.

    Warns:
        OddInputWarning: One warning for each unusual value.
    """
    texts_of: dict[tuple[int, ...], list[str]] = {}
    messages: list[tuple[str, list[str]]] = []
    for config in configs:
        # Copies of a data center share section objects, so each section is checked only once.
        sections = tuple(map(id, (config.hall, config.servers, config.hvac, config.electrical)))
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
