"""Recordings of selected episodes of environments.

The argument ``recorder`` of all environments takes an ``EpisodeRecorder``, which selects episodes
and names the destination. The wrapper ``RecordEpisodes`` does the same for vector environments. A
``Recorder`` (sdc_taichi.viz.recorder) writes each episode. ``Core`` passes every step of the batch
to the recorder, so recordings are the same for all interfaces of an environment. Recording does
not change the results of an episode.
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
    """Return True for the episodes recorded by default: 0, 1, 8, 27, ..., 1000, 2000, 3000, ...

    Gymnasium's ``RecordVideo`` has the same default.
    """
    return round(episode ** (1 / 3)) ** 3 == episode if episode < 1000 else episode % 1000 == 0


@dataclass(frozen=True, slots=True)
class EpisodeRecorder:
    """Selects the episodes and environments to record, and names the destination."""

    target: str | os.PathLike[str] | Recorder
    """Destination of the recordings: a path, the address of a viewer, or a ``Recorder``.

    A path ends in .rrd. Each file adds the number of its episode to the name, such as
    ``run-episode-8.rrd`` for ``run.rrd``. A ``Recorder`` numbers its own files.
    """
    episode_trigger: Callable[[int], bool] | None = None
    """Function of an episode's number, from 0, that returns True to record the episode; None means
    ``capped_cubic_schedule``."""
    envs: Sequence[int] | None = None
    """Indices of up to 4 environments of a batch, recorded together. None records the first
    environment, or the environments that a ``Recorder`` as target focuses on."""
    every: int | None = None
    """Number of steps between two heat maps, and between two frames of the 3D hall. None chooses
    the number by the number of recorded racks."""


RecorderOption: TypeAlias = "str | os.PathLike[str] | Recorder | EpisodeRecorder | None"
"""Type of the argument ``recorder`` of environments: an ``EpisodeRecorder``, the target of one, or
None for no recordings."""


class EpisodeRecordings:
    """Records the selected episodes of a batch, one after the other.

    Args:
        recorder: selected episodes and destination, or only a destination.
        sim: the simulator of the batch.

    Raises:
        SdcError: the recorder is not valid.
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
        self._make_recorder(0)  # An invalid target must fail here, before any episode.

    @property
    def is_recording(self) -> bool:
        """True if the current episode is recorded."""
        return self._recorder is not None

    def begin(self, sim: Simulator) -> None:
        """End the previous recording, and start one of the new episode if it is selected.

        If the recording cannot be opened, the first episode fails. A later episode continues
        without a recording after a ``RecordingWarning``.

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
        # Complete the file at exit if the user does not close the environment. Exit functions run
        # in reverse order of registration, so this one runs before those that Rerun registered at
        # its import. Rerun imports concurrent.futures.thread lazily, which fails during exit.
        importlib.import_module("concurrent.futures.thread")
        self._close_recorder = weakref.finalize(self, recorder.close)
        atexit.register(self._close_recorder)

    def add(self, result: StepResult, rewards: Mapping[str, F64]) -> None:
        """Record a step of the current episode, whose recording must be in progress.

        An error in a user's reward function can leave a step unrecorded. The next call then ends
        the recording with a ``RecordingWarning``, and the episode continues without it.

        Args:
            result: the result of the step.
            rewards: rewards and reward terms by name, (B,) each.
        """
        assert self._recorder is not None
        try:
            self._recorder.add(result, rewards=rewards)
        except SdcError as error:
            self._warn_without_recording(error)
            self.end()

    def end(self) -> None:
        """End the recording of the current episode, if there is one."""
        if self._close_recorder is not None:
            atexit.unregister(self._close_recorder)
            self._close_recorder()
        _recordings_by_place.pop(self._place, None)
        self._close_recorder = self._recorder = self._place = None

    def _warn_without_recording(self, error: SdcError) -> None:
        """Warn that the current episode continues without a recording."""
        message = f"{error}; episode {self._episode} goes on without a recording"
        warnings.warn(message, RecordingWarning, stacklevel=3)

    def _claim(self, recorder: Recorder) -> None:
        """Reserve the destination; fail if another environment of this process writes to it."""
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
        """Return the recorder of an episode: the user's, or a new one for the episode's file."""
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
"""All recordings in progress in this process, by file or by the user's recorder."""


def _check(settings: EpisodeRecorder, size: int) -> None:
    """Check the settings for a batch of ``size`` environments before the first episode."""
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
