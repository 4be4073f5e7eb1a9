"""Reinforcement learning: the algorithms of the SustainDC paper, trainings, and trained policies.

An algorithm acts in a stream of environments, learns from the transitions, and returns networks. A
policy consists of these networks and of the observation and action interface that they need.
``controller.py`` runs a policy as a controller. Training needs PyTorch; running a policy does not.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sdc_taichi.errors import ConfigError

if TYPE_CHECKING:
    from sdc_taichi.learning.trainer import train
    from sdc_taichi.learning.training_settings import TrainingSettings

__all__ = ["TrainingSettings", "require_torch", "train"]

_LAZY = {
    "TrainingSettings": "sdc_taichi.learning.training_settings",
    "train": "sdc_taichi.learning.trainer",
}


def require_torch() -> None:
    """Check that PyTorch is installed.

    Raises:
        ConfigError: PyTorch is not installed.
    """
    try:
        import torch  # noqa: F401
    except ImportError:
        raise ConfigError(
            'training needs PyTorch, which is not installed: pip install "sdc-taichi[train]"'
        ) from None


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name == "train":
        require_torch()
    globals()[name] = value = getattr(import_module(_LAZY[name]), name)
    return value
