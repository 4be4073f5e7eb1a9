"""The folder of a training: what its files are called, and who may write them.

Settings are ``settings.yaml``, curves ``training.csv``, ``validation.csv`` and ``tensorboard``. The
last policy is ``policy``, the one that did best in the validation weeks ``best``, and all that a
resumed training needs is ``checkpoint.safetensors``.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from sdc_taichi.atomic_file import FileClaim, atomic_write, naming_errors
from sdc_taichi.errors import ConfigError
from sdc_taichi.learning.training_settings import TrainingSettings, load_settings
from sdc_taichi.user_file import list_folder

SETTINGS_FILE, CHECKPOINT_FILE = "settings.yaml", "checkpoint.safetensors"
"""Files of a training."""
TRAINING_FILE, VALIDATION_FILE = "training.csv", "validation.csv"
"""Curves of a training."""
LAST_POLICY, BEST_POLICY, EVENTS = "policy", "best", "tensorboard"
"""Folders of a training."""


@contextlib.contextmanager
def claimed(out: Path, settings: TrainingSettings, *, resume: bool) -> Iterator[None]:
    """Keep other processes out of the folder of a training, once it is known to be free.

    Args:
        out: the folder, made if need be.
        settings: settings of the training.
        resume: whether it is to hold a training with these settings.

    Raises:
        SdcError: it holds other files, no training or one with other settings, another process
            trains there, or nothing can be written there.
    """
    with naming_errors(out):
        if out.exists() and not out.is_dir():
            raise ConfigError(f"{out}: is a file; valid is a folder to write a training to")
        if not resume:
            out.mkdir(parents=True, exist_ok=True)
        others = [name for name in list_folder(out) if not name.startswith(".")]
    if resume:
        different = settings_of(out).difference(settings)
        if different is not None:
            raise ConfigError(
                f"{out}: was trained with {different}; valid is to resume with its settings, or "
                "another folder"
            )
    elif SETTINGS_FILE in others:
        raise ConfigError(
            f"{out}: holds a training; go on with it with --resume, or choose another folder"
        )
    elif others:
        some = ", ".join(others[:3]) + (", ..." if len(others) > 3 else "")
        raise ConfigError(f"{out}: holds other files ({some}); choose an empty folder with --out")
    claim = FileClaim(out / "training")
    try:
        yield
    finally:
        claim.release()


def write_settings(folder: Path, settings: TrainingSettings) -> None:
    """Write the settings of the training in a folder, which holds a training from then on.

    Raises:
        SdcError: the file cannot be written.
    """
    with atomic_write(folder / SETTINGS_FILE) as file:
        file.write(settings.to_yaml().encode())


def settings_of(folder: Path) -> TrainingSettings:
    """Settings of the training in a folder.

    Raises:
        ConfigError: there is none, or they are not valid.
    """
    if not (folder / SETTINGS_FILE).is_file():
        raise ConfigError(f"{folder}: holds no training; valid is a folder that train has written")
    return load_settings(folder / SETTINGS_FILE)
