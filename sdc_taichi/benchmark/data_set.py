"""Data sets for offline learning as they are written, and the returns of their controllers."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sdc_taichi.benchmark.episodes import Collection, Episode, objective_of_optimum


@dataclass(slots=True)
class ControllerReturns:
    """Returns of the episodes of a controller, and sums over their steps."""

    controller: str
    """Name of the controller."""
    returns: list[float] = field(default_factory=list)
    """Sum of the rewards of each episode."""
    steps: int = 0
    """Number of steps of all episodes."""
    changed_commands: float = 0.0
    """Share of the commands that the nearest action gives otherwise, summed over episodes."""
    totals: dict[str, float] = field(default_factory=dict)
    """Sum of each quantity of infos over all steps, by name."""

    def add(self, episode: Episode) -> None:
        """Take an episode into account."""
        self.returns.append(float(episode.rewards.sum()))
        self.steps += len(episode.rewards)
        self.changed_commands += episode.changed_commands
        for name, values in episode.infos.items():
            self.totals[name] = self.totals.get(name, 0.0) + float(values.sum())

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return len(self.returns)

    @property
    def mean_return(self) -> float:
        """Mean over the episodes of the sum of their rewards."""
        return float(np.mean(self.returns))


@dataclass(frozen=True, slots=True)
class DataSet:
    """A data set that has been written."""

    id: str
    """Name in Minari: folders, name and version, such as ``sdc_taichi/corrected-ny-v0``."""
    folder: Path
    """Folder with its card and the folder ``data``."""
    collection: Collection
    """Episodes that the data set holds."""
    idle: ControllerReturns
    """Returns of idle commands, whether their episodes are in it or not."""
    controllers: tuple[ControllerReturns, ...]
    """Returns of the controllers whose episodes are in it, in their order."""

    @property
    def best(self) -> ControllerReturns | None:
        """Returns of the first known optimum that earns more than idle commands, if any."""
        known = (each for each in self.controllers if is_optimum(each.controller))
        return next((each for each in known if each.mean_return > self.idle.mean_return), None)

    def score(self, mean_return: float) -> float | None:
        """Share of the way from idle commands to the known optimum; None without one."""
        if self.best is None:
            return None
        return (mean_return - self.idle.mean_return) / (
            self.best.mean_return - self.idle.mean_return
        )


def is_optimum(controller: str) -> bool:
    """Whether a controller replays the commands of a known optimum."""
    return objective_of_optimum(controller) is not None
