"""The split of the year, and data centers of its weeks."""

from __future__ import annotations

import pytest
import yaml

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
from sdc_taichi.learning.training_settings import TrainingSettings


def test_each_week_is_in_one_part_of_the_year() -> None:
    assert len({*HELD_OUT, *VALIDATION, *TRAINING}) == WEEKS - 8
    assert (len(HELD_OUT), len(VALIDATION), len(TRAINING)) == (8, 4, 32)
    assert HELD_OUT[:3] == (2, 3, 15)
    assert VALIDATION == (5, 18, 31, 44)
    used = {*VALIDATION, *TRAINING}
    assert not used & {(week + days) % WEEKS for week in HELD_OUT for days in (-1, 0, 1)}


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


def test_copies_are_in_each_year_and_week() -> None:
    two = [load_config("tiny", [f"name={name}"]) for name in ("a", "b")]
    copies = data_center_weeks(two, (0, 3), (5, 6))
    assert [x.name for x in copies[:5]] == ["a-5-0", "a-5-3", "a-6-0", "a-6-3", "b-5-0"]
    assert [x.site.seed for x in copies] == [5, 5, 6, 6] * 2


def test_pairs_of_site_and_week_of_a_training_have_years_in_turn() -> None:
    settings = TrainingSettings(algorithm="ippo", sites=("NY", "CA"), years=(5, 6), weeks=(0, 1, 2))
    years = [x.site.seed for x in settings.data_centers_of_weeks()]
    assert years == [5, 6, 5, 6, 5, 6]
    assert TrainingSettings.model_validate(yaml.safe_load(settings.to_yaml())) == settings
