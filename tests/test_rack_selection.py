"""Selections of racks in words, such as ``7,row:3,hottest:10``."""

from __future__ import annotations

import numpy as np
import pytest

from sdc_taichi import load_config
from sdc_taichi.errors import ConfigError
from sdc_taichi.hall.rack_selection import default_racks, parse_racks
from sdc_taichi.hall.zones import MOST_ZONES, RACKS_PER_ZONE, hall_zones

HALL = load_config("corrected").hall
INLET_C = np.array([20.0, 21.0, 25.0, 22.0, 25.0, *np.linspace(10.0, 17.0, 15)])


@pytest.mark.parametrize(
    ("text", "racks"),
    [
        ("7", [7]),
        (" 7 , 3 ", [7, 3]),
        ("1:2", [7]),
        ("row:3", [15, 16, 17, 18, 19]),
        ("zone:0", list(range(20))),
        ("hottest:3", [2, 4, 3]),
        ("hottest:1,row:0", [2, 0, 1, 3, 4]),
        ("median", [14]),
        ("7,7,1:2", [7]),
    ],
)
def test_terms_select_racks_in_their_order(text: str, racks: list[int]) -> None:
    selection = parse_racks(text)
    selection.check(HALL)
    assert selection.racks(HALL, INLET_C).tolist() == racks
    assert selection.needs_inlets == any(word in text for word in ("hottest", "median"))


def test_last_bits_do_not_decide_which_rack_is_hotter() -> None:
    jittered = INLET_C + np.arange(20) * 1e-12
    assert parse_racks("hottest:2").racks(HALL, jittered).tolist() == [2, 4]


def test_by_default_racks_are_the_ten_hottest_and_the_median() -> None:
    racks = default_racks(HALL).racks(HALL, INLET_C).tolist()
    assert racks[:3] == [2, 4, 3]
    assert len(racks) == 11
    tiny = load_config("tiny").hall
    few = default_racks(tiny).racks(tiny, np.zeros(tiny.racks))
    assert len(few) == min(tiny.racks, 11)


@pytest.mark.parametrize(
    "text", ["", "x", "7,", "row:", "row:x", "zone:", "hottest", "1:2:3", "7-9", "²"]
)
def test_unknown_terms_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=r"--racks .*: valid are RACK, ROW:PLACE, row:ROW"):
        parse_racks(text)


@pytest.mark.parametrize(
    ("text", "valid"),
    [
        ("20", r"valid is 0\.\.19"),
        ("-1", r"valid is 0\.\.19"),
        ("4:0", r"valid is 0\.\.3:0\.\.4"),
        ("row:4", r"valid is row:0\.\.3"),
        ("zone:1", r"valid is zone:0\.\.0"),
        ("hottest:0", r"valid is hottest:1\.\.20"),
        ("1,hottest:21", r"'hottest:21': the hall of ny has 4 rows of 5 racks"),
    ],
)
def test_racks_that_a_hall_does_not_have_are_refused(text: str, valid: str) -> None:
    selection = parse_racks(text, "--racks")
    with pytest.raises(ConfigError, match=valid):
        selection.check(HALL, "ny")


@pytest.mark.parametrize(
    ("rows", "per_row"), [(4, 5), (3, 7), (12, 18), (33, 77), (1, 1000), (1000, 1), (320, 320)]
)
def test_zones_are_blocks_of_rows_that_divide_the_hall(rows: int, per_row: int) -> None:
    size = [f"hall.rows={rows}", f"hall.racks_per_row={per_row}", "hall.servers_per_rack=1"]
    hall = load_config("large", size).hall
    zones = hall_zones(hall)
    inlet_c = np.random.default_rng(0).normal(24.0, 2.0, (2, hall.racks))
    racks = [zones.racks(zone) for zone in range(zones.count)]
    np.testing.assert_array_equal(np.sort(np.concatenate(racks)), np.arange(hall.racks))
    assert 1 <= zones.count <= MOST_ZONES
    assert zones.count == 1 or hall.racks / zones.count >= RACKS_PER_ZONE
    assert zones.count == 1 or max(map(len, racks)) <= 2.5 * min(map(len, racks))
    for zone, chosen in enumerate(racks):
        highest, mean = zones.highest(inlet_c)[:, zone], zones.mean(inlet_c)[:, zone]
        np.testing.assert_array_equal(highest, inlet_c[:, chosen].max(axis=1))
        np.testing.assert_allclose(mean, inlet_c[:, chosen].mean(axis=1), rtol=1e-12)
        np.testing.assert_array_equal(zones.of_racks(chosen), zone)
        selected = parse_racks(f"zone:{zone}")
        selected.check(hall)
        np.testing.assert_array_equal(selected.racks(hall), chosen)
        row, place = divmod(int(chosen[0]), per_row)
        assert [part.start for part in zones.bounds(zone)] == [row, place]
