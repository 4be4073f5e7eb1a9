"""Recordings of the episodes of environments, one for each episode that is chosen.

``EpisodeRecorder`` says which episodes are recorded and where, as the option ``recorder`` of all
environments; ``RecordEpisodes`` wraps a vector environment to the same effect. Both have a
``Recorder`` (sdc_taichi.viz.recorder) write each episode. ``RecordingCore`` tells it of every step
that a batch does, so a recording is the same whichever standard the environment follows and however
its episodes begin, and nothing that is computed depends on whether it is recorded.
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
from sdc_taichi.viz.recording_output import RecordingWarning, check_path, is_address

if TYPE_CHECKING:
    from sdc_taichi.viz.recorder import Recorder

    _VectorWrapper: TypeAlias = VectorWrapper[Any, Any, Any]
else:
    _VectorWrapper = VectorWrapper  # Gymnasium 1.4 is the first in which it takes parameters.


def capped_cubic_schedule(episode: int) -> bool:
    """Whether an episode is recorded by default: 0, 1, 8, 27 ... and from 1000 on every thousandth.

    Gymnasium's ``RecordVideo`` has the same default.
    """
    return round(episode ** (1 / 3)) ** 3 == episode if episode < 1000 else episode % 1000 == 0


@dataclass(frozen=True, slots=True)
class EpisodeRecorder:
    """Which episodes of which environments are recorded, and where."""

    target: str | os.PathLike[str] | Recorder
    """Where recordings go.

    A file ending in .rrd, of which each episode gets one with its number, ``run-episode-8.rrd`` for
    ``run.rrd``; the address of a viewer, which gets a recording for each; or a ``Recorder``, which
    numbers by itself.
    """
    episode_trigger: Callable[[int], bool] | None = None
    """Tells by its number, from 0, whether an episode is recorded; None is
    ``capped_cubic_schedule``."""
    envs: Sequence[int] | None = None
    """Numbers of up to 4 environments of a batch, recorded side by side; None is the first, or what
    a ``Recorder`` has in focus."""
    every: int | None = None
    """Steps between two heat maps, and between two frames of the 3D hall; None follows the number
    of racks recorded."""


RecorderOption: TypeAlias = "str | os.PathLike[str] | Recorder | EpisodeRecorder | None"
"""Argument ``recorder`` of environments: an ``EpisodeRecorder``, or the target of one."""


class RecordingCore(Core):
    """A batch of data centers whose episodes can be recorded; without a recorder, ``Core``.

    Args:
        configs: configs of data centers; environment i takes config i modulo their number.
        options: what agents do, see and get.
        num_envs: number of environments; None is one per config.
        precision: number type of the server kernels.
        recorder: which episodes are recorded and where; None records nothing.

    Raises:
        SdcError: an argument that is not valid.
    """

    _recordings: _EpisodeRecordings | None = None

    def __init__(
        self,
        configs: Sequence[DataCenterConfig],
        options: EnvOptions,
        num_envs: int | None = None,
        precision: Precision = "f32",
        recorder: RecorderOption = None,
    ) -> None:
        super().__init__(configs, options, num_envs, precision)
        if recorder is not None:
            self.record_episodes(recorder)

    def record_episodes(
        self, recorder: str | os.PathLike[str] | Recorder | EpisodeRecorder
    ) -> None:
        """Record episodes from the next that begins.

        Args:
            recorder: which episodes are recorded and where.

        Raises:
            RuntimeStateError: they are recorded already.
            SdcError: a recorder that is not valid.
        """
        if self._recordings is not None:
            raise RuntimeStateError("recorder: the episodes are recorded already; valid is one")
        if not isinstance(recorder, EpisodeRecorder):
            recorder = EpisodeRecorder(recorder)
        self._recordings = _EpisodeRecordings(recorder, self.sim)

    def _on_begin(self) -> None:
        """Begin the recording of an episode if it is chosen."""
        if self._recordings is not None:
            self._recordings.begin(self.sim)

    def step(self, actions: Mapping[str, Any]) -> Transition:
        """Do a step as ``Core.step`` does, and record it."""
        done = super().step(actions)
        if self._recordings is not None and self._recordings.is_recording:
            self._recordings.add(done.result, self._named_rewards(done))
            if done.ended:
                self._recordings.end()
        return done

    def close(self) -> None:
        """End the recording and release the simulator."""
        if self._recordings is not None:
            self._recordings.end()
        super().close()

    def _named_rewards(self, done: Transition) -> dict[str, F64]:
        """Rewards by learning agent, and the unscaled terms that they are made of, (B,) each."""
        return {**done.rewards, **self._rewards.terms(done.result, self._rewards.used_terms)}


class RecordEpisodes(_VectorWrapper):
    """Records chosen environments of what ``gymnasium.make_vec`` makes for the ids of sdc_taichi.

    ``RecordEpisodes(env, target, ...)`` does the same as ``make_vec`` with
    ``recorder=EpisodeRecorder(target, ...)``. Closing the environment ends the recording.

    Args:
        env: a batch of ``gymnasium.make_vec``, wrapped or not.
        target: where recordings go, as ``EpisodeRecorder.target``.
        episode_trigger: which episodes are recorded, as ``EpisodeRecorder.episode_trigger``.
        envs: which environments are recorded, as ``EpisodeRecorder.envs``.
        every: steps between two heat maps, and between two frames of the 3D hall.

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
        if not (isinstance(env, VectorEnv) and isinstance(core, RecordingCore)):
            raise ConfigError(
                f"env: {type(getattr(env, 'unwrapped', env)).__name__} cannot be recorded here; "
                "valid is a batch of gymnasium.make_vec('sdc_taichi/...') that is one environment "
                "of its own; others take recorder=... when they are made"
            )
        super().__init__(env)
        core.record_episodes(EpisodeRecorder(target, episode_trigger, envs, every))


class _EpisodeRecordings:
    """The recordings of a batch's episodes, one after the other.

    Args:
        settings: which episodes are recorded and where.
        sim: the simulator of the batch.

    Raises:
        SdcError: settings that are not valid.
    """

    def __init__(self, settings: EpisodeRecorder, sim: Simulator) -> None:
        _check(settings, sim.size)
        self._settings = settings
        self._trigger = settings.episode_trigger or capped_cubic_schedule
        self._fleet = sim.fleet
        self._episode = -1
        self._close_recorder: Any = None
        self._recorder: Recorder | None = None
        self._place: Path | Recorder | None = None
        self._make_recorder(0)  # so that a target that is not valid is told before any episode

    @property
    def is_recording(self) -> bool:
        """Whether the present episode is recorded."""
        return self._recorder is not None

    def begin(self, sim: Simulator) -> None:
        """End the episode before, and record the one that has begun if it is chosen.

        Later ones go on without a recording that cannot be opened, after a ``RecordingWarning``.

        Args:
            sim: the simulator of the batch.

        Raises:
            SdcError: the recording of the first episode cannot be opened.
        """
        self.end()
        self._episode += 1
        if not self._trigger(self._episode):
            return
        try:
            recorder = self._make_recorder(self._episode)
            self._claim(recorder)
            recorder.begin(sim)
        except SdcError as error:
            if self._episode == 0:
                raise
            self._warn_without_recording(error)
            return
        self._recorder = recorder
        # Files are made whole at exit too, where nothing closes the environment. Functions run at
        # exit last in, first out: this one before those that Rerun, imported by now, has
        # registered. Rerun imports this module when it needs it, which at exit would be too late.
        importlib.import_module("concurrent.futures.thread")
        self._close_recorder = weakref.finalize(self, recorder.close)
        atexit.register(self._close_recorder)

    def add(self, result: StepResult, rewards: Mapping[str, F64]) -> None:
        """Record a step of the present episode, which is one that is recorded.

        The episode goes on without its recording, after a ``RecordingWarning``, where a step before
        ended in an error of a reward function.

        Args:
            result: the result of the step.
            rewards: rewards and their terms by name, (B,) each.
        """
        assert self._recorder is not None
        try:
            self._recorder.add(result, rewards=rewards)
        except SdcError as error:
            self._warn_without_recording(error)
            self.end()

    def end(self) -> None:
        """End the recording of the present episode, if there is one."""
        if self._close_recorder is not None:
            atexit.unregister(self._close_recorder)
            self._close_recorder()
        _recordings_by_place.pop(self._place, None)
        self._close_recorder = self._recorder = self._place = None

    def _warn_without_recording(self, error: SdcError) -> None:
        """Warn that the present episode is not recorded any further."""
        message = f"{error}; episode {self._episode} goes on without a recording"
        warnings.warn(message, RecordingWarning, stacklevel=3)

    def _claim(self, recorder: Recorder) -> None:
        """Make sure that no other environment of this process writes to the same place."""
        is_given = recorder is self._settings.target
        place = recorder if is_given or recorder.file is None else recorder.file.resolve()
        if place in _recordings_by_place:
            raise SdcError(
                f"{recorder.file or self._settings.target}: another environment is being recorded "
                "there; valid is a place for each"
            )
        _recordings_by_place[place] = self
        self._place = place

    def _make_recorder(self, episode: int) -> Recorder:
        """The recorder of an episode: the one given, or one for the episode's own file."""
        from sdc_taichi.viz.recorder import Recorder, distinct_names

        target, every = self._settings.target, self._settings.every
        if isinstance(target, Recorder):
            return target
        if not is_address(target):
            path = check_path(target)
            target = path.with_name(f"{path.stem}-episode-{episode}{path.suffix}")
        envs = (0,) if self._settings.envs is None else self._settings.envs
        names = distinct_names(self._fleet.names)
        return Recorder(target, focus=[names[i] for i in envs], every=every)


_recordings_by_place: weakref.WeakValueDictionary[Path | Recorder | None, _EpisodeRecordings] = (
    weakref.WeakValueDictionary()
)
"""Files and recorders that environments of this process are being recorded to."""


def _check(settings: EpisodeRecorder, size: int) -> None:
    """Refuse before the first episode what would fail in one.

    Args:
        settings: which episodes are recorded and where.
        size: number of environments.
    """
    from sdc_taichi.viz.recorder import MAX_FOCUS, Recorder

    target, envs, trigger = settings.target, settings.envs, settings.episode_trigger
    if not isinstance(target, str | os.PathLike | Recorder):
        raise ConfigError(
            f"recorder {target!r}: valid is a file ending in .rrd, the address of a viewer, a "
            "Recorder, or an EpisodeRecorder with one of them"
        )
    if isinstance(target, Recorder) and not (envs is None and settings.every is None):
        raise ConfigError("envs, every: without effect on a Recorder, which has its own; leave out")
    if not (trigger is None or callable(trigger)):
        raise ConfigError(f"episode_trigger {trigger!r}: valid is a function of a number")
    if envs is not None:
        are_numbers = isinstance(envs, Sequence) and all(
            isinstance(i, Integral) and not isinstance(i, bool) and 0 <= i < size for i in envs
        )
        if not (are_numbers and 0 < len(envs) <= MAX_FOCUS and len(set(envs)) == len(envs)):
            raise ConfigError(
                f"envs {envs!r}: valid is a list of 1 to {MAX_FOCUS} different numbers of "
                f"0..{size - 1}"
            )
