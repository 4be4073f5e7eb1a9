"""States as plain arrays and in files: written, read and checked before a run goes on from them."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.errors import SdcError
from sdc_taichi.plant.workload import NEGLIGIBLE_TASKS
from sdc_taichi.sim.drivers import Drivers, common_digits
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import State, fields_of
from sdc_taichi.user_file import ArrayFile, open_input

VERSION = 3
"""Version of what a snapshot holds."""


def fingerprint(fleet: Fleet, drivers: Drivers, precision: str) -> str:
    """SHA-256 of configs, inputs and precision, which tells simulators apart.

    The same on every processor, so that a state may go on on another one.
    """
    digest = hashlib.sha256(precision.encode())
    # Environments of a batch share their configs.
    texts: dict[int, bytes] = {}
    for config in fleet.configs:
        if id(config) not in texts:
            texts[id(config)] = config.model_dump_json().encode()
        digest.update(texts[id(config)])
    digest.update(drivers.digest())
    # A matrix that a config names may change under its name.
    if (air := fleet.air) is not None:
        mix = air.mix_weights
        for part in (mix.weights, mix.norm, mix.strength, air.exhaust_share, fleet.dcs):
            digest.update(common_digits(part))
    return digest.hexdigest()


def to_dict(state: State, fingerprint: str) -> dict[str, Any]:
    """A state as copies of its arrays, with what tells which simulator it is of.

    Args:
        state: State to copy.
        fingerprint: Of the simulator, see ``fingerprint``.
    """
    out = {name: np.array(values) for name, values in fields_of(state).items()}
    out["version"] = np.array(VERSION)
    out["fingerprint"] = np.array(fingerprint)
    return out


def check_origin(values: Mapping[str, Any], fingerprint: str) -> None:
    """Make sure that values are a whole snapshot of one simulator.

    Args:
        values: Arrays by name.
        fingerprint: Of the simulator, see ``fingerprint``.

    Raises:
        SdcError: Values that are incomplete, or of another version or simulator.
    """
    expected = {f.name for f in fields(State)} | {"version", "fingerprint"}
    missing, extra = sorted(expected - set(values)), sorted(set(values) - expected)
    if missing or extra:
        raise SdcError(
            f"snapshot: missing {missing}, unknown {extra}; it is no state of this program"
        )
    if int(values["version"]) != VERSION:
        raise SdcError(f"snapshot: version {values['version']}, expected {VERSION}")
    if str(values["fingerprint"]) != fingerprint:
        raise SdcError("snapshot: made by another fleet, inputs or precision than this one")


def to_state(values: Mapping[str, Any], like: State) -> State:
    """The state that a snapshot holds.

    Args:
        values: Arrays by name, see ``check_origin``.
        like: State of the simulator that goes on from it, for shapes and types.

    Raises:
        SdcError: Values of wrong shape, type or range.
    """
    state = State(**{name: _checked(name, values[name], x) for name, x in fields_of(like).items()})
    if np.any(np.diff(state.queue, axis=1) < -NEGLIGIBLE_TASKS):
        raise SdcError("snapshot: queue falls from older to newer work; valid never falls")
    return state


def write(path: str | os.PathLike[str], values: Mapping[str, Any]) -> None:
    """Write arrays by name to an .npz file, atomically and without pickle.

    Raises:
        SdcError: The file cannot be written.
    """
    with atomic_write(Path(path)) as file:
        np.savez(file, **values)


def read(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Arrays by name from a file of ``write``.

    Raises:
        SdcError: The file cannot be read.
    """
    with open_input(path) as file:
        arrays = ArrayFile(file, path)
        # Files of ``write`` are not compressed.
        most_bytes = os.fstat(file.fileno()).st_size
        return {name: arrays.read(name, most_bytes) for name in arrays.names}


def _checked(name: str, value: Any, like: Any) -> Any:
    """A field of a state, of the shape, type and range that it must have."""
    model, given = np.asarray(like), np.asarray(value)
    if given.shape != model.shape or given.dtype != model.dtype:
        raise SdcError(
            f"snapshot: {name} is {given.dtype} {given.shape}, expected {model.dtype} {model.shape}"
        )
    # Room heat is below zero while the air is colder than the setpoint.
    low = -np.inf if name.endswith("_c") or name == "room_heat_kwh" else 0.0
    # The last command is not a number before the first step.
    if name != "cooling_last" and not np.all(np.isfinite(given) & (given >= low)):
        raise SdcError(f"snapshot: {name} has values that are negative or not finite")
    return int(given) if given.ndim == 0 else given.copy()
