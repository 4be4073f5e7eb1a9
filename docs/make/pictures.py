"""Pictures of the documentation: a hall, a week, a year, a fleet, and controllers compared.

    python docs/make/pictures.py docs/img

All inputs are synthetic years.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from sdc_taichi import (
    Actions,
    RunRequest,
    Simulator,
    StepResult,
    load_config,
    make_controller,
    simulate_to_folder,
)
from sdc_taichi.hall.air_metrics import allowable_c
from sdc_taichi.run.folder_reader import read_flows, read_racks, read_run, read_steps
from sdc_taichi.viz import dashboards, figures, fleet_figures, flow_figures, rack_maps
from sdc_taichi.viz.figures import clock_text, draw_hall, hall_map, overview, step_time
from sdc_taichi.viz.plotting import DPI, drawn, format_time_axis, new_figure, webp
from sdc_taichi.viz.report_flows import flow_panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DAY = 96
WEEK = 7 * DAY
COMMAND_SHARE = 0.1
"""Share of a full command; the whole would empty the queue or fill the battery in a step or two."""
CONTROLLERS = {
    "idle": "idle",
    "g36": "g36",
    "g36, battery looks ahead": "cooling=g36,battery=lookahead-24h",
    "g36, load and battery greedy": "load=greedy-ci,cooling=g36,battery=greedy-ci",
}


def save(figure: Figure, path: Path, dpi: int = DPI) -> None:
    """Write a picture as WebP."""
    path.write_bytes(webp(drawn(figure, dpi)))


def draw_week(folder: Path) -> None:
    """A week of July in a mixed hall, in which work waits while the grid emits much carbon."""
    config = load_config("hall_of_2026", ["site.location=NY", "site.start=07-01"])
    with Simulator(config) as sim:
        sim.reset()
        days = np.reshape([sim.drivers.at(step).ci_g_per_kwh for step in range(WEEK)], (-1, DAY))
        cleaner = (days.mean(axis=1, keepdims=True) - days) / days.std(axis=1, keepdims=True)
        results = []
        for command in np.clip(cleaner.ravel(), -1.0, 1.0):
            load = command if command < 0.0 else COMMAND_SHARE * command
            results.append(sim.step(Actions(load=load, battery=COMMAND_SHARE * command)))
    rows = [{name: values[0] for name, values in result.per_dc().items()} for result in results]
    times = pd.date_range("2018-07-01", periods=WEEK, freq="15min")
    steps = pd.DataFrame({"time": times}).join(pd.DataFrame(rows))
    hottest = max(results, key=lambda result: float(result.rack_outlet_c.max()))
    hall_map(hottest, sim.fleet).savefig(folder / "hall.png")
    overview(steps).savefig(folder / "week.png")
    readme_picture(sim, hottest, steps).savefig(folder / "overview.png")


def readme_picture(sim: Simulator, result: StepResult, steps: pd.DataFrame) -> Figure:
    """The hall in one step beside power, carbon and queue of the week, 1600 x 700 pixels."""
    figure = new_figure(16.0, 7.0)
    left, right = figure.subfigures(1, 2, width_ratios=[4, 5], squeeze=False)[0]
    for quantity, axes in zip(("inlet", "outlet"), left.subplots(2, 1), strict=True):
        draw_hall(axes, quantity, result, sim.fleet, 0)
    left.suptitle(f"Racks on {clock_text(result, sim.fleet, 0)}", fontsize=13)
    right.suptitle("Power, carbon, queue and battery", fontsize=13)
    panels = right.subplots(3, 1, sharex=True, height_ratios=[4, 3, 3])
    draws = (figures.draw_power, figures.draw_carbon, figures.draw_storage)
    for axes, draw in zip(panels, draws, strict=True):
        draw(axes, steps)
        axes.axvline(step_time(result, sim.fleet, 0), color="black", linewidth=1, linestyle=":")
    format_time_axis(panels[-1])
    return figure


def simulate_run(out: Path, controller: str, days: int, values: list[str]) -> dict[str, Any]:
    """Write the run folder of a data center in New York; return the content of metrics.json."""
    with Simulator(load_config("corrected", ["site.location=NY", *values])) as sim:
        request = RunRequest(controller, days * 24 * sim.fleet.steps_per_hour)
        metrics = simulate_to_folder(sim, make_controller(controller, sim.fleet), request, out)
    assert metrics is not None
    return metrics


def draw_year(folder: Path, scratch: Path) -> None:
    """Dashboards of a year."""
    simulate_run(scratch, CONTROLLERS["g36, load and battery greedy"], 365, [])
    (steps,) = read_steps(read_run(scratch), [0])
    save(dashboards.year(steps, "New York"), folder / "year.webp", dpi=75)
    save(dashboards.day(steps, "07-15", "New York"), folder / "day.webp")
    save(dashboards.setpoint_scatter(steps, "New York"), folder / "setpoint_scatter.webp", dpi=85)
    save(dashboards.battery_profile(steps, "New York"), folder / "battery_profile.webp")


def draw_racks(folder: Path, scratch: Path) -> None:
    """Racks of a mixed hall over two weeks of July, with two setpoints."""
    racks_of = {}
    hall = load_config("hall_of_2026")
    for setpoint_c in (23, 25):
        values = ["site.location=NY", "site.start=07-01", f"hvac.setpoint.initial_c={setpoint_c}"]
        out = scratch / f"racks-{setpoint_c}"
        with Simulator(load_config("hall_of_2026", values)) as sim:
            request = RunRequest("idle", 14 * DAY)
            simulate_to_folder(sim, make_controller("idle", sim.fleet), request, out)
        (racks_of[f"supply air of {setpoint_c} °C"],) = read_racks(read_run(out), [0])
    allowable = allowable_c(hall.protection.ashrae_class)[1]
    save(rack_maps.inlet_map(racks_of, hall.hall, allowable), folder / "rack_inlets.webp")


def draw_controllers(folder: Path, scratch: Path) -> None:
    """July under several controllers."""
    totals = {
        label: simulate_run(scratch / str(index), name, 31, ["site.start=07-01"])["total"]
        for index, (label, name) in enumerate(CONTROLLERS.items())
    }
    save(fleet_figures.radar(totals), folder / "radar.webp")


def draw_fleet(folder: Path, scratch: Path) -> None:
    """Work that the sites of a fleet send to each other in a week of January."""
    with Simulator(load_config("fleet_of_eight")) as sim:
        controller = make_controller("geo=geo-central,load=greedy-ci", sim.fleet)
        simulate_to_folder(sim, controller, RunRequest("geo-central", WEEK), scratch)
    run = read_run(scratch)
    flows = read_flows(run)
    assert flows is not None
    figure = flow_figures.flow_map(flow_panels(run, flows), run.names, flows.place_deg)
    (folder / "fleet_flows.webp").write_bytes(webp(drawn(figure, 110), colours=64))


def main(folder: Path) -> None:
    """Write the pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    draw_week(folder)
    with tempfile.TemporaryDirectory() as scratch:
        draw_controllers(folder, Path(scratch))
        draw_year(folder, Path(scratch) / "year")
        draw_racks(folder, Path(scratch))
        draw_fleet(folder, Path(scratch) / "fleet")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
