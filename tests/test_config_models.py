"""Names of models in the schema are those that are implemented, and the other way round."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import fields
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest

from sdc_taichi.cli.options import RunOptions
from sdc_taichi.cli.simulate import simulate_command
from sdc_taichi.config import DataCenterConfig, EventKind, EventsConfig, load_config
from sdc_taichi.control.registry import controller_names
from sdc_taichi.exogenous import carbon
from sdc_taichi.hall import air_metrics, placement
from sdc_taichi.kernels import hall_arguments
from sdc_taichi.plant import battery, chiller, cooling, plants, tower, water, workload
from sdc_taichi.sim import sizing
from sdc_taichi.sim.events import schedule
from sdc_taichi.sim.fleet import STAGE_MODELS
from sdc_taichi.sim.hall_solver import Precision

REGISTRIES: dict[str, tuple[str, Collection[str]]] = {
    "hvac.setpoint.model": ("plant.cooling.SETPOINTS", cooling.SETPOINTS),
    "hvac.crac.flow_model": ("plant.cooling.CRAC_FLOWS", cooling.CRAC_FLOWS),
    "hvac.cooling_load_model": ("plant.cooling.COOLING_LOADS", cooling.COOLING_LOADS),
    "hvac.plant": ("plant.plants.PLANTS", plants.PLANTS),
    "hvac.chiller.model": ("plant.chiller.CHILLERS", chiller.CHILLERS),
    "hvac.tower.model": ("plant.tower.TOWERS", tower.TOWERS),
    "hvac.water.model": ("plant.water.WATER", water.WATER),
    "hvac.sizing.model": ("sim.sizing.MODELS", sizing.MODELS),
    "battery.model": ("plant.battery.BATTERIES", battery.BATTERIES),
    "workload.model": ("plant.workload.MODELS", workload.MODELS),
    "workload.placement": ("hall.placement.POLICIES", placement.POLICIES),
    "servers.outlet_model": ("kernels.hall_arguments.OUTLETS", hall_arguments.OUTLETS),
    "protection.ashrae_class": ("hall.air_metrics.ALLOWABLE_C", air_metrics.ALLOWABLE_C),
    "site.carbon_pairing": ("exogenous.carbon.Pairing", get_args(carbon.Pairing)),
}
"""Field of the schema to the registry of what it may name."""

BRANCHES = {"hall.inlet_model", "hvac.pumps.model", "simulation.thermal"}
"""Stages whose models are two branches of the code and in no registry."""

EVENTS: dict[EventKind, dict[str, Any]] = {
    "crac_down": {"unit": 1},
    "chiller_derate": {"share": 0.3},
    "pump_down": {"share": 0.5},
    "tower_cell_down": {"share": 0.5},
    "dry_cooler_down": {"share": 0.5},
    "outdoor_air_closed": {"share": 0.0},
    "rack_fan_failure": {"rack": 2, "share": 0.7},
    "heat_wave": {"offset_k": 4.5},
    "grid_outage": {},
}


def names_in_schema(path: str) -> set[str]:
    section: Any = DataCenterConfig
    *sections, last = path.split(".")
    for key in sections:
        section = section.model_fields[key].annotation
    annotation = section.model_fields[last].annotation
    parts = [annotation, *get_args(annotation)]
    return {name for part in parts for name in get_args(part) if isinstance(name, str)}


def differences(path: str) -> list[str]:
    """What to do about each name that schema or registry has alone."""
    registry, implemented = REGISTRIES[path]
    listed = names_in_schema(path)
    return [
        *(
            f"{name!r} is in {registry} but not in the schema: add it to the Literal of {path} in "
            "sdc_taichi/config, or remove it from the registry"
            for name in sorted(set(implemented) - listed)
        ),
        *(
            f"{name!r} is in the Literal of {path} in sdc_taichi/config but not implemented: add "
            f"it to {registry}, or remove it from the Literal"
            for name in sorted(listed - set(implemented))
        ),
    ]


@pytest.mark.parametrize("path", REGISTRIES)
def test_schema_and_registry_name_the_same_models(path: str) -> None:
    assert not differences(path), "\n".join(differences(path))


@pytest.mark.parametrize(
    ("implemented", "said"),
    [
        ([*tower.TOWERS, "merkel"], "'merkel' is in plant.tower.TOWERS but not in the schema: add"),
        (["yorkcalc", "paper"], "'released' is in the Literal of hvac.tower.model in sdc_taichi"),
    ],
)
def test_a_difference_says_what_to_do(
    implemented: list[str], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(REGISTRIES, "hvac.tower.model", ("plant.tower.TOWERS", implemented))
    (difference,) = differences("hvac.tower.model")
    assert difference.startswith(said)


def test_every_stage_is_compared() -> None:
    stages = set(STAGE_MODELS.values())
    left_out = stages - set(REGISTRIES) - BRANCHES
    assert not left_out, f"add the registry of {', '.join(left_out)} to REGISTRIES in this file"
    assert stages >= BRANCHES
    assert all(len(names_in_schema(path)) == 2 for path in BRANCHES)


def test_the_command_line_offers_every_controller_and_precision() -> None:
    hints = get_type_hints(simulate_command, include_extras=True)
    _, option = get_args(hints["controller"])
    offered = set(option.help.partition(";")[0].split(", "))
    assert offered == set(controller_names()), "the help of --controller in cli/simulate.py differs"
    names, _ = get_args(get_type_hints(RunOptions, include_extras=True)["precision"])
    assert get_args(names) == get_args(Precision), "--precision in cli/options.py differs"


def test_workloads_say_when_work_is_due() -> None:
    assert set(workload.DUE_AFTER_STEPS) == set(workload.MODELS)


def test_every_kind_of_event_disturbs_a_step() -> None:
    assert set(EVENTS) == set(get_args(EventKind)), "add the kind of event to EVENTS in this file"
    for kind, given in EVENTS.items():
        listed = {"scheduled": [{"kind": kind, "start_h": 1.0, "duration_h": 1.0, **given}]}
        config = load_config("corrected").model_copy(update={"events": EventsConfig(**listed)})  # type: ignore[arg-type]
        timeline = schedule(
            [config],
            rack_offsets=np.array([0, 3]),
            unit_offsets=np.array([0, 2]),
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
        assert len(changed) == 1, f"event {kind} has no effect in sim/events.py: implement it there"
