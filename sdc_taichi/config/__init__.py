"""The configuration of a data center: its schema, and readers of presets, files and overrides.

This package defines the valid fields, their bounds and the errors about them. It computes no hall
and no plant, and no other module validates a configuration.
"""

from sdc_taichi.config.event_schema import (
    EventKind,
    EventsConfig,
    SampledEvent,
    ScheduledEvent,
)
from sdc_taichi.config.fields import explain, validated
from sdc_taichi.config.hall_schema import HallConfig, LayoutConfig
from sdc_taichi.config.loading import (
    apply_override,
    apply_overrides,
    config_from_dict,
    load_config,
    preset_names,
    with_values,
)
from sdc_taichi.config.plain_values import load_json, load_yaml
from sdc_taichi.config.schema import DataCenterConfig

__all__ = [
    "DataCenterConfig",
    "EventKind",
    "EventsConfig",
    "HallConfig",
    "LayoutConfig",
    "SampledEvent",
    "ScheduledEvent",
    "apply_override",
    "apply_overrides",
    "config_from_dict",
    "explain",
    "load_config",
    "load_json",
    "load_yaml",
    "preset_names",
    "validated",
    "with_values",
]
