"""States as plain arrays and in files: written, read and checked before a run goes on from them."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.errors import SdcError, shortened
from sdc_taichi.hall.protection import NORMAL, TRIPPED
from sdc_taichi.plant.workload import NEGLIGIBLE_TASKS, TASKS_PER_STEP
from sdc_taichi.sim.drivers import Drivers, common_digits
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.physical_limits import AIR_LIMITS_C
from sdc_taichi.sim.sizing import Sizing
from sdc_taichi.sim.step_inputs import MOST_MOVES
from sdc_taichi.types import State, fields_of
from sdc_taichi.user_file import ArrayFile, open_input

MOST_STEPS = 10**9
"""Most steps since reset: 1,900 years of minutes."""
LAST_START = 2**53
"""Latest first step: beyond, steps would not be exact as f64."""
HALL_LIMITS_C = (-273.15, 1e6)
"""Limits of temperatures within a rack, in C: absolute zero, and more than a failing fan lets its
servers reach before the means of the hall leave ``AIR_LIMITS_C``."""
AIRFLOW_FACTOR = 100.0
"""Limit of airflows over those at the design point: fans reach a few times their speed there."""
ROUNDING = 1e-5
"""What rounding may add to a limit, as a share of it: sized devices and results in f32 differ by
less between processors."""
ROUNDING_KWH = 1e-5
"""What the battery of the released code rounds its store to, 8 decimals of a MWh."""

Limits = tuple[Any, Any]
"""Lowest and highest value of a field: numbers, or arrays that broadcast to it."""


def state_limits(fleet: Fleet, sizing: Sizing, step: int) -> dict[str, Limits]:
    """Lowest and highest value of each field of ``State`` by name, but for its ``step``.

    Args:
        fleet: B data centers with R racks, G server groups and U CRAC units.
        sizing: their sized devices.
        step: steps done since reset, which limit what can have come together.
    """
    per_unit, per_rack = fleet.unit_dc, fleet.rack_dc
    lowest_c, highest_c = fleet.values("hvac.setpoint.min_c"), fleet.values("hvac.setpoint.max_c")
    # No more than all work that has arrived can wait, and no more than the queue holds.
    limit_steps = fleet.values("workload.queue_limit_h") * fleet.steps_per_hour
    tasks = np.fmin(limit_steps, float(step)) * TASKS_PER_STEP
    spare_kwh = ROUNDING * sizing.battery_kwh + ROUNDING_KWH
    is_protected = np.array([c.protection.ashrae_class is not None for c in fleet.configs])
    most_m3s = AIRFLOW_FACTOR * fleet.unit_sums(fleet.unit_design_m3s)
    strength = 1.0 if fleet.air is None else fleet.air.mix_weights.strength
    return {
        "seed": (0, np.inf),
        "start": (0, LAST_START),
        "setpoint_c": (lowest_c[per_unit], highest_c[per_unit]),
        "cooling_run": (0, step),
        "cooling_last": (-MOST_MOVES, MOST_MOVES),
        "fan_speed": (fleet.values("hvac.crac.min_flow_ratio")[per_unit], 1.0),
        "queue": (0.0, (tasks * (1.0 + ROUNDING) + NEGLIGIBLE_TASKS)[:, None]),
        "stored_kwh": (-spare_kwh, sizing.battery_kwh + spare_kwh),
        # Heat in the room warms the supply air, and what is missing cools it.
        "room_heat_kwh": (
            (AIR_LIMITS_C[0] - highest_c) * sizing.room_kwh_per_k,
            (AIR_LIMITS_C[1] - lowest_c) * sizing.room_kwh_per_k,
        ),
        "restart_wait_min": (0.0, 60.0 * step / fleet.steps_per_hour),
        "rack_status": (NORMAL, np.where(is_protected, TRIPPED, NORMAL)[per_rack]),
        "group_inlet_c": HALL_LIMITS_C,
        "server_c": HALL_LIMITS_C,
        "mixed_c": HALL_LIMITS_C,
        "exhaust_c": (HALL_LIMITS_C[0] * strength, HALL_LIMITS_C[1] * strength),
        "captured_m3s": (0.0, most_m3s[per_rack]),
        "need_m3s": (0.0, most_m3s[per_unit]),
        "following": (0.0, most_m3s[per_unit] / np.maximum(fleet.unit_design_m3s, 1e-30)),
        "supply_excess_k": (AIR_LIMITS_C[0] - AIR_LIMITS_C[1], AIR_LIMITS_C[1] - AIR_LIMITS_C[0]),
    }


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
        found, model = as_array(f"snapshot: {name}", values[name]), np.asarray(wanted)
        if found.shape != () or found.dtype != model.dtype:
            raise SdcError(f"snapshot: {name} is {shortened(found.tolist())}, expected {wanted!r}")
        if found != model and name == "version":
            raise SdcError(f"snapshot: version {found}, expected {VERSION}")
        if found != model:
            raise SdcError("snapshot: made by another fleet, inputs or precision than this one")


def to_state(
    values: Mapping[str, Any], like: State, limits_at: Callable[[int], Mapping[str, Limits]]
) -> State:
    """The state that a snapshot holds.

    Args:
        values: Arrays by name, see ``check_origin``.
        like: State of the simulator that goes on from it, for shapes and types.
        limits_at: Lowest and highest values of the fields by name, after so many steps.

    Raises:
        SdcError: Values of wrong shape, type or range.
    """
    step = int(_checked("step", values["step"], like.step, (0, MOST_STEPS)))
    limits = limits_at(step)
    checked = {
        name: _checked(name, values[name], model, limits[name])
        for name, model in fields_of(like).items()
        if name != "step"
    }
    # The last command is no number before the first step.
    last = checked["cooling_last"]
    if np.any(np.isnan(last) != (step == 0)):
        raise SdcError(
            f"snapshot: cooling_last is {shortened(last.tolist())} after {step} steps; "
            "valid is nan before the first step and numbers from then on"
        )
    if np.any(np.diff(checked["queue"], axis=1) < -NEGLIGIBLE_TASKS):
        raise SdcError("snapshot: queue falls from older to newer work; valid never falls")
    return State(step=step, **checked)


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


def _checked(name: str, value: Any, like: Any, limits: Limits) -> Any:
    """A copy of a field of a state, of the shape, type and range that it must have."""
    model, given = np.asarray(like), as_array(f"snapshot: {name}", value)
    if given.shape != model.shape or given.dtype != model.dtype:
        raise SdcError(
            f"snapshot: {name} is {given.dtype} {given.shape}, expected {model.dtype} {model.shape}"
        )
    if given.size == 0:
        return given.copy()
    low, high = (np.broadcast_to(limit, given.shape) for limit in limits)
    is_valid = (given >= low) & (given <= high)
    if name == "cooling_last":
        is_valid |= np.isnan(given)
    if not np.all(is_valid):
        at = np.unravel_index(np.argmin(is_valid), given.shape)
        place = f" of entry {', '.join(map(str, at))}" if at else ""
        raise SdcError(
            f"snapshot: {name}{place} is {given[at]:.9g}; valid is {low[at]:.9g}..{high[at]:.9g}"
        )
    return given.copy()
