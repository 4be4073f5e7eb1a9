"""Random seeds, start days, randomly drawn inputs and saved states of episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.envs.actions import PLACEMENT_FACTOR
from sdc_taichi.envs.options import EnvOptions
from sdc_taichi.envs.rewards import MAX_PEAK_KW
from sdc_taichi.errors import ConfigError, SdcError, shortened
from sdc_taichi.exogenous.year_clock import DAYS_PER_YEAR, day_of_year
from sdc_taichi.plant.chiller import BOILING_C, FREEZING_C
from sdc_taichi.sim.drivers import Drivers, InputReader
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.sim.snapshot import as_array
from sdc_taichi.sim.step_inputs import LIQUID_COMMANDS, MOST_MOVES
from sdc_taichi.types import F64, I64, State

Seed = int | Sequence[int | None] | I64 | None
"""Seed of B environments: an integer s gives environment i the seed s + i; a sequence gives one
seed for each. None continues the random generator of an environment."""


def seeded_generators(
    seed: Seed, present: Sequence[np.random.Generator], num_envs: int
) -> list[np.random.Generator]:
    """Return the random generator of each environment, newly seeded or continued.

    Args:
        seed: environment i uses ``seed + i``, or entry i of a sequence; None continues.
        present: generators of the previous episode; empty before the first episode.
        num_envs: number of environments.

    Raises:
        ConfigError: a seed is not valid, or the number of seeds differs from ``num_envs``.
    """
    if seed is None and present:
        return list(present)
    if seed is None:
        seed = int(np.random.SeedSequence().generate_state(1, np.uint32)[0])
    if isinstance(seed, np.ndarray) and seed.ndim == 0:
        seed = seed[()]
    if isinstance(seed, Sequence | np.ndarray) and not isinstance(seed, str):
        seeds: list[Any] = list(seed)
    else:
        seeds = [_checked_seed(seed) + i for i in range(num_envs)]
    if len(seeds) != num_envs:
        raise ConfigError(f"seed: {len(seeds)} for {num_envs} environments")
    before: list[np.random.Generator | None] = [*present] or [None] * num_envs
    return [
        (rng or np.random.default_rng())
        if one is None
        else np.random.Generator(np.random.PCG64(_checked_seed(one)))
        for one, rng in zip(seeds, before, strict=True)
    ]


def chosen_start_days(start: Any, num_envs: int) -> I64:
    """Return the first day of each episode as day of the year, from 0, (B,).

    Args:
        start: day as ``MM-DD`` or as number of the day in the year, from 0; or one day for each
            environment.
        num_envs: number of environments, B.

    Raises:
        ConfigError: a day is not valid, or the number of days is neither 1 nor ``num_envs``.
    """
    if isinstance(start, np.ndarray) and start.ndim == 0:
        start = start[()]
    several = isinstance(start, list | tuple | np.ndarray)
    days = np.array([_checked_day(day) for day in (start if several else [start])], dtype=np.int64)
    if len(days) not in (1, num_envs):
        raise ConfigError(f"start_day: {len(days)} days for {num_envs} environments")
    return np.broadcast_to(days, (num_envs,))


def _checked_seed(seed: Any) -> int:
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed < 2**63:
        raise ConfigError(f"seed {seed!r}: valid is an integer of 0..2**63 - 1")
    return int(seed)


def _checked_day(day: Any) -> int:
    """Return the number of a day in the year, 0..364, from a number or ``MM-DD``."""
    if isinstance(day, int | np.integer) and not isinstance(day, bool):
        if 0 <= day < DAYS_PER_YEAR:
            return int(day)
    elif isinstance(day, str):
        try:
            return day_of_year(day)
        except ValueError:
            pass
    raise ConfigError(f"start_day {day!r}: valid is MM-DD or a day of the year, 0..364")


@dataclass(frozen=True, slots=True)
class Draw:
    """Randomly drawn inputs of the episodes of B environments."""

    years: tuple[int, ...] | None
    """Seed of the synthetic series of each environment, B; None means ``site.seed``."""
    traces: tuple[str, ...] | None
    """Workload trace of each environment, B; None means the trace of the config."""


class DrawnInputs:
    """Draws the synthetic years and workload traces of episodes at random, and reads their data.

    Args:
        configs: config of each environment, B.
        options: environment options with the ``years`` and ``traces`` to draw from.

    Raises:
        ConfigError: ``years`` is set but a data center has no synthetic series, or a trace is
            unknown.
        DataError: the file of a trace is not valid.
    """

    def __init__(self, configs: Sequence[DataCenterConfig], options: EnvOptions) -> None:
        self._years, self._traces = options.years, options.traces
        self._reader = InputReader(configs)
        self._last: tuple[Draw, Drivers] | None = None
        traces = [self._reader.check_trace(trace) for trace in self._traces or ()]
        some_trace_is_synthetic = any(trace.synthetic for trace in traces)
        if self._years is not None and not some_trace_is_synthetic:
            for config, synthetic in zip(configs, self._reader.is_synthetic(), strict=True):
                if not synthetic:
                    raise ConfigError(
                        f"years: without effect on {config.name}, of which no input is synthetic; "
                        "valid with embedded sites or traces"
                    )

    def first(self) -> Drivers:
        """Return the inputs that the configs name; the simulator sizes devices for them."""
        return self._reader.read()

    def draw(self, generators: Sequence[np.random.Generator]) -> Draw:
        """Draw the year and the trace of each environment's next episode.

        Args:
            generators: random generator of each environment. Each gives the same count of random
                numbers under all options, so options do not change later draws.
        """
        drawn = np.array([rng.integers(2**63 - 1, size=2) for rng in generators], dtype=np.int64)
        years = traces = None
        if isinstance(self._years, int):
            years = tuple((drawn[:, 0] % self._years).tolist())
        elif self._years is not None:
            years = tuple(self._years[i] for i in drawn[:, 0] % len(self._years))
        if self._traces is not None:
            traces = tuple(self._traces[i] for i in drawn[:, 1] % len(self._traces))
        return Draw(years, traces)

    def drivers(self, draw: Draw) -> Drivers:
        """Return the input series of a draw, and the same object again for an equal next draw."""
        if self._last is None or self._last[0] != draw:
            self._last = draw, self._reader.read(draw.years, draw.traces)
        return self._last[1]

    def checked(self, given: Mapping[str, Any], num_envs: int) -> Draw:
        """Return the draw that a saved state contains.

        Raises:
            SdcError: the options of these environments cannot give this draw.
        """
        years, traces = given["years"], given["traces"]
        valid_years = range(self._years) if isinstance(self._years, int) else self._years
        for name, values, valid in (
            ("years", years, valid_years),
            ("traces", traces, self._traces),
        ):
            if valid is None or values is None:
                can_be_drawn = valid is values
            else:
                can_be_drawn = len(values) == num_envs and all(x in valid for x in values)
            if not can_be_drawn:
                raise SdcError(
                    f"state: {name} {shortened(values)}: not drawn by these environments"
                )
        return Draw(years and tuple(years), traces and tuple(traces))


def draws_inputs(options: EnvOptions) -> bool:
    """Return True if episodes draw their year or workload trace at random."""
    return options.years is not None or options.traces is not None


def draw_info(draw: Draw | None) -> dict[str, Any]:
    """Return the drawn inputs as infos: ``year`` and ``trace``, (B,) each, if they are drawn."""
    info: dict[str, I64 | np.ndarray[Any, Any]] = {}
    if draw is not None and draw.years is not None:
        info["year"] = np.array(draw.years, dtype=np.int64)
    if draw is not None and draw.traces is not None:
        info["trace"] = np.array(draw.traces, dtype=object)
    return info


PARTS = ("options", "inputs", "simulator", "actions", "rewards", "generators", "keys")
"""Keys of a saved state. Their values are plain values, arrays, or dicts and lists of these."""
COMMAND_LIMITS = {
    "load": (-1.0, 1.0),
    "cooling": (-MOST_MOVES, MOST_MOVES),
    "fan": (-MOST_MOVES, MOST_MOVES),
    "placement": (1.0 / PLACEMENT_FACTOR, PLACEMENT_FACTOR),
    "battery": (-1.0, 1.0),
    "chilled_water": (FREEZING_C, BOILING_C),
    "transfer": (0.0, 1.0),
    **{name: limits for name, (_, limits) in LIQUID_COMMANDS.items()},
}
"""Minimum and maximum of each command of an agent or a controller, by field of ``Actions``."""


@dataclass(frozen=True, slots=True)
class SavedState:
    """Checked saved state of B environments with U CRAC units and R racks in total."""

    simulator: State
    """State of the simulator before the last step."""
    drivers: Drivers | None
    """Input series of the episodes; None if episodes do not draw their inputs."""
    draw: Draw | None
    """Years and traces of the episodes; None if episodes do not draw their inputs."""
    generators: list[np.random.Generator]
    """Random generator of each environment."""
    keys: I64
    """Seeds of the forecast errors, (B,)."""
    peaks_kw: F64
    """Highest billed power of the episode, before and after the last step, in kW, (2, B)."""
    commands: dict[str, F64] | None
    """Commands of the last step by field of ``Actions``, (), (B,), (U,), (R,) or (B, S) each; None
    before the first step."""


def check_state(
    values: Any,
    *,
    options: Mapping[str, Any],
    inputs: DrawnInputs | None,
    sim: Simulator,
    num_envs: int,
    learned: Sequence[str],
    by_others: Sequence[str],
    steps: int,
) -> SavedState:
    """Check a saved state against the environments that are to continue from it.

    Args:
        values: the saved state, as returned by ``state_dict``.
        options: plain values that identify the environments.
        inputs: source of drawn years and traces; None if episodes do not draw their inputs.
        sim: simulator of the environments.
        num_envs: number of environments, which differs from that of data centers with fleets.
        learned: names of the commands of learning agents; every step sets all of them.
        by_others: names of the commands that the controller ``others`` may set.
        steps: number of steps of an episode.

    Raises:
        SdcError: the state belongs to other environments, is incomplete, or is not valid.
    """
    try:
        parts = {name: values[name] for name in PARTS}
        _check_options(parts["options"], options)
        if len(parts["generators"]) != num_envs:
            raise SdcError(
                f"state: made by {len(parts['generators'])} environments; valid is {num_envs}"
            )
        draw = drivers = None
        if inputs is not None:
            draw = inputs.checked(parts["inputs"], sim.size)
            drivers = inputs.drivers(draw)
        saved = SavedState(
            simulator=sim.read_state(parts["simulator"], drivers),
            drivers=drivers,
            draw=draw,
            generators=[_generator(state) for state in parts["generators"]],
            keys=_checked("keys", parts["keys"], np.int64, [(sim.size,)], 0, 2**63 - 1),
            peaks_kw=_checked(
                "rewards", parts["rewards"], np.float64, [(2, sim.size)], 0, MAX_PEAK_KW
            ),
            commands=_checked_commands(parts["actions"], learned, by_others, sim.fleet),
        )
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise SdcError(
            f"state: {type(error).__name__}: {error}; valid is what state_dict() returned"
        ) from None
    done = saved.simulator.step + (saved.commands is not None)
    if done > steps:
        raise SdcError(f"state: {done} steps; valid is at most {steps}, the episode")
    return saved


def config_keys_of(values: Any, num_envs: int) -> I64:
    """Return the random keys of the drawn configs in a saved state, (E,).

    Raises:
        SdcError: the state has no such keys, because its environments did not draw configs.
    """
    keys = values.get("configs") if isinstance(values, Mapping) else None
    if keys is None:
        raise SdcError("state: made by environments that draw no configs; valid is one of those")
    checked: I64 = _checked("configs", keys, np.int64, [(num_envs,)], 0, 2**63 - 1)
    return checked


def _check_options(made: Mapping[str, Any], mine: Mapping[str, Any]) -> None:
    """Refuse a saved state of environments with other options."""
    for name, value in mine.items():
        if name not in made or made[name] != value:
            raise SdcError(
                f"state: made with {name} {shortened(made.get(name))}; valid is "
                f"{shortened(value)}, as here"
            )


def _generator(state: Any) -> np.random.Generator:
    """Return a random generator in a state that NumPy's ``bit_generator.state`` returned."""
    rng = np.random.Generator(np.random.PCG64(0))
    rng.bit_generator.state = state
    return rng


def _checked_commands(
    saved: Mapping[str, Any] | None, learned: Sequence[str], by_others: Sequence[str], fleet: Fleet
) -> dict[str, F64] | None:
    """Check the saved commands of the last step, (), (B,), (U,), (C,) or (R,) each.

    None stands for a state before the first step. A controller may leave the commands ``cooling``,
    ``placement``, ``chilled_water`` and those of liquid cooling at None; the saved state then lacks
    them.
    """
    if saved is None:
        return None
    names = [*learned, *by_others]
    optional = {"cooling", "placement", "chilled_water", "transfer", *LIQUID_COMMANDS}
    optional = optional.intersection(by_others)
    if not set(names) - optional <= set(saved) <= set(names):
        raise SdcError(
            f"state: actions are {shortened(sorted(saved))}; valid is a dict of {sorted(names)}"
        )
    of_parts: dict[str, tuple[int, ...]] = {
        "cooling": (fleet.units,),
        "fan": (fleet.units,),
        "placement": (fleet.racks,),
        "cdu_setpoint_c": (fleet.cdus,),
        "cdu_flow": (fleet.cdus,),
        "transfer": (fleet.size, fleet.sites_per_fleet),
    }
    return {
        name: _checked(
            f"actions of {name}",
            saved[name],
            np.float64,
            [(), (fleet.size,), of_parts.get(name, (fleet.size,))],
            *COMMAND_LIMITS[name],
        )
        for name in names
        if name in saved
    }


def _checked(
    name: str,
    values: Any,
    dtype: type[np.generic],
    shapes: Sequence[tuple[int, ...]],
    low: float,
    high: float,
) -> Any:
    """Check type, shape and range of an array in a saved state, and return a copy."""
    array = as_array(f"state: {name}", values)
    if array.shape not in shapes or array.dtype != dtype:
        raise SdcError(
            f"state: {name} are {array.dtype} {array.shape}; valid is {dtype.__name__} of "
            f"{' or '.join(map(str, dict.fromkeys(shapes)))}"
        )
    if not np.all((array >= low) & (array <= high)):
        raise SdcError(
            f"state: {name} are {shortened(array.tolist())}; valid is within {low:g}..{high:g}"
        )
    return array.copy()
