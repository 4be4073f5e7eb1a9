"""The units of the paper's tables, and what a constant setpoint reaches in them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sdc_taichi import load_config, make_controller
from sdc_taichi.benchmark.paper import (
    CONSTANT_ROW,
    PaperFigures,
    PaperTable,
    compared,
    paper_tables,
)
from sdc_taichi.errors import ConfigError
from sdc_taichi.run.loop import simulate
from sdc_taichi.run.metrics import metrics_per_dc
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F64

SCORED_H = 6 * 24.0
COLDEST = (180.4, 416.0, 928.0)
"""Carbon in kg and powers in kW of the lowest setpoint in New York, run in the released code."""


def table(number: int) -> PaperTable:
    return next(each for each in paper_tables() if each.number == number)


def rows(**changes: object) -> pd.DataFrame:
    """Two weeks of a controller that draws 300 kW for cooling and 900 kW for servers."""
    values: dict[str, object] = {
        "case": "ny",
        "row": CONSTANT_ROW,
        "seed": 0,
        "moves": "all",
        "site": "ny",
        "week": [22, 23],
        "cfp_kg": 0.3 * 1200.0 * SCORED_H,
        "grid_kwh": 1200.0 * SCORED_H,
        "hvac_kwh": 300.0 * SCORED_H,
        "it_kwh": 900.0 * SCORED_H,
        "queue_mean_tasks": [2.0, 4.0],
        "water_l": 5000.0 * SCORED_H,
    }
    return pd.DataFrame(values | changes)


def figures(ours: pd.DataFrame, scored_h: float) -> PaperFigures:
    """Our figures of the constant setpoint in the units of table 4."""
    constant = compared(table(4), ours, scored_h).set_index("label").loc[CONSTANT_ROW]
    return PaperFigures(*map(float, constant[list(PaperFigures._fields)].to_numpy()))


def test_units_of_the_tables() -> None:
    reached = figures(rows(), SCORED_H)
    assert reached == pytest.approx((0.55175 * 300.0, 300.0, 900.0, 3.0, 5.0 * 2880))


def test_printed_tables_hold_power_and_not_energy() -> None:
    """An hour of the printed IT figure is what the servers of a megawatt draw; a month is not."""
    assert [each.number for each in paper_tables()] == [2, 3, 4, 5, 6, 7]
    for each in paper_tables():
        for row in each.rows.values():
            printed = row.figures
            ci_g_per_kwh = 4e3 * printed.cfp_kg / (printed.hvac_kw + printed.it_kw)
            assert 180.0 < ci_g_per_kwh - each.noise_base_g_per_kwh < 640.0
            assert 900.0 < printed.it_kw < 1100.0


def test_rows_stand_beside_printed_ones_and_the_constant_setpoint() -> None:
    ours = [
        rows(),
        *(rows(row="happo", seed=seed, cfp_kg=rows().cfp_kg * 0.9) for seed in (0, 1)),
        rows(row="ippo-a0.1"),
        rows(row="happo", site="ga"),
        rows(row="happo", moves="load"),
        rows(row="bound", it_kwh=np.nan),
    ]
    reached = compared(table(4), pd.concat(ours), SCORED_H).set_index("label")
    assert list(reached.index) == [*(x.label for x in table(4).rows.values()), CONSTANT_ROW]
    assert reached["seeds"].to_dict()["IPPO"] == 0
    assert np.isnan(reached["cfp_kg"]["IPPO"])
    assert reached["seeds"]["HAPPO"] == 2
    assert np.isnan(reached["printed_cfp_kg"][CONSTANT_ROW])
    share = 0.9 * 300.0 / 551.75 + 251.75 / 551.75
    against_constant = reached["against_constant"]
    assert against_constant["HAPPO"] == pytest.approx(100.0 * (share - 1.0))
    assert against_constant[CONSTANT_ROW] == pytest.approx(0.0)


@pytest.mark.parametrize(
    ("ours", "message"),
    [
        (pd.concat([rows(), rows()]), "4 rows of coldest for 1 seeds and 2 weeks"),
        (pd.concat([rows(), rows(row="happo").head(1)]), "happo has 1 weeks and coldest 2"),
    ],
)
def test_rows_of_other_weeks_are_refused(ours: pd.DataFrame, message: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        compared(table(4), ours, SCORED_H)


def coldest(overrides: list[str]) -> PaperFigures:
    """The lowest setpoint through June in New York on preset ``sustaindc``, in parts of 3 days."""
    config = load_config("sustaindc", ["site.location=NY", *overrides])
    parts = [
        config.model_copy(update={"site": config.site.model_copy(update={"start": f"06-{day:02}"})})
        for day in range(1, 31, 3)
    ]
    with Simulator(parts) as sim:
        totals = simulate(sim, make_controller("coldest", sim.fleet), steps=3 * 96)
        metrics = metrics_per_dc(totals, sim.fleet)
    weeks = dict(rows().iloc[0][["case", "row", "seed", "moves", "site"]])
    return figures(pd.DataFrame(metrics).assign(**weeks, week=range(len(parts))), 3 * 24.0)


def test_the_lowest_setpoint_stands_among_the_printed_learners() -> None:
    """Within 4 % of what the released code reaches, on synthetic inputs."""
    reached = coldest([])
    assert reached[:3] == pytest.approx(COLDEST, rel=0.04)
    assert reached.queue_tasks == 0.0
    printed = [row.figures.cfp_kg for row in table(4).rows.values()]
    assert min(printed) < reached.cfp_kg < max(printed)


def released_utilisation(hourly: F64) -> F64:
    """Utilisation by quarter hour as the released code makes it of a trace, without its noise.

    Hours are interpolated over a year stretched by an hour, scaled so that the 5th and 95th
    percentile are 0.2 and 0.8, and averaged over four hours (``Workload_Manager``).

    Args:
        hourly: utilisation by the hour, 0..1, (H,).

    Returns:
        Utilisation, 0..1, (4 H,).
    """
    size = 4 * len(hourly)
    quarters = np.interp(np.linspace(0, len(hourly), size), np.arange(len(hourly)), hourly)
    low, high = np.percentile(quarters, [5.0, 95.0])
    scaled = np.clip(0.2 + 0.6 * (quarters - low) / (high - low), 0.0, 1.0)
    return np.convolve(scaled, np.full(16, 1.0 / 16), mode="same")


def test_measured_inputs_give_the_figures_of_the_released_code(
    real_data: Path, tmp_path: Path
) -> None:
    hourly = pd.read_csv(real_data / "workload" / "Alibaba_CPU_Data_Hourly_1.csv")["cpu_load"]
    stamps = pd.date_range("2022-01-01", periods=35_040, freq="15min")
    trace = pd.DataFrame(
        {"timestamp": stamps, "cpu_load": released_utilisation(hourly.to_numpy()[:8760])}
    )
    trace.to_csv(tmp_path / "trace.csv", index=False)
    reached = coldest(
        [
            f"site.weather_file={real_data}/weather/USA_NY_New.York-LaGuardia.epw",
            f"site.carbon_file={real_data}/carbon/NY_NG_&_avgCI.csv",
            f"site.workload_file={tmp_path}/trace.csv",
        ]
    )
    assert reached[:3] == pytest.approx(COLDEST, rel=0.03)
