"""Folders of recorded numbers that tests compare with: SDC_REFERENCE_DIR, else tests/reference."""

import os
from pathlib import Path


def reference_folders() -> list[Path]:
    """The folders that SDC_REFERENCE_DIR names, separated as in PATH, or that of the tests."""
    named = os.environ.get("SDC_REFERENCE_DIR", "").strip()
    if not named:
        return [Path(__file__).parent / "reference"]
    return [Path(part).resolve() for part in named.split(os.pathsep) if part]


def energyplus_tables(pattern: str) -> list[Path]:
    """Tables of EnergyPlus by their names, in the folders or in folders ``energyplus`` of them."""
    found = (path for folder in reference_folders() for path in folder.glob(pattern))
    below = (
        path for folder in reference_folders() for path in folder.glob(f"energyplus/{pattern}")
    )
    return sorted({*found, *below})
