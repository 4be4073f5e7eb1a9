"""The split of the year, and data centers of its weeks."""

from __future__ import annotations

import pytest

from sdc_taichi import ConfigError, load_config
from sdc_taichi.learning.split import (
    HELD_OUT,
    NAMED_WEEKS,
    TRAINING,
    VALIDATION,
    WEEKS,
    data_center_weeks,
    parse_weeks,
)


def test_each_week_is_in_one_part_of_the_year() -> None:
    assert sorted([*HELD_OUT, *VALIDATION, *TRAINING]) == list(range(WEEKS))
    assert (len(HELD_OUT), len(VALIDATION), len(TRAINING)) == (13, 7, 32)
    assert HELD_OUT[:2] + HELD_OUT[-1:] == (3, 7, 51)
    assert VALIDATION == (1, 9, 17, 25, 33, 41, 49)


def test_weeks_are_named_or_numbered() -> None:
    for name, weeks in NAMED_WEEKS.items():
        assert parse_weeks(name) == weeks
    assert parse_weeks("3, 7,11") == (3, 7, 11)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("held_out", "'held_out'; valid are held-out, .*did you mean 'held-out'"),
        ("3,52", "'52'; valid are .* 0..51 such as"),
        ("3,-1", "'-1'"),
        ("", "''; valid are"),
        ("3,7,3", "week 3 is given twice"),
    ],
)
def test_weeks_that_are_not_valid_are_named(text: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        parse_weeks(text)


def test_weeks_of_data_centers_begin_on_their_first_day() -> None:
    two = [load_config("tiny", [f"name={name}"]) for name in ("a", "b")]
    found = data_center_weeks(two, (0, 3, 51))
    assert [config.name for config in found] == ["a-0", "a-3", "a-51", "b-0", "b-3", "b-51"]
    assert [config.site.start for config in found[:3]] == ["01-01", "01-22", "12-24"]
    assert found[5].hall == two[1].hall
