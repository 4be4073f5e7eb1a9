"""Checks of what ``state_dict`` of an environment gave, before anything is changed by it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.envs.actions import checked_array
from sdc_taichi.envs.agents import COMMANDS_OF_AGENT
from sdc_taichi.envs.drawn_inputs import Draw, DrawnInputs
from sdc_taichi.errors import SdcError
from sdc_taichi.sim.drivers import Drivers
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F64, I64

PARTS = ("options", "inputs", "simulator", "actions", "rewards", "generators", "keys")
"""Entries of a state; all are plain values, arrays, or dicts and lists of them."""


@dataclass(frozen=True, slots=True)
class SavedState:
    """Parts of a state, checked; the simulator checks its own."""

    generators: list[np.random.Generator]
    """Generator of each environment, which draws its episodes."""
    keys: I64
    """Seeds of the errors of forecasts, (B,)."""
    peaks_kw: F64
    """Highest billed power before the last step and with it, in kW, (2, B)."""
    draw: Draw | None
    """Years and traces of the episodes; None if they draw none."""
    drivers: Drivers | None
    """Inputs of the episodes; None if they draw none."""
    commands: dict[str, F64] | None
    """Commands of the last step by field of ``Actions``, (B,) or (U,) each; None before the
    first."""


def check_state(
    values: Any, *, options: Mapping[str, Any], inputs: DrawnInputs | None, sim: Simulator
) -> SavedState:
    """Check a state against the environments that are to go on from it.

    Args:
        values: what ``state_dict`` gave.
        options: plain values that tell the environments apart.
        inputs: what draws their years and traces; None if nothing does.
        sim: their simulator.

    Raises:
        SdcError: made by other environments, incomplete, or not valid.
    """
    num_envs, units = sim.size, sim.fleet.units
    _check_parts(values, num_envs)
    for name, mine in options.items():
        made = values["options"].get(name)
        if type(made) is not type(mine) or made != mine:
            raise SdcError(f"state: made with {name} {made!r}; valid is {mine!r}, as here")
    draw = drivers = None
    if inputs is not None:
        draw = inputs.checked(values["inputs"], num_envs)
        drivers = inputs.drivers(draw)
    # The simulator checks it too; another fleet would be taken for wrong actions before.
    fingerprint = sim.fingerprint(drivers)
    if str(values["simulator"].get("fingerprint", fingerprint)) != fingerprint:
        raise SdcError("state: made by another fleet, inputs or precision than this one")
    generators = [np.random.Generator(np.random.PCG64()) for _ in range(num_envs)]
    try:
        for rng, state in zip(generators, values["generators"], strict=True):
            rng.bit_generator.state = state
    except (TypeError, ValueError, KeyError, OverflowError) as error:
        raise SdcError(f"state: a generator is not valid ({error})") from None
    keys = checked_array(values["keys"], "state: keys")
    if keys.shape != (num_envs,) or keys.dtype != np.int64 or keys.min() < 0:
        raise SdcError(f"state: keys are {keys.dtype} {keys.shape}; valid is int64 from 0 on")
    peaks_kw = checked_array(values["rewards"], "state: rewards")
    if peaks_kw.shape != (2, num_envs) or not _finite_within(peaks_kw, np.inf):
        raise SdcError(
            f"state: rewards are {peaks_kw.dtype} {peaks_kw.shape}; valid is finite numbers "
            f"(2, {num_envs})"
        )
    commands = _checked_commands(values["actions"], num_envs, units, sim.fleet.racks)
    return SavedState(generators, keys, peaks_kw.astype(np.float64), draw, drivers, commands)


def _check_parts(values: Any, num_envs: int) -> None:
    """Refuse a state whose parts are missing, unknown or of another kind."""
    if not isinstance(values, Mapping):
        raise SdcError(f"state: is a {type(values).__name__}; valid is what state_dict() gave")
    missing = [name for name in PARTS if name not in values]
    if missing:
        raise SdcError(f"state: missing {missing}; valid is what state_dict() gave")
    extra = sorted(map(str, values.keys() - set(PARTS)))
    if extra:
        raise SdcError(f"state: unknown {extra}; valid is what state_dict() gave")
    for name, kind in (("options", Mapping), ("simulator", Mapping), ("generators", list)):
        if not isinstance(values[name], kind):
            raise SdcError(f"state: {name} is a {type(values[name]).__name__}")
    made_by = len(values["generators"])
    if made_by != num_envs:
        raise SdcError(f"state: made by {made_by} environments; valid is {num_envs}")


def _checked_commands(given: Any, num_envs: int, units: int, racks: int) -> dict[str, F64] | None:
    """Commands of the last step, (B,), (U,) or (R,) each; None before the first step."""
    if given is None:
        return None
    known = {name for names in COMMANDS_OF_AGENT.values() for name in names}
    if not isinstance(given, Mapping) or not set(given) <= known:
        raise SdcError("state: actions are not valid; valid is what state_dict() gave")
    out: dict[str, F64] = {}
    for name, command in given.items():
        values = checked_array(command, f"state: actions of {name}")
        several = {"cooling": units, "fan": units, "placement": racks}
        shapes = [(), (num_envs,), (several.get(name),)]
        highest = np.inf if name in several else 1.0
        if values.shape not in shapes or not _finite_within(values, highest):
            raise SdcError(f"state: actions of {name} are not valid: {command!r}")
        out[name] = values.astype(np.float64)
    return out


def _finite_within(values: npt.NDArray[Any], highest: float) -> bool:
    """Whether an array has finite numbers alone, of at most a size."""
    numbers = values.dtype.kind in "iuf"
    return numbers and bool(np.all(np.isfinite(values) & (np.abs(values) <= highest)))
