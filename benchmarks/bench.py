"""Speed beside its targets in one run; docs/performance.md explains both.

    python benchmarks/bench.py [--quick] [--out runs/bench]

Prints tables, and writes them as bench.json and bench.md, and cost against size as bench.png.
Speed is judged by ratios of core time alone: to the two yardsticks of yardsticks.py, or to
the same work in C. Steps per second and seconds are printed beside the ratios, since
they belong to the machine and the hour. Nothing here fails for being slow: "met" and "not met" are
for people to read.
"""

import argparse
import contextlib
import importlib.metadata
import json
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import fresh
import numpy as np
import steps
from peer import Arguments, MissingError, c_step
from yardsticks import core_ratios, core_s, interpreter_loop, plain_store

import sdc_taichi
from sdc_taichi.kernels.compiler import runtime
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_solver import Hall
from sdc_taichi.types import ServerLayers

HERE = Path(__file__).parent
LIBRARIES = ("numpy", "taichi", "gymnasium", "pettingzoo")
SIZES = ((4096, 20, 200), (256, 1000, 40), (1, 100_000, 40))
QUICK_SIZES = ((4, 20, 200), (1, 400, 40))
"""Data centers, racks of each and servers of a rack of the halls beside the peer."""
LC_OPT_STEP_S, LC_OPT_STEPS_PER_S = 15.0, 61.0
"""Length of a step of LC-Opt, whose Modelica model is one data center, and its highest speed."""
CURVE = (3, 25, 250, 2500, 25_000)
"""Data centers of 4,000 servers of the curve of cost against size: 1e4 to 1e8 servers."""


@dataclass(frozen=True)
class Figure:
    """A measured value and its target, if it has one."""

    part: str
    name: str
    value: float | None
    unit: str = ""
    at_most: float | None = None
    at_least: float | None = None
    absolute: str = ""
    """Time or rate of this machine behind a ratio, with its unit, such as ``259 us/step``."""
    note: str = ""
    """Why there is no value, or how the value was measured."""

    @property
    def target(self) -> str:
        """The target as text, empty without one."""
        if self.at_most is not None:
            return f"<= {number(self.at_most)}"
        return "" if self.at_least is None else f">= {number(self.at_least)}"

    def met(self, quick: bool) -> bool | None:
        """Whether the target is met; None without one, or for a speed at tiny size."""
        if self.value is None or not self.target or (quick and self.unit != "relative"):
            return None
        if self.at_most is not None:
            return self.value <= self.at_most
        return self.at_least is not None and self.value >= self.at_least


def number(value: float) -> str:
    """Three significant digits, none after the point from 100 on."""
    if abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:.2g}" if 0 < abs(value) < 0.01 else f"{value:.3g}"


def child(part: str, *arguments: Any, **variables: str) -> Any:
    """Result of a function of fresh.py, which runs in a new process."""
    done = subprocess.run(
        [sys.executable, str(HERE / "fresh.py"), part, json.dumps(arguments)],
        check=True,
        env=os.environ | variables,
        stdout=subprocess.PIPE,
        text=True,
    )
    return json.loads(done.stdout.splitlines()[-1])


def kernel_and_peer(quick: bool) -> Iterator[Figure]:
    """Flat halls: share of the memory roof, reduction alone, and the same work in C."""
    threads, rounds = runtime.ensure_started(), 1 if quick else 20
    fleets = {
        " x ".join(map(str, size)): steps.fleet_of(*size, "approach")
        for size in (QUICK_SIZES if quick else SIZES)
    }
    count, servers = (4, 20) if quick else (1024, 200)
    unlike = steps.unlike(["hall.inlet_model=approach", *steps.STRAIGHT_LINES], servers)
    fleets[f"{count} x 20 x {servers}, each server its own"] = sdc_taichi.build_fleet(
        sdc_taichi.make_configs(unlike, count=count)
    )
    for name, fleet in fleets.items():
        yield from beside_peer(name, fleet, threads, rounds)


def beside_peer(name: str, fleet: Fleet, threads: int, rounds: int) -> Iterator[Figure]:
    """Figures of one fleet: medians over the rounds of times and of their ratios."""
    alike, conditions = fleet.groups < fleet.servers, steps.conditions(fleet)
    hall = Hall(fleet, "f32")
    sums, layers = hall.solve(conditions), hall.servers()
    reduction, whole = steps.stepped(fleet)
    calls = {"roof": plain_store(fleet.servers), "reduction": reduction, "step": whole}
    arguments = Arguments(fleet, conditions)
    try:
        calls["c"] = c_step(arguments, threads)
    except MissingError as error:
        yield Figure("kernel", f"{name}: C", None, note=f"skipped: {error}")
    spent_s = core_s(calls, rounds)

    def each(what: str, called: str) -> Figure:
        ns = 1e9 * float(np.median(spent_s[what])) / fleet.servers
        return Figure("kernel", f"{name}: {called}", ns, "ns/server")

    def over(what: str, other: str) -> float:
        return float(np.median(spent_s[what] / spent_s[other]))

    if alike:
        yield each("roof", "memory roof")
    yield each("step", "step with layers")
    for called, what, other, at_most, at_least in (
        ("share of the roof", "roof", "step", None, 0.5),
        ("reduction over step", "reduction", "step", 0.5, None),
    ):
        limits = (at_most, at_least) if alike else ()
        yield Figure("kernel", f"{name}: {called}", over(what, other), "", *limits)
    if "c" in calls:
        yield each("c", "C")
        slowest = 1.6 if alike else 2.2
        yield Figure("kernel", f"{name}: C, ours over it", over("step", "c"), at_most=slowest)
        summed = np.stack([sums.cpu_w, sums.it_fan_w, sums.it_airflow_m3s])
        apart = difference(arguments, layers, summed)
        yield Figure("kernel", f"{name}: C, largest difference", apart, "relative", at_most=1e-5)


def difference(arguments: Arguments, layers: ServerLayers, sums: Any) -> float:
    """Largest relative difference of the peer's layers and sums from ours."""
    pairs = [
        (arguments.layers.inlet_c, layers.inlet_c),
        (arguments.layers.outlet_c, layers.outlet_c),
        (arguments.layers.power_w, layers.power_w),
        (arguments.sums.T, sums),
    ]
    return max(float(np.max(np.abs(theirs / ours - 1.0))) for theirs, ours in pairs)


def environments(quick: bool) -> Iterator[Figure]:
    """Environment steps over the yardsticks, three agents with observations and rewards."""
    seconds, rounds = (0.005, 1) if quick else (1.0, 20)
    many, some, most = (8, 2, 4) if quick else (4096, 64, 1024)
    corrected = sdc_taichi.load_config("corrected")
    transient = sdc_taichi.load_config("corrected", ["simulation.thermal=transient"])
    unlike = steps.unlike([], 4 if quick else 200)
    interpreter, roof = "the interpreter yardstick", "the memory roof"

    one = steps.single_step(corrected)
    ratio = core_ratios({"step": one}, interpreter_loop(), rounds)["step"]
    spent_us = f"{number(1e6 / steps.rate(one, 1, seconds))} us/step"
    where = f"corrected, PettingZoo, N = 1, over {interpreter}"
    yield Figure("environments", where, ratio, at_most=2.0, absolute=spent_us)
    runs = (
        ("corrected", corrected, some, interpreter, 2.2),
        ("corrected", corrected, many, roof, 1.0),
        ("corrected, transient", transient, many, interpreter, 130.0),
        ("sustaindc", sdc_taichi.load_config("sustaindc"), many, roof, 0.9),
        ("corrected, each server its own", unlike, most, interpreter, 35.0),
    )
    for name, config, count, yardstick, at_most in runs:
        where = f"{name}, N = {count}"
        with steps.batch_step(config, count) as step:
            servers = sdc_taichi.build_fleet(config).servers * count
            compared = interpreter_loop() if yardstick is interpreter else plain_store(servers)
            ratio = core_ratios({"step": step}, compared, rounds)["step"]
            per_s = steps.rate(step, count, seconds)
        beside = f"{number(per_s)} steps/s"
        over = f"{where}, over {yardstick}"
        yield Figure("environments", over, ratio, at_most=at_most, absolute=beside)
        if count == many:
            yield from breakdown(where, config, count, count / per_s, seconds)


def breakdown(
    name: str, config: sdc_taichi.DataCenterConfig, count: int, env_s: float, seconds: float
) -> Iterator[Figure]:
    """Share of an environment step spent in the simulator, and in quasi-steady halls."""
    fleet = sdc_taichi.build_fleet(sdc_taichi.make_configs(config, count=count))
    parts = {}
    if fleet.models["thermal"] == "quasi_steady":
        parts["thermal kernel"] = steps.rate(steps.stepped(fleet)[0], 1, seconds)
    sim = sdc_taichi.Simulator(fleet)
    sim.reset()
    parts["simulator"] = steps.rate(sim.step, 1, seconds)
    for part, per_s in parts.items():
        share = 1.0 / per_s / env_s
        yield Figure("environments", f"{name}: {part} of the step", share)


def planned(quick: bool) -> Iterator[Figure]:
    """Steps of a simulator under model-predictive control over the interpreter yardstick."""
    count, rounds = (2, 1) if quick else (104, 10)
    for name, at_most in (("mpc-24h", 350.0), ("mpc-72h", 700.0)):
        with steps.controlled_step("corrected", name, count) as step:
            ratio = core_ratios({"step": step}, interpreter_loop(), rounds)["step"]
            per_s = steps.rate(step, count, 0.005 if quick else 1.0)
        where = f"{name}, {count} data centers, over the interpreter yardstick"
        beside = f"{number(per_s)} steps/s"
        yield Figure("planned", where, ratio, at_most=at_most, absolute=beside)


def halls(quick: bool) -> Iterator[Figure]:
    """Sweeps of the halls of the presets in runs, and a step of 100,000 racks over the roof."""
    for preset in ("corrected", "large", "hall_of_2026"):
        sweeps = steps.sweeps_of_run(preset, 2 if quick else 96)
        note = ", ".join(f"{100 * np.mean(sweeps == n):.0f} % {n}" for n in np.unique(sweeps))
        mean = float(sweeps.mean())
        yield Figure("halls", f"{preset}: sweeps of a step", mean, "sweeps", 2.0, note=note)
    sim = sdc_taichi.Simulator(sdc_taichi.load_config("large", steps.side_of(12 if quick else 320)))
    sim.reset()
    roof = plain_store(sim.fleet.servers)
    ratio = core_ratios({"step": sim.step}, roof, 1 if quick else 40)["step"]
    beside = f"{number(1e3 * wall_s(sim.step, 1 if quick else 10))} ms/step"
    name = f"{sim.fleet.racks:,} racks, over the memory roof"
    yield Figure("halls", name, ratio, at_most=2.0, absolute=beside)


def liquid(quick: bool) -> Iterator[Figure]:
    """Transient coolant loops alone, with five CDUs of three racks as in LC-Opt."""
    count, step_s = (2, 60.0) if quick else (4096, 900.0)
    step = steps.coolant_step(count, step_s)
    ratio = core_ratios({"step": step}, interpreter_loop(), 1 if quick else 5)["step"]
    per_s = count * step_s / LC_OPT_STEP_S / wall_s(step, 1 if quick else 3)
    where = f"{count:,} data centers, {step_s:g} s"
    beside = f"{number(per_s)} steps of {LC_OPT_STEP_S:g} s/s"
    over = f"{where}, over the interpreter yardstick"
    yield Figure("liquid", over, ratio, at_most=3000.0, absolute=beside)
    faster = per_s / LC_OPT_STEPS_PER_S
    note = "LC-Opt was measured on another machine"
    yield Figure("liquid", f"{where}: speed over LC-Opt", faster, at_least=1000.0, note=note)


def calls(quick: bool) -> Iterator[Figure]:
    """Number of calls of a step, which should be small and not depend on the batch."""
    many = 8 if quick else 96
    for name, overrides, at_most in (
        ("corrected", (), 4),
        ("corrected, transient", ("simulation.thermal=transient",), 5),
    ):
        kernels = steps.kernel_calls_of(steps.simulator_step(many, *overrides))
        yield Figure("calls", f"{name}: kernels of a step", kernels, "calls", at_most=at_most)
    for name, make, at_most in (
        ("simulator", steps.simulator_step, 300),
        ("vector_env", steps.environment_step, 350),
    ):
        few, most = (steps.calls_of(make(size), "call") for size in (2, many))
        yield Figure("calls", f"{name}: Python functions of a step", few, "calls", at_most=at_most)
        yield Figure("calls", f"{name}: N = {many} beyond N = 2", most - few, "calls", at_most=0)


def scaling(quick: bool) -> Iterator[Figure]:
    """Cost against size, threads, processes, memory, and growth."""
    repeats = 1 if quick else 10
    per_server = {}
    for count in CURVE[:3] if quick else CURVE:
        servers = 4000 * count
        fleet = steps.fleet_of(count, 20, 200, "approach")
        step = steps.stepped(fleet)[1]
        per_server[servers] = 1e9 * wall_s(step, repeats) / servers
        yield Figure("scaling", size_name(servers), per_server[servers], "ns/server")
        if count == CURVE[0]:
            fixed = core_ratios({"step": step}, interpreter_loop(), repeats)["step"]
        del fleet, step
    least = min(per_server)
    where = f"{size_name(least)}: a step over the interpreter yardstick"
    spent_us = f"{number(1e-3 * per_server[least] * least)} us/step"
    yield Figure("scaling", where, fixed, at_most=1.5, absolute=spent_us)
    costs = list(per_server.values())
    larger = costs[2:] or costs
    spread = max(larger) / min(larger)
    yield Figure("scaling", "dearest size over cheapest from 1e6 servers on", spread, at_most=3.0)
    if not fresh.MEMORY.exists():
        yield Figure("scaling", "memory", None, note="skipped: read from /proc, which is Linux's")
        return
    for name, count, each, at_most in (
        ("alike", 10 if quick else 2500, False, 24.0),
        ("each its own, transient", 2 if quick else 256, True, 40.0),
    ):
        used = child("memory", count, each)
        note = f"{number(used['most'])} while it is built"
        yield Figure(
            "scaling", f"memory, servers {name}", used["held"], "B/server", at_most, None, note
        )
    count = 10 if quick else 10_000
    grown = child("cycles", count) / 2**20
    yield Figure("scaling", f"growth over {count:,} reset and close cycles", grown, "MB", 1.0)


def size_name(servers: int) -> str:
    """For example 1e+06 servers."""
    return f"{servers:.0e} servers"


def wall_s(call: Callable[[], object], repeats: int) -> float:
    """Least wall time of several runs of about 10 ms or more, s."""
    call()
    begin = time.perf_counter()
    call()
    times = max(1, int(0.01 / max(time.perf_counter() - begin, 1e-9)))
    spent = []
    for _ in range(repeats):
        begin = time.perf_counter()
        for _ in range(times):
            call()
        spent.append((time.perf_counter() - begin) / times)
    return min(spent)


def starting(quick: bool) -> Iterator[Figure]:
    """Import, init and first step in a new process, with an empty and a filled kernel cache."""
    cases = {"simulator": 12.0, "environment": 12.0, "100,000 racks": 60.0}
    for what, warm_at_most in [*cases.items()][: 1 if quick else None]:
        with tempfile.TemporaryDirectory() as cache:
            # Bytecode is kept, as of an installed package, whatever the shell says.
            around = {"TI_OFFLINE_CACHE_FILE_PATH": cache, "PYTHONDONTWRITEBYTECODE": ""}
            for state, at_most in (("cold", warm_at_most + 18.0), ("warm", warm_at_most)):
                ratios, spent_s = [], []
                for _ in range(1 if quick or state == "cold" else 5):
                    begin = time.time()
                    measured = child("first_step", what, **around)
                    spent_s.append(measured["end_s"] - begin)
                    ratios.append(measured["core_s"] / (1000.0 * measured["yardstick_s"]))
                name = f"{what}, {state}, over 1,000 interpreter yardsticks"
                beside = f"{number(min(spent_s))} s"
                ratio = float(np.median(ratios))
                yield Figure("start", name, ratio, at_most=at_most, absolute=beside)


def optima(quick: bool) -> Iterator[Figure]:
    """Known optima, from the import to the last run, each in a new process."""
    every = ",".join(steps.SITES)
    cases = [("ny,ca", 2, None)] if quick else [(every, 31, 500.0), ("ny", 365, 1000.0)]
    for sites, days, at_most in cases:
        measured = child("optimum", sites, days)
        name = f"{sites.count(',') + 1} sites, {days} days"
        ratio = measured["core_s"] / (1000.0 * measured["yardstick_s"])
        beside = f"{number(measured['wall_s'])} s, {number(measured['core_s'])} core s"
        over = f"{name}, over 1,000 interpreter yardsticks"
        yield Figure("optima", over, ratio, at_most=at_most, absolute=beside)
        yield Figure("optima", f"{name}, memory", measured["most_mb"], "MB", at_most=2000.0)


def recording(quick: bool) -> Iterator[Figure]:
    """A month of simulators and environments with a recorder and without."""
    days, repeats = (1, 1) if quick else (31, 7)
    runs = [
        (f"simulator, {count} data centers", simulated, count)
        for count in ((1, 2) if quick else (1, 4, 64))
    ]
    most = 2 if quick else 64
    runs += [("PettingZoo, N = 1", played, 1), (f"vector_env, N = {most}", played, most)]
    for name, make, count in runs:
        spent: list[list[float]] = [[], []]
        with contextlib.ExitStack() as made:
            folder = made.enter_context(tempfile.TemporaryDirectory())
            files = None, Path(folder, "run.rrd")
            kinds = [make(count, days, file, made) for file in files]
            for _ in range(repeats):
                for run, times in zip(kinds, spent, strict=True):
                    begin = time.perf_counter()
                    run()
                    times.append(time.perf_counter() - begin)
        ratio = min(spent[1]) / min(spent[0])
        beside = f"{number(min(spent[1]))} s"
        yield Figure("recording", f"{name}, {days} days", ratio, at_most=1.6, absolute=beside)


def large_recording(quick: bool) -> Iterator[Figure]:
    """A recorded day of a very large hall, in which a CRAC unit fails."""
    from sdc_taichi.viz.recorder import Recorder

    rows, per_row = (50, 50) if quick else (320, 320)
    config = sdc_taichi.load_config(
        "large",
        [
            f"hall.rows={rows}",
            f"hall.racks_per_row={per_row}",
            "hvac.crac.units=64",
            "events.scheduled=[{kind: crac_down, unit: 9, start_h: 14, duration_h: 3}]",
        ],
    )
    step_count = 96
    step_s, record_s = np.zeros(step_count), np.zeros(step_count)
    with tempfile.TemporaryDirectory() as folder, sdc_taichi.Simulator(config) as sim:
        file = Path(folder, "run.rrd")
        sim.reset()
        with Recorder(file) as recorder:
            recorder.begin(sim)
            for step in range(step_count):
                begin = time.thread_time()
                result = sim.step()
                between = time.thread_time()
                recorder.add(result)
                step_s[step] = between - begin
                record_s[step] = time.thread_time() - between
        size_kb = file.stat().st_size / 1e3 / step_count
    name = f"{rows * per_row:,} racks, a day"
    ratio = 1.0 + float(record_s.sum() / step_s.sum())
    beside = f"{number(float(record_s.mean()) * 1e3)} ms/step"
    yield Figure("recording", name, ratio, at_most=2.0, absolute=beside)
    slowest = f"{name}, slowest step over a mean step without recording"
    beside = f"{number(float(record_s.max()) * 1e3)} ms"
    ratio = float(record_s.max() / step_s.mean())
    yield Figure("recording", slowest, ratio, at_most=12.0, absolute=beside)
    yield Figure("recording", f"{name}, file per step", size_kb, "kB", at_most=20.0)


def rack_histories(quick: bool) -> Iterator[Figure]:
    """Runs that write a history of racks in every step, over the same run without it."""
    from sdc_taichi.control import make_controller
    from sdc_taichi.run.description import RunRequest
    from sdc_taichi.run.folder_writer import simulate_to_folder
    from sdc_taichi.run.rack_history import history_request

    count, rounds, racks = (4, 1, 5) if quick else (960, 7, 40)
    requests = {
        "without": None,
        "all racks": history_request(None, "every=step"),
        "the ten hottest racks": history_request("hottest:10", "every=step"),
    }
    config = sdc_taichi.load_config("large", ["hall.rows=25", f"hall.racks_per_row={racks}"])
    with tempfile.TemporaryDirectory() as folder, sdc_taichi.Simulator(config) as sim:
        controller = make_controller("idle", sim.fleet)

        def simulate(name: str) -> None:
            out, history = Path(folder, name), requests[name]
            simulate_to_folder(sim, controller, RunRequest("idle", count), out, history=history)

        spent_s = core_s({name: partial(simulate, name) for name in requests}, rounds)
        where = f"{sim.fleet.racks:,} racks"
    for name in [*requests][1:]:
        ratio = float(np.median(spent_s[name] / spent_s["without"]))
        beside = f"{number(1e3 * float(np.median(spent_s[name])) / count)} ms/step"
        figure = f"history of {name}, {where}"
        yield Figure("recording", figure, ratio, at_most=1.25, absolute=beside)


def simulated(
    count: int, days: int, file: Path | None, made: contextlib.ExitStack
) -> Callable[[], None]:
    """Run of a simulator, recorded if there is a file."""
    from sdc_taichi.viz.recorder import Recorder

    configs = sdc_taichi.make_configs(sdc_taichi.load_config("corrected"), count=count)
    sim = made.enter_context(sdc_taichi.Simulator(configs))

    def run() -> None:
        sim.reset()
        if file is None:
            for _ in range(96 * days):
                sim.step()
            return
        with Recorder(file) as recorder:
            recorder.begin(sim)
            for _ in range(96 * days):
                recorder.add(sim.step())

    return run


def played(
    count: int, days: int, file: Path | None, made: contextlib.ExitStack
) -> Callable[[], None]:
    """Episode of that many environments, recorded if there is a file."""
    recorder = None
    if file is not None:
        recorder = sdc_taichi.EpisodeRecorder(file, episode_trigger=lambda _: True)
    env: Any
    if count == 1:
        env = sdc_taichi.parallel_env("corrected", days=days, recorder=recorder)
        actions: dict[str, Any] = dict.fromkeys(env.possible_agents, 1)
    else:
        env = sdc_taichi.vector_env(count, "corrected", days=days, recorder=recorder)
        actions = dict.fromkeys(env.possible_agents, np.ones(count, np.int64))
    made.callback(env.close)

    def run() -> None:
        env.reset(seed=0)
        for _ in range(96 * days):
            env.step(actions)

    return run


def machine() -> dict[str, Any]:
    """Facts of the machine and versions."""
    model = platform.processor()
    if Path("/proc/cpuinfo").exists():
        named = re.search(r"model name\s*:\s*(.*)", Path("/proc/cpuinfo").read_text())
        model = named[1].strip() if named else model
    versions = {name: importlib.metadata.version(name) for name in LIBRARIES}
    versions |= {"python": platform.python_version(), "sdc-taichi": sdc_taichi.__version__}
    return {
        "cpu": model,
        "cores": os.cpu_count(),
        "threads": runtime.ensure_started(),
        "system": f"{platform.system()} {platform.machine()}",
        "versions": versions,
    }


def show(figure: Figure, last: str, quick: bool) -> None:
    """One line of the table, under a head when a part begins."""
    if figure.part != last:
        print(f"\n{figure.part:<66}{'value':>12} {'unit':<10}{'target':>8} {'':<8}absolute")
    value = "-" if figure.value is None else number(figure.value)
    met = {True: "met", False: "NOT MET", None: ""}[figure.met(quick)]
    line = f"  {figure.name:<64}{value:>12} {figure.unit:<10}{figure.target:>8} {met:<8}"
    print(f"{line}{figure.absolute}{figure.note}".rstrip(), flush=True)


def markdown(figures: list[Figure], quick: bool) -> str:
    """Tables of all figures."""
    lines = []
    for part in dict.fromkeys(f.part for f in figures):
        lines += [
            f"\n**{part.capitalize()}**\n",
            "| figure | value | target | | absolute |",
            "|---|---|---|---|---|",
        ]
        for f in figures:
            if f.part == part:
                value = f.note if f.value is None else f"{number(f.value)} {f.unit}".strip()
                met = {True: "met", False: "not met", None: ""}[f.met(quick)]
                lines.append(f"| {f.name} | {value} | {f.target} | {met} | {f.absolute} |")
    return "\n".join(lines).lstrip() + "\n"


def plot(figures: list[Figure], path: Path) -> None:
    """Draw cost per server against size, beside the memory roof at all threads."""
    from matplotlib.figure import Figure as Canvas

    costs = {
        float(f.name.split()[0]): f.value
        for f in figures
        if f.unit == "ns/server" and f.part == "scaling"
    }
    roofs = [f.value for f in figures if f.name.endswith(": memory roof") and f.value is not None]
    canvas = Canvas(figsize=(6.4, 4.0), layout="constrained")
    axes = canvas.subplots()
    axes.loglog(*zip(*costs.items(), strict=True), "o-", label="step with layers")
    axes.axhline(min(roofs) / runtime.ensure_started(), color="C1", ls="--", label="memory roof")
    axes.set(xlabel="servers", ylabel="wall time per server and step [ns]")
    axes.grid(alpha=0.3)
    axes.legend()
    canvas.savefig(path, dpi=150)


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="tiny sizes, for correctness only")
    parser.add_argument("--out", type=Path, default=Path("runs/bench"), help="folder to write to")
    options = parser.parse_args()
    quick: bool = options.quick
    options.out.mkdir(parents=True, exist_ok=True)
    facts = machine()
    print(json.dumps(facts, indent=1))
    figures: list[Figure] = []
    # Environments first: steps of a process that has held gigabytes take a tenth longer.
    parts = environments, planned, kernel_and_peer, halls, liquid, calls, scaling, starting, optima
    for part in (*parts, recording, large_recording, rack_histories):
        for figure in part(quick):
            show(figure, figures[-1].part if figures else "", quick)
            figures.append(figure)
    if hasattr(os, "getloadavg"):
        facts["load"] = round(os.getloadavg()[0], 2)  # processes that want a core
    facts["roof_gb_per_s_and_core"] = {
        f.name.split(":")[0]: round(12.0 / f.value, 1)
        for f in figures
        if f.name.endswith(": memory roof") and f.value
    }
    missed = [f for f in figures if f.met(quick) is False]
    judged = sum(f.met(quick) is not None for f in figures)
    print(f"\n{judged - len(missed)} of {judged} targets met")
    out = [asdict(f) | {"target": f.target, "met": f.met(quick)} for f in figures]
    text = json.dumps({"quick": quick, "machine": facts, "figures": out}, indent=1)
    (options.out / "bench.json").write_text(f"{text}\n", encoding="utf-8")
    (options.out / "bench.md").write_text(markdown(figures, quick), encoding="utf-8")
    plot(figures, options.out / "bench.png")
    print(f"{options.out}: bench.json, bench.md, bench.png")


if __name__ == "__main__":
    main()
