"""Description of a data set for offline learning: returns of its controllers, and data card."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sdc_taichi.benchmark.episodes import IDLE, Collection, Episode, objective_of_optimum
from sdc_taichi.benchmark.jobs import input_paths
from sdc_taichi.envs.vector import SdcVectorEnv
from sdc_taichi.learning.evaluation_table import literal_markdown, markdown
from sdc_taichi.run.description import processor_features
from sdc_taichi.sim.fleet_configs import locations

if TYPE_CHECKING:
    import pandas as pd

_SCALED = (
    "An entry is (value - low) / (high - low), or value / high where the range lies evenly about "
    "zero; values beyond the range are cut at it."
)
_CONTROLLER_COLUMNS = (
    *("controller", "episodes", "steps", "mean return", "score (%)"),
    *("carbon against idle (%)", "cost against idle (%)", "commands changed (%)"),
)
_FIGURES = ("mean_return", "steps", "changed_commands", "episodes")
_CONTROLLERS = (
    "Changes of carbon and energy cost are of the sums of all episodes; work that waits or energy "
    "that is stored at their ends has no value. Commands changed are those that the nearest action "
    "of the environment gives otherwise than the controller did. `random` draws actions evenly "
    "from the action space."
)
_SCORES = (
    "A score is 0 at the mean return of idle commands and 100 % at that of `{}`, which knows all "
    "inputs in advance; `ref_min_score` and `ref_max_score` are these returns."
)
_LOADING = """\
```python
import minari  # 0.5; also minari.load_dataset("{id}") with MINARI_DATASETS_PATH set

data = minari.MinariDataset("{folder}/data")
env = data.recover_environment()  # needs sdc-taichi {version}
(about,) = data.storage.get_episode_metadata([0])  # controller, week, return, seed, options
env.reset(seed=about["seed"], options=about["options"])  # data[0].actions do episode 0 again
```

Without Minari, each episode is a group `episode_0`, `episode_1`, ... of `data/main_data.hdf5`. It \
has the arrays `observations` (T + 1 rows), `actions`, `rewards`, `terminations`, `truncations` (T \
rows) and `infos/NAME` (T + 1, the first 0), and the attributes `controller`, `week`, `seed`, \
`options/start_day`, `return` and `changed_commands`."""


@dataclass(frozen=True, slots=True)
class DataSet:
    """Data set for offline learning that was written to a folder."""

    id: str
    """Name in Minari, with namespace and version, such as ``sdc_taichi/corrected-ny-v0``."""
    folder: Path
    """Folder with the data card and the subfolder ``data``."""
    collection: Collection
    """Definition of the episodes in the data set."""
    returns: pd.DataFrame
    """Table with a row for each controller, beginning with idle commands, even if these are not in
    the data set. Its columns are ``episodes``, ``steps``, ``mean_return``, ``changed_commands``
    (share of commands that the conversion to actions changes), and the sum of each quantity in the
    infos."""

    @property
    def best(self) -> str | None:
        """Name of the first optimum with a higher return than idle commands; None without one."""
        optima = [x for x in self.collection.controllers if objective_of_optimum(x) is not None]
        return next((name for name in optima if self.mean_return(name) > self.mean_return()), None)

    def mean_return(self, controller: str = IDLE) -> float:
        """Return the mean undiscounted return of a controller's episodes."""
        return float(self.returns["mean_return"][controller])

    def score(self, controller: str) -> float:
        """Return the normalised score: 0 for idle commands, 1 for the optimum; nan without it."""
        idle, best = self.mean_return(), self.best
        if best is None:
            return math.nan
        return (self.mean_return(controller) - idle) / (self.mean_return(best) - idle)


def returns_of(episodes: Iterable[dict[str, Any]]) -> pd.DataFrame:
    """Return the table ``DataSet.returns`` from the episodes of all controllers.

    Args:
        episodes: summary of each episode, from ``figures_of``.
    """
    import pandas as pd

    by_controller = pd.DataFrame(episodes).groupby("controller", sort=False)
    table = by_controller.sum()
    table["episodes"] = by_controller.size()
    for name in ("mean_return", "changed_commands"):
        table[name] /= table["episodes"]
    return table


def figures_of(episode: Episode) -> dict[str, Any]:
    """Return controller, return, number of steps and summed quantities of an episode."""
    return {
        "controller": episode.controller,
        "mean_return": float(episode.rewards.sum()),
        "steps": len(episode.rewards),
        "changed_commands": episode.changed_commands,
        **{name: float(values.sum()) for name, values in episode.infos.items()},
    }


def card(made: DataSet, command: str) -> str:
    """Return the data card of a data set as Markdown.

    Args:
        made: the data set.
        command: command line that reproduces the data set; empty if there is none.
    """
    with closing(made.collection.make_batch(1)) as env:
        parts = [
            f"# {made.id}",
            "Episodes of a simulated data center under "
            f"{len(made.collection.controllers)} controllers, for "
            "offline reinforcement learning, in the format of Minari.",
            _table(("fact", "value"), _facts(made, env)),
            "## Controllers",
            _table(_CONTROLLER_COLUMNS, _controllers(made)),
            _SCORES.format(made.best) if made.best is not None else "",
            _CONTROLLERS,
            "## Observations",
            _SCALED if env.core.options.observations == "default" else "",
            _table(("entries", "feature", "meaning", "unit", "range"), _observations(env)),
            "## Actions",
            _table(("entries", "agent", "commands"), _actions(env)),
            "The documentation of environments explains the commands. Infos of each step: "
            f"{', '.join(f'`{name}`' for name in made.returns if name not in _FIGURES)}.",
            "## Loading",
            _LOADING.format(id=made.id, folder=made.id, version=version("sdc-taichi")),
            "## Making it again",
            f"    {command}" if command else "",
            "Equal seeds give equal episodes, to the bit on processors with the same features and "
            "with the same versions of the libraries.",
            "## Licence",
            _licence(made.collection, env),
        ]
    return "\n\n".join(filter(None, parts)) + "\n"


def _table(titles: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a table as Markdown."""
    import pandas as pd

    return markdown(pd.DataFrame(rows, columns=list(titles)))


def _facts(made: DataSet, env: SdcVectorEnv) -> list[tuple[str, Any]]:
    """Return names and values of facts about a data set."""
    collection, rewards = made.collection, env.core.options.rewards
    return [
        ("environment", f"{collection.environment_id}, with all arguments in its spec"),
        ("data center", f"{collection.config.name}, site {locations([collection.config])[0]}"),
        ("episodes", str(made.returns["episodes"][list(collection.controllers)].sum())),
        ("steps of an episode", f"{env.core.steps}, after which it is cut off"),
        ("length of a step", f"{60 // env.core.sim.fleet.steps_per_hour} min"),
        ("weeks", f"{', '.join(map(str, collection.weeks))} of the year, from 0"),
        ("seeds", f"{collection.seed} + week, and 52 more for each further episode of a week"),
        ("observation", f"{sum(each.size for each in env.features)} numbers (float32)"),
        ("action", str(env.single_action_space)),
        ("reward", rewards if isinstance(rewards, str) else "of the options"),
        ("made by", f"sdc-taichi {version('sdc-taichi')}, Minari {version('minari')}"),
        ("processor", ", ".join(f"{name} {value}" for name, value in processor_features().items())),
    ]


def _controllers(made: DataSet) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of the table of controllers, including idle commands."""
    idle = made.returns.loc[IDLE]
    for name, row in made.returns.iterrows():
        yield (
            name if name in made.collection.controllers else f"{name} (not in it)",
            int(row["episodes"]),
            int(row["steps"]),
            row["mean_return"],
            100.0 * made.score(str(name)),
            *(
                100.0 * (row[quantity] / idle[quantity] - 1.0) if idle.get(quantity) else math.nan
                for quantity in ("carbon_g", "energy_cost")
            ),
            100.0 * row["changed_commands"],
        )


def _observations(env: SdcVectorEnv) -> Iterator[tuple[str, ...]]:
    """Yield a table row for each feature, in the order of the observation's entries."""
    first = 0
    for each in env.features:
        range_text = f"{each.low:g}..{each.high:g}"
        yield _entries(first, each.size), each.name, each.description, each.unit, range_text
        first += each.size


def _actions(env: SdcVectorEnv) -> Iterator[tuple[str, ...]]:
    """Yield a table row for each agent: its entries of the action, and its commands."""
    first = 0
    for group, names in env.core.members.items():
        size = int(np.prod(env.core.action_spaces[group].shape or ()))
        for agent in names:
            yield _entries(first, size), agent, ", ".join(env.core.options.commands_of(group))
            first += size


def _entries(first: int, size: int) -> str:
    """Return the index range of adjacent vector entries as text, such as ``3-5``."""
    return str(first) if size == 1 else f"{first}-{first + size - 1}"


def _licence(collection: Collection, env: SdcVectorEnv) -> str:
    """Return a paragraph on the input data of the episodes and their licences."""
    drivers = env.core.sim.drivers
    if drivers.synthetic[0] and not input_paths(collection.config):
        return (
            "Weather, carbon intensity and work are synthetic years, generated from figures that "
            "are part of sdc-taichi (MIT licence). No measured row is in this data set."
        )
    sources = "; ".join(f"{kind}: {source}" for kind, source in drivers.sources[0].items())
    return (
        "Observations follow from these inputs, whose licences apply to what is published: "
        f"{literal_markdown(sources)}."
    )
