"""The pictures that only the examples draw show what they are said to show."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from sdc_taichi import SdcError, Simulator, StepResult, load_config, make_configs
from sdc_taichi.exogenous.synthetic import synthetic_site, synthetic_sites, synthetic_traces
from sdc_taichi.viz.data_figures import CARBON, TEMPERATURE, WORKLOAD

pytestmark = pytest.mark.repo

EXAMPLES = Path(__file__).parent.parent / "examples"
DOLLARS = r"_x$_{$"


def example(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(EXAMPLES)
    return importlib.import_module(name)


@pytest.fixture
def inputs(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    return example("input_figures", monkeypatch)


def contrast(figure: Any) -> float:
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    return float(np.asarray(canvas.buffer_rgba())[..., :3].std())


def test_panels_show_daily_means_and_ranges(inputs: ModuleType) -> None:
    names = synthetic_sites()[:5]
    series = inputs.site_series(names, "outdoor_c")
    figure = inputs.year_panels(series, TEMPERATURE, "synthetic")
    assert [axes.get_title(loc="left") for axes in figure.axes[:5]] == list(names)
    hours = np.reshape(synthetic_site(names[1]).outdoor_c.values, (365, -1))
    axes = figure.axes[1]
    np.testing.assert_allclose(axes.lines[0].get_ydata(), hours.mean(axis=1))
    (band,) = axes.collections
    spread = band.get_paths()[0].vertices[:, 1]
    assert (spread.min(), spread.max()) == (hours.min(), hours.max())
    assert not any(axes.get_visible() for axes in figure.axes[5:]), "no empty panels"
    assert contrast(figure) > 5


def test_week_of_workloads(inputs: ModuleType) -> None:
    series = inputs.trace_series(synthetic_traces())
    (axes,) = inputs.first_week(series, WORKLOAD).axes
    assert axes.get_ylabel() == "workload (% of capacity)"
    assert [line.get_label() for line in axes.lines] == list(synthetic_traces())
    for line, values in zip(axes.lines, series.values(), strict=True):
        per_day = round(pd.Timedelta(days=1) / (values.index[1] - values.index[0]))
        np.testing.assert_array_equal(line.get_ydata(), 100 * values[: 7 * per_day])


def test_series_that_do_not_fit(inputs: ModuleType) -> None:
    with pytest.raises(SdcError, match="no series"):
        inputs.year_panels({}, CARBON)
    early = pd.Series(1.0, index=pd.date_range("2001-01-01", periods=24, freq="h"))
    late = pd.Series(1.0, index=pd.date_range("2001-07-01", periods=24, freq="h"))
    with pytest.raises(SdcError, match="series 'early' ends before 2001-07-01"):
        inputs.first_week({"early": early, "late": late}, CARBON)


def test_names_are_written_as_they_are(inputs: ModuleType) -> None:
    series = inputs.site_series(["NY"], "ci_g_per_kwh")
    figure = inputs.first_week({DOLLARS: series["NY"]}, CARBON)
    assert contrast(figure) > 5
    (text,) = figure.axes[0].get_legend().get_texts()
    assert text.get_text() == r" _x\$_{\$"


def frame(results: list[StepResult]) -> pd.DataFrame:
    times = pd.date_range("2001-01-01", periods=len(results), freq="15min")
    names = results[0].per_dc()
    return pd.DataFrame({"time": times, **{k: [r.per_dc()[k][0] for r in results] for k in names}})


def test_readme_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plot_hall = example("plot_hall", monkeypatch)
    with Simulator(make_configs(load_config("corrected"), sites=["NY", "CA"])) as sim:
        sim.reset()
        results = [sim.step() for _ in range(60)]
    figure = plot_hall.readme_picture(results[50], sim.fleet, frame(results))
    assert figure.subfigs[0].get_suptitle() == "Racks on 1 January 12:30"
    assert contrast(figure) > 10
    figure.savefig(tmp_path / "x.png")
    assert (tmp_path / "x.png").read_bytes()[16:24] == bytes([0, 0, 6, 64, 0, 0, 2, 188])
    with pytest.raises(SdcError, match="the run has no such time"):
        plot_hall.readme_picture(results[50], sim.fleet, frame(results[:50]))
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(SdcError, match=r'pip install "sdc-taichi\[plot\]"'):
        plot_hall.readme_picture(results[50], sim.fleet, frame(results))


def test_outages_are_shaded_for_their_own_data_center(monkeypatch: pytest.MonkeyPatch) -> None:
    hall_figures = example("hall_figures", monkeypatch)
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


def test_example_animates_a_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from PIL import Image

    module = example("plot_runs", monkeypatch)
    module.plot_failure(tmp_path)
    (path,) = tmp_path.iterdir()
    picture: Any = Image.open(path)
    assert picture.n_frames == module.FAILURE_STEPS
    assert path.stat().st_size < 300_000
    brightness = []
    for frame in (40, 71, 74):  # before the first failure, at its end, after it
        picture.seek(frame)
        brightness.append(np.asarray(picture.convert("L"))[40:500].mean())
    assert brightness[1] > brightness[2] > 0
    assert brightness[1] > 1.2 * brightness[0]
