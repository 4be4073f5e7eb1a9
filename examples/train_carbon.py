"""Agents that emit less carbon than a data center left alone, in weeks they have not seen.

    python examples/train_carbon.py FOLDER [--seeds 0 1 2] [--steps 1800000]

trains the three agents with skrl and the default rewards on preset ``corrected``, one data center
per site and training week, and runs them and rule-based controllers in every fourth week of the
year, which is left out of training. Forecasts and rewards on the last day of a training week read
ahead into the first day of the held-out week that follows, so only days 2 to 7 are scored, whoever
acts. Writes ``training.json`` (settings, results by seed, curves) and ``training.png`` to FOLDER
and prints the tables of docs/training.md.

Weather, carbon intensity and work are the synthetic years of the sites.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from datetime import date, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from train_skrl import ALGORITHMS, BatchEnv, learner, prepare, trainer

import sdc_taichi
from sdc_taichi import (
    DataCenterConfig,
    Simulator,
    StepResult,
    build_fleet,
    load_config,
    make_controller,
    simulate,
)
from sdc_taichi.types import F64

SITES = ("AZ", "CA", "GA", "IL", "NY", "TX", "VA", "WA")
DAYS = 7
STEPS = DAYS * 96
UNSCORED_STEPS = 96
"""First day of a held-out week, which training has seen ahead."""
HELD_OUT = tuple(range(3, 52, 4))
"""Weeks of the year that are left out of training."""
TRAINED = tuple(week for week in range(52) if week not in HELD_OUT)
RULES = ("g36", "lookahead-24h", "greedy-ci", "load=greedy-ci,cooling=g36,battery=lookahead-24h")
SUMMED = (
    *("carbon_g", "it_kwh", "hvac_kwh", "charge_kwh", "discharge_kwh", "battery_loss_kwh"),
    *("arrived_tasks", "executed_tasks", "dropped_tasks"),
)
SETTINGS: dict[str, Any] = {
    "rollout": 48,
    "hidden": (64, 64),
    "learning_rate": 1e-3,
    "discount_factor": 0.97,
    "gae_lambda": 0.9,
    "entropy_loss_scale": 0.003,
    "learning_epochs": 4,
}

Sums = dict[str, F64]
"""Sums over the scored days of a week of what ``SUMMED`` names, (B,) each, site by site."""


def data_centers(sites: Sequence[str], weeks: Sequence[int]) -> list[DataCenterConfig]:
    """One per site and week of the year, site by site."""
    first = date(2001, 1, 1)
    starts = [(first + timedelta(days=DAYS * week)).strftime("%m-%d") for week in weeks]
    return [
        load_config("corrected", [f"name={s}-{t}", f"site.location={s}", f"site.start={t}"])
        for s in sites
        for t in starts
    ]


def make_env(configs: Sequence[DataCenterConfig]) -> BatchEnv:
    """All three agents of the data centers; an episode is the week of each."""
    env = sdc_taichi.vector_env(
        len(configs),
        config=list(configs),
        days=DAYS,
        start="fixed",
        autoreset_mode="SameStep",
    )
    return BatchEnv(env, seed=0)


def run_rules(name: str, configs: Sequence[DataCenterConfig]) -> Sums:
    """The weeks under a named controller."""
    fleet = build_fleet(list(configs))
    sums = {key: np.zeros(fleet.size) for key in SUMMED}

    def score(result: StepResult) -> None:
        if result.step >= UNSCORED_STEPS:
            for key, total in sums.items():
                total += getattr(result, key)

    with Simulator(fleet) as sim:
        simulate(sim, make_controller(name, fleet), STEPS, on_step=score)
    return sums


def run_policies(agent: Any, env: BatchEnv) -> Sums:
    """The weeks under the most probable actions of the policies."""
    sums = {name: np.zeros(env.num_envs) for name in SUMMED}
    agent.enable_training_mode(False)
    observations, _ = env.reset()
    with torch.no_grad():
        for step in range(STEPS):
            _, outputs = agent.act(observations, env.state(), timestep=0, timesteps=STEPS)
            best = {a: out["net_output"].argmax(-1, keepdim=True) for a, out in outputs.items()}
            observations, *_, infos = env.step(best)
            if step >= UNSCORED_STEPS:
                for name, total in sums.items():
                    total += infos[name]
    return sums


def against_idle(sums: Sums, idle: Sums, sites: Sequence[str]) -> dict[str, Any]:
    """Changes against idle over all data centers, in percent.

    ``cfp_per_work`` is carbon over executed work: work left in the queue saves nothing. ``stored``
    is what batteries gain over the scored days, as a share of idle's energy: carbon that a loss of
    stored energy saves has been emitted before.
    """

    def change(name: str) -> float:
        return 100 * float(sums[name].sum() / idle[name].sum() - 1)

    by_site = [
        [s[name].reshape(len(sites), -1).sum(axis=1) for name in ("carbon_g", "executed_tasks")]
        for s in (sums, idle)
    ]
    (mine, done), (its, all_work) = by_site
    drawn_kwh = sums["charge_kwh"] - sums["discharge_kwh"]
    stored_kwh = np.sum(drawn_kwh - sums["battery_loss_kwh"])
    idle_kwh = np.sum(idle["it_kwh"] + idle["hvac_kwh"])
    return {
        "cfp": change("carbon_g"),
        "cfp_per_work": 100 * float(mine.sum() / its.sum() * all_work.sum() / done.sum() - 1),
        "it": change("it_kwh"),
        "hvac": change("hvac_kwh"),
        "stored": 100 * float(stored_kwh / idle_kwh),
        "dropped": 100 * float(sums["dropped_tasks"].sum() / sums["arrived_tasks"].sum()),
        "cfp_per_work_by_site": dict(
            zip(sites, (100 * (mine / its * all_work / done - 1)).tolist(), strict=True)
        ),
    }


def train_seed(
    seed: int,
    algorithm: str,
    configs: Sequence[DataCenterConfig],
    held_out: BatchEnv,
    idle: Sums,
    sites: Sequence[str],
    *,
    steps: int,
    points: int,
) -> dict[str, Any]:
    """Train from one seed, and compare with idle at evenly spaced points of the training."""
    prepare(seed)
    env = make_env(configs)
    agent = learner(env, algorithm, **SETTINGS)
    episode_steps = env.num_envs * STEPS
    episodes = max(1, round(steps / episode_steps))
    teacher = trainer(env, agent, STEPS)
    marks = {round(x) for x in np.linspace(0, episodes, points + 1)}
    curve: list[dict[str, Any]] = []
    seconds = 0.0
    for episode in range(episodes + 1):
        if episode in marks:
            now = against_idle(run_policies(agent, held_out), idle, sites)
            curve.append({"steps": episode * episode_steps} | now)
            print(
                f"seed {seed}, {curve[-1]['steps']:9d} steps: CFP {now['cfp']:+.2f} %", flush=True
            )
        if episode < episodes:
            start = time.perf_counter()
            teacher.train()
            seconds += time.perf_counter() - start
    env.close()
    return {"seed": seed, "train_s": seconds, "steps": episodes * episode_steps, "curve": curve}


def draw(report: Mapping[str, Any]) -> Figure:
    """Carbon against idle over the training, and by site at its end."""
    figure = Figure(figsize=(9, 3.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    sites = report["sites"]
    for i, seed in enumerate(report["seeds"]):
        millions = [point["steps"] / 1e6 for point in seed["curve"]]
        values = [point["cfp_per_work"] for point in seed["curve"]]
        left.plot(millions, values, marker=".", label=f"seed {seed['seed']}")
        last = seed["curve"][-1]["cfp_per_work_by_site"]
        at = np.arange(len(sites)) + 0.25 * (i - 1)
        right.bar(at, [last[site] for site in sites], 0.25)
    best = min(report["rules"], key=lambda name: report["rules"][name]["cfp_per_work"])
    left.axhline(0, color="black", linewidth=0.8, label="idle")
    left.axhline(
        report["rules"][best]["cfp_per_work"], color="grey", linestyle="--", label="best rules"
    )
    left.set_xlabel("steps of training (million)")
    left.set_ylabel("CFP per work against idle (%)")
    left.legend(fontsize="small")
    right.set_xticks(np.arange(len(sites)), sites)
    right.set_xlabel("site, trained")
    right.axhline(0, color="black", linewidth=0.8)
    return figure


def print_tables(report: Mapping[str, Any]) -> None:
    """Rules and seeds against idle, then mean and spread of the seeds."""
    columns = ("cfp", "cfp_per_work", "it", "hvac", "stored", "dropped")
    print(
        "| held-out weeks, against idle (%) | CFP | CFP per work | IT | HVAC | stored | dropped |"
    )
    print("|---|---|---|---|---|---|---|")
    rows = dict(report["rules"])
    rows |= {f"seed {s['seed']}": s["curve"][-1] for s in report["seeds"]}
    for name, row in rows.items():
        print(f"| {name} | " + " | ".join(f"{row[c]:+.2f}" for c in columns) + " |")
    for name in ("cfp", "cfp_per_work"):
        found = report["summary"][name]
        print(
            f"{name}: mean of the seeds {found['mean']:+.2f} %, from {found['lowest']:+.2f} to "
            f"{found['highest']:+.2f} %, standard deviation {found['sd']:.2f}"
        )
    print(
        f"training {sum(s['train_s'] for s in report['seeds']):.0f} s, all {report['all_s']:.0f} s"
    )


def summarise(seeds: Sequence[Mapping[str, Any]], name: str) -> dict[str, float]:
    """Mean and spread over the seeds at the end of the training."""
    values = np.array([seed["curve"][-1][name] for seed in seeds])
    return {
        "mean": float(values.mean()),
        "lowest": float(values.min()),
        "highest": float(values.max()),
        "sd": float(values.std(ddof=1)) if len(values) > 1 else 0.0,
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Train from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--algorithm", choices=ALGORITHMS, default="ippo")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=1_800_000, help="of all data centers, by seed")
    parser.add_argument("--points", type=int, default=6, help="of the curve")
    parser.add_argument("--sites", nargs="+", default=SITES)
    parser.add_argument("--train-weeks", type=int, nargs="+", default=TRAINED)
    parser.add_argument("--held-out-weeks", type=int, nargs="+", default=HELD_OUT)
    given = parser.parse_args(arguments)
    common = sorted({*given.train_weeks} & {*given.held_out_weeks})
    if common:
        parser.error(f"weeks {common} are both trained on and held out")

    start = time.perf_counter()
    configs = data_centers(given.sites, given.train_weeks)
    unseen = data_centers(given.sites, given.held_out_weeks)
    idle = run_rules("idle", unseen)
    rules = {name: against_idle(run_rules(name, unseen), idle, given.sites) for name in RULES}
    held_out = make_env(unseen)
    seeds = [
        train_seed(
            seed,
            given.algorithm,
            configs,
            held_out,
            idle,
            given.sites,
            steps=given.steps,
            points=given.points,
        )
        for seed in given.seeds
    ]
    held_out.close()
    report = {
        "preset": "corrected",
        "algorithm": given.algorithm,
        "settings": SETTINGS,
        "sites": list(given.sites),
        "train_weeks": list(given.train_weeks),
        "held_out_weeks": list(given.held_out_weeks),
        "unscored_steps": UNSCORED_STEPS,
        "idle_cfp_kg": float(idle["carbon_g"].sum() / 1e3),
        "rules": rules,
        "seeds": seeds,
        "summary": {name: summarise(seeds, name) for name in ("cfp", "cfp_per_work")},
        "all_s": time.perf_counter() - start,
    }
    given.folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(report, indent=1, allow_nan=False)
    (given.folder / "training.json").write_text(text + "\n", encoding="utf-8")
    draw(report).savefig(given.folder / "training.png", dpi=120)
    print_tables(report)


if __name__ == "__main__":
    main()
