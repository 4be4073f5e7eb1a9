"""Names with which shells complete a word of the command line.

Each function returns the names that begin like the word; where there are none, shells offer files.
"""

from __future__ import annotations

from collections.abc import Iterable


def presets_and_fields(incomplete: str) -> list[str]:
    """Presets, and fields of the configuration with the sign that their value follows."""
    from sdc_taichi.config import preset_names
    from sdc_taichi.config.reference import field_names

    return _beginning(incomplete, [*preset_names(), *(f"{name}=" for name in field_names())])


def presets(incomplete: str) -> list[str]:
    """Presets."""
    from sdc_taichi.config import preset_names

    return _beginning(incomplete, preset_names())


def sites(incomplete: str) -> list[str]:
    """Sites, after those that a list holds already."""
    from sdc_taichi.exogenous.registry import site_names

    before, comma, _ = incomplete.rpartition(",")
    return _beginning(incomplete, (f"{before}{comma}{name.lower()}" for name in site_names()))


def sites_and_traces(incomplete: str) -> list[str]:
    """Sites and workload traces."""
    from sdc_taichi.exogenous.registry import site_names, trace_names

    return _beginning(incomplete, [*site_names(), *trace_names()])


def controllers(incomplete: str) -> list[str]:
    """Controllers; of those that take a value, what comes before it."""
    from sdc_taichi.control.registry import controller_names

    names = (name.partition(":") for name in controller_names())
    return _beginning(incomplete, ("".join(parts[:2]) for parts in names))


def algorithms(incomplete: str) -> list[str]:
    """Algorithms of training."""
    from sdc_taichi.learning.settings import LEARNING_SETTINGS

    return _beginning(incomplete, LEARNING_SETTINGS)


def suites(incomplete: str) -> list[str]:
    """Suites of the benchmark."""
    from sdc_taichi.benchmark.suite import suite_names

    return _beginning(incomplete, suite_names())


def _beginning(incomplete: str, names: Iterable[str]) -> list[str]:
    return [name for name in names if name.startswith(incomplete)]
