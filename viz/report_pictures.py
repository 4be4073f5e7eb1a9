"""Sections of a report with pictures: fleet, data centers, inputs, and a known optimum."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import SdcError
from sdc_taichi.hall.air_metrics import RECOMMENDED_C, TIE_K, allowable_c, rank
from sdc_taichi.optimum.objective import Objective
from sdc_taichi.run.achievable import OPTIMUM
from sdc_taichi.run.folder_reader import (
    RunFolder,
    is_number,
    read_configs,
    read_fleet_steps,
    read_racks,
    read_run,
    read_steps,
)
from sdc_taichi.run.optimum_folder import find_optimum, optimum_remarks, remarks_beside

from . import dashboards, data_figures, figures, fleet_figures, rack_maps
from .plotting import format_number, scale_thousands, with_local_time
from .report_html import (
    DASH,
    MAX_ROWS,
    Block,
    first_texts,
    folded,
    paragraph,
    picture,
    table,
    time_text,
)

if TYPE_CHECKING:
    import pandas as pd

MAX_SHOWN_DCS = 3
"""Largest number of data centers that all have pictures; larger fleets show extreme ones."""
MAX_DETAILED_DCS = 2
"""Largest number of shown data centers with pictures of setpoints and battery, so that a report
stays small."""
YEAR_FROM_H = 48.0
"""Shortest run that is drawn as heat maps by day and hour, in h."""


_SAVED = {
    "carbon": "carbon_g",
    "energy": "grid_kwh",
    "cost": "energy_cost",
    "water": "water_l",
}
"""Column of steps.parquet that measures each objective of an optimum.

The pictures show the day with the largest saving in this column.
"""


@dataclass(frozen=True, slots=True)
class ShownDataCenter:
    """A data center with its own section of pictures in a report."""

    index: int
    """Index of the data center in the fleet."""
    reason: str
    """Reason for showing the data center, as text; empty if all data centers are shown."""
    steps: pd.DataFrame
    """Rows of steps.parquet of the data center."""
    racks: pd.DataFrame
    """Statistics of each rack over the run, as ``read_racks`` returns them."""
    config: DataCenterConfig
    """Config of the data center."""


def fleet_section(run: RunFolder) -> list[Block]:
    """Return the section of the whole fleet: sums over the run, and hottest inlets over time."""
    fleet = read_fleet_steps(run)
    count = len(run.names)
    powers_kw = (fleet.series["it_w"] + fleet.series["overhead_w"]).to_numpy() / 1e3
    power, unit = scale_thousands(powers_kw, "kW", "MW")
    overview = picture(
        fleet_figures.fleet_overview(fleet.series),
        f"Power, PUE, emitted carbon and hottest inlets of all {count} data centers over the run. "
        f"Highest power {power.max():.3g} {unit}, "
        f"hottest inlet {fleet.series['inlet_max_c'].max():.1f} °C.",
        f"Sums over the {count:,} data centers step by step, each on its own clock; the axis shows "
        f"that of {run.names[0]}. Below, the hottest inlet of each data center: median, the middle "
        "80 % and the highest.",
    )
    if len(fleet.inlet_max_c) > 1:
        order = np.argsort(-rank(fleet.inlet_max_c.max(axis=0)), kind="stable")[:3]
        hottest = ", ".join(run.names[dc] for dc in order)
        cut = (
            f" The {fleet_figures.MAX_MAP_ROWS} hottest of {count:,} are shown."
            if count > fleet_figures.MAX_MAP_ROWS
            else ""
        )
        hot_halls = picture(
            fleet_figures.fleet_map(fleet.edge_times, fleet.inlet_max_c, run.names),
            f"Hottest inlet of each data center over time, hottest data centers first: {hottest}.",
            f"Which halls ran hot, and when: the hottest inlet of each.{cut}",
        )
        return [overview, hot_halls]
    return [overview]


def shown_data_centers(run: RunFolder) -> list[ShownDataCenter]:
    """Return the data centers with pictures: all in small fleets, or those with extreme metrics."""
    dcs = run.metrics["data_centers"]
    if len(dcs) <= MAX_SHOWN_DCS:
        reasons = dict.fromkeys(range(len(dcs)), "")
    else:
        reasons = {}
        for key, best, text in (
            ("hottest_inlet_c", max, "hottest inlet"),
            ("pue", max, "highest PUE"),
            ("cue_kg_per_kwh", max, "most carbon per IT energy"),
        ):
            known = [i for i, dc in enumerate(dcs) if dc["metrics"][key] is not None]
            # If a metric has the same value in all data centers, none of them is extreme.
            if len({dcs[i]["metrics"][key] for i in known}) > 1:
                dc = best(known, key=lambda i: dcs[i]["metrics"][key])
                reasons[dc] = f"{reasons[dc]}, {text}" if dc in reasons else f"it has the {text}"
        reasons = reasons or {0: "hottest inlet, PUE and carbon are equal in all"}
    shown = list(reasons)
    parts = read_steps(run, shown), read_racks(run, shown), read_configs(run, shown)
    return [
        ShownDataCenter(index, reason, with_local_time(steps), racks, config)
        for (index, reason), steps, racks, config in zip(reasons.items(), *parts, strict=True)
    ]


def data_center_section(
    run: RunFolder, dc: ShownDataCenter, *, detailed: bool = True, has_maps: bool = True
) -> list[Block]:
    """Return the section of a data center: text, pictures and config.

    Args:
        run: the run.
        dc: the data center.
        detailed: True to include pictures of setpoints and battery.
        has_maps: True to include the maps of the racks.
    """
    steps, hall = dc.steps, dc.config.hall
    parts = [paragraph(f"Shown because {dc.reason} of {len(run.names):,}.")] if dc.reason else []
    location = run.metrics["data_centers"][dc.index]["location"]
    text = f"{hall.rows} rows of {hall.racks_per_row} racks, site {location}."
    if dc.config.description:
        text = f"{dc.config.description.rstrip('.')}; {text}"
    parts.append(paragraph(text))
    if len(steps) < 2:
        parts.append(paragraph("A single step has no pictures."))
    else:
        at = steps.iloc[int(rank(steps["inlet_max_c"].to_numpy()).argmax())]
        when = f"{at['inlet_max_c']:.1f} °C on {time_text(run, at['time'].to_pydatetime())}"
        conditions = (
            f"At its hottest inlet, {when}: outdoor {at['outdoor_c']:.1f} °C, wet bulb "
            f"{at['wet_bulb_c']:.1f} °C, setpoint {at['setpoint_c']:.1f} °C, supply air "
            f"{at['supply_c']:.1f} °C, IT {format_number(at['it_w'] / 1e3)} kW, HVAC "
            f"{format_number(at['hvac_w'] / 1e3)} kW, airflow of CRAC units "
            f"{format_number(at['crac_flow_m3s'])} and of servers "
            f"{format_number(at['it_airflow_m3s'])} m³/s."
        )
        parts.append(paragraph(conditions))
        parts += rack_maps_blocks({"": run}, dc) if has_maps else []
        parts += _data_center_pictures(run, dc, when, detailed)
    return [*parts, folded("Configuration", dc.config.to_yaml())]


def _data_center_pictures(
    run: RunFolder, dc: ShownDataCenter, hottest_text: str, detailed: bool
) -> list[Block]:
    """Return the pictures of one data center.

    Args:
        run: the run.
        dc: the data center.
        hottest_text: temperature and time of the hottest inlet of the data center, as text.
        detailed: True to include pictures of setpoints and battery.
        has_maps: True to include the maps of the racks.
    """
    name, steps = run.names[dc.index], dc.steps
    out = _whole_run_picture(run, name, steps)
    date = dashboards.hottest_day(steps)
    if int((steps["time"].dt.strftime("%Y-%m-%d") == date).sum()) > 1:
        events = run.metrics["data_centers"][dc.index]["events"]
        out.append(
            picture(
                dashboards.day(steps, date, name, events),
                f"Temperatures, power, carbon, commands, queue and battery of {name} on the day of "
                f"its hottest inlet, {hottest_text}.",
                "The day of the hottest inlet. The dotted line is 27 °C, the highest recommended "
                "inlet; failures and racks under protection are shaded.",
            )
        )
    if detailed and float(np.ptp(steps["setpoint_c"])) > 0:
        out.append(
            picture(
                dashboards.setpoint_scatter(steps, name),
                f"Steps of {name} by outdoor temperature and IT power, coloured by setpoint, by "
                "HVAC power as a share of IT power, and by hottest inlet.",
                "Which setpoint was used at which weather and load, what cooling cost there and "
                "how hot it became.",
            )
        )
    if detailed and float(np.ptp(steps["soc"])) > 0:
        out.append(
            picture(
                dashboards.battery_profile(steps, name),
                f"Carbon intensity, battery power and battery charge of {name} by time of day.",
                "What the battery did over the day. Lines are means over the days, bands hold 80 % "
                "of them.",
            )
        )
    return out


def rack_maps_blocks(runs: Mapping[str, RunFolder], dc: ShownDataCenter) -> list[Block]:
    """Return the maps of the racks over each run: highest inlet, and hours above the recommended.

    Args:
        runs: runs of one hall, keyed by name; a single run needs no name.
        dc: the data center, as the first of the runs shows it.
    """
    hall, first, (_, recommended_c) = dc.config.hall, next(iter(runs.values())), RECOMMENDED_C
    name = first.names[dc.index]
    allowable = allowable_c(dc.config.protection.ashrae_class)[1]
    racks_of = {label: read_racks(run, [dc.index])[0] for label, run in runs.items()}
    hours = dc.racks["hottest_h"].to_numpy()
    rack = int(hours.argmax())
    others = int(np.count_nonzero(hours == hours.max())) - 1
    most_often = (
        f"Most often the hottest was row {rack // hall.racks_per_row}, rack {rack}"
        f"{f' and {others} more' * (others > 0)}: "
        f"{100 * hours.max() / first.hours:.0f} % of the time. "
        if len(runs) == 1
        else ""
    )
    inlet = picture(
        rack_maps.inlet_map(racks_of, hall, allowable),
        f"Map of the racks of {name} by their highest inlet over the run. {most_often}",
        f"Highest inlet of each rack over the run. The colours change at {recommended_c:g} °C, the "
        f"highest recommended inlet, and at {allowable:g} °C, the highest allowable one. "
        f"{most_often}Row 0 is on top; racks within {TIE_K:g} K of the hottest are marked.",
    )
    above = {label: racks for label, racks in racks_of.items() if racks["above_27_h"].any()}
    never = ", ".join(label for label in racks_of if label not in above)
    cool = f"No rack was above {recommended_c:g} °C, the highest recommended inlet"
    if not above:
        return [inlet, paragraph(f"{cool}, at any time.")]
    caption = (
        f"How long the hottest inlet of each rack was above {recommended_c:g} °C, the highest "
        "recommended inlet; grey racks never were."
    )
    return [
        inlet,
        picture(
            rack_maps.hours_map(above, hall),
            f"Map of the racks of {name} by the hours in which an inlet was above "
            f"{recommended_c:g} °C.",
            f"{caption} {f'{cool} in {never}.' if never else ''}",
        ),
    ]


def _whole_run_picture(run: RunFolder, name: str, steps: pd.DataFrame) -> list[Block]:
    """Return heat maps by day and hour, or a step plot for short runs; empty up to one day."""
    if run.hours >= YEAR_FROM_H:
        whole = picture(
            dashboards.year(steps, name),
            f"Weather, hottest inlet, power and carbon of {name} by day and hour of the day, "
            "and energy and carbon by day or month.",
            "The run by day, to the right, and time of day, upwards.",
        )
        return [whole]
    if run.hours > 24.0:
        whole = picture(
            figures.overview(steps),
            f"Weather, power by device, carbon, queue and battery of {name} over the run.",
            f"The whole run of {name}.",
        )
        return [whole]
    return []


def inputs_section(run: RunFolder, shown: Sequence[ShownDataCenter]) -> list[Block]:
    """Return the section of pictures of the inputs: weather, carbon intensity and workload."""
    names = [run.names[dc.index] for dc in shown]
    origin = "as the run read them" + (", SYNTHETIC in part" if run.metrics["synthetic"] else "")
    out = []
    for column, quantity, label in (
        ("outdoor_c", data_figures.TEMPERATURE, "Outdoor temperature"),
        ("ci_g_per_kwh", data_figures.CARBON, "Carbon intensity"),
        ("demand", data_figures.WORKLOAD, "Arriving work"),
    ):
        series = _shared_series(names, [dc.steps.set_index("time")[column] for dc in shown])
        means = ", ".join(
            f"{name} {quantity.factor * values.mean():.4g}" for name, values in series.items()
        )
        out.append(
            picture(
                data_figures.comparison(series, quantity),
                f"{label} by time and by hour of the day. Means: {means}.",
                f"{label}, {origin}.",
            )
        )
        # The relative variation of a day is undefined if the mean carbon intensity of it is zero.
        has_means = all(data_figures.daily(values).mean().min() > 0 for values in series.values())
        if column == "ci_g_per_kwh" and has_means and len(series) > 1:
            out.append(
                picture(
                    data_figures.carbon_variation(series),
                    "Mean carbon intensity against its variation within the day.",
                    "Mean carbon intensity against its variation within the day: to the right, the "
                    "time of use matters more.",
                )
            )
    return out


def _shared_series(names: Sequence[str], all_series: Sequence[pd.Series]) -> dict[str, pd.Series]:
    """Return series keyed by the names of data centers, joined if their series are equal."""
    groups: list[tuple[list[str], pd.Series]] = []
    for name, values in zip(names, all_series, strict=True):
        same = next((group for group, series in groups if series.equals(values)), None)
        if same is None:
            groups.append(([name], values))
        else:
            same.append(name)
    return {", ".join(group): series for group, series in groups}


@dataclass(frozen=True, slots=True)
class KnownOptimum:
    """A known optimum for the inputs of a run."""

    run: RunFolder
    """Run folder of the simulation that reached the optimum's achieved figure."""
    content: Mapping[str, Any]
    """Content of optimum.json."""


def known_optimum(runs: Sequence[RunFolder]) -> KnownOptimum | None:
    """Return an optimum for the inputs and steps of the first run, or None if there is none.

    The optimum may be in the folder of any of the runs.

    Raises:
        SdcError: an optimum is damaged, or is for other data centers or steps.
    """
    first = runs[0].metrics
    for run in runs:
        stored = find_optimum(run.path, first["fingerprint"], first["steps_done"])
        if stored is not None:
            place, content = stored
            best = run if place == run.path else read_run(place)
            names = [dc.get("name") for dc in content["data_centers"]]
            if names != runs[0].names or best.metrics["steps_done"] != first["steps_done"]:
                raise SdcError(f"{place}: optimum of other data centers; solve it again")
            return KnownOptimum(best, content)
    return None


def optimum_section(
    run: RunFolder, optimum: KnownOptimum, shown: Sequence[ShownDataCenter]
) -> list[Block]:
    """Return the section of an optimum: its table, and pictures of the day of largest saving."""
    content = optimum.content
    of_run = remarks_beside(run.metrics) if _beside_optimum(run, content) is not None else []
    remarks = first_texts(list(dict.fromkeys([*optimum_remarks(content), *of_run])))
    parts = [*map(paragraph, remarks), _optimum_table(run, content)]
    if run.metrics["steps_done"] > 1:
        parts += [_day_picture(run, optimum, dc) for dc in shown]
    return parts


def share_of(run: RunFolder, optimum: KnownOptimum) -> float | None:
    """Return the share of the achievable of a run, or None if its files do not determine it.

    The share is 0 for idle commands and 1 for the achieved path of the optimum. If metrics.json
    does not contain the share, it is computed from the metrics of the run, provided that the run
    ends with an empty queue and has not used the battery. Other runs end in a state whose value
    would have to be included.

    Args:
        run: the run.
        optimum: an optimum, possibly for other inputs.
    """
    content = optimum.content
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
    idle, achieved = best["idle"], best["achieved"]
    ends_differ = total["queue_end_tasks"] != 0 or _uses_battery(run)
    if ends_differ or content["scored_from"] or not idle > achieved:
        return None
    figure = Objective.parse(content["objective"]).figure(
        **{name: total[name] for name in ("cfp_kg", "grid_kwh", "cost", "water_l")}
    )
    return float((idle - figure) / (idle - achieved))


def _uses_battery(run: RunFolder) -> bool:
    """Return True if a battery of a run has done more than to draw its standby."""
    total, dcs = run.metrics["total"], range(len(run.names))
    if total["battery_charge_kwh"] == 0 or total["battery_discharge_kwh"] > 0:
        return bool(total["battery_discharge_kwh"] > 0)
    return any(
        bool(np.any(np.abs(steps["soc"] - config.battery.initial_soc) > 1e-9))
        for steps, config in zip(read_steps(run, dcs, ["soc"]), read_configs(run, dcs), strict=True)
    )


def _beside_optimum(run: RunFolder, content: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the entry ``optimum`` of a run's metrics.json if it is about the same optimum.

    None means that there is no such entry, or that it has another objective, other agents or
    another first scored step.
    """
    entry = run.metrics.get("optimum")
    if entry is None:
        return None
    decisive = ("objective", "agents", "scored_from")
    return entry if all(entry.get(name) == content[name] for name in decisive) else None


def _optimum_table(run: RunFolder, content: Mapping[str, Any]) -> Block:
    """Return the table of figures of an optimum, for each data center and for all together."""
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
    for i, (dc, of_run) in enumerate(zip(dcs, run.metrics["data_centers"], strict=True)):
        shares = (each["data_centers"][i].get("share") for each in controllers)
        rows.append(row(dc["name"], dc, of_run["metrics"], shares))
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
    return table(caption, heads, rows, numbers=range(1, len(heads)))


def _percent(share: Any) -> float | None:
    """Convert a share to %, or return None if it is not a number."""
    return 100.0 * share if is_number(share) else None


def _day_picture(run: RunFolder, optimum: KnownOptimum, dc: ShownDataCenter) -> Block:
    """Return the picture of the day on which the optimum saves most against the run.

    If the run is that of the optimum, the picture shows the day on which the battery moves most
    energy.
    """
    name = run.names[dc.index]
    objective = str(optimum.content["objective"])
    saving = objective if objective in _SAVED else "carbon"
    if optimum.run is run:
        steps_of = {OPTIMUM: dc.steps}
        saved = (dc.steps["charge_kwh"] + dc.steps["discharge_kwh"]).to_numpy()
        caption = "The day on which the battery moves most energy, on the achieved path."
    else:
        (best,) = read_steps(
            optimum.run, [dc.index], [*figures.OPTIMUM_COLUMNS[1:], _SAVED[saving]]
        )
        steps_of = {run.metrics["controller"]: dc.steps, OPTIMUM: best}
        saved = (dc.steps[_SAVED[saving]] - best[_SAVED[saving]]).to_numpy()
        caption = f"The day on which the achieved path saves most {saving} against this run."
    date = figures.day_of_most_saved(saved, dc.steps["time"])
    return picture(
        figures.optimum_day(steps_of, date, name, by_price=objective == "cost"),
        f"Grid, utilisation, setpoint and battery charge of {name} on a day under "
        f"{' and '.join(steps_of)}.",
        caption,
    )
