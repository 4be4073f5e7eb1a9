"""All areas by name, and how many cases each has."""

from __future__ import annotations

from dataclasses import dataclass

from fuzz.case import Area
from fuzz.command_lines import command_lines
from fuzz.configs import configs
from fuzz.data_files import data_files
from fuzz.faults import faults
from fuzz.matrices import matrices
from fuzz.policies import policies
from fuzz.run_folders import run_folders
from fuzz.states import states
from fuzz.studies import studies

SEED = 17
"""Seed of the sample that is part of the suite."""


@dataclass(frozen=True)
class Plan:
    """An area and its share of the cases."""

    area: Area
    """What a case does."""
    cases: int
    """Number of cases of `make fuzz`."""
    sample: int
    """Number of cases that are part of the suite."""


AREAS = {
    "configs": Plan(configs, 900, 130),
    "data_files": Plan(data_files, 300, 45),
    "matrices": Plan(matrices, 200, 35),
    "states": Plan(states, 260, 40),
    "policies": Plan(policies, 120, 20),
    "run_folders": Plan(run_folders, 120, 22),
    "studies": Plan(studies, 150, 20),
    "command_lines": Plan(command_lines, 150, 24),
    "faults": Plan(faults, 70, 4),
}
