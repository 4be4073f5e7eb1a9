"""Split of the year's weeks into training, validation and held-out weeks.

Agents learn in the training weeks. Validation weeks decide which checkpoint or setting is best.
Held-out weeks are for the final results and take no part in any choice. Each quarter of 13 weeks
has two of them, in the middle of January, April, July and October, a validation week and eight
training weeks. A week in no part lies before and after held-out weeks, because weather persists for
days and forecasts reach into the next day. Forecasts on the last day of a week contain data of the
next week's first day, so the first day of each week is simulated but not scored.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from datetime import date, timedelta

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import ConfigError, suggestion

WEEKS = 52
"""Number of whole weeks of a year."""
DAYS_PER_WEEK = 7
UNSCORED_DAYS = 1
"""Number of days at the beginning of each week that are simulated but not scored."""
_QUARTERS = range(0, WEEKS, 13)
HELD_OUT = tuple(first + week for first in _QUARTERS for week in (2, 3))
"""Test weeks of the year, 0..51, in which results are reported."""
VALIDATION = tuple(first + 5 for first in _QUARTERS)
"""Weeks of the year, 0..51, by which checkpoints and settings are chosen."""
TRAINING = tuple(first + week for first in _QUARTERS for week in (0, *range(6, 13)))
"""Weeks of the year, 0..51, in which agents learn."""
NAMED_WEEKS: Mapping[str, tuple[int, ...]] = {
    "held-out": HELD_OUT,
    "validation": VALIDATION,
    "training": TRAINING,
}
"""Weeks of each part of the split, by name."""


def parse_weeks(text: str) -> tuple[int, ...]:
    """Return weeks of the year from a name such as ``held-out``, or numbers such as ``3,7,11``.

    Raises:
        ConfigError: the name is unknown, a number is not a week, or a week is repeated.
    """
    if text.strip() in NAMED_WEEKS:
        return NAMED_WEEKS[text.strip()]
    valid = f"{', '.join(NAMED_WEEKS)}, or weeks 0..{WEEKS - 1} such as 3,7,11"
    weeks = []
    for part in (part.strip() for part in text.split(",")):
        if not re.fullmatch(r"[0-9]{1,2}", part) or int(part) >= WEEKS:
            meant = suggestion(part, NAMED_WEEKS, " (did you mean {!r}?)")
            raise ConfigError(f"weeks {text!r}: {part!r}; valid are {valid}{meant}")
        if int(part) in weeks:
            raise ConfigError(f"weeks {text!r}: week {part} is given twice; valid is each once")
        weeks.append(int(part))
    return tuple(weeks)


def first_day(week: int) -> str:
    """Return the first day, as ``MM-DD``, of a week of the year, 0..51."""
    return f"{date(2001, 1, 1) + timedelta(days=DAYS_PER_WEEK * week):%m-%d}"


def data_center_weeks(
    configs: Iterable[DataCenterConfig], weeks: Sequence[int], years: Sequence[int] = ()
) -> list[DataCenterConfig]:
    """Return a copy of each data center for each year and week, named ``NAME-WEEK``.

    A data center is sized for its year, so copies in different years differ a little in size.

    Args:
        configs: the data centers, such as one for each site.
        weeks: weeks of the year, 0..51, in which the copies begin.
        years: seeds of the synthetic years; the name of a copy is then ``NAME-YEAR-WEEK``. An empty
            sequence selects ``site.seed`` of each data center.

    Returns:
        All years of the first data center, then all years of the second, and so on, with all weeks
        of each year one after another.
    """
    return [
        of_week(config if year is None else in_year(config, year), week)
        for config in configs
        for year in years or (None,)
        for week in weeks
    ]


def of_week(config: DataCenterConfig, week: int) -> DataCenterConfig:
    """Return a copy of a data center that begins in a week of the year, 0..51."""
    site = config.site.model_copy(update={"start": first_day(week)})
    return config.model_copy(update={"name": f"{config.name}-{week}", "site": site})


def in_year(config: DataCenterConfig, year: int) -> DataCenterConfig:
    """Return a copy of a data center in the synthetic year with a seed."""
    site = config.site.model_copy(update={"seed": year})
    return config.model_copy(update={"name": f"{config.name}-{year}", "site": site})
