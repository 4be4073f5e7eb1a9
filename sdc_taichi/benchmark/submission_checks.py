"""Checks of rows of others: the weeks of the case, and figures that fit together.

All that is tested follows from the rows themselves, from results of the same case that are known,
and from the inputs of the case. What a run did within a week is not known, so figures that were
made up with care pass; ``submission_rerun`` runs policies again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from sdc_taichi.errors import ConfigError, shortened
from sdc_taichi.learning.evaluation import ALL, METRICS
from sdc_taichi.learning.split import UNSCORED_DAYS
from sdc_taichi.optimum.objective import Objective
from sdc_taichi.optimum.problem import AGENTS
from sdc_taichi.run.achievable import share_of_achievable
from sdc_taichi.types import F64

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = (
    *("moves", "site", "week", "figure", "valued_figure", "idle_figure", "achieved_figure"),
    *("share", "broken"),
)
"""Columns of rows of a suite beside the metrics; ``controller`` may stand beside them."""
_TEXTS = ("controller", "moves", "site", "broken")
_MAY_BE_NEGATIVE = ("cost", "hottest_inlet_c")
_RECOMMENDED_C = 27.0
_SAME = 1e-6
"""Relative difference up to which two figures are equal."""
_END_ERROR = 0.05
"""Largest error of the value of ends that curves tell, over that value. Trained policies that put
off a tenth of the work of two days were below the bound by 4 % of it."""


@dataclass(frozen=True, slots=True)
class KnownCase:
    """Figures and limits of a case that rows of others are held against."""

    objective: Objective
    """Objective of its figures."""
    days: int
    """Days of each week that are run, of which the first is not scored."""
    frame: pd.DataFrame
    """Rows of one result that moves all, one for each week, in the order of all results."""
    bound: F64
    """Bound of the figure in each week, nan where it is not known, (W,)."""
    ci_g_per_kwh: F64
    """Lowest and highest carbon intensity of the scored days of each week, in g/kWh, (W, 2)."""


def check_rows(frame: pd.DataFrame, known: KnownCase, place: str) -> None:
    """See that rows are those of a controller in the weeks of a case.

    Args:
        frame: the rows.
        known: what is known of the case.
        place: where they are, at the start of every message.

    Raises:
        ConfigError: naming the place, the week, the figure and what would be valid.
    """
    _check_columns(frame, known, place)
    for moves in dict.fromkeys(map(str, frame["moves"])):
        if moves not in (ALL, *AGENTS):
            raise ConfigError(
                f"{place}: moves {shortened(moves)}; valid are {', '.join((ALL, *AGENTS))}"
            )
        _check_weeks(frame[frame["moves"] == moves], known, f"{place}, {moves}")
    whole = frame[frame["moves"] == ALL].reset_index(drop=True)
    if whole.empty:
        raise ConfigError(f"{place}: no rows that move {ALL}; valid is one for each week")
    rows = _Rows(whole, place)
    _check_numbers(rows, known)
    _check_same_weeks(rows, known)
    _check_figures(rows, known)
    _check_balances(rows, known)


@dataclass(frozen=True, slots=True)
class _Rows:
    """Rows that move all, and how their errors are told."""

    frame: pd.DataFrame
    """One row for each week."""
    place: str
    """Where they are."""

    def values(self, name: str) -> F64:
        """Values of a column, (W,)."""
        return np.asarray(self.frame[name].to_numpy(np.float64))

    def refuse(self, wrong: npt.NDArray[np.bool_], text: str, **values: F64) -> None:
        """Refuse the first row that is wrong.

        Args:
            wrong: whether each row is, (W,).
            text: what is wrong with a row and what would be valid, with fields for values.
            values: values of the fields in each row, (W,) each.

        Raises:
            ConfigError: one of them is.
        """
        if wrong.any():
            at = int(np.flatnonzero(wrong)[0])
            site, week = self.frame["site"][at], self.frame["week"][at]
            told = text.format(**{name: value[at] for name, value in values.items()})
            raise ConfigError(f"{self.place}: week {week} of {site}: {told}")


def _check_columns(frame: pd.DataFrame, known: KnownCase, place: str) -> None:
    """Refuse columns that are missing, of another kind, or not known."""
    import pandas as pd

    metrics = [name for name in METRICS if name in known.frame.columns]
    lacking = [name for name in (*COLUMNS, *metrics) if name not in frame.columns]
    if lacking:
        raise ConfigError(f"{place}: no column {lacking[0]}; valid are those of the suite's rows")
    for name in frame.columns:
        if name not in (*COLUMNS, *METRICS, "controller"):
            raise ConfigError(
                f"{place}: column {shortened(str(name))}; valid are {', '.join(COLUMNS)} and "
                "metrics of a run"
            )
        kind = frame[name].dtype
        is_text = not pd.api.types.is_numeric_dtype(kind)
        if (name in _TEXTS) != is_text and not (name in _TEXTS and frame[name].isna().all()):
            valid = "texts" if name in _TEXTS else "numbers"
            raise ConfigError(f"{place}: column {name} is of {kind}; valid are {valid}")


def _check_weeks(part: pd.DataFrame, known: KnownCase, place: str) -> None:
    """Refuse rows of other weeks, or in another order, than those of the case."""
    own, expected = _keys(part), _keys(known.frame)
    missing = [key for key in expected if key not in own]
    more = [key for key in own if key not in expected]
    for keys, what in ((missing, "is missing"), (more, "is none of the case")):
        if keys:
            site, week = keys[0]
            raise ConfigError(f"{place}: week {week:g} of {site} {what}; valid is each week once")
    if own != expected:
        raise ConfigError(f"{place}: {len(own)} rows, not in the order of the case; valid is that")


def _keys(frame: pd.DataFrame) -> list[tuple[str, float]]:
    """Site and week of each row."""
    return list(zip(map(str, frame["site"]), map(float, frame["week"]), strict=True))


def _check_numbers(rows: _Rows, known: KnownCase) -> None:
    """Refuse figures that are not finite, and amounts below 0."""
    has_optimum = known.frame["achieved_figure"].notna().to_numpy()
    names = [name for name in METRICS if name in rows.frame]
    of_optimum = ("valued_figure", "achieved_figure")
    for name in ("figure", "idle_figure", *of_optimum, *names):
        own = rows.values(name)
        needed = has_optimum if name in of_optimum else np.full(len(own), True)
        wrong = needed & ~np.isfinite(own)
        rows.refuse(wrong, name + " {own}; valid is a finite number", own=own)
    for name in names:
        if name not in _MAY_BE_NEGATIVE:
            own = rows.values(name)
            rows.refuse(own < 0.0, name + " {own:g}; valid is 0 or more", own=own)


def _check_same_weeks(rows: _Rows, known: KnownCase) -> None:
    """Refuse figures that no controller moves, where they are not those of the case."""
    for name in ("idle_figure", "achieved_figure", "arrived_tasks"):
        own, theirs = rows.values(name), known.frame[name].to_numpy(np.float64)
        rows.refuse(
            np.isfinite(theirs) & ~_equal(own, theirs),
            name + " {own:.9g}, and {theirs:.9g} in other rows of the case; valid are the same "
            "data centers",
            own=own,
            theirs=theirs,
        )


def _check_figures(rows: _Rows, known: KnownCase) -> None:
    """Refuse figures that do not follow from metrics, or are below the bound, and wrong shares."""
    names = ("cfp_kg", "grid_kwh", "cost", "water_l")
    own = rows.values("figure")
    told = known.objective.figure(**{name: rows.values(name) for name in names})
    rows.refuse(
        ~_equal(own, told),
        "figure {own:.9g}, and {told:.9g} by its metrics; valid are equal ones",
        own=own,
        told=told,
    )
    idle, achieved = rows.values("idle_figure"), rows.values("achieved_figure")
    valued, share = rows.values("valued_figure"), rows.values("share")
    expected = share_of_achievable(valued, idle, achieved)
    size = 1.0 + np.abs(np.nan_to_num(expected))
    rows.refuse(
        np.isfinite(expected) & ~(np.abs(share - expected) <= _SAME * size),
        "share {own:.9g}, and {told:.9g} by its figures; valid are equal ones",
        own=share,
        told=expected,
    )
    # Ends are valued by curves, which are off by a part of that value.
    slack = _SAME * np.abs(known.bound) + _END_ERROR * np.abs(valued - own)
    rows.refuse(
        np.isfinite(achieved) & (valued < known.bound - slack),
        "valued_figure {own:.9g}, below the bound {bound:.9g} that nothing can reach; valid is a "
        "figure not below it",
        own=valued,
        bound=known.bound,
    )


def _check_balances(rows: _Rows, known: KnownCase) -> None:
    """Refuse energy, carbon, power, work and temperatures that contradict each other."""
    grid, cfp = rows.values("grid_kwh"), rows.values("cfp_kg")
    unserved = rows.values("unserved_kwh") if "unserved_kwh" in rows.frame else 0.0 * grid
    least = rows.values("it_kwh") + rows.values("hvac_kwh")
    least = least - rows.values("battery_throughput_kwh") - unserved
    rows.refuse(
        grid < least - _SAME * np.abs(least),
        "grid_kwh {own:.9g}; valid is at least {least:.9g}, IT and HVAC energy less what the "
        "battery delivers",
        own=grid,
        least=least,
    )
    low, high = (known.ci_g_per_kwh[:, k] / 1e3 * grid for k in (0, 1))
    rows.refuse(
        (cfp < low * (1.0 - _SAME)) | (cfp > high * (1.0 + _SAME)),
        "cfp_kg {own:.9g}; valid is {low:.9g} to {high:.9g}, grid energy times the carbon "
        "intensity of the week",
        own=cfp,
        low=low,
        high=high,
    )
    days = known.days - UNSCORED_DAYS
    peak, mean = rows.values("peak_kw"), grid / (24.0 * days)
    rows.refuse(
        peak < mean * (1.0 - _SAME),
        "peak_kw {own:.9g}; valid is at least the mean power, {mean:.9g}",
        own=peak,
        mean=mean,
    )
    arrived = rows.values("arrived_tasks")
    done = rows.values("executed_tasks") + rows.values("dropped_tasks")
    # Work that waits when the scored days begin came on the day before.
    most = arrived * (1.0 + 2.0 / days)
    rows.refuse(
        done > most * (1.0 + _SAME),
        "executes and drops {done:.9g} tasks, and {arrived:.9g} arrive; valid is at most "
        "{most:.9g}",
        done=done,
        arrived=arrived,
        most=most,
    )
    over, hottest = rows.values("over_27_degree_h"), rows.values("hottest_inlet_c")
    rows.refuse(
        (over > 0.0) & (hottest <= _RECOMMENDED_C),
        "over_27_degree_h {over:g} with hottest_inlet_c {hottest:g}; valid is 0",
        over=over,
        hottest=hottest,
    )


def _equal(values: F64, others: F64) -> npt.NDArray[np.bool_]:
    """Whether figures are equal but for rounding."""
    return np.asarray(np.abs(values - others) <= _SAME * np.maximum(np.abs(others), 1e-12))
