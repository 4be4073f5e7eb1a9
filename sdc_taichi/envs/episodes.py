"""Seeds, first days, drawn inputs and saved states of episodes."""

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
from sdc_taichi.sim.drivers import Drivers, InputReader
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.sim.snapshot import as_array
from sdc_taichi.sim.step_inputs import MOST_MOVES
from sdc_taichi.types import F64, I64, State

Seed = int | Sequence[int | None] | I64 | None
"""Seed of environment 0, to which environment i adds i; or one for each environment, of which None
goes on with the generator that is there; or None for all."""


def seeded_generators(
    seed: Seed, present: Sequence[np.random.Generator], num_envs: int
) -> list[np.random.Generator]:
    """A generator for each environment, by its seed or the present one.

    Args:
        seed: environment i takes ``seed + i``, or entry i.
        present: generators of the episode before; none before the first.
        num_envs: number of environments.

    Raises:
        ConfigError: a seed that is not valid, or another number of them than of environments.
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


def chosen_start_days(given: Any, num_envs: int) -> I64:
    """First day of each episode, counted from 0 in the year, (B,).

    Args:
        given: a day as ``MM-DD`` or counted from 0, or one for each environment.
        num_envs: number of environments.

    Raises:
        ConfigError: a day that is not valid, or another number of them than of environments.
    """
    if isinstance(given, np.ndarray) and given.ndim == 0:
        given = given[()]
    several = isinstance(given, list | tuple | np.ndarray)
    days = np.array([_checked_day(day) for day in (given if several else [given])], dtype=np.int64)
    if len(days) not in (1, num_envs):
        raise ConfigError(f"start_day: {len(days)} days for {num_envs} environments")
    return np.broadcast_to(days, (num_envs,))


def _checked_seed(seed: Any) -> int:
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed < 2**63:
        raise ConfigError(f"seed {seed!r}: valid is an integer of 0..2**63 - 1")
    return int(seed)


def _checked_day(day: Any) -> int:
    """Day of the year, 0..364."""
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
    """Inputs of the episodes of B environments."""

    years: tuple[int, ...] | None
    """Seed of the synthetic series of each environment, B; None is ``site.seed``."""
    traces: tuple[str, ...] | None
    """Workload trace of each environment, B; None is what the config names."""


class DrawnInputs:
    """Draws years and traces of episodes, and reads them.

    Args:
        configs: config of each environment, B.
        options: what episodes draw from.

    Raises:
        ConfigError: years of data centers without a synthetic series, or an unknown trace.
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
        """Inputs that the configs name, by which devices are sized."""
        return self._reader.read()

    def draw(self, generators: Sequence[np.random.Generator]) -> Draw:
        """Year and trace of the next episodes.

        Args:
            generators: that of each environment, of which the same numbers are drawn whatever the
                options.
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
        """Inputs of a draw; the same object while the draws are the same."""
        if self._last is None or self._last[0] != draw:
            self._last = draw, self._reader.read(draw.years, draw.traces)
        return self._last[1]

    def checked(self, given: Any, num_envs: int) -> Draw:
        """The draw that a saved state names.

        Raises:
            SdcError: a draw that these options cannot give.
        """
        names = {"years", "traces"}
        if not isinstance(given, Mapping) or set(given) != names:
            raise SdcError("state: inputs are not valid; valid is what state_dict() gave")
        years, traces = given["years"], given["traces"]
        for name, values, valid in (
            ("years", years, range(self._years) if isinstance(self._years, int) else self._years),
            ("traces", traces, self._traces),
        ):
            if valid is None or values is None:
                good = valid is values
            else:
                listed = isinstance(values, list | tuple) and len(values) == num_envs
                good = listed and all(type(x) is type(valid[0]) and x in valid for x in values)
            if not good:
                raise SdcError(
                    f"state: {name} {shortened(values)}: not drawn by these environments"
                )
        return Draw(None if years is None else tuple(years), traces and tuple(traces))


def draws_inputs(options: EnvOptions) -> bool:
    """Whether episodes draw years or traces."""
    return options.years is not None or options.traces is not None


def draw_info(draw: Draw | None) -> dict[str, Any]:
    """Infos of a draw: ``year`` and ``trace``, (B,) each, as far as they are drawn."""
    info: dict[str, I64 | np.ndarray[Any, Any]] = {}
    if draw is not None and draw.years is not None:
        info["year"] = np.array(draw.years, dtype=np.int64)
    if draw is not None and draw.traces is not None:
        info["trace"] = np.array(draw.traces, dtype=object)
    return info


PARTS = ("options", "inputs", "simulator", "actions", "rewards", "generators", "keys")
"""Entries of a state; all are plain values, arrays, or dicts and lists of them."""
COMMAND_LIMITS = {
    "load": (-1.0, 1.0),
    "cooling": (-MOST_MOVES, MOST_MOVES),
    "fan": (-MOST_MOVES, MOST_MOVES),
    "placement": (1.0 / PLACEMENT_FACTOR, PLACEMENT_FACTOR),
    "battery": (-1.0, 1.0),
}
"""Lowest and highest command that an agent or a controller can give, by field of ``Actions``."""
_MAY_BE_NONE = frozenset({"cooling", "placement"})
"""Fields of ``Actions`` that a controller may leave at None."""


@dataclass(frozen=True, slots=True)
class SavedState:
    """Parts of a state of B environments with U CRAC units and R racks, checked."""

    simulator: State
    """State of the simulator before the last step."""
    drivers: Drivers | None
    """Inputs of the episodes; None if they draw none."""
    draw: Draw | None
    """Years and traces of the episodes; None if they draw none."""
    generators: list[np.random.Generator]
    """Generator of each environment, which draws its episodes."""
    keys: I64
    """Seeds of the errors of forecasts, (B,)."""
    peaks_kw: F64
    """Highest billed power before the last step and with it, in kW, (2, B)."""
    commands: dict[str, F64] | None
    """Commands of the last step by field of ``Actions``, (), (B,), (U,) or (R,) each; None before
    the first."""


def check_state(
    values: Any,
    *,
    options: Mapping[str, Any],
    inputs: DrawnInputs | None,
    sim: Simulator,
    learned: Sequence[str],
    by_others: Sequence[str],
    steps: int,
) -> SavedState:
    """Check a state against the environments that will continue from it.

    Args:
        values: what ``state_dict`` gave.
        options: plain values that tell the environments apart.
        inputs: what draws their years and traces; None if nothing does.
        sim: their simulator.
        learned: names of the commands that agents learn, which each of their steps has.
        by_others: names of the commands that ``others`` may give.
        steps: number of steps of an episode.

    Raises:
        SdcError: made by other environments, incomplete, or not valid.
    """
    _check_parts(values, sim.size)
    _check_options(values["options"], options)
    draw = drivers = None
    if inputs is not None:
        draw = inputs.checked(values["inputs"], sim.size)
        drivers = inputs.drivers(draw)
    elif values["inputs"] is not None:
        raise SdcError("state: inputs were drawn; valid is None, as these environments draw none")
    state = sim.read_state(values["simulator"], drivers)
    given = _checked_commands(values["actions"], learned, by_others, sim.fleet)
    if given is None and state.step > 0:
        raise SdcError(f"state: no actions after {state.step} steps; valid is before the first")
    done = state.step + (given is not None)
    if done > steps:
        raise SdcError(f"state: {done} steps; valid is at most {steps}, the episode")
    steps_per_day = 24 * sim.fleet.steps_per_hour
    first_days, rest = np.divmod(state.start, steps_per_day)
    if np.any(rest) or np.any(first_days >= DAYS_PER_YEAR):
        raise SdcError(
            f"state: simulator starts in step {shortened(state.start.tolist())} of the year; "
            f"valid is midnight, a multiple of {steps_per_day}, of one of {DAYS_PER_YEAR} days"
        )
    keys = as_array("state: keys", values["keys"])
    if keys.shape != (sim.size,) or keys.dtype != np.int64 or keys.min() < 0:
        raise SdcError(f"state: keys are {keys.dtype} {keys.shape}; valid is int64 from 0 on")
    return SavedState(
        simulator=state,
        drivers=drivers,
        draw=draw,
        generators=[_checked_generator(x, i) for i, x in enumerate(values["generators"])],
        keys=keys.copy(),
        peaks_kw=_checked_peaks_kw(values["rewards"], sim.size),
        commands=given,
    )


def _check_parts(values: Any, num_envs: int) -> None:
    """Refuse a state whose parts are missing, unknown or of another type."""
    if not isinstance(values, Mapping):
        raise SdcError(f"state: is a {type(values).__name__}; valid is what state_dict() gave")
    if set(values) != set(PARTS):
        raise SdcError(
            f"state: parts are {shortened(sorted(map(str, values)))}; valid is {sorted(PARTS)}"
        )
    for name, kind in (("options", Mapping), ("simulator", Mapping), ("generators", list)):
        if not isinstance(values[name], kind):
            raise SdcError(f"state: {name} is a {type(values[name]).__name__}")
    made_by = len(values["generators"])
    if made_by != num_envs:
        raise SdcError(f"state: made by {made_by} environments; valid is {num_envs}")


def _check_options(made: Mapping[str, Any], mine: Mapping[str, Any]) -> None:
    """Refuse a state that was made with other options."""
    for name, value in mine.items():
        if name not in made or not _is_equal(made[name], value):
            raise SdcError(
                f"state: made with {name} {shortened(made.get(name))}; valid is "
                f"{shortened(value)}, as here"
            )


def _is_equal(one: Any, other: Any) -> bool:
    """Whether two option values are equal; text equals text alone."""
    try:
        return bool(one == other)
    except ValueError:  # arrays
        return False


def _checked_generator(state: Any, index: int) -> np.random.Generator:
    """The generator of an environment in the state that NumPy gave."""
    rng = np.random.Generator(np.random.PCG64(0))
    try:
        rng.bit_generator.state = state
    except (TypeError, ValueError, KeyError, OverflowError):
        raise SdcError(
            f"state: generator {index} is not valid ({shortened(state)}); valid is the state of a "
            "PCG64 of NumPy"
        ) from None
    return rng


def _checked_peaks_kw(given: Any, num_envs: int) -> F64:
    """Highest billed power before the last step and with it, in kW, (2, B)."""
    peaks_kw = as_array("state: rewards", given)
    if peaks_kw.shape != (2, num_envs) or peaks_kw.dtype != np.float64:
        raise SdcError(
            f"state: rewards are {peaks_kw.dtype} {peaks_kw.shape}; valid is float64 (2, "
            f"{num_envs})"
        )
    if not np.all((peaks_kw >= 0.0) & (peaks_kw <= MAX_PEAK_KW)):
        raise SdcError(
            f"state: rewards are {shortened(peaks_kw.tolist())}; valid is powers of "
            f"0..{MAX_PEAK_KW:g} kW"
        )
    return peaks_kw.copy()


def _checked_commands(
    given: Any, learned: Sequence[str], by_others: Sequence[str], fleet: Fleet
) -> dict[str, F64] | None:
    """Commands of the last step, (), (B,), (U,) or (R,) each; None before the first step."""
    if given is None:
        return None
    names = [*learned, *by_others]
    optional = _MAY_BE_NONE.intersection(by_others)
    if not isinstance(given, Mapping) or not set(names) - optional <= set(given) <= set(names):
        found = sorted(map(str, given)) if isinstance(given, Mapping) else given
        raise SdcError(
            f"state: actions are {shortened(found)}; valid is a dict of {sorted(names)}, or None "
            "before the first step"
        )
    return {name: _checked_command(name, given[name], fleet) for name in names if name in given}


def _checked_command(name: str, given: Any, fleet: Fleet) -> F64:
    """A command of the last step."""
    values = as_array(f"state: actions of {name}", given)
    of_parts = {"cooling": fleet.units, "fan": fleet.units, "placement": fleet.racks}
    shapes = [(), (fleet.size,)] + ([(of_parts[name],)] if name in of_parts else [])
    if values.shape not in shapes or values.dtype != np.float64:
        raise SdcError(
            f"state: actions of {name} are {values.dtype} {values.shape}; valid is float64 of "
            f"{' or '.join(map(str, shapes))}"
        )
    low, high = COMMAND_LIMITS[name]
    if not np.all((values >= low) & (values <= high)):
        raise SdcError(
            f"state: actions of {name} are {shortened(values.tolist())}; valid is within "
            f"{low:g}..{high:g}"
        )
    return values.copy()
