"""Made-up studies of suites: folders as runs leave them, of figures that fit together."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sdc_taichi.benchmark.jobs import DoneJob, Job
from sdc_taichi.benchmark.store import ResultStore, Study
from sdc_taichi.learning.evaluation import METRICS
from sdc_taichi.types import F64

SITES, WEEKS = ("ca", "ny"), (3, 7, 11)
IDLE = np.array([100.0, 120.0, 90.0, 220.0, 200.0, 210.0])
ACHIEVED, BOUND = 0.9 * IDLE, 0.89 * IDLE
CI_KG_PER_KWH = 0.25
ARRIVED = 5000.0
RUN, SOLVE = (f"sdc_taichi.benchmark.suite_jobs:{name}" for name in ("run_row", "solve_reference"))
ROWS: dict[str, dict[str, Any]] = {
    "idle": {"controller": "idle"},
    "coldest": {"controller": "cooling=constant:16"},
    "g36": {"controller": "g36", "about": "a | pipe, <b>markup</b> and _more_"},
    "mpc-24h": {"controller": "mpc-24h"},
    "ippo": {"train": {"algorithm": "ippo"}, "agents_alone": True},
    "optimum": {"optimum": "achieved"},
    "bound": {"optimum": "bound"},
}
SAVED_PCT = {
    "idle": (0.0,),
    "coldest": (-20.0,),
    "g36": (2.0,),
    "mpc-24h": (9.0,),
    "ippo": (1.5, 2.5, 5.0),
}
"""Carbon that each seed of a row saves against idle commands, in %."""


def frame_of(
    saved: float | F64, moves: str = "all", *, figures_alone: bool = False
) -> pd.DataFrame:
    """Rows of a result, which save a share of the carbon of idle commands in each week."""
    figure = IDLE * (1.0 - np.asarray(saved))
    grid_kwh = figure / CI_KG_PER_KWH
    metrics = dict.fromkeys(METRICS, 0.0) | {
        "cfp_kg": figure,
        "grid_kwh": grid_kwh,
        "it_kwh": 0.8 * grid_kwh,
        "hvac_kwh": 0.19 * grid_kwh,
        "water_l": 2.0 * grid_kwh,
        "cost": 0.1 * grid_kwh,
        "peak_kw": grid_kwh / 100.0,
        "hottest_inlet_c": 25.0,
        "arrived_tasks": ARRIVED,
        "executed_tasks": ARRIVED,
        "queue_mean_tasks": 1.0,
    }
    if figures_alone:
        metrics = dict.fromkeys(METRICS, np.nan)
    columns = {
        "controller": "",
        "moves": moves,
        "site": np.repeat(SITES, len(WEEKS)),
        "year": 10,
        "week": list(WEEKS) * len(SITES),
        "figure": figure,
        "valued_figure": figure,
        "idle_figure": IDLE,
        "achieved_figure": ACHIEVED,
        "share": (IDLE - figure) / (IDLE - ACHIEVED),
        "broken": "",
    }
    return pd.DataFrame(columns | metrics)


def frames_of_row(name: str, seed: int) -> pd.DataFrame:
    """Rows of a result of the made-up suite."""
    if name == "optimum":
        beside = {"load": 0.04, "battery": 0.04, "together": 0.06, "in_turn": 0.09}
        others = [frame_of(x, moves, figures_alone=True) for moves, x in beside.items()]
        return pd.concat([frame_of(0.1), *others], ignore_index=True)
    if name == "bound":
        return frame_of(0.11, figures_alone=True)
    wiggle = 0.002 * np.sin(np.arange(len(IDLE)) + seed) * (name not in ("idle", "coldest"))
    whole = frame_of(SAVED_PCT[name][seed] / 100.0 + wiggle)
    if name != "ippo":
        return whole
    return pd.concat([whole, frame_of(0.01, "battery"), frame_of(0.01, "load")], ignore_index=True)


def done_job(
    row: str,
    seed: int,
    frame: pd.DataFrame | None,
    *,
    spec: Mapping[str, Any],
    metrics: Mapping[str, Any] | None = None,
    suite: str = "made-up",
    case: str = "two-sites",
    files: Mapping[str, bytes] | None = None,
    source: str = "0" * 64,
) -> DoneJob:
    """A job of the made-up suite with its result."""
    partition = {"suite": suite, "case": case, "row": row, "seed": str(seed)}
    values = {"name": row, "row": dict(spec), "seed": seed, "case": {}, "objective": "carbon"}
    rows = b""
    if frame is not None:
        out = io.BytesIO()
        frame.to_parquet(out, index=False)
        rows = out.getvalue()
    made = {"fingerprint": "f" * 64, "objective": "carbon", "unit": "kg CO2e"}
    return DoneJob(
        Job(RUN if frame is not None else SOLVE, values, partition),
        rows=rows,
        metrics=dict(made if metrics is None else metrics),
        files=dict(files or {}),
        core_s=36.0,
        training_core_s=30.0 if files else 0.0,
        source=source,
        processor={"architecture": "x86_64"},
    )


def reference_jobs() -> list[DoneJob]:
    """Jobs that have solved for the optima of the made-up suite."""
    jobs = []
    for at, site in enumerate(SITES):
        of_site = slice(at * len(WEEKS), (at + 1) * len(WEEKS))
        metrics = {
            "part": "held-out",
            "site": site,
            "weeks": list(WEEKS),
            "idle_figure": IDLE[of_site].tolist(),
            "achieved_figure": ACHIEVED[of_site].tolist(),
            "bound_figure": BOUND[of_site].tolist(),
        }
        name = f"reference-held-out-{site}"
        jobs.append(done_job(name, 0, None, spec={}, metrics=metrics))
    return jobs


def settings_of(rows: Sequence[str] = tuple(ROWS)) -> dict[str, Any]:
    """Settings of the made-up suite."""
    return {
        "name": "made-up",
        "title": "A made-up suite",
        "about": "What it shows & <what> not.",
        "objective": "carbon",
        "accounting": "standard",
        "seeds": 3,
        "cases": {
            "two-sites": {
                "about": "Two sites.",
                "sites": ["CA", "NY"],
                "training_weeks": [0],
                "validation_weeks": [1],
                "weeks": list(WEEKS),
            }
        },
        "rows": {name: ROWS[name] for name in rows},
    }


def write_study(folder: Path, *, leave_out: Sequence[str] = (), source: str = "0" * 64) -> Path:
    """Write the made-up suite, as a run of it leaves its folder."""
    jobs = reference_jobs()
    for name, spec in ROWS.items():
        for seed in range(len(SAVED_PCT.get(name, (0.0,)))):
            jobs.append(done_job(name, seed, frames_of_row(name, seed), spec=spec, source=source))
    store = ResultStore(folder)
    partitions = [dict(done.job.partition) for done in jobs]
    settings = {"quick": False, "suite": settings_of()}
    command = "sdc-taichi benchmark made-up"
    study = Study(kind="suite", command=command, settings=settings, partitions=partitions)
    with store.claimed(study):
        for done in jobs:
            if done.job.name not in leave_out:
                store.keep(done)
    return folder
