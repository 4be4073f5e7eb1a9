"""Policies in folders as controllers to evaluate, and the folder of an evaluation's results."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.envs.agents import COMMAND_OF_AGENT
from sdc_taichi.errors import ConfigError, SdcError
from sdc_taichi.learning.controller import PolicyController
from sdc_taichi.learning.evaluation import Contender, DataCenterWeeks, Evaluation
from sdc_taichi.learning.evaluation_table import (
    by_agent,
    by_site,
    differences,
    is_compared,
    markdown,
    summary,
)
from sdc_taichi.learning.policy import Policy
from sdc_taichi.learning.training_folder import SETTINGS_FILE, settings_of
from sdc_taichi.learning.training_settings import TrainingSettings
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.user_file import list_folder

if TYPE_CHECKING:
    import pandas as pd

FORMAT = "sdc-evaluation/1"
"""Version of the format of evaluation.json."""
EVALUATION_FILE, ROWS_FILE, TABLE_FILE = "evaluation.json", "rows.csv", "table.md"
"""Files of an evaluation."""
_BOUND_IS_NONE = "none"


def training_settings(folders: Sequence[Path]) -> TrainingSettings | None:
    """Settings of the first of several trainings; None if none of the folders is of a training.

    Args:
        folders: folders of trainings or policies.

    Raises:
        ConfigError: settings that are not valid, or trainings on other data centers than the first.
    """
    found: tuple[Path, TrainingSettings] | None = None
    for folder in folders:
        if not (folder / SETTINGS_FILE).is_file():
            continue
        settings = settings_of(folder)
        if found is None:
            found = folder, settings
        for name in ("config", "overrides"):
            if getattr(settings, name) != getattr(found[1], name):
                raise ConfigError(
                    f"{folder}: was trained with another {name} than {found[0]}; valid with both "
                    "is --config"
                )
    return None if found is None else found[1]


def contenders_of(
    folders: Sequence[Path], fleet: Fleet, *, agents_alone: bool = True
) -> list[Contender]:
    """Policies of trainings as contenders; those that differ in their seed alone share a name.

    Args:
        folders: folders of trainings or policies.
        fleet: data centers that they are to control.
        agents_alone: whether each agent of a policy of several also runs alone.

    Raises:
        SdcError: a folder without a policy, or a policy that does not fit the data centers.
    """
    policies = [Policy.load(folder) for folder in folders]
    keys = [_key(folder, policy) for folder, policy in zip(folders, policies, strict=True)]
    names = _names(folders, policies, keys)
    found = []
    for folder, policy, key in zip(folders, policies, keys, strict=True):
        controller = PolicyController(policy, fleet, f"policy {folder}")
        parts = _parts(policy)
        alone = parts if agents_alone and len(parts) > 1 else ()
        found.append(Contender(names[key], controller, policy.about.seed, alone))
    return found


def evaluation_content(
    evaluation: Evaluation,
    weeks: DataCenterWeeks,
    *,
    command: str = "",
    folders: Sequence[Path] = (),
) -> dict[str, Any]:
    """Content of evaluation.json.

    Args:
        evaluation: the evaluation.
        weeks: the weeks that it is of.
        command: command line that does it again.
        folders: folders of its trainings or policies.
    """
    names = [n for n in dict.fromkeys(evaluation.rows.get("controller", ())) if is_compared(n)]
    return {
        "format": FORMAT,
        "version": version("sdc-taichi"),
        "command": command,
        "objective": str(weeks.objective),
        "unit": weeks.objective.unit,
        "sites": list(dict.fromkeys(weeks.sites)),
        "weeks": list(dict.fromkeys(weeks.weeks)),
        "steps": weeks.steps,
        "scored_from": weeks.scored_from,
        "seed": weeks.seed,
        "forecast_error": asdict(weeks.forecast_error),
        "fingerprint": weeks.sim.fingerprint(),
        "has_optimum": weeks.optimum is not None,
        "policies": [{"folder": str(f), **Policy.load(f).about.model_dump()} for f in folders],
        "summary": _records(summary(evaluation)),
        "by_site": _records(by_site(evaluation)),
        "by_agent": _records(by_agent(evaluation)),
        "differences": _records(differences(evaluation, names[0])) if names else [],
        "missing": list(evaluation.missing),
        "remarks": remarks(weeks),
    }


def remarks(weeks: DataCenterWeeks) -> list[str]:
    """Sentences that warn of figures without an optimum, or whose ends are not valued.

    Args:
        weeks: the weeks that it is of.
    """
    if weeks.optimum is None:
        return ["Without an optimum ends have no value: an empty battery or work put off saves."]
    names, kinds = weeks.optimum.names, weeks.optimum.bound_kinds
    return [
        f"{name}: bound {kind}; ends that differ have no value there"
        for name, kind in zip(names, kinds, strict=True)
        if kind.startswith(_BOUND_IS_NONE)
    ]


def tables_of(evaluation: Evaluation, weeks: DataCenterWeeks) -> list[tuple[str, pd.DataFrame]]:
    """Tables with their titles: all weeks together, by site, by agent, and differences.

    Args:
        evaluation: the evaluation.
        weeks: the weeks that it is of.
    """
    names = [n for n in dict.fromkeys(evaluation.rows["controller"]) if is_compared(n)]
    days = weeks.steps // (24 * weeks.sim.fleet.steps_per_hour)
    scored = "day 2" if days == 2 else f"days 2 to {days}"
    title = f"{weeks.objective}, {scored} of {len(weeks.weeks)} data-center weeks, 95 % intervals"
    found = [
        (title, summary(evaluation)),
        ("against idle commands by site (%)", by_site(evaluation)),
        ("each agent alone, the others idle", by_agent(evaluation)),
    ]
    if names:
        found.append((f"{names[0]} against the others", differences(evaluation, names[0])))
    return [(title, table) for title, table in found if len(table)]


def prepare_evaluation_folder(out: Path, *, force: bool = False) -> None:
    """Make the folder of an evaluation, or see that its files may be replaced.

    Args:
        out: the folder.
        force: also take a folder with other files.

    Raises:
        SdcError: a file, a folder with other files, or one that cannot be made.
    """
    if out.exists() and not out.is_dir():
        raise ConfigError(f"--out {out}: is a file; valid is a folder")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SdcError(f"--out {out}: cannot be made: {error.strerror or error}") from None
    others = [name for name in list_folder(out) if not name.startswith(".")]
    if others and EVALUATION_FILE not in others and not force:
        some = ", ".join(sorted(others)[:3])
        raise ConfigError(
            f"--out {out}: holds other files ({some}); choose another folder, or --force"
        )


def write_evaluation(
    out: Path, evaluation: Evaluation, weeks: DataCenterWeeks, content: Mapping[str, Any]
) -> None:
    """Write rows.csv, table.md and, last, evaluation.json.

    Args:
        out: the folder.
        evaluation: the evaluation.
        weeks: the weeks that it is of.
        content: content of evaluation.json.

    Raises:
        SdcError: a file cannot be written.
    """
    tables = [
        text
        for title, table in tables_of(evaluation, weeks)
        for text in (f"## {title[:1].upper()}{title[1:]}", markdown(table))
    ]
    texts = {
        ROWS_FILE: evaluation.rows.to_csv(index=False),
        TABLE_FILE: "\n\n".join([*tables, *content["remarks"], f"    {content['command']}"]) + "\n",
        EVALUATION_FILE: content_json(content),
    }
    for name, text in texts.items():
        with atomic_write(out / name) as file:
            file.write(text.encode())


def content_json(content: Mapping[str, Any]) -> str:
    """JSON text of the content of evaluation.json."""
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _key(folder: Path, policy: Policy) -> str:
    """Text that is equal for trainings which differ in their seed alone."""
    about = policy.about.model_dump(exclude={"seed", "fingerprint"})
    settings = {}
    if (folder / SETTINGS_FILE).is_file():
        settings = settings_of(folder).model_dump(mode="json", exclude={"seed"})
        about.pop("steps")  # the best policies of seeds come from different updates
    return json.dumps([about, policy.interface.model_dump(), settings], sort_keys=True)


def _names(
    folders: Sequence[Path], policies: Sequence[Policy], keys: Sequence[str]
) -> dict[str, str]:
    """Name of each key: its algorithm, or its folder where another key has that algorithm."""
    first = {key: i for i, key in reversed(list(enumerate(keys)))}
    algorithms = [policies[i].about.algorithm for i in first.values()]
    names: dict[str, str] = {}
    for key, i in first.items():
        name = policies[i].about.algorithm
        if algorithms.count(name) > 1:
            name = re.sub(r"[-_.]?(seed)?[-_.]?\d+$", "", folders[i].absolute().name) or name
        names[key] = name if name not in names.values() else str(folders[i])
    return names


def _parts(policy: Policy) -> tuple[str, ...]:
    """Of load, cooling and battery what the agents of a policy move."""
    return tuple(COMMAND_OF_AGENT[agent] for agent in policy.interface.agents)


def _records(table: Any) -> list[dict[str, Any]]:
    """Rows of a table for JSON, which has no nan."""
    return [
        {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in row.items()
        }
        for row in table.to_dict("records")
    ]
