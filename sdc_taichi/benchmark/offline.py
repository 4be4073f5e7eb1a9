"""Data sets for offline learning: episodes of controllers in Minari's format, with a data card."""

from __future__ import annotations

import contextlib
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import closing
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from sdc_taichi.atomic_file import FileClaim, naming_errors
from sdc_taichi.benchmark.data_set import DataSet, card, figures_of, returns_of
from sdc_taichi.benchmark.episodes import IDLE, Collection, Episode, Progress, episodes
from sdc_taichi.errors import ConfigError, SdcError

CARD_FILE = "README.md"
"""File name of the data card, in the same folder as the subfolder ``data`` that Minari reads."""
_DATA = "data"
_SPARE = 2.0
"""Required free disk space before an episode is written, as a multiple of its array size."""
_ID = re.compile(r"[A-Za-z0-9_-]+(/[A-Za-z0-9_-]+)*-v[0-9]+")


def require_minari() -> None:
    """Check that Minari and its HDF5 storage are installed.

    Raises:
        ConfigError: Minari or its HDF5 storage is not installed.
    """
    try:
        import h5py  # noqa: F401
        import minari  # noqa: F401
    except ImportError:
        raise ConfigError(
            "data sets need Minari and h5py, which are not installed: "
            'pip install "sdc-taichi[offline]"'
        ) from None


def data_set_folder(root: Path, data_set: str, *, replace: bool = False) -> Path:
    """Return the folder in which Minari looks for a data set.

    Args:
        root: folder of all data sets, as in ``MINARI_DATASETS_PATH``.
        data_set: name of the data set in Minari.
        replace: True if an existing data set may be replaced.

    Raises:
        ConfigError: the name is not valid, or the folder already exists.
    """
    if not _ID.fullmatch(data_set):
        raise ConfigError(
            f"data set {data_set!r}: valid is a name of letters, digits, _ and -, below folders if "
            "you like, with a version, such as sdc_taichi/corrected-ny-v0"
        )
    folder = root / data_set
    if folder.exists():
        if not (folder / _DATA / "metadata.json").is_file():
            raise ConfigError(f"{folder}: is there and is no data set; valid is another name")
        if not replace:
            raise ConfigError(f"{folder}: exists; choose another name or replace it with --force")
    return folder


def write_data_set(
    collection: Collection,
    root: Path,
    data_set: str,
    *,
    command: str = "",
    replace: bool = False,
    progress: Progress | None = None,
    stop: Callable[[], bool] | None = None,
) -> DataSet:
    """Collect episodes and write them as a Minari data set.

    The data set appears under its name only after it is complete. Idle commands are also run, as
    score 0 of normalised scores; score 1 is the optimum, if it is one of the controllers.

    Args:
        collection: episodes to collect.
        root: folder of all data sets.
        data_set: name of the data set in Minari.
        command: command line that reproduces the data set, for the data card.
        replace: True to replace an existing data set with this name.
        progress: progress callback ``(stage, done, total)``.
        stop: called before every step; if it returns true, ``StoppedError`` is raised.

    Raises:
        SdcError: Minari is missing, a name or an option is not valid, or a file cannot be written.
        StoppedError: ``stop`` returned true; no data set is written.
    """
    require_minari()
    folder = data_set_folder(root, data_set, replace=replace)
    collection.check()
    with _new_folder(folder) as unfinished:
        storage = _new_storage(collection, unfinished / _DATA)
        figures = []
        for name in dict.fromkeys((IDLE, *collection.controllers)):
            for episode in episodes(collection, name, progress=progress, stop=stop):
                figures.append(figures_of(episode))
                if name in collection.controllers:
                    _keep(storage, episode)
        made = DataSet(data_set, folder, collection, returns_of(figures))
        storage.update_metadata(_metadata(made))
        (unfinished / CARD_FILE).write_text(card(made, command), encoding="utf-8")
    return made


@contextlib.contextmanager
def _new_folder(folder: Path) -> Iterator[Path]:
    """Yield a hidden temporary folder, which is renamed to ``folder`` after a block without error.

    Raises:
        SdcError: the folder is not writable, or another process writes to it.
    """
    with naming_errors(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
    claim = FileClaim(folder)
    unfinished = folder.with_name(f".{folder.name}.unfinished")
    try:
        with naming_errors(folder):
            # A killed process may have left an unfinished folder.
            shutil.rmtree(unfinished, ignore_errors=True)
            unfinished.mkdir()
            yield unfinished
            if folder.exists():
                shutil.rmtree(folder)
            unfinished.replace(folder)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
        claim.release()


def _new_storage(collection: Collection, folder: Path) -> Any:
    """Create an empty Minari storage, with the environment in which episodes can be reproduced."""
    from minari.dataset.minari_storage import MinariStorage

    with closing(collection.make_env()) as env:
        # The path must be absolute: Minari computes a size of 0 for a relative path.
        return MinariStorage.new(
            folder.absolute(),
            observation_space=env.observation_space,
            action_space=env.action_space,
            env_spec=env.spec,
            data_format="hdf5",
        )


def _require_space(folder: Path, size: float) -> None:
    """Check the free space of a disk, because HDF5 crashes if the disk is full.

    Args:
        folder: folder on the disk.
        size: required space, in bytes.

    Raises:
        SdcError: the free space is too small.
    """
    free = shutil.disk_usage(folder).free
    if free < size:
        raise SdcError(
            f"{folder}: cannot be written: {size / 1e6:,.0f} MB are needed, {free / 1e6:,.0f} MB "
            "are free"
        )


def _keep(storage: Any, episode: Episode) -> None:
    """Add an episode to a Minari storage."""
    from minari.data_collector.episode_buffer import EpisodeBuffer

    arrays = (episode.observations, episode.actions, episode.rewards, *episode.infos.values())
    _require_space(storage.data_path, _SPARE * sum(array.nbytes for array in arrays))
    steps = len(episode.rewards)
    truncated = np.arange(1, steps + 1) == steps
    number = storage.total_episodes
    storage.update_episodes(
        [
            EpisodeBuffer(
                id=number,
                seed=episode.start.seed,
                options={"start_day": episode.start.day},
                observations=episode.observations,
                actions=episode.actions,
                rewards=episode.rewards,
                terminations=np.zeros(steps, dtype=np.bool_),
                truncations=truncated,
                infos=episode.infos,
            )
        ]
    )
    about = {
        "controller": episode.controller,
        "week": episode.start.week,
        "return": float(episode.rewards.sum()),
        "changed_commands": episode.changed_commands,
    }
    storage.update_episode_metadata([about], [number])


def _metadata(made: DataSet) -> dict[str, Any]:
    """Return the metadata of a data set with the names that Minari uses."""
    names = ", ".join(made.collection.controllers)
    metadata: dict[str, Any] = {
        "dataset_id": made.id,
        "minari_version": version("minari"),
        "algorithm_name": names,
        "description": (
            f"Episodes of a simulated data center ({made.collection.environment_id}) under {names}."
        ),
        "requirements": [f"sdc-taichi=={version('sdc-taichi')}"],
    }
    if made.best is not None:
        metadata |= {
            "ref_min_score": made.mean_return(),
            "ref_max_score": made.mean_return(made.best),
            "num_episodes_average_score": int(made.returns["episodes"][made.best]),
        }
    return metadata
