"""Recordings read back equal to the results, and pictures that show what they should."""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
import pytest

from sdc_taichi import (
    Actions,
    DataCenterConfig,
    SdcError,
    Simulator,
    StepResult,
    build_fleet,
    load_config,
    make_configs,
)
from sdc_taichi.viz import figures, hall_figures, recorder
from sdc_taichi.viz.recorder import Recorder

STEPS = 110  # more than a block, and no multiple of one
ODD_NAME = "hall/1 [a]"


def configs() -> list[DataCenterConfig]:
    """Six data centers, one with a name that needs escaping and one with another season."""
    out = make_configs(load_config("tiny"), count=6, sites=["NY", "CA"])
    summer = out[2].site.model_copy(update={"start": "07-01"})
    out[1] = out[1].model_copy(update={"name": ODD_NAME})
    out[2] = out[2].model_copy(update={"site": summer})
    return out


def simulate(sim: Simulator, steps: int) -> list[StepResult]:
    sim.reset()
    rng = np.random.default_rng(3)
    commands = [rng.uniform(-1.0, 1.0, (3, sim.size)) for _ in range(steps)]
    return [sim.step(Actions(*command)) for command in commands]


@pytest.fixture(scope="module")
def run() -> Iterator[tuple[Simulator, list[StepResult]]]:
    with Simulator(configs()) as sim:
        yield sim, simulate(sim, STEPS)


@pytest.fixture(scope="module")
def recording(
    run: tuple[Simulator, list[StepResult]], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    sim, results = run
    path = tmp_path_factory.mktemp("recording") / "run.rrd"
    with Recorder(path, sim.fleet, every=2, sources=sim.drivers.sources) as rec:
        for result in results:
            rec.log(result)
    return path


def frame(results: list[StepResult], dc: int = 0) -> pd.DataFrame:
    times = pd.date_range("2001-01-01", periods=len(results), freq="15min")
    columns = {name: [r.per_dc()[name][dc] for r in results] for name in results[0].per_dc()}
    return pd.DataFrame({"time": times, **columns})


def read(path: Path) -> dict[str, dict[str, Any]]:
    """Every entity's columns over the whole recording, in order of step; static ones too."""
    from rerun.chunk import RrdReader

    parts: dict[str, dict[str, list[Any]]] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        for name, column in chunk.to_record_batch().to_pydict().items():
            parts.setdefault(chunk.entity_path, {}).setdefault(name, []).extend(column)
    for columns in parts.values():
        if "step" in columns:
            order = np.argsort(columns["step"])
            for name, values in columns.items():
                if len(values) == len(order):
                    columns[name] = [values[i] for i in order]
    return parts


def scalars(entity: dict[str, Any]) -> npt.NDArray[np.float64]:
    return np.array(entity["Scalars:scalars"])


def test_series_read_back(run: tuple[Simulator, list[StepResult]], recording: Path) -> None:
    entities = read(recording)
    focus = {0: "ny-0", 1: r"hall\/1\ \[a\]", 2: "ny-2", 3: "ca-3"}
    _, results = run
    for dc, name in focus.items():
        for plot, lines in recorder.PLOTS.items():
            entity = entities[f"/dc/{name}/series/{plot}"]
            assert entity["step"] == list(range(STEPS))
            expected = [
                [getattr(r, field)[dc] * factor for _, field, factor, _ in lines] for r in results
            ]
            np.testing.assert_array_equal(scalars(entity), expected)
            assert entity["SeriesLines:names"] == [[line[0] for line in lines]]
            assert all(line[0].endswith("]") for line in lines), "a unit in every name"
    assert not [path for path in entities if "ny-4" in path or "ca-5" in path]
    np.testing.assert_array_equal(
        scalars(entities["/fleet/mean_pue"])[:, 0], [np.mean(r.pue) for r in results]
    )
    np.testing.assert_allclose(
        scalars(entities["/fleet/carbon_kg"])[:, 0], [r.carbon_g.sum() / 1e3 for r in results]
    )
    np.testing.assert_array_equal(
        scalars(entities["/fleet/hottest_inlet_c"])[:, 0], [max(r.inlet_max_c) for r in results]
    )


def test_times_are_the_clock_of_the_data_center(recording: Path) -> None:
    entities = read(recording)
    winter = entities["/dc/ny-0/series/pue"]["sim_time"]
    summer = entities["/dc/ny-2/series/pue"]["sim_time"]
    assert str(winter[0]) == "2001-01-01 00:00:00"
    assert str(summer[0]) == "2001-07-01 00:00:00"
    assert str(summer[97]) == "2001-07-02 00:15:00"
    assert summer[0].tzinfo is None


def test_heat_maps_read_back(run: tuple[Simulator, list[StepResult]], recording: Path) -> None:
    sim, results = run
    entities = read(recording)
    for dc, name in ((0, "ny-0"), (3, "ca-3")):
        hall = sim.fleet.configs[dc].hall
        for what, limits in recorder.MAPS.items():
            entity = entities[f"/dc/{name}/map/{what}"]
            assert entity["step"] == list(range(0, STEPS, 2))
            assert entity["DepthImage:depth_range"] == [[list(limits)]]
            (((form,),)) = entity["DepthImage:format"]
            height, width = form["height"], form["width"]
            tile_h, tile_w = (height + 1) // hall.rows - 1, (width + 1) // hall.racks_per_row - 1
            for shot, step in enumerate(entity["step"]):
                ((raw,),) = (entity["DepthImage:buffer"][shot],)
                pixels = np.frombuffer(bytes(raw), np.float16).reshape(height, width)
                racks = getattr(results[step], f"rack_{what}_c")
                first = sim.fleet.rack_start[dc]
                for rack in range(hall.racks):
                    row, column = divmod(rack, hall.racks_per_row)
                    y, x = row * (tile_h + 1), column * (tile_w + 1)
                    tile = pixels[y : y + tile_h, x : x + tile_w]
                    assert np.ptp(tile) == 0
                    assert abs(float(tile[0, 0]) - racks[first + rack]) <= recorder.QUANTUM_K / 2
                assert np.all(pixels[tile_h, :] == limits[0])


@pytest.mark.parametrize(("rows", "per_row"), [(4, 5), (20, 200), (50, 20), (1, 1), (40, 4)])
def test_tiles_are_equal_and_legible(rows: int, per_row: int) -> None:
    index = recorder.tile_index(rows, per_row)
    counts = np.bincount(index.ravel())
    assert np.all(counts[: rows * per_row] == counts[0])
    assert counts[0] >= 16
    assert 0.5 <= index.shape[1] / index.shape[0] <= 5.0


def test_heat_maps_are_clamped() -> None:
    racks = np.array([[-40.0, 20.03, 99.0, 30.0]], dtype=np.float32)
    pixels = recorder.heat_map_pixels(racks, recorder.tile_index(2, 2), (10.0, 45.0))
    assert set(np.unique(pixels)) == {10.0, 20.0, 45.0, 30.0}


def test_recording_explains_itself(
    run: tuple[Simulator, list[StepResult]], recording: Path
) -> None:
    from rerun.chunk import RrdReader

    sim, _ = run
    entities = read(recording)
    (((text,),)) = entities["/summary"]["TextDocument:text"]
    for expected in (ODD_NAME, "site CA", "synthetic year, seed 10", "carnot", "other 2 data"):
        assert expected in text
    assert sim.fleet.configs[0].description in text
    assert "10 C" in entities["/legend/outlet/ticks"]["Points2D:labels"][0]
    (blueprint,) = RrdReader(recording).blueprints()
    chunks = RrdReader(recording).stream(store=blueprint).to_chunks()
    shown = str([chunk.to_record_batch().to_pydict() for chunk in chunks])
    for expected in ("ny-0", ODD_NAME, "fleet", "sim_time", "HVAC by device [kW]"):
        assert expected in shown


def test_without_sources_the_configured_ones_are_named(tmp_path: Path) -> None:
    base = load_config("tiny", ["site.carbon_file=/data/ci.csv", "site.seed=4"])
    with (
        Simulator(load_config("tiny")) as sim,
        Recorder(tmp_path / "x.rrd", build_fleet(base)) as r,
    ):
        sim.reset()
        r.log(sim.step())
    (((text,),)) = read(tmp_path / "x.rrd")["/summary"]["TextDocument:text"]
    assert "weather (as configured): NY, synthetic, seed 4" in text
    assert "carbon (as configured): file /data/ci.csv" in text


def test_rerun_verifies_the_recording(recording: Path) -> None:
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    command = shutil.which("rerun", path=path)
    if command is None:
        pytest.skip("the rerun command is not installed")
    done = subprocess.run(
        [command, "rrd", "verify", str(recording)],
        env={**os.environ, "RERUN_ANALYTICS": "0"},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "1 file verified without error" in done.stdout + done.stderr


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_interrupted_recording_is_readable(
    run: tuple[Simulator, list[StepResult]], tmp_path: Path, error: type[BaseException]
) -> None:
    sim, results = run
    path = tmp_path / "cut.rrd"
    path.write_text("older")

    def cut() -> None:
        with Recorder(path, sim.fleet) as rec:
            for result in results[:100]:
                rec.log(result)
            assert path.read_text() == "older"
            raise error

    with pytest.raises(error):
        cut()
    assert [p.name for p in tmp_path.iterdir()] == ["cut.rrd"]
    assert len(scalars(read(path)["/dc/ny-0/series/pue"])) == 100


def test_failed_write_is_reported_and_leaves_nothing(
    run: tuple[Simulator, list[StepResult]], tmp_path: Path
) -> None:
    sim, results = run
    path = tmp_path / "x.rrd"
    rec = Recorder(path, sim.fleet)
    rec.log(results[0])
    path.mkdir()
    with pytest.raises(SdcError, match=r"x\.rrd: cannot be written"):
        rec.close()
    assert [p.name for p in tmp_path.iterdir()] == ["x.rrd"]
    with pytest.raises(SdcError, match="closed"):
        rec.log(results[1])


def test_results_that_do_not_fit_are_refused(
    run: tuple[Simulator, list[StepResult]], tmp_path: Path
) -> None:
    sim, results = run
    with Recorder(tmp_path / "a.rrd", sim.fleet) as rec:
        rec.log(results[5])
        with pytest.raises(SdcError, match="step 5 after step 5"):
            rec.log(results[5])
    other = build_fleet(load_config("tiny"))
    with (
        Recorder(tmp_path / "b.rrd", other) as rec,
        pytest.raises(SdcError, match="6 data centers and 24 racks, expected 1 and 4"),
    ):
        rec.log(results[0])


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("x.txt", {}, r"must end in \.rrd"),
        ("none/x.rrd", {}, "is no folder"),
        ("x.rrd", {"every": 0}, "every 0"),
        ("x.rrd", {"every": 2.0}, "every 2.0"),
        ("x.rrd", {"focus": ["ny-0", "ny"]}, "focus 'ny': no such data center; valid: ny-0"),
        ("x.rrd", {"focus": ["ny-0"] * 2}, "up to 4 different"),
        ("x.rrd", {"focus": [f"dc-{i}" for i in range(5)]}, "up to 4 different"),
    ],
)
def test_bad_arguments(tmp_path: Path, name: str, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(SdcError, match=message):
        Recorder(tmp_path / name, build_fleet(configs()), **arguments)
    assert not list(tmp_path.iterdir())


def test_full_disk_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil.disk_usage(tmp_path)._replace(free=5000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    with pytest.raises(SdcError, match="expected 2 MB"):
        Recorder(tmp_path / "x.rrd", build_fleet(configs()))


def test_focus_and_default_interval(tmp_path: Path) -> None:
    large = make_configs(load_config("tiny", ["hall.rows=2", "name=a"]), count=2)
    fleet = build_fleet(large)
    with Simulator(fleet) as sim, Recorder(tmp_path / "x.rrd", fleet, focus=("ny-1",)) as rec:
        for result in simulate(sim, 3):
            rec.log(result)
    entities = read(tmp_path / "x.rrd")
    assert "/dc/ny-0/map/inlet" not in entities
    assert entities["/dc/ny-1/map/inlet"]["step"] == [0, 1, 2]
    assert recorder._check_every(None, 200) == 1
    assert recorder._check_every(None, 201) == 4


def test_missing_rerun_is_explained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(SdcError, match="pip install rerun-sdk"):
        Recorder(tmp_path / "x.rrd", build_fleet(configs()))
    assert not list(tmp_path.iterdir())


def test_missing_matplotlib_is_explained(
    run: tuple[Simulator, list[StepResult]], monkeypatch: pytest.MonkeyPatch
) -> None:
    sim, results = run
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    explained = r'pip install "sdc-taichi\[plot\]"'
    with pytest.raises(SdcError, match=explained):
        figures.hall_map(results[0], sim.fleet)
    with pytest.raises(SdcError, match=explained):
        figures.overview(frame(results))
    with pytest.raises(SdcError, match=explained):
        figures.readme_picture(results[0], sim.fleet, frame(results))


def test_import_is_light() -> None:
    code = (
        "import sys, sdc_taichi.viz.recorder, sdc_taichi.viz.figures;"
        "print({'rerun', 'matplotlib', 'pandas', 'taichi'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def render(figure: Any) -> npt.NDArray[np.uint8]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


@pytest.mark.parametrize("dc", [0, 3])
def test_hall_map_shows_the_racks(run: tuple[Simulator, list[StepResult]], dc: int) -> None:
    sim, results = run
    result, hall = results[40], sim.fleet.configs[dc].hall
    figure = figures.hall_map(result, sim.fleet, dc)
    pixels = render(figure)
    maps, bars = figure.axes[:2], figure.axes[2:]
    axes: Any
    mesh: Any
    for axes, bar, what in zip(maps, bars, ("inlet", "outlet"), strict=True):
        values = getattr(result, f"rack_{what}_c")[slice(*sim.fleet.rack_start[dc : dc + 2])]
        mesh = axes.collections[0]
        np.testing.assert_array_equal(np.ravel(mesh.get_array()), values.astype(np.float64))
        low, high = mesh.get_clim()
        assert low <= values.min() <= values.max() <= high
        assert (axes.get_xlabel(), axes.get_ylabel()) == ("rack in row", "row")
        assert axes.yaxis_inverted(), "row 0 at the top, as in recordings"
        assert bar.get_ylabel() == f"{what} (°C)"
        row, rack = divmod(int(values.argmax()), hall.racks_per_row)
        assert f"hottest {values.max():.1f} °C" in axes.get_title(loc="left")
        assert f"row {row} rack {rack}" in axes.get_title(loc="left")
        outlined = [(round(p.get_x() - 0.04), round(p.get_y() - 0.04)) for p in axes.patches]
        assert (rack, row) in outlined
        assert [t.get_text() for t in axes.texts] == [f"{v:.1f}" for v in values]
        for index, value in enumerate(values):
            y, x = divmod(index, hall.racks_per_row)
            across, up = axes.transData.transform((x + 0.2, y + 0.2)).astype(int)
            drawn = pixels[len(pixels) - 1 - up, across, :3]
            expected = np.array(mesh.cmap(mesh.norm(value))[:3]) * 255
            assert np.abs(drawn - expected).max() <= 2
    assert f"{sim.fleet.names[dc]}: 1 January 10:00" == figure.get_suptitle()


def test_hall_map_of_a_large_hall(run: tuple[Simulator, list[StepResult]]) -> None:
    approach = np.random.default_rng(0).uniform(3.0, 6.0, 200).tolist()
    values = ["hall.rows=10", "hall.racks_per_row=20", f"hall.supply_approach_k={approach}"]
    config = load_config(
        "corrected", [*values, "hall.return_approach_k=-3", "servers.power_w=[150, 10]"]
    )
    with Simulator(config) as sim:
        sim.reset()
        result = sim.step()
        figure = figures.hall_map(result, sim.fleet)
    axes: Any = figure.axes[0]
    hottest = int(np.argmax(approach))
    row, rack = divmod(hottest, 20)
    assert f"row {row} rack {rack}" in axes.get_title(loc="left")
    (ring,) = axes.lines
    assert (ring.get_xdata()[0], ring.get_ydata()[0]) == (rack + 0.5, row + 0.5)
    assert not axes.texts
    assert render(figure).std() > 10


def filled_to(area: Any) -> float:
    return max(float(path.vertices[:, 1].max()) for path in area.get_paths())


def test_overview_shows_the_run(run: tuple[Simulator, list[StepResult]]) -> None:
    _, results = run
    steps = frame(results)
    figure = figures.overview(steps)
    panels: list[Any] = figure.axes
    weather, power, carbon, storage, emitted, charge = panels
    labels = [axes.get_ylabel() for axes in figure.axes]
    for expected in ("(°C)", "(kW)", "g CO₂/kWh", "(tasks)", "kg CO₂/step", "(%)"):
        assert sum(expected in label for label in labels) == 1
    named = {line.get_label(): line.get_ydata() for line in weather.lines}
    for name in ("outdoor_c", "wet_bulb_c", "setpoint_c"):
        line = named[name.removesuffix("_c").replace("_", " ")]
        np.testing.assert_array_equal(line, steps[name])
    assert max(filled_to(area) for area in power.collections) == pytest.approx(
        ((steps["it_w"] + steps["hvac_w"]) / 1e3).max()
    )
    assert [area.get_label() for area in power.collections] == [
        name for name, _ in figures.POWERS.values()
    ]
    assert not power.lines
    np.testing.assert_array_equal(carbon.lines[0].get_ydata(), steps["ci_g_per_kwh"])
    np.testing.assert_array_equal(storage.lines[0].get_ydata(), steps["queue_tasks"])
    assert filled_to(emitted.collections[0]) == pytest.approx(steps["carbon_g"].max() / 1e3)
    assert filled_to(charge.collections[0]) == pytest.approx(100 * steps["soc"].max())
    pixels = render(figure)
    for axes in figure.axes[:4]:
        box = axes.get_window_extent()
        inside = pixels[len(pixels) - int(box.y1) : len(pixels) - int(box.y0), :, :3]
        assert len(np.unique(inside.reshape(-1, 3), axis=0)) > 20


def test_overview_marks_devices_left_out_of_the_total(
    run: tuple[Simulator, list[StepResult]],
) -> None:
    steps = frame(run[1])
    steps["hvac_w"] = steps["chiller_w"]
    line: Any
    (line,) = figures.overview(steps).axes[1].lines
    assert line.get_label() == "counted in total"
    np.testing.assert_allclose(line.get_ydata(), (steps["it_w"] + steps["chiller_w"]) / 1e3)


def test_readme_picture(run: tuple[Simulator, list[StepResult]], tmp_path: Path) -> None:
    sim, results = run
    figure = figures.readme_picture(results[50], sim.fleet, frame(results))
    figure.savefig(tmp_path / "x.png")
    assert png_size(tmp_path / "x.png") == (1600, 700)
    titles = [sub.get_suptitle() for sub in figure.subfigs]
    assert titles[0] == "Racks on 1 January 12:30"
    assert render(figure).std() > 10
    with pytest.raises(SdcError, match="the run has no such time"):
        figures.readme_picture(results[50], sim.fleet, frame(results[:50]))


def test_bad_results_and_tables(run: tuple[Simulator, list[StepResult]]) -> None:
    sim, results = run
    steps = frame(results)
    with pytest.raises(SdcError, match=r"data center 6: valid is 0\.\.5"):
        figures.hall_map(results[0], sim.fleet, 6)
    with pytest.raises(SdcError, match="result of 24 racks, expected 4"):
        figures.hall_map(results[0], build_fleet(load_config("tiny")))
    with pytest.raises(SdcError, match="missing columns wet_bulb_c, soc"):
        figures.overview(steps.drop(columns=["soc", "wet_bulb_c"]))
    with pytest.raises(SdcError, match="increasing time"):
        figures.overview(pd.concat([steps, steps]))
    with pytest.raises(SdcError, match="1 rows"):
        figures.overview(steps[:1])


def test_outages_are_shaded_for_their_own_data_center() -> None:
    down = "events.scheduled=[{kind: crac_down, unit: 0, start_h: 1, duration_h: 1}]"
    base = ["hvac.crac.units=2", "hvac.sizing.design_wet_bulb_c=26"]
    halls = [load_config("corrected", [*base, "name=a"]), load_config("corrected", [*base, down])]
    with Simulator(halls) as sim:
        sim.reset()
        results = [sim.step() for _ in range(10)]

    def shaded(dc: int) -> list[Any]:
        figure = hall_figures.failure_curves({"run": results}, sim.fleet, dc)
        return [c.get_paths() for axes in figure.axes for c in axes.collections]

    assert shaded(0) == [[], []]
    for paths in shaded(1):
        (path,) = paths
        assert 1.0 <= path.vertices[:, 0].min() < path.vertices[:, 0].max() == 2.0


@pytest.mark.repo
def test_example_writes_the_pictures(tmp_path: Path) -> None:
    example = Path(__file__).parent.parent / "examples" / "plot_hall.py"
    subprocess.run([sys.executable, str(example), str(tmp_path)], check=True, timeout=120)
    assert {p.name for p in tmp_path.iterdir()} == {"hall.png", "week.png", "overview.png"}
    assert png_size(tmp_path / "overview.png") == (1600, 700)
    assert (tmp_path / "overview.png").stat().st_size < 250_000


def png_size(path: Path) -> tuple[int, int]:
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    width, height = struct.unpack(">II", data[16:24])
    return width, height
