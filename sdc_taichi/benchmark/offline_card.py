"""The card of a data set for offline learning: what it holds, how it was made, how to load it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import closing
from importlib.metadata import version

from sdc_taichi.benchmark.data_set import ControllerReturns, DataSet
from sdc_taichi.benchmark.episodes import Collection
from sdc_taichi.envs.vector import SdcVectorEnv
from sdc_taichi.run.processor import processor_features
from sdc_taichi.sim.fleet_configs import locations
from sdc_taichi.types import Actions

_CONTINUOUS = {
    "load": "below 0 that share of what could wait is deferred, above 0 of what waits is run",
    "cooling": "change of the supply setpoint, as a share of {change:g} K",
    "battery": "share of the power limit: above 0 charges, below 0 discharges",
    "fan": "change of the fan speed, as a share of {fan:g} of full speed",
    "placement": "relative load 10^a of each rack",
}
_DISCRETE = {
    "load": "0 defers, 1 changes nothing, 2 runs what waits",
    "cooling": "0 lowers the supply setpoint by a step, 1 holds it, 2 raises it",
    "battery": "{charge} charges, {hold} holds, {discharge} discharges",
    "fan": "0 slows, 1 holds, 2 speeds up by a step",
    "placement": "0, 1, 2 are relative loads 0.1, 1, 10 of each rack",
}
_INFOS = {
    "carbon_g": "emissions of the step, g CO2e",
    "grid_kwh": "energy bought in the step, kWh",
    "energy_cost": "price of that energy without demand charges, in the currency of the tariff",
    "cost": "weighted sum of the costs that the option `costs` names",
}
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
        synthetic = env.core.sim.drivers.synthetic[0] and not _files(collection)
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
        _table(("entries", "feature", "what it is", "unit", "range"), observations),
        "## Actions",
        _table(("entries", "agent", "command", "what it is"), actions),
        "## Infos",
        _table(("name", "what it is"), _infos(made)),
        "## Loading",
        loading,
        "## Making it again",
        _again(command),
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
        kept = each in made.controllers
        score = made.score(each.mean_return)
        rows.append(
            (
                f"`{_text(each.controller)}`" if kept else f"`{each.controller}` (not in it)",
                f"{each.episodes:,}" if kept else "",
                f"{each.steps:,}" if kept else "",
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
    """Agent, command and meaning of the entries of an action."""
    core, options = env.core, env.core.options
    meanings = _CONTINUOUS if options.actions == "continuous" else _DISCRETE
    values: dict[str, float] = {"change": options.setpoint_change_k, "fan": options.fan_change}
    if options.actions == "discrete" and "agent_bat" in core.agents:
        for word, share in (("charge", 1.0), ("hold", 0.0), ("discharge", -1.0)):
            values[word] = int(core.actions_of(Actions(battery=share))["agent_bat"].flat[0])
    rows: list[tuple[str, ...]] = []
    first = 0
    for agent in core.agents:
        shape = core.action_spaces[agent].shape
        size = shape[0] if shape else 1
        decided = options.commands_of(agent)
        what = "; then ".join(meanings[command].format_map(values) for command in decided)
        rows.append((_entries(first, size), agent, ", ".join(decided), what))
        first += size
    return rows


def _entries(first: int, size: int) -> str:
    """Numbers of entries that stand side by side."""
    return str(first) if size == 1 else f"{first}-{first + size - 1}"


def _infos(made: DataSet) -> list[tuple[str, ...]]:
    """Quantities of infos and what they are."""
    names = made.idle.totals
    return [(f"`{n}`", _INFOS.get(n, f"cost `{n.removeprefix('cost_')}`")) for n in names]


def _again(command: str) -> str:
    """The command, and on what the bits depend."""
    text = (
        "Equal seeds give equal episodes, to the bit on processors with the same features and with "
        "the same versions of the libraries; the last digits may differ on others."
    )
    return f"    {command}\n\n{text}" if command else text


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


def _files(collection: Collection) -> list[str]:
    """Files that the data center takes inputs from."""
    site = collection.config.site
    named = (site.weather_file, site.carbon_file, site.workload_file)
    return [name for name in named if name is not None]


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
