"""Flows of work between the sites of a fleet, in run folders and reports."""

from __future__ import annotations

import itertools
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from rrd import read, scalars, verify
from sdc_taichi import (
    Recorder,
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
from sdc_taichi.run.folder_reader import read_flows, read_run, read_steps
from sdc_taichi.sim.transfer import task_kwh
from sdc_taichi.types import StepResult
from sdc_taichi.viz import report
from sdc_taichi.viz.flow_figures import FlowPanel, flow_map
from sdc_taichi.viz.report_flows import flow_panels

SITES = ["AZ", "CA", "NY", "WA"]
HOURS = 30


def run_fleets(
    folder: Path, recording: Path | None = None
) -> dict[tuple[int, int, int], list[float]]:
    """Run two fleets of four sites; return work and saving by hour, sender and receiver."""
    fleet = {"sites": SITES, "link_share_per_hour": 0.2}
    config = with_values(load_config("tiny", ["workload.flexible_share=0.4"]), {"fleet": fleet})
    sums: dict[tuple[int, int, int], list[float]] = defaultdict(lambda: [0.0, 0.0])
    with Simulator(make_configs(config, count=2)) as sim:

        def add(result: StepResult) -> None:
            if recorder is not None:
                recorder.add(result)
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

        recorder = None if recording is None else Recorder(recording, focus=["ca-1"])
        if recorder is not None:
            recorder.begin(sim)
        controller = make_controller("geo=geo-all-cleaner,load=greedy-ci", sim.fleet)
        simulate_to_folder(sim, controller, RunRequest("geo", 4 * HOURS), folder, on_step=add)
        if recorder is not None:
            recorder.close()
    return dict(sums)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two fleets, beside which ``sums.csv`` has its flows."""
    out = tmp_path_factory.mktemp("runs") / "fleets"
    sums = run_fleets(out, out.with_name("run.rrd"))
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


def test_recordings_show_flows_of_the_fleet_in_focus(folder: Path) -> None:
    """The data center in focus belongs to the second fleet, of data centers 4 to 7."""
    run = read_run(folder)
    flows = read_flows(run)
    assert flows is not None
    recorded = read(folder.with_name("run.rrd"))
    for field in ("sent_tasks", "landed_tasks"):
        lines = recorded[f"/flows/{field}"]
        assert lines["SeriesLines:names"] == [run.names[4:]]
        expected = np.stack([steps[field] for steps in read_steps(run, range(4, 8))], axis=1)
        np.testing.assert_array_equal(scalars(lines), expected)
        assert expected.any()
    arrows = recorded["/flows/map/sent"]
    assert arrows["step"] == [4 * hour + 3 for hour in range(HOURS)]
    rows = flows.table[flows.table["sender"] >= 4]
    strips = arrows["GeoLineStrings:line_strings"]
    by_hour = [rows[rows["hour"] == hour] for hour in range(HOURS)]
    assert [len(each) for each in strips] == [len(each) for each in by_hour]
    assert min(map(len, strips)) < max(map(len, strips))
    for arrow, (sender, receiver) in zip(
        itertools.chain.from_iterable(strips),
        rows[["sender", "receiver"]].to_numpy(),
        strict=True,
    ):
        np.testing.assert_allclose(arrow[0], flows.place_deg[sender])
        np.testing.assert_allclose(arrow[11], flows.place_deg[receiver])
    assert recorded["/flows/map/wa-1"]["step"] == arrows["step"]
    assert verify(folder.with_name("run.rrd")).returncode == 0


def test_maps_show_the_mean_day(folder: Path) -> None:
    """Hours 0 to 5 of the day occur twice in a run of 30 h, the others once."""
    run = read_run(folder)
    flows = read_flows(run)
    assert flows is not None
    panels = flow_panels(run, flows)
    rows = flows.table[flows.table["sender"] < 4]
    twice = rows["hour"] % 24 < 6
    assert panels[0].tasks.sum() == pytest.approx(rows.loc[twice, "tasks"].sum() / 2)
    assert sum(panel.tasks.sum() for panel in panels[1:]) == pytest.approx(
        rows.loc[~twice, "tasks"].sum()
    )
    for dc, steps in enumerate(read_steps(run, range(4))):
        first = steps["time"].dt.tz_convert("UTC").dt.hour < 6
        assert panels[0].executed_tasks[dc] == pytest.approx(
            steps.loc[first, "executed_tasks"].sum() / 2
        )
        assert panels[0].ci_g_per_kwh[dc] == pytest.approx(steps.loc[first, "ci_g_per_kwh"].mean())
        assert panels[1].ci_g_per_kwh[dc] == pytest.approx(steps[24:48]["ci_g_per_kwh"].mean())


def test_names_on_maps_never_overlap() -> None:
    """A map of 40 close sites names only those with most work, and can span the date line."""
    rng = np.random.default_rng(3)
    place_deg = np.stack(
        [rng.uniform(40, 44, 40), (rng.uniform(178, 184, 40) + 180) % 360 - 180], axis=1
    )
    tasks = rng.uniform(0, 9, (40, 40)) * (rng.uniform(size=(40, 40)) < 0.05)
    panel = FlowPanel("night", tasks, rng.uniform(50, 90, 40), rng.uniform(50, 600, 40))
    figure = flow_map([panel], [f"site-{i}" for i in range(40)], place_deg)
    axes = figure.axes[0]
    discs: Any = axes.collections[0]
    assert np.ptp(discs.get_offsets()[:, 0]) < 6
    centres = axes.transData.transform(discs.get_offsets())
    radii = np.sqrt(discs.get_sizes()) / 2 * figure.dpi / 72
    boxes = [np.stack([c - r, c + r]) for c, r in zip(centres, radii, strict=True)]
    names = [text.get_window_extent().get_points() for text in axes.texts]
    assert len(names) >= 5
    for place, box in enumerate(names):
        for other in (*boxes, *names[:place]):
            assert np.any(box[0] >= other[1]) or np.any(other[0] >= box[1])


def test_reports_of_fleets_list_the_largest_flows(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = read_run(folder)
    flows = read_flows(run)
    assert flows is not None
    # Other sections take seconds to draw.
    for section in ("fleet_section", "data_center_section", "hot_racks_section"):
        monkeypatch.setattr(report, section, lambda *_, **__: [])
    page = report.report_html(run)
    section = page[page.index("Work sent between sites</h2>") :]
    pairs = flows.table.groupby(["sender", "receiver"])["tasks"].sum()
    largest: Any = pairs.idxmax()
    sender, receiver = largest
    assert section.index(f"{run.names[sender]} to {run.names[receiver]}") < section.index(">all<")
    assert "The first of 2 fleets." in section
