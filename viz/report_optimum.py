"""Section of a report about a known optimum of the run's inputs, and shares in comparisons."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sdc_taichi.errors import SdcError
from sdc_taichi.optimum.objective import Objective
from sdc_taichi.run.achievable import OPTIMUM
from sdc_taichi.run.folder_reader import RunFolder, is_number, read_run, read_steps
from sdc_taichi.run.folder_writer import METRICS_FILE
from sdc_taichi.run.optimum_folder import find_optimum, optimum_remarks, remarks_beside

from .optimum_figure import COLUMNS, day_of_most_saved, optimum_day
from .plotting import format_number
from .report_html import DASH, MAX_ROWS, first_texts, html_table, paragraph, picture_element
from .report_pictures import ShownDataCenter

_SAVED = {
    "carbon": "carbon_g",
    "energy": "grid_kwh",
    "cost": "energy_cost",
    "water": "water_l",
}
"""Columns of steps.parquet by the objectives of which days are told."""


@dataclass(frozen=True, slots=True)
class KnownOptimum:
    """An optimum of the inputs of a run."""

    run: RunFolder
    """Run folder of the achieved path."""
    content: Mapping[str, Any]
    """Content of optimum.json."""


def known_optimum(runs: Sequence[RunFolder]) -> KnownOptimum | None:
    """An optimum of the inputs and steps of the first of some runs, in the folder of any of them.

    Raises:
        SdcError: an optimum that is damaged.
    """
    first = runs[0].metrics
    for run in runs:
        found = find_optimum(run.path, first["fingerprint"], first["steps_done"])
        if found is not None:
            place, content = found
            best = run if place == run.path else read_run(place)
            names = [dc.get("name") for dc in content["data_centers"]]
            if names != runs[0].names or best.metrics["steps_done"] != first["steps_done"]:
                raise SdcError(f"{place}: optimum of other data centers; solve it again")
            return KnownOptimum(best, content)
    return None


def optimum_section(run: RunFolder, optimum: KnownOptimum, shown: Sequence[ShownDataCenter]) -> str:
    """Figures of an optimum, and its day beside that of the run.

    Args:
        run: the run.
        optimum: an optimum of its inputs.
        shown: data centers with pictures.
    """
    content = optimum.content
    own = remarks_beside(run.metrics) if _beside_optimum(run, content) is not None else []
    remarks = first_texts(list(dict.fromkeys([*optimum_remarks(content), *own])))
    parts = [*map(paragraph, remarks), _table(run, content)]
    if run.metrics["steps_done"] > 1:
        parts += [_day_picture(run, optimum, dc) for dc in shown]
    return "".join(parts)


def shares_of(runs: Sequence[RunFolder], optimum: KnownOptimum) -> list[float | None]:
    """Share of the achievable of each run; None where its files do not tell it.

    Where metrics.json does not hold it, a run that ends with no work waiting and has not used the
    battery ends as it began, and its figure tells its share.

    Args:
        runs: the runs.
        optimum: an optimum of the inputs of the first.
    """
    return [_share_of(run, optimum.content) for run in runs]


def _share_of(run: RunFolder, content: Mapping[str, Any]) -> float | None:
    """Share of the achievable of a run."""
    if run.metrics["fingerprint"] != content["fingerprint"]:
        return None
    if run.metrics["controller"] == OPTIMUM and find_optimum(
        run.path, content["fingerprint"], content["steps"]
    ):
        return 1.0
    if _beside_optimum(run, content) is not None:
        share = run.metrics["total"].get("achievable_share")
        return float(share) if is_number(share) else None
    total, best = run.metrics["total"], content["total"]
    used = ("queue_end_tasks", "battery_charge_kwh", "battery_discharge_kwh")
    idle, achieved = best["idle"], best["achieved"]
    ends_differ = any(total[name] != 0 for name in used)
    if ends_differ or content["scored_from"] or not idle > achieved:
        return None
    figure = Objective.parse(content["objective"]).figure(
        **{name: total[name] for name in ("cfp_kg", "grid_kwh", "cost", "water_l")}
    )
    return float((idle - figure) / (idle - achieved))


def _beside_optimum(run: RunFolder, content: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """What metrics.json says of an optimum of this objective, agents and steps; None if nothing.

    Raises:
        SdcError: it is damaged.
    """
    own = run.metrics.get("optimum")
    if own is None:
        return None
    lists = ("bound_kinds", "broken")
    size = len(run.names)
    if not isinstance(own, dict) or any(
        not isinstance(own.get(name), list) or len(own[name]) != size for name in lists
    ):
        raise SdcError(f"{run.path / METRICS_FILE}: optimum is damaged; simulate the run again")
    decisive = ("objective", "agents", "scored_from")
    return own if all(own.get(name) == content[name] for name in decisive) else None


def _table(run: RunFolder, content: Mapping[str, Any]) -> str:
    """Figures of each data center and of all."""
    controllers, dcs = content["controllers"], content["data_centers"]
    beside = _beside_optimum(run, content) is not None
    heads = ["data center", "idle", "bound", "achieved", "gap (points)"]
    heads += [f"{name} alone" for name in content["total"]["alone"]]
    heads += ["this run, ends valued", "share (%)"] if beside else []
    heads += [f"{each['controller']}, share (%)" for each in controllers]

    def row(
        name: str, figures: Mapping[str, Any], metrics: Mapping[str, Any], shares: Iterable[Any]
    ) -> list[str]:
        values = [figures[key] for key in ("idle", "bound", "achieved", "gap_points")]
        values += list(figures["alone"].values())
        if beside:
            values += [metrics.get("valued_figure"), _percent(metrics.get("achievable_share"))]
        values += map(_percent, shares)
        return [name, *(format_number(v) if is_number(v) else DASH for v in values)]

    rows = []
    for i, (dc, own) in enumerate(zip(dcs, run.metrics["data_centers"], strict=True)):
        shares = (each["data_centers"][i].get("share") for each in controllers)
        rows.append(row(dc["name"], dc, own["metrics"], shares))
    caption = (
        f"Objective {content['objective']}: figures in {content['unit'].replace('CO2', 'CO₂')}, "
        "less is better; the gap between bound and achieved in % of idle; shares of the "
        "achievable, 0 as good as idle commands and 100 as good as the achieved path"
    )
    if len(rows) > MAX_ROWS:
        caption += f"; the first {MAX_ROWS} data centers, and all together"
        rows = rows[:MAX_ROWS]
    if len(dcs) > 1:
        shares = (each.get("share") for each in controllers)
        rows.append(row("all", content["total"], run.metrics["total"], shares))
    return html_table(caption, heads, rows, numbers=range(1, len(heads)))


def _percent(share: Any) -> float | None:
    """A share in %."""
    return 100.0 * share if is_number(share) else None


def _day_picture(run: RunFolder, optimum: KnownOptimum, dc: ShownDataCenter) -> str:
    """The day on which the optimum saves most against the run, of one data center."""
    name = run.names[dc.index]
    objective = str(optimum.content["objective"])
    saving = objective if objective in _SAVED else "carbon"
    if optimum.run is run:
        steps_of = {OPTIMUM: dc.steps}
        saved = (dc.steps["charge_kwh"] + dc.steps["discharge_kwh"]).to_numpy()
        caption = "The day on which the battery moves most energy, on the achieved path."
    else:
        (best,) = read_steps(optimum.run, [dc.index], [*COLUMNS[1:], _SAVED[saving]])
        steps_of = {run.metrics["controller"]: dc.steps, OPTIMUM: best}
        saved = (dc.steps[_SAVED[saving]] - best[_SAVED[saving]]).to_numpy()
        caption = f"The day on which the achieved path saves most {saving} against this run."
    date = day_of_most_saved(saved, dc.steps["time"])
    return picture_element(
        optimum_day(steps_of, date, name, by_price=objective == "cost"),
        f"Grid, utilisation, setpoint and battery charge of {name} on a day under "
        f"{' and '.join(steps_of)}.",
        caption,
    )
