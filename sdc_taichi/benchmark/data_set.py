"""A data set for offline learning: returns of its controllers, and its card in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

import numpy as np

from sdc_taichi.benchmark.episodes import Collection, Episode, objective_of_optimum
from sdc_taichi.benchmark.jobs import input_paths
from sdc_taichi.envs.vector import SdcVectorEnv
from sdc_taichi.run.processor import processor_features
from sdc_taichi.sim.fleet_configs import locations

_SCALED = (
    "An entry is (value - low) / (high - low), or value / high where the range lies evenly about "
    "zero; values beyond the range are cut at it."
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


def card(made: DataSet, command: str) -> str:
    """The card as Markdown.

    Args:
        made: the data set.
        command: command line that makes it again; empty if there is none.
    """
    collection = made.collection
    with closing(collection.make_batch(1)) as env:
        facts = _facts(made, env)
        observations = _observations(env)
        actions = _actions(env)
        scaled = env.core.options.observations == "default"
        sources = env.core.sim.drivers.sources[0]
        synthetic = env.core.sim.drivers.synthetic[0] and not input_paths(collection.config)
    loading = _LOADING.format(id=made.id, folder=made.id, version=version("sdc-taichi"))
    parts = [
        f"# {made.id}",
        f"Episodes of a simulated data center under {len(made.controllers)} controllers, for "
        "offline reinforcement learning, in the format of Minari.",
        _table(("", ""), facts),
        "## Controllers",
        _table(*_controllers(made)),
        _about_controllers(made),
        "## Observations",
        _SCALED if scaled else "",
        _table(("entries", "feature", "meaning", "unit", "range"), observations),
        "## Actions",
        _table(("entries", "agent", "command"), actions),
        f"The documentation of environments explains the commands. Infos of each step: "
        f"{', '.join(f'`{name}`' for name in made.idle.totals)}.",
        "## Loading",
        loading,
        "## Making it again",
        f"    {command}" if command else "",
        "Equal seeds give equal episodes, to the bit on processors with the same features and with "
        "the same versions of the libraries.",
        "## Licence",
        _licence(sources, synthetic=synthetic),
    ]
    return "\n\n".join(filter(None, parts)) + "\n"


def _facts(made: DataSet, env: SdcVectorEnv) -> list[tuple[str, str]]:
    """Names and values of what the data set holds, in a few words each."""
    collection, options = made.collection, env.core.options
    episodes = sum(each.episodes for each in made.controllers)
    steps = sum(each.steps for each in made.controllers)
    (place,) = locations([collection.config])
    rewards = options.rewards if isinstance(options.rewards, str) else "of the options"
    each_week = "" if collection.repeats == 1 else f", {collection.repeats} episodes of each"
    return [
        ("environment", f"`{collection.environment_id}`, with all arguments in its spec"),
        ("data center", f"{_text(collection.config.name)}, site {_text(place)}"),
        ("episodes", f"{episodes:,}, cut off after {env.core.steps:,} steps and never over"),
        ("steps", f"{steps:,} of {60 // env.core.sim.fleet.steps_per_hour} min"),
        ("weeks", f"{', '.join(map(str, collection.weeks))} of the year, from 0{each_week}"),
        ("seeds", f"{collection.seed} + week, and 52 more for each further episode of a week"),
        ("observation", f"{sum(each.size for each in env.features)} numbers (float32)"),
        ("action", f"`{env.single_action_space}`".replace("\n", " ")),
        ("reward", f"{_text(str(rewards))}, undiscounted sum in the table below"),
        ("made by", f"sdc-taichi {version('sdc-taichi')}, Minari {version('minari')}"),
        ("processor", ", ".join(f"{name} {value}" for name, value in processor_features().items())),
    ]


def _controllers(made: DataSet) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Titles and rows of the table of controllers."""
    titles = (
        *("controller", "episodes", "steps", "mean return", "score (%)"),
        *("carbon against idle (%)", "cost against idle (%)", "commands changed (%)"),
    )
    listed = made.controllers
    if not any(each.controller == made.idle.controller for each in listed):
        listed = (made.idle, *listed)
    rows: list[tuple[str, ...]] = []
    for each in listed:
        is_in_set = each in made.controllers
        score = made.score(each.mean_return)
        rows.append(
            (
                f"`{_text(each.controller)}`" if is_in_set else f"`{each.controller}` (not in it)",
                f"{each.episodes:,}" if is_in_set else "",
                f"{each.steps:,}" if is_in_set else "",
                f"{each.mean_return:.2f}",
                "" if score is None else f"{100.0 * score:.1f}",
                _change_pct(each, made.idle, "carbon_g"),
                _change_pct(each, made.idle, "energy_cost"),
                f"{100.0 * each.changed_commands / each.episodes:.1f}",
            )
        )
    return titles, rows


def _about_controllers(made: DataSet) -> str:
    """How to read the table of controllers."""
    text = (
        "Changes of carbon and energy cost are of the sums over all episodes; what waits or is "
        "stored at their ends is not valued. Commands changed are those that the nearest action "
        "of the environment gives otherwise than the controller did. `random` draws actions "
        "evenly from the action space."
    )
    if made.best is None:
        return text
    return (
        f"A score is 0 at the mean return of idle commands and 100 % at that of "
        f"`{made.best.controller}`, which knows all inputs in advance; `ref_min_score` and "
        f"`ref_max_score` are these returns. {text}"
    )


def _observations(env: SdcVectorEnv) -> list[tuple[str, ...]]:
    """Features, in the order of their entries."""
    rows: list[tuple[str, ...]] = []
    first = 0
    for each in env.features:
        entries, what = _entries(first, each.size), each.description.replace("|", "/")
        rows.append((entries, f"`{each.name}`", what, each.unit, f"{each.low:g}..{each.high:g}"))
        first += each.size
    return rows


def _actions(env: SdcVectorEnv) -> list[tuple[str, ...]]:
    """Agent and commands of the entries of an action."""
    core = env.core
    rows: list[tuple[str, ...]] = []
    first = 0
    for agent in core.agents:
        size = int(np.prod(core.action_spaces[agent].shape or ()))
        rows.append((_entries(first, size), agent, ", ".join(core.options.commands_of(agent))))
        first += size
    return rows


def _entries(first: int, size: int) -> str:
    """Numbers of entries that stand side by side."""
    return str(first) if size == 1 else f"{first}-{first + size - 1}"


def _licence(sources: dict[str, str], *, synthetic: bool) -> str:
    """Whose data the episodes are made from."""
    if synthetic:
        return (
            "Weather, carbon intensity and work are synthetic years, generated from figures that "
            "are part of sdc-taichi (MIT licence). No measured row is in this data set."
        )
    listed = "; ".join(f"{kind}: {_text(source)}" for kind, source in sources.items())
    return (
        f"Observations follow from these inputs, whose licences apply to what is published: "
        f"{listed}."
    )


def _change_pct(reached: ControllerReturns, idle: ControllerReturns, name: str) -> str:
    """Change of a sum against that of idle commands, in %; empty where that is 0."""
    base = idle.totals.get(name, 0.0)
    return f"{100.0 * (reached.totals[name] / base - 1.0):+.2f}" if base else ""


def _table(titles: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [titles, ["---"] * len(titles), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _text(text: str) -> str:
    """Text of the user's that breaks neither a line nor a table."""
    return " ".join(text.split()).replace("|", "/").replace("`", "'")
