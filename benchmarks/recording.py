"""What a recording costs beside the run without one; docs/viz.md explains the table.

    python benchmarks/recording.py [--quick] [--out runs/bench]

Halls of three sizes run in this process and in turn with and without a recorder, in the default
way of ``sdc-taichi simulate``: a step is simulated, written to steps.parquet and recorded. Time is
the best of several runs; memory is what the most that a process of its own holds grows by when it
records after it has not.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import sdc_taichi
from sdc_taichi.control import make_controller
from sdc_taichi.run.description import RunRequest, describe_run
from sdc_taichi.run.folder_writer import simulate_to_folder
from sdc_taichi.viz.recorder import Recorder

MONTH_STEPS = 31 * 96
SIZES: dict[str, tuple[str, list[str], int, int]] = {
    "2 halls of 20 racks x 200 servers": ("corrected", [], 2, MONTH_STEPS),
    "1,000 racks x 40 servers": ("large", [], 1, MONTH_STEPS),
    "100,000 racks x 40 servers": (
        "large",
        [
            "hall.rows=250",
            "hall.racks_per_row=400",
            "hvac.crac.units=1",
            "hall.inlet_model=approach",
        ],
        1,
        96,
    ),
}
"""Preset, overrides, data centers and steps."""
QUICK_STEPS = 30


def simulator(name: str) -> sdc_taichi.Simulator:
    """Data centers of a size."""
    preset, overrides, count, _ = SIZES[name]
    config = sdc_taichi.load_config(preset, ["site.start=07-01", *overrides])
    return sdc_taichi.Simulator(sdc_taichi.make_configs(config, count=count))


def run_s(sim: sdc_taichi.Simulator, steps: int, folder: Path, recorded: bool) -> float:
    """Wall time of a run with its files, s."""
    asked = RunRequest("idle", steps)
    controller = make_controller("idle", sim.fleet)
    begin = time.perf_counter()
    if recorded:
        with Recorder(folder / "run.rrd") as recorder:
            recorder.begin(sim, describe_run(sim, asked))
            simulate_to_folder(sim, controller, asked, folder, on_step=recorder.add)
    else:
        simulate_to_folder(sim, controller, asked, folder)
    return time.perf_counter() - begin


def most_mb() -> float:
    """The most memory that this process has held, MB."""
    status = Path("/proc/self/status")
    if status.exists():
        # Not what getrusage says, which a process on Linux has from its parent.
        (line,) = (x for x in status.read_text().splitlines() if x.startswith("VmHWM:"))
        return float(line.split()[1]) / 1e3
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / 1e6 if sys.platform == "darwin" else most / 1e3


def memory_mb(name: str, steps: int) -> float:
    """Memory that a recording takes, MB, in a process of its own."""
    done = subprocess.run(
        [sys.executable, __file__, "--memory-of", json.dumps([name, steps])],
        capture_output=True,
        text=True,
        check=True,
    )
    return float(done.stdout.splitlines()[-1])


def measured(name: str, quick: bool) -> dict[str, Any]:
    """Costs of one size."""
    steps = QUICK_STEPS if quick else SIZES[name][3]
    repeats = 1 if quick else 3
    spent: dict[bool, list[float]] = {False: [], True: []}
    with simulator(name) as sim, tempfile.TemporaryDirectory() as folder:
        run_s(sim, min(steps, QUICK_STEPS), Path(folder), recorded=True)
        for _ in range(repeats):
            for recorded, times in spent.items():
                times.append(run_s(sim, steps, Path(folder), recorded))
        file_mb = Path(folder, "run.rrd").stat().st_size / 1e6
    off_s, on_s = min(spent[False]), min(spent[True])
    return {
        "name": name,
        "steps": steps,
        "off_us": 1e6 * off_s / steps,
        "on_us": 1e6 * on_s / steps,
        "ratio": on_s / off_s,
        "file_mb": file_mb,
        "memory_mb": memory_mb(name, steps),
    }


def markdown(rows: list[dict[str, Any]]) -> str:
    """The table of docs/viz.md."""
    lines = [
        "| halls | steps | without, us/step | with, us/step | ratio | file, MB | memory, MB |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        lines.append(
            f"| {row['name']} | {row['steps']:,} | {row['off_us']:,.0f} | {row['on_us']:,.0f} | "
            f"{row['ratio']:.2f} | {row['file_mb']:.1f} | {row['memory_mb']:.0f} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument(
        "--quick", action="store_true", help="few steps of one size, for correctness only"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/bench"), help="folder to write to")
    parser.add_argument("--memory-of", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.memory_of is not None:
        name, steps = json.loads(given.memory_of)
        with simulator(name) as sim, tempfile.TemporaryDirectory() as folder:
            run_s(sim, steps, Path(folder), recorded=False)
            without_mb = most_mb()
            run_s(sim, steps, Path(folder), recorded=True)
        print(most_mb() - without_mb)
        return
    given.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for name in list(SIZES)[:1] if given.quick else SIZES:
        rows.append(measured(name, given.quick))
        print(json.dumps(rows[-1]), flush=True)
    (given.out / "recording.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    (given.out / "recording.md").write_text(markdown(rows), encoding="utf-8")
    print(markdown(rows), end="")


if __name__ == "__main__":
    main()
