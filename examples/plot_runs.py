"""Pictures of runs, controllers and inputs.

    python examples/plot_runs.py FOLDER

writes a year of a data center in New York and a day of it (g36, greedy on carbon intensity),
July under several controllers, a CRAC failure as animation, and what drives the embedded sites. All
inputs are synthetic years.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import input_figures

from sdc_taichi import RunRequest, Simulator, load_config, make_controller, simulate_to_folder
from sdc_taichi.exogenous.synthetic import synthetic_sites, synthetic_traces
from sdc_taichi.run.folder_reader import read_racks, read_run, read_steps
from sdc_taichi.viz import dashboards, data_figures, fleet_figures
from sdc_taichi.viz.animation import write_animation
from sdc_taichi.viz.plotting import DPI, webp

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CONTROLLERS = {
    "idle": "idle",
    "g36": "g36",
    "g36, battery looks ahead": "cooling=g36,battery=lookahead-24h",
    "g36, load and battery greedy": "load=greedy-ci,cooling=g36,battery=greedy-ci",
}
FAILURE = (
    "name=New York",
    "hvac.crac.units=4",
    "simulation.thermal=transient",
    "simulation.steps_per_hour=12",
    "events.scheduled=[{kind: crac_down, unit: 0, start_h: 4, duration_h: 2},"
    "{kind: crac_down, unit: 2, start_h: 8, duration_h: 1}]",
)
FAILURE_STEPS = 168


def save(figure: Figure, path: Path, dpi: int = DPI) -> None:
    """Write a picture small."""
    path.write_bytes(webp(figure, dpi)[2])


def simulate_run(out: Path, controller: str, days: int, values: list[str]) -> dict[str, Any]:
    """Write the run folder of one data center; the content of metrics.json."""
    with Simulator(load_config("corrected", ["site.location=NY", *values])) as sim:
        steps = days * 24 * sim.fleet.steps_per_hour
        driver = make_controller(controller, sim.fleet)
        written = simulate_to_folder(sim, driver, RunRequest(controller, steps), out)
    if written is None:
        raise RuntimeError("the run has no steps")
    return written


def plot_year(folder: Path, scratch: Path) -> None:
    """Dashboards of a year."""
    simulate_run(scratch, CONTROLLERS["g36, load and battery greedy"], 365, [])
    (steps,) = read_steps(read_run(scratch), [0])
    save(dashboards.year(steps, "New York"), folder / "year.webp", dpi=75)
    save(dashboards.day(steps, "07-15", "New York"), folder / "day.webp")
    save(dashboards.setpoint_scatter(steps, "New York"), folder / "setpoint_scatter.webp", dpi=85)
    save(dashboards.battery_profile(steps, "New York"), folder / "battery_profile.webp")
    hall = load_config("corrected").hall
    (racks,) = read_racks(read_run(scratch), [0])
    save(dashboards.hot_racks(racks, hall, "New York"), folder / "hot_racks.webp")


def plot_controllers(folder: Path, scratch: Path) -> None:
    """July under several controllers."""
    totals = {
        label: simulate_run(scratch / str(index), name, 31, ["site.start=07-01"])["total"]
        for index, (label, name) in enumerate(CONTROLLERS.items())
    }
    save(fleet_figures.radar(totals), folder / "radar.webp")


def plot_failure(folder: Path) -> None:
    """CRAC units that fail one after the other."""
    with Simulator(load_config("corrected", ["site.start=07-01", *FAILURE])) as sim:
        sim.reset()
        steps = (sim.step() for _ in range(FAILURE_STEPS))
        write_animation(folder / "crac_failure.webp", steps, sim.fleet)


def plot_inputs(folder: Path) -> None:
    """Workload, temperature and carbon intensity of the embedded years."""
    note = "synthetic years, seed 10"
    traces = input_figures.trace_series(synthetic_traces())
    outdoor = input_figures.site_series(synthetic_sites(), "outdoor_c")
    carbon = input_figures.site_series(synthetic_sites(), "ci_g_per_kwh")
    work, heat, grid = data_figures.WORKLOAD, data_figures.TEMPERATURE, data_figures.CARBON
    for name, figure in (
        ("workload", input_figures.year_panels(traces, work, note)),
        ("workload_week", input_figures.first_week(traces, work, note)),
        ("temperature", input_figures.year_panels(outdoor, heat, note)),
        ("temperature_compared", data_figures.comparison(outdoor, heat, note)),
        ("carbon", input_figures.year_panels(carbon, grid, note)),
        ("carbon_compared", data_figures.comparison(carbon, grid, note)),
        ("carbon_variation", data_figures.carbon_variation(carbon, note)),
    ):
        save(figure, folder / f"{name}.webp")


def main(folder: Path) -> None:
    """Write the pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    plot_inputs(folder)
    plot_failure(folder)
    with tempfile.TemporaryDirectory() as scratch:
        plot_controllers(folder, Path(scratch))
        plot_year(folder, Path(scratch) / "year")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python examples/plot_runs.py FOLDER")
    main(Path(sys.argv[1]))
