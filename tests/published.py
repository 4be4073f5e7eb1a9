"""Published cells: figures of rows of suites in one week of a site, and what is run again of them.

``docs/make/benchmark.py`` writes a folder for each suite, with cells.csv, published.json and
the policies of rows that learned.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pandas as pd

from sdc_taichi.benchmark.suite import Suite, load_suite
from sdc_taichi.run.description import processor_features

FOLDER = Path(__file__).parent / "reference" / "benchmark"
SUITES = tuple(sorted(path.name for path in FOLDER.iterdir()))
"""Suites of which something is published."""
FIGURES = ("figure", "cfp_kg", "grid_kwh", "hvac_kwh", "water_l", "cost")
"""Figures that need no optimum."""
WAITING = {"bill", "elsewhere"}
"""Suites on preset ``corrected``, whose models have changed since version 0.2.0.dev0 published
them: their cells wait until they are published again."""
SAME = 1e-6
"""Relative difference up to which figures are those that were published, on equal processors."""
ALIKE, DECIDED_ALIKE = 1e-4, 1e-3
"""Elsewhere, for rules and for plans and policies, which magnify last bits."""


def described(name: str) -> dict[str, Any]:
    """What was published of a suite."""
    published: dict[str, Any] = json.loads((FOLDER / name / "published.json").read_text("utf-8"))
    return published


def cells(name: str) -> dict[str, dict[str, Any]]:
    """Controller, site, week and published figures of each row of a suite."""
    frame = pd.read_csv(FOLDER / name / "cells.csv")
    return {
        str(cell["row"]): {str(k): v for k, v in cell.items()} for cell in frame.to_dict("records")
    }


def suite_of(name: str) -> Suite:
    """The suite as it is defined."""
    file = FOLDER / name / "suite.yaml"
    return load_suite(str(file) if file.exists() else name)


def tolerance(row: str, published: dict[str, Any]) -> float:
    """Relative difference up to which the figures of a row are those that were published."""
    if published["processors"][row] == processor_features():
        return SAME
    is_decided = row == "ippo" or "mpc" in row
    return DECIDED_ALIKE if is_decided else ALIKE
