"""Flows of work between the sites of a fleet, in run folders and reports."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sdc_taichi import (
    SdcError,
    Simulator,
    load_config,
    make_configs,
    simulate_to_folder,
    with_values,
)
from sdc_taichi.control.registry import make_controller
from sdc_taichi.run.description import RunRequest
from sdc_taichi.run.flows_file import FLOWS_FILE
from sdc_taichi.run.folder_reader import read_flows, read_run
from sdc_taichi.sim.transfer import task_kwh
from sdc_taichi.types import StepResult

SITES = ["AZ", "CA", "NY", "WA"]
HOURS = 30


def run_fleets(folder: Path) -> dict[tuple[int, int, int], list[float]]:
    """Run two fleets of four sites; return work and saving by hour, sender and receiver."""
    fleet = {"sites": SITES, "link_share_per_hour": 0.2}
    config = with_values(load_config("tiny", ["workload.flexible_share=0.4"]), {"fleet": fleet})
    sums: dict[tuple[int, int, int], list[float]] = defaultdict(lambda: [0.0, 0.0])
    with Simulator(make_configs(config, count=2)) as sim:

        def add(result: StepResult) -> None:
            energy = task_kwh(sim.fleet, sim.sizing)[0]
            for fleet, sender, receiver in np.argwhere(sim.flows_tasks()):
                tasks = sim.flows_tasks()[fleet, sender, receiver]
                a, b = (
                    result.ci_g_per_kwh[4 * fleet + sender],
                    result.ci_g_per_kwh[4 * fleet + receiver],
                )
                entry = sums[result.step // 4, int(4 * fleet + sender), int(4 * fleet + receiver)]
                entry[0] += tasks
                entry[1] += tasks * energy * (a - b - 0.06 * (a + b) / 2)

        controller = make_controller("geo=geo-all-cleaner,load=greedy-ci", sim.fleet)
        simulate_to_folder(sim, controller, RunRequest("geo", 4 * HOURS), folder, on_step=add)
    return dict(sums)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two fleets, beside which ``sums.csv`` has its flows."""
    out = tmp_path_factory.mktemp("runs") / "fleets"
    sums = run_fleets(out)
    pd.DataFrame([(*key, *sums[key]) for key in sorted(sums)]).to_csv(out.with_name("sums.csv"))
    return out


def test_flows_are_kept_by_hour_and_pair(folder: Path) -> None:
    sums = pd.read_csv(folder.with_name("sums.csv"), index_col=0).to_numpy()
    run = read_run(folder)
    flows = read_flows(run)
    assert flows is not None
    assert flows.sites_per_fleet == 4
    table = flows.table
    assert 0 < len(table) == len(sums)
    assert np.array_equal(table[["hour", "sender", "receiver"]], sums[:, :3])
    np.testing.assert_allclose(table[["tasks", "saved_g"]], sums[:, 3:], rtol=1e-9)
    assert table["transfer_g"].sum() == pytest.approx(run.metrics["total"]["transfer_g"])
    begin = pd.Timestamp("2019-01-01", tz="UTC")
    assert list(table["time"]) == [begin + pd.Timedelta(hours=h) for h in table["hour"]]
    assert flows.place_deg[[0, 4]].tolist() == [[33.428, -112.004]] * 2
    names = pd.read_parquet(folder / FLOWS_FILE)["sender"]
    assert set(names) <= {f"{site.lower()}-{copy}" for site in SITES for copy in range(2)}


def test_only_fleets_have_flows(folder: Path, tmp_path: Path) -> None:
    run_fleets(tmp_path)
    written = (tmp_path / FLOWS_FILE).read_bytes()
    assert written == (folder / FLOWS_FILE).read_bytes()
    with Simulator(load_config("tiny")) as sim:
        simulate_to_folder(sim, make_controller("idle", sim.fleet), RunRequest("idle", 8), tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {"metrics.json", "steps.parquet", "config.yaml"}
    assert read_flows(read_run(tmp_path)) is None
    (tmp_path / FLOWS_FILE).write_bytes(written)
    with pytest.raises(SdcError, match=r"flows.parquet: of another run than metrics.json"):
        read_flows(read_run(tmp_path))
