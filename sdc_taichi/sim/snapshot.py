"""Snapshots of a simulator: write, read and check states as plain arrays and as files."""

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
from sdc_taichi.config.liquid_schema import FLOW_LIMITS, SETPOINT_LIMITS_C
from sdc_taichi.errors import SdcError, shortened
from sdc_taichi.hall.protection import NORMAL, TRIPPED
from sdc_taichi.sim.drivers import Drivers, common_digits
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.step_inputs import MOST_MOVES
from sdc_taichi.types import State, fields_of
from sdc_taichi.user_file import ArrayFile, open_input

MOST_STEPS = 10**9
"""Maximum number of steps since reset: 1,900 years of one-minute steps."""
LAST_START = 2**53
"""Largest index of a first step; larger indices are not exact in f64."""
LIMITS: dict[str, tuple[float, float]] = {
    "step": (0, MOST_STEPS),
    "seed": (0, np.inf),
    "start": (0, LAST_START),
    "cooling_run": (0, MOST_STEPS),
    "cooling_last": (-MOST_MOVES, MOST_MOVES),
    "fan_speed": (0.0, 1.0),
    "cdu_setpoint_c": SETPOINT_LIMITS_C,
    "cdu_flow": FLOW_LIMITS,
    "rack_status": (NORMAL, TRIPPED),
}
"""Minimum and maximum of fields of ``State``; ``OTHER_LIMITS`` applies to all other fields.

The limits detect damaged files. A state within the limits from which no physical step is possible
raises a ``PhysicalLimitError`` in the next step."""
OTHER_LIMITS = (-1e12, 1e12)
"""Minimum and maximum of the fields of ``State`` that ``LIMITS`` does not list."""
VERSION = 6
"""Version of the snapshot format."""


def fingerprint(fleet: Fleet, drivers: Drivers, precision: str) -> str:
    """Return the SHA-256 of configs, inputs and precision, which identifies a simulator.

    Numbers are rounded to f32 first, so that the fingerprint normally does not depend on the
    processor and a run can continue on another machine.
    """
    digest = hashlib.sha256(precision.encode())
    # Many data centers can share one config object, which is then converted to JSON only once.
    texts: dict[int, bytes] = {}
    for config in fleet.configs:
        if id(config) not in texts:
            texts[id(config)] = config.model_dump_json().encode()
        digest.update(texts[id(config)])
    digest.update(drivers.digest())
    # The content of a matrix file can change without a change of its name in the config.
    if (air := fleet.air) is not None:
        mix = air.mix_weights
        for part in (mix.weights, mix.norm, mix.strength, air.exhaust_share, fleet.dcs):
            digest.update(common_digits(part))
    return digest.hexdigest()


def to_dict(state: State, fingerprint: str) -> dict[str, Any]:
    """Return a snapshot: copies of the arrays of a state, its version and its fingerprint.

    Args:
        state: State to copy.
        fingerprint: Fingerprint of the simulator, see ``fingerprint``.
    """
    out = {name: np.array(values) for name, values in fields_of(state).items()}
    out["version"] = np.array(VERSION)
    out["fingerprint"] = np.array(fingerprint)
    return out


def check_origin(values: Any, fingerprint: str) -> None:
    """Check that a snapshot is complete and belongs to one simulator.

    Args:
        values: Snapshot as arrays by name.
        fingerprint: Fingerprint of the simulator, see ``fingerprint``.

    Raises:
        SdcError: The snapshot is incomplete, or of another version or simulator.
    """
    if not isinstance(values, Mapping):
        raise SdcError(
            f"snapshot: is a {type(values).__name__}; valid is what state_dict() returned"
        )
    if "version" in values:
        # The fields of another version differ, so its number says more than their names.
        _check_label(values, "version", VERSION, f"snapshot: version {{}}, expected {VERSION}")
    expected = {f.name for f in fields(State)} | {"version", "fingerprint"}
    missing = sorted(expected - set(values))
    extra = sorted(str(name)[:80] for name in set(values) - expected)
    if missing or extra:
        raise SdcError(
            f"snapshot: missing {missing}, unknown {extra}; it is no state of this program"
        )
    _check_label(
        values,
        "fingerprint",
        fingerprint,
        "snapshot: made by another fleet, inputs or precision than this one",
    )


def _check_label(values: Mapping[str, Any], name: str, wanted: int | str, message: str) -> None:
    """Check a label of a snapshot.

    Raises:
        SdcError: The label has the wrong type or, with ``message``, the wrong value.
    """
    stored, model = as_array(f"snapshot: {name}", values[name]), np.asarray(wanted)
    if stored.shape != () or stored.dtype != model.dtype:
        raise SdcError(f"snapshot: {name} is {shortened(stored.tolist())}, expected {wanted!r}")
    if stored != model:
        raise SdcError(message.format(stored))


def to_state(values: Mapping[str, Any], like: State) -> State:
    """Return the state of a snapshot.

    Args:
        values: Snapshot that ``check_origin`` has accepted.
        like: State of the simulator, which defines shapes and types.

    Raises:
        SdcError: A value has a wrong shape, type or range.
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
    """Read arrays by name from a file of ``write``.

    Raises:
        SdcError: The file cannot be read.
    """
    with open_input(path) as file:
        arrays = ArrayFile(file, path)
        # Files of ``write`` are not compressed, so no array can be larger than the file.
        most_bytes = os.fstat(file.fileno()).st_size
        return {name: arrays.read(name, most_bytes) for name in arrays.names}


def as_array(label: str, value: Any) -> npt.NDArray[Any]:
    """Convert a NumPy array or scalar to an array.

    Args:
        label: Name of the value, for the error message.
        value: Any value.

    Raises:
        SdcError: The value is neither a NumPy array nor a NumPy scalar.
    """
    if not isinstance(value, np.ndarray | np.generic):
        raise SdcError(f"{label} is a {type(value).__name__}; valid is an array of NumPy")
    return np.asarray(value)


def _checked(name: str, value: Any, like: Any) -> Any:
    """Return a copy of a field of a state after checking its shape, type and range."""
    model, array = np.asarray(like), as_array(f"snapshot: {name}", value)
    if array.shape != model.shape or array.dtype != model.dtype:
        raise SdcError(
            f"snapshot: {name} is {array.dtype} {array.shape}, expected {model.dtype} {model.shape}"
        )
    low, high = LIMITS.get(name, OTHER_LIMITS)
    is_valid = (array >= low) & (array <= high)
    if name == "cooling_last":
        # nan means that there was no command yet.
        is_valid |= np.isnan(array)
    if not np.all(is_valid):
        at = np.unravel_index(np.argmin(is_valid), array.shape)
        place = f" of entry {', '.join(map(str, at))}" if at else ""
        raise SdcError(f"snapshot: {name}{place} is {array[at]:.9g}; valid is {low:g}..{high:g}")
    return array.copy()
