"""Parts of every environment, read alike from the arguments of all entry points.

``parallel_env``, ``aec_env``, ``gymnasium.make``, ``gymnasium.make_vec`` and ``vector_env`` take
the same ``config``, ``overrides``, ``options`` and options by keyword, and refuse the same ones.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

from sdc_taichi.config import (
    DataCenterConfig,
    apply_overrides,
    config_from_dict,
    load_config,
    with_values,
)
from sdc_taichi.envs.options import EnvOptions, make_options
from sdc_taichi.envs.recording import RecorderOption, RecordingCore
from sdc_taichi.errors import ConfigError
from sdc_taichi.sim.hall_solver import Precision

OneConfig: TypeAlias = DataCenterConfig | Mapping[str, Any]
"""A config, or its sections as plain values."""
ConfigSource: TypeAlias = str | os.PathLike[str] | OneConfig | Sequence[OneConfig]
"""A preset, a file, a config or its sections, or for batches several of the latter."""
Overrides: TypeAlias = Mapping[str, Any] | Sequence[str]
"""Values put into the config: section.key to value, or a list of ``section.key=value``."""


def configs_and_options(
    config: ConfigSource,
    overrides: Overrides,
    options: EnvOptions | None,
    keywords: Mapping[str, Any],
    *,
    only_agent: str | None = None,
) -> tuple[list[DataCenterConfig], EnvOptions]:
    """The configs and options that the arguments of an entry point mean.

    Args:
        config: a preset, a file, a config, or several configs.
        overrides: values put into every config.
        options: options; None is the default ones.
        keywords: fields of ``EnvOptions`` that take the place of those in ``options``.
        only_agent: the one agent that learns, where the entry point is for one.

    Raises:
        ConfigError: a config, override or option that is not valid.
    """
    configs = _configs(config, _checked_overrides(overrides))
    return configs, _options(options, keywords, only_agent)


def single_core(
    config: ConfigSource,
    overrides: Overrides,
    options: EnvOptions | None,
    keywords: Mapping[str, Any],
    precision: Precision,
    recorder: RecorderOption,
    *,
    only_agent: str | None = None,
) -> RecordingCore:
    """The core of an environment with one data center.

    Args:
        config: a preset, a file or a config.
        overrides: values put into the config.
        options: options; None is the default ones.
        keywords: fields of ``EnvOptions`` that take the place of those in ``options``.
        precision: precision of the server kernels.
        recorder: what records episodes, if anything.
        only_agent: the one agent that learns, where the entry point is for one.

    Raises:
        SdcError: several configs, or an argument that is not valid.
    """
    configs, chosen = configs_and_options(
        config, overrides, options, keywords, only_agent=only_agent
    )
    if len(configs) != 1:
        raise ConfigError(f"config: {len(configs)} data centers; valid is one, or vector_env")
    return RecordingCore(configs, chosen, None, precision, recorder)


def _configs(source: Any, overrides: Overrides) -> list[DataCenterConfig]:
    if isinstance(source, str | os.PathLike):
        if isinstance(overrides, Mapping):
            return [_with_overrides(load_config(source), overrides)]
        # With its overrides a file may be valid that is not without them.
        return [load_config(source, list(overrides))]
    listed: list[Any] = list(source) if isinstance(source, Sequence) else [source]
    if not listed:
        raise ConfigError("config: an empty list; valid is at least one data center")
    return [_with_overrides(_checked_config(one), overrides) for one in listed]


def _checked_config(given: Any) -> DataCenterConfig:
    if isinstance(given, Mapping):
        return config_from_dict(dict(given))
    if not isinstance(given, DataCenterConfig):
        raise ConfigError(
            f"config {given!r}: valid is a preset, a file, DataCenterConfigs, or dicts of their "
            "sections"
        )
    return given


def _with_overrides(config: DataCenterConfig, overrides: Overrides) -> DataCenterConfig:
    if not overrides:
        return config
    if isinstance(overrides, Mapping):
        return with_values(config, overrides)
    return apply_overrides(config, list(overrides))


def _checked_overrides(given: Any) -> Overrides:
    listed = isinstance(given, Mapping | Sequence) and not isinstance(given, str | bytes)
    if not listed or not all(isinstance(one, str) for one in given):
        raise ConfigError(
            f"overrides {given!r}: valid is a list of section.key=value, or a dict of section.key "
            "to value"
        )
    checked: Overrides = given
    return checked


def _options(options: Any, keywords: Mapping[str, Any], only_agent: str | None) -> EnvOptions:
    if options is not None and not isinstance(options, EnvOptions):
        raise ConfigError(f"options {options!r}: valid is EnvOptions, or its fields by keyword")
    given = dict(keywords)
    if options is not None:
        # Fields left at their default are not given: some are errors where they have no effect.
        given = {name: getattr(options, name) for name in options.model_fields_set} | given
    if only_agent is not None:
        agents = given.setdefault("agents", (only_agent,))
        if agents not in ((only_agent,), [only_agent]):
            raise ConfigError(
                f"agents {agents!r}: the one agent here is {only_agent}; valid with "
                "sdc_taichi/Joint-v0"
            )
    return make_options(**given)
