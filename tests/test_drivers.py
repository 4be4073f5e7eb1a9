"""Series on the clock of the simulator."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import exogenous_builders as build
from sdc_taichi import (
    ConfigError,
    DataError,
    Drivers,
    drivers_from_arrays,
    load_config,
    load_drivers,
    make_configs,
)


def test_seasons_start_where_the_config_says() -> None:
    year, july = (
        load_drivers([load_config("tiny", [f"site.start={start}"])]) for start in ("01-01", "07-01")
    )
    first_of_july = 181 * 96
    assert july.at(0).outdoor_c == year.at(first_of_july).outdoor_c
    assert july.at(0).demand == year.at(first_of_july).demand
    assert july.at(184 * 96).outdoor_c == year.at(0).outdoor_c, "the year repeats"


def test_utc_rows_shift_carbon_intensity_by_the_offset_of_the_site() -> None:
    local, shifted = (
        load_drivers([load_config("tiny", ["site.location=CA", f"site.carbon_pairing={pairing}"])])
        for pairing in ("local", "utc_rows")
    )
    # California is 8 h behind UTC: at local noon the released pairing shows the row of 4 o'clock.
    noon, four = 48, 16
    assert shifted.at(noon).ci_g_per_kwh == local.at(four).ci_g_per_kwh
    assert shifted.at(noon).outdoor_c == local.at(noon).outdoor_c


def test_time_stamps_have_the_year_of_config_weather_carbon_or_workload(tmp_path: Path) -> None:
    typical = list(build.epw_lines("2021-01-01", "2021-07-01"))
    typical += build.epw_lines("2015-07-01", "2016-01-01")[8:]
    stamps = build.hours("2019-01-01", "2020-01-01")
    workload = ["timestamp,cpu_load", *(f"{stamp}:00,0.5" for stamp in stamps)]
    contents = {
        "typical.epw": typical,
        "measured.epw": list(build.epw_lines("2021-01-01", "2022-01-01")),
        "carbon.csv": build.carbon_lines("2022-01-01", "2023-01-01"),
        "workload.csv": workload,
    }
    for name, lines in contents.items():
        (tmp_path / name).write_text(build.text(lines))

    def stamp(*values: str) -> str:
        settings = [value.replace("=@", f"={tmp_path}/") for value in values]
        drivers = load_drivers([load_config("tiny", settings)])
        return str(drivers.times(np.array([0]), 4)[0, 0])[:10]

    measured, carbon = "site.weather_file=@measured.epw", "site.carbon_file=@carbon.csv"
    trace = "site.workload_file=@workload.csv"
    assert stamp("site.start=03-01") == "2018-03-01"
    assert stamp("site.weather_file=@typical.epw") == "2018-01-01"
    assert stamp("site.weather_file=@typical.epw", carbon) == "2022-01-01"
    assert stamp(carbon, measured, trace) == "2021-01-01"
    assert stamp(trace) == "2019-01-01"
    assert stamp("site.year=2030", carbon, measured, trace) == "2030-01-01"


@pytest.mark.parametrize("year", ["1899", "2101", "2018.5", "soon"])
def test_years_that_are_none(year: str) -> None:
    with pytest.raises(ConfigError, match=r"site\.year"):
        load_config("tiny", [f"site.year={year}"])


def test_copies_store_a_series_once() -> None:
    drivers = load_drivers(make_configs(load_config("tiny"), count=50, sites=["ny", "wa"]))
    assert len(drivers.outdoor_c.values) == 2 * 35040
    world = drivers.at(1000)
    assert len(np.unique(world.outdoor_c)) == 2
    np.testing.assert_array_equal(world.outdoor_c[0::2], world.outdoor_c[0])


def test_design_conditions_of_a_file_size_the_plant(tmp_path: Path) -> None:
    """The 99.6 % quantile of the year stays where a file has none."""
    lines = list(build.epw_lines())
    found: list[Drivers] = []
    for line in (lines[1], build.DESIGN_LINE):
        lines[1] = line
        path = tmp_path / f"{len(found)}.epw"
        path.write_text("\n".join(lines))
        found.append(load_drivers([load_config("tiny", [f"site.weather_file={path}"])]))
    without, given = found
    assert given.design_outdoor_c == 32.9
    assert given.design_wet_bulb_c == 25.2
    assert without.design_outdoor_c == np.quantile(without.outdoor_c.values, 0.996)
    assert without.design_wet_bulb_c == np.quantile(without.wet_bulb_c.values, 0.996)


def test_design_temperatures_of_a_year_do_not_depend_on_the_time_step() -> None:
    found = []
    for steps in (1, 4, 60):
        config = load_config("tiny", [f"simulation.steps_per_hour={steps}"])
        drivers = load_drivers([config])
        found.append((drivers.design_outdoor_c[0], drivers.design_wet_bulb_c[0]))
    assert len(set(found)) == 1


def test_series_of_different_length_repeat_on_their_own() -> None:
    drivers = drivers_from_arrays([1.0, 2.0, 3.0], [0.0] * 3, [100.0] * 3, [0.1, 0.2, 0.3])
    assert [float(drivers.at(k).outdoor_c[0]) for k in range(5)] == [1.0, 2.0, 3.0, 1.0, 2.0]


@pytest.mark.parametrize(
    ("change", "place"),
    [
        ({"demand": [0.5, 1.2]}, "demand of data center 0 at step 1 is 1.2"),
        ({"wet_bulb_c": [5.0, 25.0]}, "wet_bulb_c of data center 0 at step 1 is 25"),
        ({"ci_g_per_kwh": [-1.0, 3.0]}, "ci_g_per_kwh of data center 0 at step 0 is -1"),
        ({"outdoor_c": [20.0, np.nan]}, "outdoor_c has values that are not finite"),
        ({"outdoor_c": [20.0, 20.0, 20.0]}, "has shape"),
    ],
)
def test_impossible_arrays_are_refused(change: dict[str, list[float]], place: str) -> None:
    given: dict[str, Any] = {
        "outdoor_c": [20.0, 20.0],
        "wet_bulb_c": [15.0, 15.0],
        "ci_g_per_kwh": [300.0, 300.0],
        "demand": [0.5, 0.5],
    }
    with pytest.raises(DataError, match=place):
        drivers_from_arrays(**{**given, **change})
