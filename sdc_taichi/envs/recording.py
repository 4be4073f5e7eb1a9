"""Recordings of chosen episodes of environments.

Option ``recorder`` of all environments takes an ``EpisodeRecorder``, the choice of episodes and
their destination; wrapper ``RecordEpisodes`` does the same for vector environments. A ``Recorder``
(sdc_taichi.viz.recorder) writes each episode. ``Core`` passes it every step of the batch, so
recordings do not depend on the interface of the environment, and results do not depend on whether
they are recorded.
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

from sdc_taichi.errors import ConfigError, SdcError
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F64, StepResult
from sdc_taichi.viz.recording_output import RecordingWarning, check_path, is_address

if TYPE_CHECKING:
    from sdc_taichi.viz.recorder import Recorder


def capped_cubic_schedule(episode: int) -> bool:
    """Whether an episode is recorded by default: 0, 1, 8, 27, ..., 1000, 2000, 3000, ...

    Gymnasium's ``RecordVideo`` has the same default.
    """
    return round(episode ** (1 / 3)) ** 3 == episode if episode < 1000 else episode % 1000 == 0


@dataclass(frozen=True, slots=True)
class EpisodeRecorder:
    """Choice of the recorded episodes and environments, and their destination."""

    target: str | os.PathLike[str] | Recorder
    """Destination of the recordings.

    Either a path ending in .rrd, to whose name each file adds the number of its episode
    (``run-episode-8.rrd`` for ``run.rrd``); the address of a viewer; or a ``Recorder``, which
    numbers its own files.
    """
    episode_trigger: Callable[[int], bool] | None = None
    """Function of the episode's number, from 0, that decides whether to record it; None is
    ``capped_cubic_schedule``."""
    envs: Sequence[int] | None = None
    """Indices of up to 4 environments of a batch, recorded together; None is the first, or the
    focus of a given ``Recorder``."""
    every: int | None = None
    """Steps between two heat maps, and between two frames of the 3D hall; None chooses by the
    number of recorded racks."""


RecorderOption: TypeAlias = "str | os.PathLike[str] | Recorder | EpisodeRecorder | None"
"""Argument ``recorder`` of environments: an ``EpisodeRecorder``, or the target of one."""


class EpisodeRecordings:
    """Successive recordings of a batch's episodes.

    Args:
        recorder: chosen episodes and destination, or a destination.
        sim: the simulator of the batch.

    Raises:
        SdcError: a recorder that is not valid.
    """

    def __init__(
        self, recorder: str | os.PathLike[str] | Recorder | EpisodeRecorder, sim: Simulator
    ) -> None:
        settings = recorder if isinstance(recorder, EpisodeRecorder) else EpisodeRecorder(recorder)
        _check(settings, sim.size)
        self._settings = settings
        self._trigger = settings.episode_trigger or capped_cubic_schedule
        self._fleet = sim.fleet
        self._episode = -1
        self._close_recorder: Any = None
        self._recorder: Recorder | None = None
        self._place: Path | Recorder | None = None
        self._make_recorder(0)  # reports an invalid target before any episode

    @property
    def is_recording(self) -> bool:
        """Whether the present episode is recorded."""
        return self._recorder is not None

    def begin(self, sim: Simulator) -> None:
        """End the previous recording, and begin one of the new episode if it is chosen.

        If the recording of a later episode cannot be opened, the episode continues without it after
        a ``RecordingWarning``.

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
        # Complete the file at exit if nothing closes the environment. Exit functions run last in,
        # first out, so this one precedes those that Rerun registered at its import. Rerun imports
        # concurrent.futures.thread only when it needs it, which at exit would be too late.
        importlib.import_module("concurrent.futures.thread")
        self._close_recorder = weakref.finalize(self, recorder.close)
        atexit.register(self._close_recorder)

    def add(self, result: StepResult, rewards: Mapping[str, F64]) -> None:
        """Record a step of the present episode, which has a recording.

        If an earlier step is missing after an error of a reward function, the episode continues
        without its recording after a ``RecordingWarning``.

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
        """Warn that the recording of the present episode ends."""
        message = f"{error}; episode {self._episode} goes on without a recording"
        warnings.warn(message, RecordingWarning, stacklevel=3)

    def _claim(self, recorder: Recorder) -> None:
        """Reserve the destination, unless another environment of this process writes there."""
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
        """Recorder of an episode: the given one, or a new one for the file of the episode."""
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


_recordings_by_place: weakref.WeakValueDictionary[Path | Recorder | None, EpisodeRecordings] = (
    weakref.WeakValueDictionary()
)
"""Recordings in progress in this process, by file or given recorder."""


def _check(settings: EpisodeRecorder, size: int) -> None:
    """Check settings of a batch of ``size`` environments before the first episode."""
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
