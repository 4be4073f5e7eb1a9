"""Names of models in the schema are those that are implemented, and the other way round."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import fields
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest

from sdc_taichi import ConfigError, Simulator
from sdc_taichi.cli.options import RunOptions
from sdc_taichi.cli.simulate import simulate_command
from sdc_taichi.config import DataCenterConfig, EventKind, EventsConfig, load_config
from sdc_taichi.control.registry import controller_names
from sdc_taichi.exogenous import carbon
from sdc_taichi.hall import air_metrics, placement
from sdc_taichi.kernels import hall_arguments
from sdc_taichi.plant import chiller
from sdc_taichi.plant.chiller import ChillerModel, ChillerPoint, ChillerResult
from sdc_taichi.sim import sizing
from sdc_taichi.sim.events import Places, schedule
from sdc_taichi.sim.hall_state import Precision
from sdc_taichi.types import Values

REGISTRIES: dict[str, tuple[str, Collection[str]]] = {
    "hvac.sizing.model": ("sim.sizing.MODELS", sizing.MODELS),
    "workload.placement": ("hall.placement.POLICIES", placement.POLICIES),
    "servers.outlet_model": ("kernels.hall_arguments.OUTLETS", hall_arguments.OUTLETS),
    "protection.ashrae_class": ("hall.air_metrics.ALLOWABLE_C", air_metrics.ALLOWABLE_C),
    "site.carbon_pairing": ("exogenous.carbon.Pairing", get_args(carbon.Pairing)),
}
"""Fields of the schema whose names stand in a Literal, and the registries of what they name; the
names of the models of ``plant`` are taken from their registries."""

EVENTS: dict[EventKind, dict[str, Any]] = {
    "crac_down": {"unit": 1},
    "chiller_derate": {"share": 0.3},
    "pump_down": {"share": 0.5},
    "tank_down": {"share": 0.0},
    "tower_cell_down": {"share": 0.5},
    "dry_cooler_down": {"share": 0.5},
    "outdoor_air_closed": {"share": 0.0},
    "rack_fan_failure": {"rack": 2, "share": 0.7},
    "heat_wave": {"offset_k": 4.5},
    "grid_outage": {},
    "link_down": {},
    "cdu_down": {"unit": 1},
    "cdu_pump_down": {},
    "facility_pump_down": {"share": 0.5},
    "cooler_down": {"share": 0.0},
    "leak": {"rack": 2, "litres": 20},
}


def names_in_schema(path: str) -> set[str]:
    section: Any = DataCenterConfig
    *sections, last = path.split(".")
    for key in sections:
        section = section.model_fields[key].annotation
    annotation = section.model_fields[last].annotation
    parts = [annotation, *get_args(annotation)]
    return {name for part in parts for name in get_args(part) if isinstance(name, str)}


@pytest.mark.parametrize("path", REGISTRIES)
def test_schema_and_registry_name_the_same_models(path: str) -> None:
    registry, names = REGISTRIES[path]
    assert names_in_schema(path) == set(names), f"the Literal of {path} differs from {registry}"


def test_the_command_line_offers_every_controller_and_precision() -> None:
    hints = get_type_hints(simulate_command, include_extras=True)
    _, option = get_args(hints["controller"])
    offered = set(option.help.partition(";")[0].split(", "))
    assert offered == set(controller_names()), "the help of --controller in cli/simulate.py differs"
    names, _ = get_args(get_type_hints(RunOptions, include_extras=True)["precision"])
    assert get_args(names) == get_args(Precision), "--precision in cli/options.py differs"


def constant_air_cooled(load_w: Values, point: ChillerPoint) -> ChillerResult:
    """A chiller of constant COP whose condenser stands in the air."""
    load = np.maximum(load_w, 0.0)
    power_w = load / point.machine.reference_cop
    return ChillerResult(power_w, load, load + 1.0, 0.0 * load, load, load, load + power_w)


def test_a_chiller_is_one_entry_of_the_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    """The entry alone decides on names, plant, COP and bounds."""
    record = ChillerModel(
        constant_air_cooled,
        tower_water=False,
        outdoor_air=True,
        reference_cop=3.3,
        chilled_water_bounds_c=(5.0, 15.0),
    )
    monkeypatch.setitem(chiller.CHILLERS, "of_mine", record)
    july = ["hvac.chiller.model=of_mine", "site.start=07-15", "site.location=AZ"]
    config = load_config("corrected", july)
    assert config.hvac.plant_in_use == "air_cooled"
    with Simulator(config) as sim:
        sim.reset()
        day = [sim.step() for _ in range(96)]
        machine = sim.sizing.water_side.machine
    assert sum(step.water_l[0] for step in day) == 0
    assert machine.reference_cop == 3.3
    for step in day:
        np.testing.assert_allclose(step.chiller_load_w / step.chiller_w, 3.3)
    for override, message in (
        ("hvac.plant=water_cooled", "any but .*of_mine"),
        ("hvac.chiller.coil_approach_k=12", "valid within 5..15 C"),
        ("hvac.chiller.model=other", "'of_mine'"),
    ):
        with pytest.raises(ConfigError, match=message):
            load_config("corrected", [*july, override])


def test_every_kind_of_event_disturbs_a_step() -> None:
    assert set(EVENTS) == set(get_args(EventKind)), "add the kind of event to EVENTS in this file"
    for kind, given in EVENTS.items():
        listed = {"scheduled": [{"kind": kind, "start_h": 1.0, "duration_h": 1.0, **given}]}
        config = load_config("corrected").model_copy(update={"events": EventsConfig(**listed)})  # type: ignore[arg-type]
        timeline = schedule(
            [config],
            Places(np.array([0, 3]), np.array([0, 2]), np.array([0, 2]), np.array([2])),
            steps_per_hour=4,
            seed=0,
        )
        before, during = timeline.at(0), timeline.at(4)
        changed = [
            field.name
            for field in fields(before)
            if field.name not in ("active", "active_events")
            and not np.array_equal(getattr(before, field.name), getattr(during, field.name))
        ]
        assert len(changed) == 1 + (kind == "leak"), (
            f"event {kind} has no effect in sim/events.py: implement it there"
        )
