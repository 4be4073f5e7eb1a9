"""Weeks of the year that policies are trained in, chosen by, and shown by.

Every fourth week is held out: nothing is chosen by it. Validation weeks decide which checkpoint or
setting is best. Agents learn in the others. Forecasts of the last day of a week read ahead into the
first day of the next, so that day is run but not scored.
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
"""Days at the beginning of a week that are run but not scored."""
HELD_OUT = tuple(range(3, WEEKS, 4))
"""Weeks that results are shown for."""
VALIDATION = tuple(range(1, WEEKS, 8))
"""Weeks that choices are made by."""
TRAINING = tuple(week for week in range(WEEKS) if week not in {*HELD_OUT, *VALIDATION})
"""Weeks that agents learn in."""
NAMED_WEEKS: Mapping[str, tuple[int, ...]] = {
    "held-out": HELD_OUT,
    "validation": VALIDATION,
    "training": TRAINING,
}
"""Parts of the year by name."""


def parse_weeks(text: str) -> tuple[int, ...]:
    """Weeks of the year from a name such as ``held-out``, or from numbers such as ``3,7,11``.

    Raises:
        ConfigError: an unknown name, a number that is no week, or one that is given twice.
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
    """First day of a week of the year, 0..51, as ``MM-DD``."""
    return f"{date(2001, 1, 1) + timedelta(days=DAYS_PER_WEEK * week):%m-%d}"


def data_center_weeks(
    configs: Iterable[DataCenterConfig], weeks: Sequence[int]
) -> list[DataCenterConfig]:
    """One data center for each of several and each week, named ``NAME-WEEK``.

    Args:
        configs: the data centers, such as one for each site.
        weeks: weeks of the year, 0..51.

    Returns:
        Their copies, data center by data center.
    """
    return [
        config.model_copy(
            update={
                "name": f"{config.name}-{week}",
                "site": config.site.model_copy(update={"start": first_day(week)}),
            }
        )
        for config in configs
        for week in weeks
    ]
