"""Data sets for offline learning: episodes of controllers in Minari's format, each with a card."""

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
"""Name of the card, which lies beside the folder ``data`` that Minari reads."""
_DATA = "data"
_SPARE = 2.0
"""Space to have before an episode is written, over the size of its arrays."""
_ID = re.compile(r"[A-Za-z0-9_-]+(/[A-Za-z0-9_-]+)*-v[0-9]+")


def require_minari() -> None:
    """Make sure that Minari and its HDF5 storage are there.

    Raises:
        ConfigError: they are not installed.
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
    """Folder of a data set below the folder of all, where Minari looks for it.

    Args:
        root: folder of all data sets, as in ``MINARI_DATASETS_PATH``.
        data_set: its name in Minari.
        replace: whether one that is there may be replaced.

    Raises:
        ConfigError: a name that is not valid, or a folder that is taken.
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
    """Collect episodes and write them as a data set of Minari.

    It appears under its name once it is whole. Idle commands are run too, as the lower end of
    normalised scores; the upper end is the known optimum, where it is one of the controllers.

    Args:
        collection: what is collected.
        root: folder of all data sets.
        data_set: name in Minari.
        command: command line that makes it again, for the card.
        replace: whether a data set of that name is replaced.
        progress: progress callback ``(stage, done, total)``.
        stop: called before every step; true ends the work.

    Raises:
        SdcError: Minari is missing, something is not valid, or a file cannot be written.
        StoppedError: ``stop`` was true; nothing is kept.
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
    """A hidden folder that gets the name of ``folder`` if the block ends without an error.

    Raises:
        SdcError: it cannot be written, or another process writes it.
    """
    with naming_errors(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
    claim = FileClaim(folder)
    unfinished = folder.with_name(f".{folder.name}.unfinished")
    try:
        with naming_errors(folder):
            # Left by a process that was killed.
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
    """An empty storage of Minari, with the environment that its episodes can be done again in."""
    from minari.dataset.minari_storage import MinariStorage

    with closing(collection.make_env()) as env:
        # Minari finds no file below a relative path when it adds up their sizes.
        return MinariStorage.new(
            folder.absolute(),
            observation_space=env.observation_space,
            action_space=env.action_space,
            env_spec=env.spec,
            data_format="hdf5",
        )


def _require_space(folder: Path, size: float) -> None:
    """Make sure that a disk has space, because HDF5 crashes on a full one.

    Args:
        folder: folder that is written to.
        size: what is needed, in bytes.

    Raises:
        SdcError: less is free.
    """
    free = shutil.disk_usage(folder).free
    if free < size:
        raise SdcError(
            f"{folder}: cannot be written: {size / 1e6:,.0f} MB are needed, {free / 1e6:,.0f} MB "
            "are free"
        )


def _keep(storage: Any, episode: Episode) -> None:
    """Add an episode to a storage."""
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
    """Metadata of a data set, as Minari names it."""
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
