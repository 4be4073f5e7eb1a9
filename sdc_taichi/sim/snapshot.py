"""States as plain arrays and in files: written, read and checked before a run goes on from them."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.errors import SdcError, shortened
from sdc_taichi.hall.protection import NORMAL, TRIPPED
from sdc_taichi.sim.drivers import Drivers, common_digits
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.step_inputs import MOST_MOVES
from sdc_taichi.types import State, fields_of
from sdc_taichi.user_file import ArrayFile, open_input

MOST_STEPS = 10**9
"""Most steps since reset: 1,900 years of minutes."""
LAST_START = 2**53
"""Latest first step: beyond, steps would not be exact as f64."""
LIMITS: dict[str, tuple[float, float]] = {
    "step": (0, MOST_STEPS),
    "seed": (0, np.inf),
    "start": (0, LAST_START),
    "cooling_run": (0, MOST_STEPS),
    "cooling_last": (-MOST_MOVES, MOST_MOVES),
    "fan_speed": (0.0, 1.0),
    "rack_status": (NORMAL, TRIPPED),
}
"""Lowest and highest value of fields of ``State``; all others lie within ``OTHER_LIMITS``.

A whole file of this simulator holds no other values: these limits catch damaged ones. What lies
within them and cannot be continued ends in the next step, as a ``PhysicalLimitError``."""
OTHER_LIMITS = (-1e12, 1e12)
"""Lowest and highest value of the other fields of ``State``."""
VERSION = 3
"""Version of what a snapshot holds."""


def fingerprint(fleet: Fleet, drivers: Drivers, precision: str) -> str:
    """SHA-256 of configs, inputs and precision, which tells simulators apart.

    Equal on all processors, so that a state can be continued on another one, unless a value of the
    inputs rounds apart there.
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


def check_origin(values: Any, fingerprint: str) -> None:
    """Make sure that values are a whole snapshot of one simulator.

    Args:
        values: Arrays by name.
        fingerprint: Of the simulator, see ``fingerprint``.

    Raises:
        SdcError: Values that are incomplete, or of another version or simulator.
    """
    if not isinstance(values, Mapping):
        raise SdcError(
            f"snapshot: is a {type(values).__name__}; valid is what state_dict() returned"
        )
    expected = {f.name for f in fields(State)} | {"version", "fingerprint"}
    missing = sorted(expected - set(values))
    extra = sorted(str(name)[:80] for name in set(values) - expected)
    if missing or extra:
        raise SdcError(
            f"snapshot: missing {missing}, unknown {extra}; it is no state of this program"
        )
    for name, wanted in (("version", VERSION), ("fingerprint", fingerprint)):
        stored, model = as_array(f"snapshot: {name}", values[name]), np.asarray(wanted)
        if stored.shape != () or stored.dtype != model.dtype:
            raise SdcError(f"snapshot: {name} is {shortened(stored.tolist())}, expected {wanted!r}")
        if stored != model and name == "version":
            raise SdcError(f"snapshot: version {stored}, expected {VERSION}")
        if stored != model:
            raise SdcError("snapshot: made by another fleet, inputs or precision than this one")


def to_state(values: Mapping[str, Any], like: State) -> State:
    """The state that a snapshot holds.

    Args:
        values: Arrays by name, see ``check_origin``.
        like: State of the simulator that goes on from it, for shapes and types.

    Raises:
        SdcError: Values of wrong shape, type or range.
    """
    fields_checked = {
        name: _checked(name, values[name], model) for name, model in fields_of(like).items()
    }
    return State(**fields_checked | {"step": int(fields_checked["step"])})


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


def as_array(label: str, value: Any) -> npt.NDArray[Any]:
    """An array or number of NumPy as an array.

    Args:
        label: What it is, for errors.
        value: Any value.

    Raises:
        SdcError: A value of another kind.
    """
    if not isinstance(value, np.ndarray | np.generic):
        raise SdcError(f"{label} is a {type(value).__name__}; valid is an array of NumPy")
    return np.asarray(value)


def _checked(name: str, value: Any, like: Any) -> Any:
    """A copy of a field of a state, of the shape, type and range that it must have."""
    model, array = np.asarray(like), as_array(f"snapshot: {name}", value)
    if array.shape != model.shape or array.dtype != model.dtype:
        raise SdcError(
            f"snapshot: {name} is {array.dtype} {array.shape}, expected {model.dtype} {model.shape}"
        )
    low, high = LIMITS.get(name, OTHER_LIMITS)
    is_valid = (array >= low) & (array <= high)
    if name == "cooling_last":
        # There is no last command before the first step.
        is_valid |= np.isnan(array)
    if not np.all(is_valid):
        at = np.unravel_index(np.argmin(is_valid), array.shape)
        place = f" of entry {', '.join(map(str, at))}" if at else ""
        raise SdcError(f"snapshot: {name}{place} is {array[at]:.9g}; valid is {low:g}..{high:g}")
    return array.copy()
