"""Reference values of the device models, and what every result of a model must hold."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sdc_taichi.types import F64

REFERENCE = Path(__file__).parent / "reference"
ALL_CHECKS: list[dict[str, Any]] = json.loads((REFERENCE / "physics_checks.json").read_text())[
    "checks"
]
TRAJECTORIES = sorted(path.stem for path in (REFERENCE / "trajectories").glob("*.csv"))
"""Names of the recorded runs of the released code."""


def checks_of(group: str) -> pytest.MarkDecorator:
    """Parametrise a test by the reference checks of a device, as ``check``."""
    chosen = [check for check in ALL_CHECKS if check["group"] == group]
    return pytest.mark.parametrize("check", chosen, ids=[check["id"] for check in chosen])


@cache
def recorded(name: str) -> tuple[dict[str, F64], dict[str, float]]:
    """Columns and sizing of a recorded run."""
    path = REFERENCE / "trajectories" / f"{name}.csv"
    with path.open() as file:
        rows = list(csv.DictReader(file))
    columns = {key: np.array([float(row[key]) for row in rows]) for key in rows[0]}
    return columns, json.loads(path.with_suffix(".json").read_text())["sizing"]


@pytest.fixture(autouse=True, scope="module")
def floating_point_errors() -> Iterator[None]:
    """Raise where a model divides by zero, overflows or makes NaN."""
    with np.errstate(all="raise", under="ignore"):
        yield


def assert_batch(result: Any, alone: Callable[[slice], Any]) -> None:
    """Assert that results are finite f64 of five data centers, each the same alone."""
    for field in result._fields if hasattr(result, "_fields") else result.__slots__:
        values = getattr(result, field)
        assert (values.shape, values.dtype) == ((5,), np.float64)
        assert np.isfinite(values).all()
        for i in range(5):
            assert getattr(alone(slice(i, i + 1)), field)[0] == values[i]
