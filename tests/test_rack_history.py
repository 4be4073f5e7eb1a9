"""Histories of racks in run folders: values, intervals, selections, bad input, interruption."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner, Result

from sdc_taichi import Fleet, SdcError, Simulator, StepResult, load_config, make_configs
from sdc_taichi.cli.app import app
from sdc_taichi.control import make_controller
from sdc_taichi.run import rack_history
from sdc_taichi.run.description import RunRequest
from sdc_taichi.run.folder_writer import simulate_to_folder
from sdc_taichi.run.rack_history import (
    QUANTUMS,
    RACK_HISTORY_FILE,
    RACK_KEY_COLUMNS,
    history_request,
)

STEPS = 10


class History(NamedTuple):
    """A run with a history of racks, and the results of its steps."""

    fleet: Fleet
    results: list[StepResult]
    rows: pd.DataFrame


def simulate(
    out: Path,
    racks: str | None = None,
    every: str | None = None,
    *,
    sites: str = "ny",
    values: tuple[str, ...] = (),
    steps: int = STEPS,
) -> History:
    """Run the hall of 2026 with a history."""
    configs = make_configs(load_config("hall_of_2026", list(values)), sites=sites.split(","))
    results: list[StepResult] = []
    with Simulator(configs) as sim:
        simulate_to_folder(
            sim,
            make_controller("idle", sim.fleet),
            RunRequest("idle", steps),
            out,
            history=history_request(racks, every),
            on_step=results.append,
        )
        rows = pd.read_parquet(out / RACK_HISTORY_FILE)
        return History(sim.fleet, results, rows)


def quantities(result: StepResult) -> dict[str, np.ndarray]:
    """Values of a step by column of the history."""
    return {
        "inlet_c": result.rack_inlet_c,
        "inlet_max_c": result.rack_inlet_max_c,
        "outlet_c": result.rack_outlet_c,
        "power_w": result.rack_power_w,
        "airflow_m3s": result.rack_airflow_m3s,
    }


@pytest.mark.parametrize(("every", "steps"), [(None, 1), ("every=15min", 1), ("every=1h", 4)])
def test_rows_are_means_and_highest_inlets_of_intervals(
    every: str | None, steps: int, tmp_path: Path
) -> None:
    done = simulate(tmp_path, None, every or "every=step", sites="ny,ca")
    fleet, racks = done.fleet, done.fleet.racks
    assert list(done.rows.columns) == [*RACK_KEY_COLUMNS, *QUANTUMS, "status"]
    starts = range(0, STEPS, steps)
    assert len(done.rows) == len(starts) * racks
    for number, start in enumerate(starts):
        rows = done.rows.iloc[number * racks : (number + 1) * racks]
        assert set(rows["step"]) == {start}
        assert rows["dc"].tolist() == [fleet.names[dc] for dc in fleet.rack_dc]
        of_hall = np.arange(racks) - fleet.rack_offsets[fleet.rack_dc]
        assert rows["rack"].tolist() == of_hall.tolist()
        assert rows["row"].tolist() == (of_hall // fleet.configs[0].hall.racks_per_row).tolist()
        results = done.results[start : start + steps]
        for name, quantum in QUANTUMS.items():
            values = np.array([quantities(each)[name] for each in results])
            expected = values.max(axis=0) if name == "inlet_max_c" else values.mean(axis=0)
            assert np.abs(rows[name] - expected).max() <= 0.51 * quantum + 1e-6, name
    local = done.rows["time"].dt.tz_convert(None) + pd.to_timedelta(
        done.rows["utc_offset_h"], unit="h"
    )
    expected_times = pd.Timestamp("2018-01-01") + pd.to_timedelta(done.rows["step"] * 15, "min")
    assert (local == expected_times).all()


def test_chosen_racks_are_those_of_every_hall_in_order(tmp_path: Path) -> None:
    done = simulate(tmp_path / "chosen", "7,1:2,row:3", sites="ny,ca")
    per_row = done.fleet.configs[0].hall.racks_per_row
    row = range(3 * per_row, 4 * per_row)
    expected = sorted({7, per_row + 2, *row})
    for _, rows in done.rows.groupby(["dc", "step"], observed=True):
        assert rows["rack"].tolist() == expected
    whole = simulate(tmp_path / "whole", None, "every=step", sites="ny,ca").rows
    part = whole[whole["rack"].isin(expected)].reset_index(drop=True)
    pd.testing.assert_frame_equal(done.rows, part, check_exact=True)


def test_hottest_racks_are_those_of_the_whole_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rack_history, "_ROWS_PER_GROUP", 600)
    done = simulate(tmp_path, "hottest:5", sites="ny,ca", steps=30)
    assert [path.name for path in tmp_path.glob(".*")] == []
    for dc, name in enumerate(done.fleet.names):
        first, last = done.fleet.rack_offsets[dc : dc + 2]
        highest = np.max([r.rack_inlet_max_c[first:last] for r in done.results], axis=0)
        racks = done.rows.loc[done.rows["dc"] == name, "rack"]
        assert len(racks) == 5 * 30
        assert racks.nunique() == 5
        others = np.delete(highest, racks.unique())
        assert highest[racks.unique()].min() >= others.max() - 1e-4


def test_shares_of_crac_units_are_those_of_the_air(tmp_path: Path) -> None:
    done = simulate(tmp_path, "row:0", "every=1h,unit-shares")
    units = int(done.fleet.unit_offsets[-1])
    shares = done.rows[[f"unit_{unit}_share" for unit in range(units)]].to_numpy()
    assert np.abs(shares.sum(axis=1) - 1.0).max() < units * 2.0**-12
    assert shares.std(axis=0).min() > 0.0, "racks of a row have different units near them"


def test_a_later_run_without_history_removes_it(tmp_path: Path) -> None:
    simulate(tmp_path, "0")
    with Simulator(load_config("hall_of_2026")) as sim:
        controller = make_controller("idle", sim.fleet)
        simulate_to_folder(sim, controller, RunRequest("idle", 1), tmp_path)
    assert not (tmp_path / RACK_HISTORY_FILE).exists()


def test_an_interrupted_run_has_the_history_of_its_steps(tmp_path: Path) -> None:
    with Simulator(load_config("hall_of_2026")) as sim:
        seen: list[int] = []
        simulate_to_folder(
            sim,
            make_controller("idle", sim.fleet),
            RunRequest("idle", 100),
            tmp_path,
            history=history_request(None, "every=1h"),
            on_step=lambda result: seen.append(result.step),
            stop=lambda: len(seen) == 6,
        )
        rows = pd.read_parquet(tmp_path / RACK_HISTORY_FILE)
    assert sorted(set(rows["step"])) == [0, 4]


# --- bad input ---


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["simulate", "hall_of_2026", *map(str, arguments), "--quiet"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--racks", "row:99"), r"--racks row:99: the hall has \d+ rows of \d+ racks; valid is"),
        (("--racks", "9999"), r"--racks 9999: the hall has"),
        (("--racks", "warm"), r"--racks warm: valid are RACK"),
        (("--rack-history", "15min"), r"--rack-history 15min: valid are every=step"),
        (("--rack-history", "every=0min"), r"--rack-history every=0min: valid are every=step"),
        (("--rack-history", "every=nanh"), r"--rack-history every=nanh: valid are every=step"),
        (("--rack-history", "every=7min"), r"every=7min: valid is a whole number of steps of 15"),
        (("--rack-history", "shares"), r"--rack-history shares: valid are every=step"),
    ],
)
def test_bad_requests_are_one_line_and_write_nothing(
    arguments: tuple[str, str], message: str, tmp_path: Path
) -> None:
    done = run("--days", 1, "--out", tmp_path / "run", *arguments)
    assert done.exit_code == 2
    assert done.stderr.count("\n") == 1
    assert re.search(message, done.stderr.replace("'", "")), done.stderr
    assert not [*(tmp_path / "run").glob("*")]


def test_a_history_that_does_not_fit_the_disk_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = shutil.disk_usage(tmp_path)._replace(free=60_000_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: free)
    with pytest.raises(SdcError, match=r"racks.parquet: about [\d.]+ GB for 216 racks and 35,040"):
        simulate(tmp_path / "run", None, "every=15min", steps=35_040)
    assert not [*(tmp_path / "run").glob("*")]
    simulate(tmp_path / "run", "0:1", "every=1h", steps=1)
