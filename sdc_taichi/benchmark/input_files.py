"""Files that configurations name as inputs, whose content decides results of jobs.

A path says little of a result: another file may lie there later, or on another machine. So jobs are
told apart by the content of these files as well.
"""

from __future__ import annotations

from sdc_taichi.benchmark.vary import value_at
from sdc_taichi.config import DataCenterConfig
from sdc_taichi.user_file import read_bytes

FILE_FIELDS = (
    "site.weather_file",
    "site.carbon_file",
    "site.workload_file",
    "hall.recirculation.matrix_file",
)
"""Fields of the configuration that name files."""
MOST_INPUT_BYTES = 2**28
"""Largest of these files that is read, in bytes."""


def input_paths(config: DataCenterConfig) -> list[str]:
    """Paths of the files that a configuration names, each once.

    Args:
        config: the configuration.
    """
    named = (value_at(config, field) for field in FILE_FIELDS)
    return list(dict.fromkeys(path for path in named if path is not None))


def read_input(path: str) -> bytes:
    """Content of an input file.

    Args:
        path: the file.

    Raises:
        SdcError: it cannot be read, or is too large.
    """
    return read_bytes(path, MOST_INPUT_BYTES)
