"""Air in the hall: moved load, failing CRAC units, and what thermal memory changes.

    python examples/hall_studies.py FOLDER [--quick]

writes the pictures of docs/hall.md and docs/transients.md to FOLDER and prints their tables.
``--quick`` runs hours in place of months. Weather, carbon intensity and work of the study of modes
are the synthetic years of the sites.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import hall_figures
import numpy as np

from sdc_taichi import (
    Actions,
    DataCenterConfig,
    Drivers,
    Simulator,
    StepResult,
    View,
    build_fleet,
    drivers_from_arrays,
    load_config,
    make_controller,
    simulate,
)
from sdc_taichi.control import Controller
from sdc_taichi.hall.floor_plan import floor_plan
from sdc_taichi.run.metrics import Metric, metrics_per_dc
from sdc_taichi.types import F64
from sdc_taichi.viz.floor_plan_figure import floor_plan_figure

MOVED_KW = 15.0
MODES = ("quasi_steady", "transient")
SITES = ("NY", "AZ", "WA", "IL")
SEASONS = {"winter": "01-10", "summer": "07-10"}
CONTROLLERS = ("idle", "random", "g36", "coldest", "warmest", "lookahead-24h", "greedy-ci")
DAYS = 28
SUBSTEPS_S = (15, 30, 60, 120)
REFERENCE_SUBSTEP_S = 5
FOUR_UNITS = (
    "hvac.crac.units=4",
    "hall.recirculation.calibrate=rack",
    "hvac.setpoint.initial_c=22",
    "hvac.sizing.design_wet_bulb_c=26",
)
"""Four CRAC units and the same air at each rack, which the studies of failures start from."""


@dataclass(frozen=True)
class MovedLoad:
    """What moving work from one rack to another changes; (R,) each."""

    config: DataCenterConfig
    source: int
    target: int
    moved_kw: F64
    """IT power after less before."""
    change_k: F64
    """Inlet after less before."""
    distance_m: F64
    """From the inlet of each rack to the nearer of the two exhausts."""


def steady_weather(demand: float, steps: int) -> Drivers:
    """A warm day that stands still: 30 C, 22 C wet bulb, 400 g/kWh."""
    one = np.ones(steps)
    return drivers_from_arrays(30.0 * one, 22.0 * one, 400.0 * one, demand * one)


def move_load() -> MovedLoad:
    """Move 15 kW from one rack to another of a hall of 80 racks at half load.

    Placement is by weights equal to the wanted loads, so that every rack gets just its own.
    """
    config = load_config(
        "corrected",
        [
            "name=eight rows",
            "hall.recirculation.calibrate=rack",
            "hall.rows=8",
            "hall.racks_per_row=10",
            "hall.supply_approach_k=5.15",
            "hall.return_approach_k=-3.1",
            "servers.power_w=[150, 10]",
            "workload.placement=weights",
            "hvac.sizing.design_wet_bulb_c=26",
        ],
    )
    racks, source, target = config.hall.racks, 12, 67
    rack_kw = 1e-3 * sum(g.count * g.full_w for g in config.rack_groups()[0])
    step = MOVED_KW / (rack_kw * config.servers.curves.cpu_shift)
    load = np.full((2, racks), 0.5)
    load[:, source] += np.array([0.5, -0.5]) * step
    load[:, target] += np.array([-0.5, 0.5]) * step
    inlet, power = [], []
    with Simulator(config, drivers=steady_weather(0.5, 2), precision="f64") as sim:
        for placement in load:
            sim.reset()
            result = sim.step(Actions(placement=placement))
            inlet.append(result.rack_inlet_c.astype(np.float64))
            power.append(result.rack_power_w.astype(np.float64))
    plan = floor_plan(config.hall)
    to_exhausts = plan.front_m[:, None] - plan.back_m[[source, target]]
    return MovedLoad(
        config=config,
        source=source,
        target=target,
        moved_kw=(power[1] - power[0]) / 1e3,
        change_k=inlet[1] - inlet[0],
        distance_m=np.hypot(*np.moveaxis(to_exhausts, -1, 0)).min(axis=1),
    )


def failing_units(
    unit: int | None,
    *,
    thermal: str = "transient",
    steps_per_hour: int = 60,
    hours: float = 4.0,
    substep_s: float = 60.0,
) -> tuple[Simulator, list[StepResult]]:
    """One of four CRAC units down from 1 h to 2 h, or all of them (None), at 90 % load and 22 C."""
    which = "" if unit is None else f"unit: {unit}, "
    config = load_config(
        "corrected",
        [
            *FOUR_UNITS,
            "protection.ashrae_class=A2",
            f"simulation.thermal={thermal}",
            f"simulation.substep_s={substep_s}",
            f"simulation.steps_per_hour={steps_per_hour}",
            f"events.scheduled=[{{kind: crac_down, {which}start_h: 1, duration_h: 1}}]",
        ],
    )
    steps = round(hours * steps_per_hour)
    with Simulator(config, drivers=steady_weather(0.9, steps)) as sim:
        sim.reset()
        return sim, [sim.step() for _ in range(steps)]


def uncooled(rack_kw: float, event: str, minutes: int = 15) -> list[float]:
    """Mean inlet at the end of each minute in C, beginning with the one before cooling is lost.

    Full load, four CRAC units at 22 C, no protection.

    Args:
        rack_kw: IT nameplate of a rack, in kW.
        event: kind and share of the event from the start on, as in a config.
        minutes: length of the run.
    """
    config = load_config(
        "corrected",
        [
            *FOUR_UNITS,
            "servers.power_w=[150, 10]",
            f"hall.servers_per_rack={round(rack_kw * 1e3 / 150)}",
            "simulation.thermal=transient",
            "simulation.substep_s=5",
            "simulation.steps_per_hour=60",
            f"events.scheduled=[{{{event}, start_h: {1 / 60}, duration_h: 9}}]",
        ],
    )
    with Simulator(config, drivers=steady_weather(1.0, minutes + 1)) as sim:
        sim.reset()
        return [float(sim.step().inlet_mean_c[0]) for _ in range(minutes + 1)]


class SideBySide:
    """Several controllers in one fleet: data center i is driven by controller i % n."""

    def __init__(self, controllers: Sequence[Controller]) -> None:
        self._controllers = tuple(controllers)

    def reset(self, seed: int) -> None:
        """Reset all of them with the same seed."""
        for controller in self._controllers:
            controller.reset(seed)

    def act(self, view: View) -> Actions:
        """Of each controller the commands for its own data centers."""
        chosen = np.arange(view.size) % len(self._controllers)
        commands = np.zeros((3, view.size))
        for i, controller in enumerate(self._controllers):
            given = controller.act(view)
            for row, value in enumerate((given.load, given.cooling, given.battery)):
                held = 0.0 if value is None else value
                numbers = np.asarray(getattr(held, "value", held), dtype=np.float64)
                commands[row] = np.where(chosen == i, numbers, commands[row])
        return Actions(*commands)


@dataclass(frozen=True)
class ModeRun:
    """One run of all sites, seasons and controllers."""

    names: tuple[tuple[str, str, str], ...]
    """Site, season and controller of each data center."""
    metrics: list[dict[str, Metric]]
    inlet_max_c: F64
    """(steps, B), as the next two."""
    it_w: F64
    hvac_w: F64
    ms_per_step: float
    """Best tenth of the steps, so that other work on the machine does not count."""

    def column(self, name: str) -> F64:
        """A metric of every data center, (B,)."""
        return np.array([row[name] for row in self.metrics], dtype=np.float64)


def run_mode(
    overrides: Sequence[str],
    steps: int,
    *,
    sites: Sequence[str] = SITES,
    seasons: Mapping[str, str] = SEASONS,
    controllers: Sequence[str] = CONTROLLERS,
) -> ModeRun:
    """Run every controller at every site and season, in one fleet."""
    names = tuple((s, t, c) for s in sites for t in seasons for c in controllers)
    configs = [
        load_config(
            "corrected",
            [
                f"name={s}-{t}-{c}",
                f"site.location={s}",
                f"site.start={seasons[t]}",
                *overrides,
            ],
        )
        for s, t, c in names
    ]
    fleet = build_fleet(configs)
    driver = SideBySide([make_controller(name, fleet) for name in controllers])
    results: list[tuple[F64, F64, F64]] = []
    clock: list[float] = []

    def keep(result: StepResult) -> None:
        results.append((result.inlet_max_c, result.it_w, result.hvac_w))
        clock.append(time.perf_counter())

    with Simulator(fleet) as sim:
        totals = simulate(sim, driver, steps, on_step=keep)
    inlet, it_w, hvac_w = (np.array(x) for x in zip(*results, strict=True))
    return ModeRun(
        names=names,
        metrics=metrics_per_dc(totals, fleet),
        inlet_max_c=inlet,
        it_w=it_w,
        hvac_w=hvac_w,
        ms_per_step=1e3 * float(np.quantile(np.diff(clock), 0.1)),
    )


@dataclass(frozen=True)
class Ranking:
    """Whether two runs rank the controllers alike at every site and season."""

    pairs: int
    swapped: int
    """Pairs of controllers whose order differs."""
    largest_gap: float
    """By which the pairs in another order differ in either run, relative; 0 without any."""
    best_kept: int
    """Sites and seasons with the same best controller."""
    situations: int


def compare_ranking(first: ModeRun, second: ModeRun, metric: str) -> Ranking:
    """Order of the controllers by a metric, lower being better."""
    controllers = len({c for _, _, c in first.names})
    values = [r.column(metric).reshape(-1, controllers) for r in (first, second)]
    pairs = swapped = 0
    gap = 0.0
    for a, b in zip(*values, strict=True):
        for i in range(controllers):
            for j in range(i):
                pairs += 1
                if (a[i] - a[j]) * (b[i] - b[j]) < 0:
                    swapped += 1
                    gap = max(gap, abs(a[i] / a[j] - 1), abs(b[i] / b[j] - 1))
    best = sum(int(a.argmin() == b.argmin()) for a, b in zip(*values, strict=True))
    return Ranking(pairs, swapped, gap, best, len(values[0]))


def print_moved(moved: MovedLoad) -> None:
    """Change of the inlets by distance."""
    kw = moved.moved_kw
    print(
        f"moved {MOVED_KW:g} kW from rack {moved.source} to rack {moved.target}: "
        f"{kw[moved.source]:+.2f} and {kw[moved.target]:+.2f} kW with fans and inlets"
    )
    print("distance to the nearer exhaust (m)   mean change, largest change of an inlet (K)")
    edges = (0.0, 1.5, 3.0, 4.5, 6.0, 9.0)
    for low, high in pairwise(edges):
        inside = (moved.distance_m >= low) & (moved.distance_m < high)
        if inside.any():
            change = np.abs(moved.change_k[inside])
            print(f"{low:6.1f} .. {high:4.1f}   {change.mean():8.4f}  {change.max():8.4f}")


def print_failures(hours: float) -> None:
    """Peaks of both failures, by mode and time step."""
    print(
        "failure        mode          step (min)  hottest inlet (C)  supply (C)  "
        "racks throttled, tripped  lost work (%)"
    )
    for label, unit in (("1 of 4 units", 0), ("4 of 4 units", None)):
        for mode in MODES:
            for per_hour in (60, 12, 4):
                _, results = failing_units(unit, thermal=mode, steps_per_hour=per_hour, hours=hours)
                lost = sum(float(r.lost_tasks[0]) for r in results)
                arrived = sum(float(r.arrived_tasks[0]) for r in results)
                print(
                    f"{label:14} {mode:13} {60 // per_hour:10d}  "
                    f"{max(float(r.inlet_max_c[0]) for r in results):17.1f}  "
                    f"{max(float(r.supply_c[0]) for r in results):10.1f}  "
                    f"{max(float(r.throttled_racks[0]) for r in results):15.0f}, "
                    f"{max(float(r.tripped_racks[0]) for r in results):7.0f}  "
                    f"{100 * lost / arrived:13.1f}"
                )


def print_warm_up() -> None:
    """How fast halls of several densities warm without cooling."""
    print(
        "lost            kW per rack   mean inlet before, after 1, 3, 5, 10 min (C)   then (K/min)"
    )
    for label, event in (
        ("all CRAC units", "kind: crac_down"),
        ("chiller", "kind: chiller_derate, share: 0"),
    ):
        for rack_kw in (5, 10, 28):
            inlet_c = uncooled(rack_kw, event)
            shown = "  ".join(f"{inlet_c[minute]:.1f}" for minute in (0, 1, 3, 5, 10))
            rate = (inlet_c[15] - inlet_c[5]) / 10
            print(f"{label:15} {rack_kw:11d}   {shown:43}   {rate:.1f}")


def print_failing_substeps() -> None:
    """What the substep changes when units fail, at steps of 15 min."""
    print(
        "substep (s)   1 of 4 down: hottest inlet in the first step (C)   4 of 4: peak, supply (C)"
    )
    for seconds in (REFERENCE_SUBSTEP_S, *SUBSTEPS_S):
        one, all_units = (
            failing_units(unit, steps_per_hour=4, hours=2.0, substep_s=seconds)[1]
            for unit in (0, None)
        )
        peak = max(float(r.inlet_max_c[0]) for r in all_units)
        print(
            f"{seconds:11d}   {float(one[4].inlet_max_c[0]):8.2f}   {peak:8.2f}  "
            f"{float(all_units[-1].supply_c[0]):8.2f}"
        )


def print_modes(runs: Mapping[str, ModeRun]) -> None:
    """Differences of the two modes."""
    steady, moving = (runs[mode] for mode in MODES)
    print("transient less quasi-steady, by controller: mean over sites and seasons (largest)")
    print(
        f"{'controller':14} {'IT %':>16} {'HVAC %':>16} {'CFP %':>16} {'hottest inlet K':>18} "
        f"{'h above 27 C':>22}"
    )
    of = np.array([c for _, _, c in steady.names])
    for controller in dict.fromkeys(of):
        mine = of == controller
        cells = []
        for name in ("it_kwh", "hvac_kwh", "cfp_kg"):
            change = 100 * (moving.column(name) / steady.column(name) - 1)[mine]
            cells.append(f"{change.mean():+8.3f} ({np.abs(change).max():5.3f})")
        hottest = (moving.column("hottest_inlet_c") - steady.column("hottest_inlet_c"))[mine]
        cells.append(f"{hottest.mean():+9.2f} ({np.abs(hottest).max():5.2f})")
        above = [r.column("inlet_above_27_h")[mine].mean() for r in (steady, moving)]
        cells.append(f"{above[0]:9.1f} -> {above[1]:7.1f}")
        print(f"{controller:14} " + " ".join(f"{c:>16}" for c in cells))
    print_savings(runs)
    for name in ("facility_kwh", "cfp_kg"):
        rank = compare_ranking(steady, moving, name)
        print(
            f"ranking by {name}: {rank.swapped} of {rank.pairs} pairs of controllers change order, "
            f"by gaps of up to {100 * rank.largest_gap:.3f} %; same best in {rank.best_kept} of "
            f"{rank.situations} sites and seasons"
        )
    inlet = np.abs(moving.inlet_max_c - steady.inlet_max_c)
    hvac = np.abs(moving.hvac_w - steady.hvac_w) / steady.hvac_w.mean(axis=0)
    print(
        f"per step: hottest inlet differs by {inlet.mean():.3f} K on average, "
        f"{np.quantile(inlet, 0.99):.2f} K in 1 % of the steps, {inlet.max():.2f} K at most; HVAC "
        f"power by {100 * hvac.mean():.2f} %, {100 * np.quantile(hvac, 0.99):.1f} % and "
        f"{100 * hvac.max():.0f} % of its mean"
    )
    print(
        f"cost per step of {len(steady.names)} halls of 20 racks: "
        + ", ".join(f"{mode} {runs[mode].ms_per_step:.2f} ms" for mode in MODES)
        + f", ratio {moving.ms_per_step / steady.ms_per_step:.2f}"
    )


def print_coarse_cost(runs: Mapping[str, ModeRun], steps: int) -> None:
    """Cost with the longest substeps."""
    names = runs[MODES[0]].names
    coarse = run_mode(
        ["simulation.thermal=transient", f"simulation.substep_s={SUBSTEPS_S[-1]}"],
        steps,
        sites=tuple(dict.fromkeys(s for s, _, _ in names)),
        controllers=tuple(dict.fromkeys(c for _, _, c in names)),
    )
    ratio = coarse.ms_per_step / runs[MODES[0]].ms_per_step
    print(f"with substeps of {SUBSTEPS_S[-1]} s {coarse.ms_per_step:.2f} ms, ratio {ratio:.2f}")


def print_savings(runs: Mapping[str, ModeRun]) -> None:
    """What each controller saves against idling, in both modes."""
    print("against idle, mean over sites and seasons (%): quasi-steady, transient")
    print(f"{'controller':14} {'facility energy':>20} {'CFP':>20}")
    names = runs[MODES[0]].names
    controllers = list(dict.fromkeys(c for _, _, c in names))
    for i, controller in enumerate(controllers[1:], 1):
        cells = []
        for metric in ("facility_kwh", "cfp_kg"):
            saved = []
            for mode in MODES:
                table = runs[mode].column(metric).reshape(-1, len(controllers))
                saved.append(100 * (table[:, i] / table[:, 0] - 1).mean())
            cells.append(f"{saved[0]:+9.3f} {saved[1]:+9.3f}")
        print(f"{controller:14} " + " ".join(f"{c:>20}" for c in cells))


def print_substeps(steps: int) -> None:
    """How results converge with the substep, under random actions."""
    sites = SITES[:2]

    def at(seconds: float) -> ModeRun:
        overrides = ["simulation.thermal=transient", f"simulation.substep_s={seconds}"]
        return run_mode(overrides, steps, sites=sites, controllers=("random",))

    reference = at(REFERENCE_SUBSTEP_S)
    print(
        f"against substeps of {REFERENCE_SUBSTEP_S} s (random actions at {len(sites)} sites): "
        "hottest inlet (K) rms, largest; IT, HVAC energy (%) largest; ms per step"
    )
    for seconds in SUBSTEPS_S:
        found = at(seconds)
        inlet = found.inlet_max_c - reference.inlet_max_c
        energy = [
            100 * np.abs(found.column(n) / reference.column(n) - 1).max()
            for n in ("it_kwh", "hvac_kwh")
        ]
        print(
            f"{seconds:6d} s   {np.sqrt(np.mean(inlet**2)):.4f}  {np.abs(inlet).max():.3f}   "
            f"{energy[0]:.4f}  {energy[1]:.4f}   {found.ms_per_step:.2f}"
        )


def main(folder: Path, quick: bool) -> None:
    """Draw the figures and print the tables."""
    folder.mkdir(parents=True, exist_ok=True)
    hours = 2.5 if quick else 4.0
    four = load_config("corrected", ["hvac.crac.units=4"])
    floor_plan_figure(four).savefig(folder / "hall_plan.png")

    moved = move_load()
    print_moved(moved)
    hall_figures.load_shift(
        moved.config.hall, moved.change_k, moved.distance_m, (moved.source, moved.target)
    ).savefig(folder / "moved_load.png")

    one, all_units = (failing_units(unit, hours=hours) for unit in (0, None))
    times = [0.95, 1.05, 1.25, 1.95, 2.05, 2.25 if quick else 2.5]
    hall_figures.failure_maps(one[1], one[0].fleet, times).savefig(folder / "crac_failure_maps.png")
    hall_figures.failure_curves(
        {"1 of 4 CRAC units down for an hour": one[1], "all 4 down for an hour": all_units[1]},
        one[0].fleet,
    ).savefig(folder / "crac_failure.png")
    print_failures(hours)
    print_warm_up()
    print_failing_substeps()

    steps = 24 if quick else DAYS * 96
    controllers = CONTROLLERS[:3] if quick else CONTROLLERS
    sites = SITES[:1] if quick else SITES
    runs = {
        mode: run_mode([f"simulation.thermal={mode}"], steps, sites=sites, controllers=controllers)
        for mode in MODES
    }
    print_modes(runs)
    print_coarse_cost(runs, min(steps, 96))
    shown = ("NY", "summer", "random")
    at = runs[MODES[0]].names.index(shown)
    days = slice(0, steps) if quick else slice(96, 3 * 96)
    hall_figures.thermal_modes(
        {mode: (r.inlet_max_c[days, at], r.hvac_w[days, at]) for mode, r in runs.items()},
        "New York in July, random actions",
    ).savefig(folder / "modes.png")
    print_substeps(12 if quick else 7 * 96)


if __name__ == "__main__":
    arguments = [a for a in sys.argv[1:] if a != "--quick"]
    if len(arguments) != 1:
        sys.exit("usage: python examples/hall_studies.py FOLDER [--quick]")
    main(Path(arguments[0]), quick="--quick" in sys.argv)
