"""Pictures show what the steps hold."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
import pytest

from sdc_taichi import SdcError, Simulator, StepResult, build_fleet, load_config
from sdc_taichi.config import HallConfig
from sdc_taichi.control import make_controller, view_maker
from sdc_taichi.exogenous.synthetic import synthetic_site
from sdc_taichi.run.metrics import Metric
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.viz import (
    dashboards,
    data_figures,
    figures,
    fleet_figures,
    plotting,
    rack_maps,
)
from sdc_taichi.viz.plotting import darken

DAYS = 3
DOLLARS = "_x$_{$"

Run = tuple[Fleet, list[StepResult]]


@pytest.fixture(scope="module")
def run() -> Run:
    """Three days of a hall whose CRAC unit fails on the second, driven by all three agents."""
    values = [
        "hvac.crac.units=2",
        "site.start=02-27",
        f"name={DOLLARS}",
        "events.scheduled=[{kind: crac_down, unit: 0, start_h: 36, duration_h: 2}]",
    ]
    with Simulator(load_config("corrected", values)) as sim:
        controller = make_controller("load=greedy-ci,cooling=g36,battery=greedy-ci", sim.fleet)
        sim.reset()
        controller.reset(0)
        look = view_maker(sim)
        results: list[StepResult] = []
        for _ in range(96 * DAYS):
            results.append(sim.step(controller.act(look(results[-1] if results else None))))
        return sim.fleet, results


@pytest.fixture(scope="module")
def steps(run: Run) -> pd.DataFrame:
    fleet, results = run
    names = results[0].per_dc()
    columns = {name: [getattr(r, name)[0] for r in results] for name in names}
    times = [figures.step_time(r, fleet, 0) for r in results]
    return pd.DataFrame({"step": [r.step for r in results], "time": times, **columns})


def render(figure: Any) -> npt.NDArray[np.uint8]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


def test_step_at_finds_the_step_of_a_time(run: Run) -> None:
    fleet, results = run
    assert figures.step_at(results, fleet, "02-27 00:00") is results[0]
    assert figures.step_at(iter(results), fleet, "02-28 12:20") is results[96 + 49]
    assert figures.step_at(results, fleet, "03-01 23:59") is results[-1]
    title = figures.hall_map(figures.step_at(results, fleet, "02-28 12:20"), fleet).get_suptitle()
    assert title == r"_x\$_{\$: 28 February 12:15"


@pytest.mark.parametrize(
    ("when", "message"),
    [
        ("03-02 00:00", "no step covers it; the steps are those from 02-27 00:00 to 03-01 23:45"),
        ("02-28", "valid is MM-DD HH:MM"),
        ("02-28 12:00:00", "valid is MM-DD HH:MM"),
    ],
)
def test_times_that_are_not_in_the_run(run: Run, when: str, message: str) -> None:
    with pytest.raises(SdcError, match=message):
        figures.step_at(run[1], run[0], when)
    with pytest.raises(SdcError, match="there are no steps"):
        figures.step_at([], run[0], "02-28 12:00")


def clock(x: float) -> str:
    from matplotlib import dates

    num2date: Any = dates.num2date
    return str(num2date(x).strftime("%m-%d %H:%M"))


def test_day_shows_one_day_and_its_failure(steps: pd.DataFrame) -> None:
    event = {"kind": "crac_down", "target": 0, "start_step": 144, "end_step": 152}
    figure: Any = dashboards.day(steps, "02-28", DOLLARS, [event])
    shown = steps[96:192]
    temperatures, _, _, commands, storage = figure.axes[:5]
    lines = {line.get_label(): line for line in (*temperatures.lines, *commands.lines)}
    for name, label in (
        ("outdoor_c", "outdoor"),
        ("wet_bulb_c", "wet bulb"),
        ("inlet_max_c", "hottest inlet"),
        ("supply_c", "supply air"),
        ("setpoint_c", "setpoint"),
        ("cooling_command", "setpoint (steps)"),
    ):
        values = lines[label].get_ydata()
        np.testing.assert_array_equal(values, [*shown[name], shown[name].iloc[-1]])
    (span,) = temperatures.patches
    edges = [clock(x) for x in (span.get_x(), span.get_x() + span.get_width())]
    assert (span.get_label(), edges) == ("crac down", ["02-28 12:00", "02-28 14:00"])
    assert storage.get_xlabel() == "local standard time on 28 February"
    assert figure.get_suptitle() == r"_x\$_{\$"
    assert render(figure).std() > 10


def test_day_puts_effects_after_their_causes(steps: pd.DataFrame) -> None:
    figure: Any = dashboards.day(steps, "02-28")
    temperatures, _, carbon, commands, storage, *_ = figure.axes
    for axes in figure.axes:
        assert [clock(x) for x in axes.get_xlim()] == ["02-28 00:00", "03-01 00:00"]
    for line in (*temperatures.lines[:5], *commands.lines, *carbon.lines):
        assert line.get_drawstyle() == "steps-post"
        assert clock(line.get_xdata(orig=False)[-1]) == "03-01 00:00"
    # The queue is that at the end of a step, and the day begins with that of the evening before.
    (queue,) = storage.lines
    times = queue.get_xdata(orig=False)
    assert [clock(times[0]), clock(times[-1])] == ["02-28 00:00", "03-01 00:00"]
    np.testing.assert_array_equal(queue.get_ydata(), steps["queue_tasks"][95:192])


def test_day_of_the_second_year(steps: pd.DataFrame) -> None:
    hottest_c = steps["inlet_max_c"].max() + 10.0
    later = steps["time"][:96] + pd.Timedelta(days=365)
    hot = steps[:96].assign(time=later, inlet_max_c=hottest_c)
    both = pd.concat([steps, hot])
    assert dashboards.hottest_day(both) == "2019-02-27"
    first: Any = dashboards.day(both, "02-27")
    second: Any = dashboards.day(both, dashboards.hottest_day(both))
    assert first.axes[4].get_xlabel() == "local standard time on 27 February 2018"
    assert second.axes[4].get_xlabel() == "local standard time on 27 February 2019"
    assert second.axes[0].lines[2].get_ydata().max() == hottest_c


@pytest.mark.parametrize("date", ["02-26", "03-02", "2-28", "x"])
def test_days_that_the_run_does_not_have(steps: pd.DataFrame, date: str) -> None:
    message = rf"date '{date}': valid is MM-DD of a day of the run, 02-27 to 03-01 \(3 days\)"
    with pytest.raises(SdcError, match=message):
        dashboards.day(steps, date)


def test_year_puts_each_step_at_its_day_and_hour(steps: pd.DataFrame) -> None:
    short = steps[:-5]  # the last hours of the last day are missing
    figure: Any = dashboards.year(short, "ny")
    for axes, (name, factor, label, _) in zip(figure.axes, dashboards.CARPETS, strict=False):
        (image,) = axes.images
        grid = image.get_array()
        if name == "carbon_kg_per_h":
            expected = short["carbon_g"] / 1e3 / 0.25
        else:
            expected = factor * short[name]
        np.testing.assert_allclose(grid.T.ravel().compressed(), expected)
        assert grid.shape == (96, 3)
        assert np.count_nonzero(np.ma.getmaskarray(grid)) == 5
        assert image.colorbar.ax.get_ylabel() == label
        assert image.origin == "lower", "midnight below"
    energy = figure.axes[6]
    heights = [bar.get_height() for bar in energy.patches]
    by_day = short.groupby(short["time"].dt.date)[["it_kwh", "hvac_kwh"]].sum() / 1e3
    np.testing.assert_allclose(heights, [*by_day["it_kwh"], *by_day["hvac_kwh"]])
    assert energy.get_ylabel() == "energy (MWh/day)"
    assert render(figure).std() > 10


def hourly(begin: str, days: int, it_kwh: float = 2.0) -> pd.DataFrame:
    times = pd.date_range(begin, periods=24 * days, freq="h")
    values = {name: 1.0 for name, *_ in dashboards.CARPETS if name != "carbon_kg_per_h"}
    return pd.DataFrame(
        {"time": times, **values, "it_kwh": it_kwh, "hvac_kwh": 1.0, "carbon_g": 5.0}
    )


def test_year_sums_months_of_long_runs() -> None:
    steps = hourly("2001-11-01", 120)
    figure: Any = dashboards.year(steps)
    energy, emitted = figure.axes[6:8]
    heights = [bar.get_height() for bar in energy.patches]
    np.testing.assert_allclose(heights[:4], np.array([30, 31, 31, 28]) * 24 * 2 / 1e3)
    assert [tick.get_text() for tick in energy.get_xticklabels()] == ["Nov", "Dec", "Jan", "Feb"]
    assert energy.get_ylabel() == "energy (MWh/month)"
    assert emitted.get_ylabel() == "emitted (kg CO₂e/month)"
    with pytest.raises(SdcError, match="47 h; valid are two days or more"):
        dashboards.year(steps[:47])


def test_scatter_shows_every_step(steps: pd.DataFrame) -> None:
    figure: Any = dashboards.setpoint_scatter(steps, "ny")
    setpoint, share, inlet = (axes.collections[0] for axes in figure.axes[:3])
    expected = sorted(
        zip(steps["outdoor_c"], steps["it_w"] / 1e3, steps["setpoint_c"], strict=True)
    )
    points = np.column_stack([setpoint.get_offsets(), setpoint.get_array()])
    np.testing.assert_allclose(sorted(map(tuple, points)), expected)
    assert share.get_array().max() == pytest.approx(100 * (steps["hvac_w"] / steps["it_w"]).max())
    assert inlet.get_array().max() == steps["inlet_max_c"].max()
    many = pd.concat(
        [steps.assign(time=steps["time"] + pd.Timedelta(days=3 * i)) for i in range(50)]
    )
    hours = many["time"].dt.hour + many["time"].dt.minute / 60
    figure = dashboards.setpoint_scatter(many.assign(outdoor_c=hours))
    drawn = figure.axes[0].collections[0].get_offsets()
    assert len(drawn) == dashboards.MAX_SCATTER_POINTS < len(many)
    assert len(np.unique(drawn[:, 0])) == 96, "every time of day"


def test_battery_profile_is_the_mean_day(steps: pd.DataFrame) -> None:
    figure: Any = dashboards.battery_profile(steps)
    carbon, power, charge = figure.axes
    by_slot = {name: np.reshape(steps[name], (DAYS, 96)) for name in steps if name != "time"}
    np.testing.assert_allclose(carbon.lines[0].get_ydata(), by_slot["ci_g_per_kwh"].mean(axis=0))
    np.testing.assert_allclose(charge.lines[0].get_ydata(), 100 * by_slot["soc"].mean(axis=0))
    charging, discharging = (patch.get_data().values for patch in power.patches)
    assert charging.max() > 0 > discharging.min(), "the battery of this run works"
    np.testing.assert_allclose(charging, by_slot["charge_kwh"].mean(axis=0) / 0.25)
    np.testing.assert_allclose(discharging, -by_slot["discharge_kwh"].mean(axis=0) / 0.25)
    assert carbon.lines[0].get_xdata()[0] == 0.125
    assert charge.lines[0].get_xdata()[0] == 0.25, "at the end of the step"


def racks_with(hall: HallConfig, **peaks: float) -> pd.DataFrame:
    """Racks of 24 C that were never above 27 C, except those named ``rack_N``."""
    peak_c, above_h = np.full(hall.racks, 24.0), np.zeros(hall.racks)
    for name, value in peaks.items():
        peak_c[int(name[5:])] = value
        above_h[int(name[5:])] = 2.5 if value > 27.0 else 0.0
    return pd.DataFrame({"inlet_max_c": peak_c, "above_27_h": above_h})


def cells(axes: Any) -> Any:
    return np.ma.filled(axes.collections[0].get_array(), 0.0).ravel()


def test_inlet_map_shows_limits_and_ties() -> None:
    hall = load_config("corrected").hall
    racks = racks_with(hall, rack_1=27.2, rack_3=27.19999, rack_4=36.0)
    figure: Any = rack_maps.inlet_map({"": racks}, hall, 35.0)
    axes, bar = figure.axes
    np.testing.assert_array_equal(cells(axes), racks["inlet_max_c"])
    assert [text.get_text() for text in axes.texts][:5] == ["24.0", "27.2", "24.0", "27.2", "36.0"]
    row, rack = divmod(4, hall.racks_per_row)
    assert axes.get_title(loc="left") == (
        f"hottest inlet 36.0 °C, 9.0 K above the recommended 27 °C, at row {row} rack {rack}"
    )
    ticks = [text.get_text() for text in bar.get_yticklabels()]
    assert ticks[-2:] == ["27 recommended", "35 allowable"]
    mesh = axes.collections[0]
    cool, warm, _, violet = mesh.cmap(mesh.norm([26.9, 27.1, 34.9, 35.1]))
    assert cool[1] > cool[0], "green"
    assert warm[0] > warm[2] + 0.2, "yellow"
    assert violet[2] > violet[1] + 0.2
    with pytest.raises(SdcError, match=r"19 rows; valid is one for each of 20 racks"):
        rack_maps.inlet_map({"": racks[1:]}, hall, 35.0)
    with pytest.raises(SdcError, match="missing columns above_27_h"):
        rack_maps.hours_map({"": racks[["inlet_max_c"]]}, hall)
    assert render(figure).std() > 5


def test_variants_share_the_colours_of_rack_maps() -> None:
    hall = load_config("corrected").hall
    runs = {"before": racks_with(hall), "after_$": racks_with(hall, rack_7=28.4)}
    figure: Any = rack_maps.inlet_map(runs, hall, 32.0)
    first, second, _ = figure.axes
    assert first.collections[0].get_clim() == second.collections[0].get_clim() == (24.0, 29.0)
    assert first.get_title(loc="left").startswith("before: hottest inlet 24.0 °C, 3.0 K below")
    hours: Any = rack_maps.hours_map(runs, hall)
    before, after, _ = hours.axes
    assert before.get_title(loc="left").startswith("before: 0 of 20 racks")
    np.testing.assert_array_equal(cells(after), runs["after_$"]["above_27_h"])
    assert [text.get_text() for text in after.texts if text.get_text() != "--"] == ["2.5"]
    assert render(hours).std() > 5


def test_dark_pages_exchange_ink_and_paper_alone() -> None:
    hall = load_config("corrected").hall
    figure: Any = rack_maps.inlet_map({"": racks_with(hall, rack_2=29.0)}, hall, 35.0)
    light = render(figure).astype(int)
    darken(figure)
    dark = render(figure).astype(int)
    assert light[0, 0].min() == 255
    assert dark[0, 0, :3].max() < 40
    coloured = np.ptp(light[..., :3], axis=2) > 90
    assert coloured.sum() > 1000
    # Antialiased edges of the colour bar mix colours with ink.
    assert (dark == light).all(axis=2)[coloured].mean() > 0.99
    ink = (light[..., :3].max(axis=2) < 40) & (np.arange(len(light)) < 20)[:, None]
    assert ink.any()
    assert dark[ink][:, :3].min() > 150, "the title is light"


def fleet_of(steps: pd.DataFrame) -> pd.DataFrame:
    inlets = {f"inlet_{part}_c": steps["inlet_max_c"] for part in ("low", "mid", "high", "max")}
    return steps[["time", "it_w", "overhead_w", "carbon_g"]].assign(**inlets)


@pytest.mark.parametrize(("factor", "power"), [(1.0, "kW"), (1e4, "MW")])
def test_fleet_overview_fits_the_size(steps: pd.DataFrame, factor: float, power: str) -> None:
    given = fleet_of(steps)
    given[["it_w", "overhead_w", "carbon_g"]] *= factor
    figure: Any = fleet_figures.fleet_overview(given)
    axes, pue, carbon, inlets = figure.axes
    assert axes.get_ylabel() == f"power ({power})"
    unit = 1e3 if power == "kW" else 1e6
    highest = max(area.get_paths()[0].vertices[:, 1].max() for area in axes.collections)
    assert highest == pytest.approx((given["it_w"] + given["overhead_w"]).max() / unit)
    expected = 1 + steps["overhead_w"] / steps["it_w"]
    np.testing.assert_allclose(pue.lines[0].get_ydata()[:-1], expected)
    assert carbon.get_ylabel() == f"emitted ({'kg' if power == 'kW' else 't'} CO₂e/h)"
    assert clock(inlets.get_xlim()[1]) == "03-02 00:00"


@pytest.mark.parametrize(("name", "rack"), [("inlet", 0), ("outlet", 1)])
def test_hall_map_shows_the_racks(run: Run, name: str, rack: int) -> None:
    fleet, results = run
    figure: Any = figures.hall_map(results[40], fleet)
    values = getattr(results[40], f"rack_{name}_c")
    axes, bar = figure.axes[rack], figure.axes[2 + rack]
    np.testing.assert_array_equal(axes.collections[0].get_array().ravel(), values)
    assert bar.get_ylabel() == f"{name} (°C)"
    assert axes.yaxis_inverted(), "row 0 at the top, as in recordings"
    assert [text.get_text() for text in axes.texts] == [f"{v:.1f}" for v in values]
    row, place = divmod(int(values.argmax()), fleet.configs[0].hall.racks_per_row)
    title = axes.get_title(loc="left")
    assert f"hottest {values.max():.1f} °C, row {row} rack {place}" in title
    outlined = [(round(p.get_x() - 0.04), round(p.get_y() - 0.04)) for p in axes.patches]
    assert (place, row) in outlined
    assert render(figure).std() > 10


def test_overview_shows_the_run(steps: pd.DataFrame) -> None:
    figure: Any = figures.overview(steps)
    weather, power, carbon, storage, emitted, charge = figure.axes
    for line, name in zip(weather.lines, ("outdoor_c", "wet_bulb_c", "setpoint_c"), strict=True):
        np.testing.assert_array_equal(line.get_ydata()[:-1], steps[name])
    np.testing.assert_array_equal(carbon.lines[0].get_ydata()[:-1], steps["ci_g_per_kwh"])
    np.testing.assert_array_equal(storage.lines[0].get_ydata(), steps["queue_tasks"])

    def highest(axes: Any) -> float:
        return max(float(a.get_paths()[0].vertices[:, 1].max()) for a in axes.collections)

    assert highest(power) == pytest.approx(((steps["it_w"] + steps["overhead_w"]) / 1e3).max())
    assert highest(emitted) == pytest.approx(steps["carbon_g"].max() / 1e3 / 0.25)
    assert highest(charge) == pytest.approx(100 * steps["soc"].max())
    assert not power.lines
    # Presets may leave devices out of the total.
    partly = steps.assign(overhead_w=steps["chiller_w"])
    (line,) = figures.overview(partly).axes[1].lines
    np.testing.assert_allclose(
        np.asarray(line.get_ydata())[:-1], (steps["it_w"] + steps["chiller_w"]) / 1e3
    )


def test_missing_matplotlib_is_explained(
    steps: pd.DataFrame, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(SdcError, match=r'pip install "sdc-taichi\[plot\]"'):
        figures.overview(steps)


def test_import_is_light() -> None:
    code = (
        "import sys, sdc_taichi.viz.recorder, sdc_taichi.viz.figures;"
        "print({'rerun', 'matplotlib', 'pandas', 'taichi'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_tables_that_are_no_run(run: Run, steps: pd.DataFrame) -> None:
    fleet, results = run
    with pytest.raises(SdcError, match=r"data center 1: valid is 0\.\.0"):
        figures.hall_map(results[0], fleet, 1)
    with pytest.raises(SdcError, match="result of 20 racks, expected 4"):
        figures.hall_map(results[0], build_fleet(load_config("tiny")))
    with pytest.raises(SdcError, match="1 rows; valid are two or more"):
        figures.overview(steps[:1])
    with pytest.raises(SdcError, match="missing columns soc"):
        dashboards.battery_profile(steps.drop(columns="soc"))
    with pytest.raises(SdcError, match="missing columns load_command"):
        dashboards.day(steps.drop(columns="load_command"), "02-28")
    with pytest.raises(SdcError, match="increasing time"):
        dashboards.year(pd.concat([steps, steps]))


def totals(**changed: float) -> dict[str, Metric]:
    given: dict[str, Metric] = {
        "cfp_kg": 100.0,
        "hvac_kwh": 50.0,
        "it_kwh": 1000.0,
        "water_l": 0.0,
        "queue_mean_tasks": 2.0,
    }
    return given | changed


def test_radar_is_scaled_to_the_worst() -> None:
    runs = {"a": totals(), DOLLARS: totals(cfp_kg=97.0, it_kwh=980.0, queue_mean_tasks=0.0)}
    figure: Any = fleet_figures.radar(runs)
    (axes,) = figure.axes
    first, second = (line.get_ydata() for line in axes.lines)
    np.testing.assert_allclose(first, [1, 1, 1, 0, 1, 1])
    # Middles: 95 % of the carbon, 95 % of the IT energy, since 98 leaves no room below the best.
    np.testing.assert_allclose(second, [0.4, 1, 0.6, 0, 0, 0.4])
    ticks = [tick.get_text() for tick in axes.get_xticklabels()]
    assert ticks[0] == "carbon footprint\n100 kg CO₂e at the rim\n95 in the middle"
    assert ticks[3] == "water\n0 L for all"
    assert render(figure).std() > 5
    assert [t.get_text() for t in figure.legends[0].get_texts()] == ["a", r" _x\$_{\$"]


@pytest.mark.parametrize(
    ("runs", "message"),
    [
        ({"a": totals()}, "1 runs to compare"),
        ({str(i): totals() for i in range(13)}, "13 runs to compare; valid are 2 to 12"),
        ({"a": totals(), "b": totals(cfp_kg=-1.0)}, "run 'b': cfp_kg is -1.0"),
        ({"a": totals(), "b": {}}, "run 'b': cfp_kg is None"),
    ],
)
def test_runs_that_cannot_be_compared(runs: dict[str, Any], message: str) -> None:
    with pytest.raises(SdcError, match=message):
        fleet_figures.radar(runs)


def test_fleet_map_shows_the_hottest_first() -> None:
    hours = np.array([0, 24, 48, 72, 96, 102])
    time = np.datetime64("2001-01-01", "ms") + hours * np.timedelta64(1, "h")
    inlets = np.random.default_rng(0).uniform(20, 30, (5, 100))
    figure: Any = fleet_figures.fleet_map(time, inlets, [f"dc{i}" for i in range(100)])
    axes = figure.axes[0]
    order = np.argsort(-inlets.max(axis=0))[: fleet_figures.MAX_MAP_ROWS]
    assert [t.get_text() for t in axes.get_yticklabels()] == [f"dc{i}" for i in order]
    np.testing.assert_array_equal(axes.collections[0].get_array(), inlets[:, order].T)
    assert axes.get_ylabel() == "the 40 hottest of 100 data centers"
    assert clock(axes.get_xlim()[1]) == "01-05 06:00", "the last interval ends with the run"
    with pytest.raises(SdcError, match=r"expected \(5, 3\)"):
        fleet_figures.fleet_map(time, inlets, ["a", "b", "c"])


@pytest.mark.parametrize("steps", [2, 95, 200, 300, 385, 479, 500, 700, 3000, 9000, 12000])
def test_every_length_has_ticks(steps: int) -> None:
    """matplotlib warns of lengths that it finds no ticks for."""
    times = pd.date_range("2001-02-27", periods=steps, freq="15min")
    series = {"x": pd.Series(np.arange(steps) % 96 + 1.0, index=times)}
    figure: Any = data_figures.comparison(series, data_figures.CARBON)
    render(figure)
    assert 2 <= len(figure.axes[0].get_xticks()) <= 11


def hourly_carbon(site: str) -> pd.Series:
    times = pd.date_range("2001-01-01", periods=8760, freq="h")
    return pd.Series(synthetic_site(site).ci_g_per_kwh.values, index=times)


def test_comparison_shows_weeks_and_hours() -> None:
    series = {name: hourly_carbon(name) for name in ("NY", "CA")}
    figure: Any = data_figures.comparison(series, data_figures.CARBON)
    left, right = figure.axes
    values = synthetic_site("CA").ci_g_per_kwh.values
    assert len(values) == 8760
    by_hour = np.reshape(values, (365, 24)).mean(axis=0)
    np.testing.assert_allclose(right.lines[1].get_ydata(), by_hour)
    weeks = np.reshape(values[: 52 * 168], (52, 168)).mean(axis=1)
    np.testing.assert_allclose(left.lines[1].get_ydata()[:52], weeks)
    times = left.lines[1].get_xdata(orig=False)
    assert [clock(x) for x in (times[0], times[-1])] == ["01-04 12:00", "12-31 12:00"], "middles"
    assert left.get_ylabel() == right.get_ylabel() == "carbon intensity (g CO₂e/kWh)"


def test_the_leap_day_is_no_gap(steps: pd.DataFrame) -> None:
    """Two days on both sides of 29 February 2004, which no run has."""
    times = [*pd.date_range("2004-02-28", periods=96, freq="15min"),
             *pd.date_range("2004-03-01", periods=96, freq="15min")]  # fmt: skip
    both = steps[:192].assign(time=times)
    values = both.set_index("time")["ci_g_per_kwh"]
    assert len(data_figures.daily(values).mean()) == 2
    assert data_figures.mean_and_variation("x", values)[0] == pytest.approx(values.mean())
    assert plotting.step_hours(both[95:]) == 0.25
    storage: Any = dashboards.day(both, "03-01").axes[4]
    (queue,) = storage.lines
    ends = queue.get_xdata(orig=False)
    assert [clock(x) for x in (ends[0], ends[1], ends[-1])] == [
        "03-01 00:00", "03-01 00:15", "03-02 00:00",
    ]  # fmt: skip


def test_variation_is_that_of_each_day() -> None:
    times = pd.date_range("2001-01-01", periods=48, freq="h")
    # Flat days of different level vary from day to day, not within.
    flat = pd.Series(np.repeat([100.0, 300.0], 24), index=times)
    assert data_figures.mean_and_variation("flat", flat) == (200.0, 0.0)
    swing = pd.Series(np.tile([50.0, 150.0], 24), index=times)
    assert data_figures.mean_and_variation("swing", swing) == pytest.approx((100.0, 0.5))
    figure: Any = data_figures.carbon_variation({"flat": flat, "swing": swing})
    points = [(line.get_xdata()[0], line.get_ydata()[0]) for line in figure.axes[0].lines]
    assert points == [(0.0, 200.0), (pytest.approx(50.0), 100.0)]
    with pytest.raises(SdcError, match="series 'zero': a day with a mean of 0"):
        data_figures.carbon_variation({"zero": 0.0 * flat})


def test_series_that_are_too_short() -> None:
    one = pd.Series([1.0], index=pd.date_range("2001-01-01", periods=1, freq="h"))
    with pytest.raises(SdcError, match="no series"):
        data_figures.comparison({}, data_figures.CARBON)
    with pytest.raises(SdcError, match="series 'x': 1 values"):
        data_figures.comparison({"x": one}, data_figures.CARBON)
