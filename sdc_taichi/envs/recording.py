"""Recordings of the episodes of environments, a file for each that is chosen.

The core of a batch tells of every step that it does, so a recording is the same whichever standard
the environment follows and however its episodes begin, and nothing that it computes depends on
whether it is recorded.
"""

from __future__ import annotations

import atexit
import importlib
import os
import warnings
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from gymnasium.vector import VectorEnv, VectorWrapper

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.envs.core import Core, Transition
from sdc_taichi.envs.options import EnvOptions
from sdc_taichi.errors import ConfigError, RuntimeStateError, SdcError
from sdc_taichi.sim.hall_solver import Precision
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F64, StepResult
from sdc_taichi.viz.streams import RecordingWarning, check_path, is_address

if TYPE_CHECKING:
    from sdc_taichi.viz.recorder import Recorder


def cubes(episode: int) -> bool:
    """Whether an episode is recorded by default: 0, 1, 8, 27 ... and from 1000 on every thousandth.

    Gymnasium's ``RecordVideo`` has the same default.
    """
    return round(episode ** (1 / 3)) ** 3 == episode if episode < 1000 else episode % 1000 == 0


@dataclass(frozen=True, slots=True)
class EpisodeRecorder:
    """Which episodes of which environments are recorded, and where.

    Args:
        target: a file ending in .rrd, of which each episode gets one with its number,
            ``run-episode-8.rrd`` for ``run.rrd``; the address of a viewer, which gets a recording
            for each; or a ``Recorder``, which numbers by itself.
        episode_trigger: tells by its number, from 0, whether an episode is recorded; None is
            ``cubes``.
        envs: numbers of up to 4 environments of a batch, recorded side by side; None is the first,
            or what a ``Recorder`` has in focus.
        every: steps between two heat maps, as ``Recorder`` takes it.
    """

    target: str | os.PathLike[str] | Recorder
    episode_trigger: Callable[[int], bool] | None = None
    envs: Sequence[int] | None = None
    every: int | None = None


Recording: TypeAlias = "str | os.PathLike[str] | Recorder | EpisodeRecorder | None"
"""What environments take as ``recorder``: a target of ``EpisodeRecorder`` or one with settings."""


class RecordedCore(Core):
    """Data centers whose episodes can be recorded; without a recorder nothing else than ``Core``.

    Args:
        configs: configs of data centers; environment i takes config i modulo their number.
        options: what agents do, see and get.
        num_envs: number of environments; None is one per config.
        precision: of the server kernels.
        recorder: a target of ``EpisodeRecorder``, or one with its settings; None records nothing.

    Raises:
        SdcError: an argument that is not valid.
    """

    _episodes: _Episodes | None = None

    def __init__(
        self,
        configs: Sequence[DataCenterConfig],
        options: EnvOptions,
        num_envs: int | None = None,
        precision: Precision = "f32",
        recorder: Recording = None,
    ) -> None:
        super().__init__(configs, options, num_envs, precision)
        if recorder is not None:
            self.record(recorder)

    def record(self, recorder: str | os.PathLike[str] | Recorder | EpisodeRecorder) -> None:
        """Record episodes from the next that begins.

        Raises:
            RuntimeStateError: they are recorded already.
            SdcError: a recorder that is not valid.
        """
        if self._episodes is not None:
            raise RuntimeStateError("recorder: the episodes are recorded already; valid is one")
        given = recorder if isinstance(recorder, EpisodeRecorder) else EpisodeRecorder(recorder)
        self._episodes = _Episodes(given, self.sim)

    def _begin(self) -> None:
        super()._begin()
        if self._episodes is not None:
            self._episodes.begin(self.sim)

    def step(self, actions: Mapping[str, Any]) -> Transition:
        """As ``Core.step``, and record the step."""
        done = super().step(actions)
        if self._episodes is not None and self._episodes.recording:
            self._episodes.add(done.result, self._rewards_by_name(done))
            if done.ended:
                self._episodes.end()
        return done

    def close(self) -> None:
        """End the recording and let go of the simulator."""
        if self._episodes is not None:
            self._episodes.end()
        super().close()

    def _rewards_by_name(self, done: Transition) -> dict[str, F64]:
        """Rewards by learning agent, and the terms that they are made of, unscaled, by name."""
        return {**done.rewards, **self._rewards.terms(done.result, self._rewards.used_terms)}


class RecordEpisodes(VectorWrapper[Any, Any, Any]):
    """Records chosen environments of what ``gymnasium.make_vec`` gives for the ids of sdc_taichi.

    The same as ``make_vec(..., recorder=EpisodeRecorder(target, ...))``. Closing the environment
    ends the recording.

    Args:
        env: a batch of ``gymnasium.make_vec``, wrapped or not.
        target: as ``EpisodeRecorder`` takes it, and so are the others.
        episode_trigger: which episodes.
        envs: which environments.
        every: steps between two heat maps.

    Raises:
        SdcError: an environment of another kind, or an argument that is not valid.
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        target: str | os.PathLike[str] | Recorder,
        *,
        episode_trigger: Callable[[int], bool] | None = None,
        envs: Sequence[int] | None = None,
        every: int | None = None,
    ) -> None:
        core = getattr(getattr(env, "unwrapped", None), "core", None)
        if not (isinstance(env, VectorEnv) and isinstance(core, RecordedCore)):
            raise ConfigError(
                f"env: {type(getattr(env, 'unwrapped', env)).__name__} cannot be recorded here; "
                "valid is a batch of gymnasium.make_vec('sdc_taichi/...') that is one environment "
                "of its own; others take recorder=... when they are made"
            )
        super().__init__(env)
        core.record(EpisodeRecorder(target, episode_trigger, envs, every))


class _Episodes:
    """The recordings of a batch's episodes, one after the other."""

    def __init__(self, given: EpisodeRecorder, sim: Simulator) -> None:
        _check(given, sim.size)
        self._given = given
        self._trigger = cubes if given.episode_trigger is None else given.episode_trigger
        self._fleet = sim.fleet
        self._episode = -1
        self._closing: Any = None
        self._recorder: Recorder | None = None
        self._place: Path | Recorder | None = None
        self._recorder_of(0)  # so that a target that is not valid is told before the first episode

    @property
    def recording(self) -> bool:
        """Whether the present episode is recorded."""
        return self._recorder is not None

    def begin(self, sim: Simulator) -> None:
        """An episode has begun, and the one before is over.

        Later ones go on without a recording that cannot be opened, after a ``RecordingWarning``.

        Raises:
            SdcError: the recording of the first episode cannot be opened.
        """
        self.end()
        self._episode += 1
        if not self._trigger(self._episode):
            return
        try:
            recorder = self._recorder_of(self._episode)
            self._claim(recorder)
            recorder.begin(sim)
        except SdcError as error:
            if self._episode == 0:
                raise
            self._go_without(error)
            return
        self._recorder = recorder
        # Whole files also where nothing closes the environment. What runs at exit does so last in,
        # first out: this before what Rerun, imported by now, has registered. Rerun imports this
        # module when it needs it, which at exit would be too late.
        importlib.import_module("concurrent.futures.thread")
        self._closing = weakref.finalize(self, recorder.close)
        atexit.register(self._closing)

    def add(self, result: StepResult, rewards: Mapping[str, F64]) -> None:
        """A step of the present episode, which is recorded.

        The episode goes on without its recording, after a ``RecordingWarning``, where a step before
        ended in an error of a reward function.
        """
        assert self._recorder is not None
        try:
            self._recorder.add(result, rewards=rewards)
        except SdcError as error:
            self._go_without(error)
            self.end()

    def end(self) -> None:
        """The present episode is over."""
        if self._closing is not None:
            atexit.unregister(self._closing)
            self._closing()
        _places.pop(self._place, None)
        self._closing = self._recorder = self._place = None

    def _go_without(self, error: SdcError) -> None:
        told = f"{error}; episode {self._episode} goes on without a recording"
        warnings.warn(told, RecordingWarning, stacklevel=3)

    def _claim(self, recorder: Recorder) -> None:
        """Make sure that no other environment of this process writes to the same place."""
        given = recorder is self._given.target
        place = recorder if given or recorder.file is None else recorder.file.resolve()
        if place in _places:
            raise SdcError(
                f"{recorder.file or self._given.target}: another environment is being recorded "
                "there; valid is a place for each"
            )
        _places[place] = self
        self._place = place

    def _recorder_of(self, episode: int) -> Recorder:
        from sdc_taichi.viz.recorder import Recorder, distinct

        target, every = self._given.target, self._given.every
        if isinstance(target, Recorder):
            return target
        if not is_address(target):
            path = check_path(target)
            target = path.with_name(f"{path.stem}-episode-{episode}{path.suffix}")
        envs = (0,) if self._given.envs is None else self._given.envs
        names = distinct(self._fleet.names)
        return Recorder(target, focus=[names[i] for i in envs], every=every)


_places: weakref.WeakValueDictionary[Path | Recorder | None, _Episodes] = (
    weakref.WeakValueDictionary()
)
"""Who is recording where."""


def _check(given: EpisodeRecorder, size: int) -> None:
    """Refuse before the first episode what would fail in one."""
    from sdc_taichi.viz.recorder import MAX_FOCUS, Recorder

    target, envs, trigger = given.target, given.envs, given.episode_trigger
    if not isinstance(target, str | os.PathLike | Recorder):
        raise ConfigError(
            f"recorder {target!r}: valid is a file ending in .rrd, the address of a viewer, a "
            "Recorder, or an EpisodeRecorder with one of them"
        )
    if isinstance(target, Recorder) and not (envs is None and given.every is None):
        raise ConfigError("envs, every: without effect on a Recorder, which has its own; leave out")
    if not (trigger is None or callable(trigger)):
        raise ConfigError(f"episode_trigger {trigger!r}: valid is a function of a number")
    if envs is not None:
        numbers = isinstance(envs, Sequence) and all(
            isinstance(i, Integral) and not isinstance(i, bool) and 0 <= i < size for i in envs
        )
        if not (numbers and 0 < len(envs) <= MAX_FOCUS and len(set(envs)) == len(envs)):
            raise ConfigError(
                f"envs {envs!r}: valid is a list of 1 to {MAX_FOCUS} different numbers of "
                f"0..{size - 1}"
            )
