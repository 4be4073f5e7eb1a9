"""Files of known optima: optimum.json in the run folder of the achieved path.

The achieved path is stored as a normal run whose controller is named ``optimum``. ``optimum.json``
contains the objective values of the optimum. If a run was compared with an optimum, its
metrics.json contains the comparison as well.
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
"""Format version of optimum.json, stored in its field ``format``."""
FOLDER = "optimum"
"""Name of the optimum's subfolder in the folder of the run that it is compared with."""
_BOUND = "bound"
_FIGURES = ("idle", "bound", "achieved")
_ALL_OF_IT = 1.0 + 1e-6
"""Share of the achievable above which a controller counts as better than the achieved path; the
margin covers round-off."""


def optimum_content(optimum: Optimum, reached: Sequence[Achievement] = ()) -> dict[str, Any]:
    """Return the content of optimum.json."""
    dcs = range(len(optimum.names))
    total = _figures(
        {name: float(getattr(optimum, name).sum()) for name in _FIGURES},
        {name: float(values.sum()) for name, values in optimum.alone.items()},
        {name: float(values.sum()) for name, values in optimum.uncoordinated.items()},
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
    """Simulate the achieved path of an optimum, and write its run folder with optimum.json.

    Args:
        sim: Simulator for which the optimum was solved.
        optimum: The optimum.
        out: Path of the folder.
        reached: Comparisons of controllers with the optimum.
        seed: Seed of the simulator's events.
        force: True allows a folder that contains other files.
        on_step: Callback that receives the result of every step.
        stop: Callback before every step; the run ends if it returns True.

    Returns:
        True if the whole path was simulated; otherwise optimum.json is not written.

    Raises:
        SdcError: ``simulate_to_folder`` has raised it.
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
    """Find the optimum of a run in the run's folder or in its subfolder ``optimum``.

    Args:
        folder: Folder of the run.
        fingerprint: Fingerprint of the run's configs and inputs.
        steps: Number of steps of the run.

    Returns:
        Run folder of the achieved path, and content of optimum.json; None if there is no optimum
        with the same fingerprint and number of steps.

    Raises:
        SdcError: An optimum.json is damaged.
    """
    for place in (folder, folder / FOLDER):
        if os.path.isfile(place / OPTIMUM_FILE):
            content = _read(place / OPTIMUM_FILE)
            if (content["fingerprint"], content["steps"]) == (fingerprint, steps):
                return place, content
    return None


def optimum_remarks(content: Mapping[str, Any]) -> list[str]:
    """Return sentences that explain the values of an optimum, and its failed checks."""
    dcs = content["data_centers"]
    remarks = ["Achieved: what the simulator reached with all inputs known in advance."]
    if any(dc["bound_kind"] == _BOUND for dc in dcs):
        moved = content["agents"]
        of = f" of {' and '.join(moved)} alone" if set(AGENTS) - set(moved) else ""
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
    """Return sentences that qualify the share of a run: weak bounds, and violated constraints.

    Args:
        metrics: Content of metrics.json of a run that was compared with an optimum.
    """
    names, comparison = [dc["name"] for dc in metrics["data_centers"]], metrics["optimum"]
    kinds = zip(names, comparison["bound_kinds"], strict=True)
    remarks = [f"{name}: {kind}" for name, kind in kinds if kind != _BOUND]
    return remarks + [
        f"{name}: this run {text}, which the achieved path does not"
        for name, texts in zip(names, comparison["broken"], strict=True)
        for text in texts
    ]


def _data_center(optimum: Optimum, dc: int) -> dict[str, Any]:
    """Return the entry of optimum.json for one data center."""
    limit_c = float(optimum.inlet_limit_c[dc])
    figures = _figures(
        {name: float(getattr(optimum, name)[dc]) for name in _FIGURES},
        {name: float(values[dc]) for name, values in optimum.alone.items()},
        {name: float(values[dc]) for name, values in optimum.uncoordinated.items()},
    )
    return {
        "name": optimum.names[dc],
        **figures,
        "bound_kind": optimum.bound_kinds[dc],
        "inlet_limit_c": limit_c if math.isfinite(limit_c) else None,
        "certificates": {k: finite_or_none(v) for k, v in optimum.certificates[dc].items()},
        "failures": list(optimum.failures[dc]),
    }


def _figures(
    figures: Mapping[str, float], alone: Mapping[str, float], uncoordinated: Mapping[str, float]
) -> dict[str, Any]:
    """Return objective values, and the gap from bound to achieved value in % of the idle value."""
    idle, bound, achieved = (figures[name] for name in _FIGURES)
    gap = 100.0 * (achieved - bound) / idle if idle else math.nan
    return {
        **{name: finite_or_none(value) for name, value in figures.items()},
        "gap_points": finite_or_none(gap),
        "alone": {name: finite_or_none(value) for name, value in alone.items()},
        "uncoordinated": {name: finite_or_none(value) for name, value in uncoordinated.items()},
    }


def _read(path: Path) -> dict[str, Any]:
    """Read an optimum.json, and check the fields that reports read."""
    try:
        content = load_json(read_text(path, MOST_METRICS_BYTES))
    except SdcError:
        raise
    except ValueError as error:
        raise SdcError(f"{path}: not valid JSON: {error}") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        label = content.get("format") if isinstance(content, dict) else type(content).__name__
        raise SdcError(f"{path}: format {label!r}; valid is {FORMAT!r}, solve the optimum again")
    kinds: dict[str, Any] = dict.fromkeys(("fingerprint", "objective", "unit"), str)
    kinds |= dict.fromkeys(("steps", "scored_from"), int) | {"total": dict}
    kinds |= dict.fromkeys(("agents", "data_centers", "controllers"), list)
    wrong = [name for name, kind in kinds.items() if not isinstance(content.get(name), kind)]
    dcs = [] if wrong else [*content["data_centers"], content["total"]]
    keys = {"idle", "bound", "achieved", "gap_points", "alone"}
    wrong += ["data_centers" for dc in dcs if not (isinstance(dc, dict) and keys <= set(dc))][:1]
    if wrong:
        raise SdcError(f"{path}: {wrong[0]} is missing or damaged; solve the optimum again")
    return dict(content)
