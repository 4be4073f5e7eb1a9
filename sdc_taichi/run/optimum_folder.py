"""Known optima as files: optimum.json, beside the run folder of the achieved path.

The achieved path is a run as any other, whose controller is named ``optimum``. ``optimum.json``
holds the figures; metrics.json of a run beside which an optimum was solved repeats its own.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sdc_taichi.config import load_json
from sdc_taichi.errors import SdcError
from sdc_taichi.optimum.problem import AGENTS
from sdc_taichi.optimum.result import Optimum
from sdc_taichi.run.achievable import OPTIMUM, AchievedPath, Achievement
from sdc_taichi.run.description import RunRequest
from sdc_taichi.run.folder_writer import OPTIMUM_FILE, metrics_json, simulate_to_folder, write_text
from sdc_taichi.run.metrics import finite_or_none
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import StepResult
from sdc_taichi.user_file import MOST_METRICS_BYTES, read_text

FORMAT = "sdc-optimum/1"
"""Version of the format of optimum.json, which its field ``format`` names."""
FOLDER = "optimum"
"""Name of the folder of an optimum inside that of the run beside which it was solved."""
_BOUND = "bound"
_FIGURES = ("idle", "bound", "achieved")
_ALL_OF_IT = 1.0 + 1e-6
"""Share of the achievable beyond which a controller does better than the achieved path."""


def optimum_content(optimum: Optimum, reached: Sequence[Achievement] = ()) -> dict[str, Any]:
    """Content of optimum.json.

    Args:
        optimum: the optimum.
        reached: what controllers reached beside it.
    """
    dcs = range(len(optimum.names))
    total = _figures(
        {name: float(getattr(optimum, name).sum()) for name in _FIGURES},
        {name: float(values.sum()) for name, values in optimum.alone.items()},
    )
    return {
        "format": FORMAT,
        "fingerprint": optimum.fingerprint,
        "objective": str(optimum.objective),
        "unit": optimum.objective.unit,
        "agents": list(optimum.agents),
        "steps": optimum.steps,
        "scored_from": optimum.scored_from,
        "data_centers": [_data_center(optimum, dc) for dc in dcs],
        "total": total,
        "controllers": [
            {
                "controller": each.controller,
                "share": finite_or_none(each.total_share),
                "data_centers": [
                    {
                        "figure": float(each.figure[dc]),
                        "valued_figure": finite_or_none(each.valued_figure[dc]),
                        "share": finite_or_none(each.share[dc]),
                        "broken": list(each.broken[dc]),
                    }
                    for dc in dcs
                ],
            }
            for each in reached
        ],
    }


def write_optimum(
    sim: Simulator,
    optimum: Optimum,
    out: Path,
    *,
    reached: Sequence[Achievement] = (),
    seed: int = 0,
    force: bool = False,
    on_step: Callable[[StepResult], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> bool:
    """Run the achieved path of an optimum once more, into a run folder with optimum.json.

    Args:
        sim: the simulator that the optimum is of.
        optimum: the optimum.
        out: the folder.
        reached: what controllers reached beside it.
        seed: of the simulator's events.
        force: also write into a folder with other files.
        on_step: called with the result of every step.
        stop: asked before every step; true ends the run.

    Returns:
        Whether the whole path was run; without, there is no optimum.json.

    Raises:
        SdcError: as ``simulate_to_folder``.
    """
    request = RunRequest(OPTIMUM, optimum.steps, seed)
    written = simulate_to_folder(
        sim, AchievedPath(optimum), request, out, force=force, on_step=on_step, stop=stop
    )
    if written is None or written["steps_done"] < optimum.steps:
        return False
    write_text(out / OPTIMUM_FILE, f"{metrics_json(optimum_content(optimum, reached))}\n")
    return True


def find_optimum(folder: Path, fingerprint: str, steps: int) -> tuple[Path, dict[str, Any]] | None:
    """The optimum of a run: of its own folder, or of the folder ``optimum`` in it.

    Args:
        folder: folder of the run.
        fingerprint: fingerprint of the run's configs and inputs.
        steps: number of its steps.

    Returns:
        Run folder of the achieved path, and content of optimum.json; None if there is none of
        equal inputs and steps.

    Raises:
        SdcError: an optimum.json that is damaged.
    """
    for place in (folder, folder / FOLDER):
        if os.path.isfile(place / OPTIMUM_FILE):
            content = _read(place / OPTIMUM_FILE)
            if (content["fingerprint"], content["steps"]) == (fingerprint, steps):
                return place, content
    return None


def optimum_remarks(content: Mapping[str, Any]) -> list[str]:
    """Explanations of the figures of an optimum, and checks that failed, in words.

    Args:
        content: content of optimum.json.
    """
    dcs = content["data_centers"]
    remarks = ["Achieved: what the simulator reached with all inputs known in advance."]
    if any(dc["bound_kind"] == _BOUND for dc in dcs):
        moved = content["agents"]
        of = "" if len(moved) == len(AGENTS) else f" of {' and '.join(moved)} alone"
        remarks.insert(
            0,
            f"Bound: with these inputs, no controller{of} that keeps the constraints and ends as "
            "it began comes below it.",
        )
    remarks += [f"{dc['name']}: {dc['bound_kind']}" for dc in dcs if dc["bound_kind"] != _BOUND]
    remarks += [f"{dc['name']}: does not hold: {text}" for dc in dcs for text in dc["failures"]]
    for each in content["controllers"]:
        remarks += [
            f"{dc['name']}: {each['controller']} {text}, which the achieved path does not"
            for dc, reached in zip(dcs, each["data_centers"], strict=True)
            for text in reached["broken"]
        ]
        remarks += [
            f"{dc['name']}: {each['controller']} reaches {100.0 * reached['share']:.2f} % of the "
            "achievable, more than the achieved path: the best is between it and the bound"
            for dc, reached in zip(dcs, each["data_centers"], strict=True)
            if reached["share"] is not None
            and reached["share"] > _ALL_OF_IT
            and not reached["broken"]
        ]
    return remarks


def remarks_beside(metrics: Mapping[str, Any]) -> list[str]:
    """Reservations about the share of a run, in words: bounds that are none, limits that it breaks.

    Args:
        metrics: content of metrics.json of a run beside an optimum.
    """
    names, beside = [dc["name"] for dc in metrics["data_centers"]], metrics["optimum"]
    kinds = zip(names, beside["bound_kinds"], strict=True)
    remarks = [f"{name}: {kind}" for name, kind in kinds if kind != _BOUND]
    return remarks + [
        f"{name}: this run {text}, which the achieved path does not"
        for name, texts in zip(names, beside["broken"], strict=True)
        for text in texts
    ]


def _data_center(optimum: Optimum, dc: int) -> dict[str, Any]:
    """What optimum.json says of a data center."""
    limit_c = float(optimum.inlet_limit_c[dc])
    figures = _figures(
        {name: float(getattr(optimum, name)[dc]) for name in _FIGURES},
        {name: float(values[dc]) for name, values in optimum.alone.items()},
    )
    return {
        "name": optimum.names[dc],
        **figures,
        "bound_kind": optimum.bound_kinds[dc],
        "inlet_limit_c": limit_c if math.isfinite(limit_c) else None,
        "certificates": {k: finite_or_none(v) for k, v in optimum.certificates[dc].items()},
        "failures": list(optimum.failures[dc]),
    }


def _figures(figures: Mapping[str, float], alone: Mapping[str, float]) -> dict[str, Any]:
    """Figures, and the gap between bound and achieved in % of the idle figure."""
    idle, bound, achieved = (figures[name] for name in _FIGURES)
    gap = 100.0 * (achieved - bound) / idle if idle else math.nan
    return {
        **{name: finite_or_none(value) for name, value in figures.items()},
        "gap_points": finite_or_none(gap),
        "alone": {name: finite_or_none(value) for name, value in alone.items()},
    }


def _read(path: Path) -> dict[str, Any]:
    """Content of an optimum.json, checked as far as reports rely on it."""
    try:
        content = load_json(read_text(path, MOST_METRICS_BYTES))
    except SdcError:
        raise
    except ValueError as error:
        raise SdcError(f"{path}: not valid JSON: {error}") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        found = content.get("format") if isinstance(content, dict) else type(content).__name__
        raise SdcError(f"{path}: format {found!r}; valid is {FORMAT!r}, solve the optimum again")
    kinds: dict[str, Any] = dict.fromkeys(("fingerprint", "objective", "unit"), str)
    kinds |= dict.fromkeys(("steps", "scored_from"), int) | {"total": dict}
    kinds |= dict.fromkeys(("agents", "data_centers", "controllers"), list)
    wrong = [name for name, kind in kinds.items() if not isinstance(content.get(name), kind)]
    dcs = [] if wrong else [*content["data_centers"], content["total"]]
    whole = {"idle", "bound", "achieved", "gap_points", "alone"}
    wrong += ["data_centers" for dc in dcs if not (isinstance(dc, dict) and whole <= set(dc))][:1]
    if wrong:
        raise SdcError(f"{path}: {wrong[0]} is missing or damaged; solve the optimum again")
    return dict(content)
