"""All algorithms trained on eight sites, and compared in weeks that no training has seen.

    python examples/learning_study.py FOLDER [--scenario carbon] [--seeds 5] [--steps 2000000]

trains each algorithm with each seed in FOLDER/trainings, goes on where it was interrupted, and
compares what did best in the validation weeks with rules and the known optimum in the held-out
weeks. Writes the tables of docs/training.md to FOLDER/held-out and prints them, and draws the share
of the achievable over the training to FOLDER/learning.png. All inputs are synthetic years.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sdc_taichi import make_controller
from sdc_taichi.learning.evaluation import Contender, DataCenterWeeks, evaluate, prepare
from sdc_taichi.learning.evaluation_folder import (
    contenders_of,
    evaluation_content,
    prepare_evaluation_folder,
    write_evaluation,
)
from sdc_taichi.learning.split import HELD_OUT
from sdc_taichi.learning.trainer import train
from sdc_taichi.learning.training_folder import VALIDATION_FILE
from sdc_taichi.learning.training_settings import TrainingSettings, make_settings
from sdc_taichi.viz.plotting import save_picture

ALGORITHMS = ("ppo", "ippo", "mappo", "happo", "haa2c", "had3qn", "hasac")
RULES = (
    *("g36", "lookahead-24h", "greedy-ci"),
    "load=greedy-ci,cooling=g36,battery=lookahead-24h",
)


def settings_of(algorithm: str, seed: int, given: argparse.Namespace) -> TrainingSettings:
    """Settings of one training."""
    values: dict[str, Any] = {
        "algorithm": algorithm,
        "scenario": given.scenario,
        "seed": seed,
        "steps": given.steps,
        "validation": {"steps": max(1, given.steps // 4), "optimum": not given.no_optimum},
        "tensorboard": False,
    }
    if given.sites:
        values["sites"] = given.sites
    if given.weeks:
        values["weeks"] = given.weeks
    if given.data_centers:
        values["data_centers"] = given.data_centers
    return make_settings(values)


def train_all(folder: Path, given: argparse.Namespace) -> list[Path]:
    """Train what has not been trained, and return the folders of all trainings."""
    folders = []
    for seed in range(given.seeds):
        for algorithm in given.algorithms:
            folders.append(out := folder / f"{algorithm}-{seed}")
            settings = settings_of(algorithm, seed, given)
            done = train(settings, out, resume=out.exists())
            print(f"{out.name}: {done.steps:,} steps", file=sys.stderr, flush=True)
    return folders


def compare(folders: Sequence[Path], given: argparse.Namespace) -> Path:
    """Run policies and rules in the held-out weeks, and return the folder of the tables."""
    settings = settings_of(given.algorithms[0], 0, given)
    out: Path = given.folder / "held-out"
    prepare_evaluation_folder(out)
    with prepare(
        settings.data_centers_of_sites(),
        given.held_out_weeks,
        objective=settings.validation.objective,
        optimum=not given.no_optimum,
    ) as weeks:
        found = evaluate(weeks, contenders(folders, weeks, given.rules))
        content = evaluation_content(
            found, weeks, command=" ".join(["python", *sys.argv]), folders=folders
        )
        write_evaluation(out, found, weeks, content)
    return out


def contenders(
    folders: Sequence[Path], weeks: DataCenterWeeks, rules: Sequence[str]
) -> list[Contender]:
    """Policies of all trainings, and rules."""
    fleet = weeks.sim.fleet
    found = contenders_of(folders, fleet)
    return found + [Contender(name, make_controller(name, fleet)) for name in rules]


def draw(folders: Sequence[Path], algorithms: Sequence[str]) -> Figure:
    """Share of the achievable in the validation weeks over the training, mean of the seeds."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    for algorithm in algorithms:
        curves = [_curve(f) for f in folders if f.name.rpartition("-")[0] == algorithm]
        points = min(len(curve) for curve in curves)
        steps, shares = np.mean([curve[:points] for curve in curves], axis=0).T
        axes.plot(steps / 1e6, 100.0 * shares, marker=".", label=algorithm)
    axes.set_xlabel("steps of training (million)")
    axes.set_ylabel("share of the achievable (%)")
    axes.legend(fontsize="small")
    return figure


def _curve(folder: Path) -> list[tuple[float, float]]:
    """Steps and share of the achievable at each validation of a training."""
    with (folder / VALIDATION_FILE).open(newline="") as file:
        return [(float(row["steps"]), float(row["share"])) for row in csv.DictReader(file)]


def main(arguments: Sequence[str] | None = None) -> None:
    """Train and compare from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenario", default="carbon")
    parser.add_argument("--algorithms", nargs="+", default=ALGORITHMS)
    parser.add_argument("--seeds", type=int, default=5, help="number of seeds")
    parser.add_argument("--steps", type=int, default=2_000_000, help="of all data centers together")
    parser.add_argument("--sites", nargs="+", help="in place of those of the scenario")
    parser.add_argument("--weeks", type=int, nargs="+", help="in place of the training weeks")
    parser.add_argument("--data-centers", type=int, help="at once, in place of about 256")
    parser.add_argument("--held-out-weeks", type=int, nargs="+", default=HELD_OUT)
    parser.add_argument("--rules", nargs="*", default=RULES)
    parser.add_argument("--no-optimum", action="store_true", help="leave the optimum out")
    given = parser.parse_args(arguments)
    folders = train_all(given.folder / "trainings", given)
    out = compare(folders, given)
    save_picture(draw(folders, given.algorithms), given.folder / "learning.png")
    print((out / "table.md").read_text("utf-8"))


if __name__ == "__main__":
    main()
