"""Pictures that show what they should."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
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
from sdc_taichi.viz import figures

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


def frame(results: list[StepResult], dc: int = 0) -> pd.DataFrame:
    times = pd.date_range("2001-01-01", periods=len(results), freq="15min")
    columns = {name: [r.per_dc()[name][dc] for r in results] for name in results[0].per_dc()}
    return pd.DataFrame({"time": times, **columns})


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
        values = getattr(result, f"rack_{what}_c")[slice(*sim.fleet.rack_offsets[dc : dc + 2])]
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
        "corrected",
        [
            *values,
            "hall.return_approach_k=-3",
            "servers.power_w=[150, 10]",
            "hall.recirculation.calibrate=rack",
        ],
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
    for expected in ("(°C)", "(kW)", "g CO₂e/kWh", "(tasks)", "kg CO₂e/h", "(%)"):
        assert sum(expected in label for label in labels) == 1
    named = {line.get_label(): line.get_ydata()[:-1] for line in weather.lines}
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
    np.testing.assert_array_equal(carbon.lines[0].get_ydata()[:-1], steps["ci_g_per_kwh"])
    np.testing.assert_array_equal(storage.lines[0].get_ydata(), steps["queue_tasks"])
    assert filled_to(emitted.collections[0]) == pytest.approx(steps["carbon_g"].max() / 1e3 / 0.25)
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
    steps["overhead_w"] = steps["chiller_w"]
    line: Any
    (line,) = figures.overview(steps).axes[1].lines
    assert line.get_label() == "counted in total"
    np.testing.assert_allclose(line.get_ydata()[:-1], (steps["it_w"] + steps["chiller_w"]) / 1e3)


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
