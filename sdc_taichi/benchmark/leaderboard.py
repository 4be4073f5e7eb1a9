"""Tables that compare the rows of a case: ranking, pairwise differences, and performance profiles.

A row is an entry of a suite: a controller, or a method that finds one. Two groups of rows have
different ranks ("places") only if the 95 % intervals of all paired differences between them exclude
0; otherwise the rows share a rank. The order of rows with a shared rank has no meaning. Rows with
too few weeks or seeds for a confidence interval have no rank.

A "figure" is the value of the objective (lower is better).
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sdc_taichi.benchmark.suite import TRIAL
from sdc_taichi.benchmark.suite_results import (
    ACHIEVED,
    BOUND,
    LEARNER,
    RULE,
    CaseResults,
    RowResult,
    TrialMetrics,
    evaluation_of,
)
from sdc_taichi.learning.evaluation import IDLE, Evaluation
from sdc_taichi.learning.evaluation_table import (
    TITLES,
    by_site,
    column_samples,
    samples,
    summary,
)
from sdc_taichi.learning.statistics import (
    DRAWS,
    Statistic,
    bootstrap_values,
    change_pct,
    drawn_weeks,
    percentile_interval,
    performance_profile,
    probability_of_improvement,
    sample_mean,
)
from sdc_taichi.optimum.problem import AGENTS, ALL_AGENTS
from sdc_taichi.optimum.uncoordinated import WAYS, title_of
from sdc_taichi.types import F64

if TYPE_CHECKING:
    import pandas as pd

THRESHOLDS_PCT = (0.0, 25.0, 50.0, 75.0, 90.0)
"""Thresholds of the share of the achievable saving in performance profiles, in %."""
CONSTRAINTS = {
    "throttled_rack_h": "throttled (rack h)",
    "tripped_rack_h": "tripped (rack h)",
    "unserved_kwh": "unserved (kWh)",
    "unmet_cooling_kwh": "heat left (kWh)",
    "lost_tasks": "lost (tasks)",
}
"""Titles of constraint metrics (mean per week), shown if any row has a value other than 0."""
OUTAGES = ("throttled_rack_h", "tripped_rack_h", "unserved_kwh", "lost_tasks")
"""Constraint metrics that reduce emissions because less work is done."""
BOARD_TITLES = {
    **TITLES,
    **CONSTRAINTS,
    "place": "place",
    "row": "row",
    "kind": "kind",
    "core_min": "core min",
    "settings": "settings",
    "default_pct": "default settings (%)",
    "steps": "training steps",
    "gradient_steps": "gradient steps",
    "training_core_s": "training (core s)",
    "parts_pct": "sum of the agents alone (%)",
    "together_pct": "together (%)",
    "worth_points": "coordination (points)",
    **{agent: f"{agent} alone (%)" for agent in ALL_AGENTS},
    **{way: f"{title_of(way)} (%)" for way in WAYS},
    **{f"above_{x:g}_pct": f"above {x:g} % (%)" for x in THRESHOLDS_PCT},
}
"""Titles of columns in tables of this module."""
_Samples = Mapping[str, tuple[F64, F64]]
"""Objective of each row by seed and week, (S, W), and of idle commands, as from ``samples``."""
FEWEST = 3
"""Minimum number of weeks per site, and of seeds per trained row, for intervals and ranks."""
_CURVE = "validation.csv"
"""File of a training with its results in the validation weeks."""
_SEED = 0
_LEAST_POINTS = 1e-9
"""Difference up to which two changes count as equal, in percentage points."""


@dataclass(frozen=True, slots=True)
class Leaderboard:
    """Tables that compare the rows of a case."""

    case: CaseResults
    """Results of the case."""
    evaluation: Evaluation
    """The results as an evaluation."""
    standings: pd.DataFrame
    """Ranking of the rows: changes against idle commands, share of the achievable saving, other
    metrics, seeds and processor time."""
    pairs: pd.DataFrame
    """Differences between the change of each row and that of the best rule or of the row below, in
    percentage points, with the probability of improvement."""
    profiles: pd.DataFrame
    """Share of weeks, in %, in which a row exceeds thresholds of the share of the achievable
    saving; empty without an optimum."""
    coordination: pd.DataFrame
    """Savings of each agent of a row alone, of all agents together and, for the optimum, of agents
    that do not plan together; empty if no agent ran alone."""
    apart: pd.DataFrame
    """Comparison of rows whose agents were trained together with rows whose agents were trained
    separately."""
    curves: pd.DataFrame
    """Change against idle commands in the validation weeks, in %, of each trained row during its
    training, by steps and by core seconds, with 95 % intervals of its seeds."""
    trials: pd.DataFrame
    """Trials of settings: the settings as JSON, the change against idle commands in the validation
    weeks, in %, and the core seconds of the training; ``best`` is True for the chosen settings."""
    sites: pd.DataFrame
    """Change against idle commands in %, by row and site."""
    best_rule: str
    """Name of the rule-based controller with the lowest objective; empty without rules."""


def leaderboard(case: CaseResults) -> Leaderboard:
    """Compute all tables that compare the rows of a case."""
    evaluation = evaluation_of(case)
    figures = samples(evaluation)
    changes = {name: float(change_pct(*pair)) for name, pair in figures.items()}
    drawn = _drawn_changes(evaluation, figures)
    controllers = [name for name, kind in case.kinds.items() if kind not in (ACHIEVED, BOUND)]
    ranked = [name for name in controllers if _has_intervals(case, evaluation, name)]
    placed = places({name: changes[name] for name in ranked}, drawn)
    rules = [name for name, kind in case.kinds.items() if kind == RULE and name != IDLE]
    best = min(rules, key=lambda name: changes[name], default="")
    order = list(dict.fromkeys([*placed, *controllers, *case.rows]))
    return Leaderboard(
        case=case,
        evaluation=evaluation,
        standings=_standings(case, evaluation, placed, order),
        pairs=_pairs(evaluation, figures, drawn, order[: len(controllers)], best),
        profiles=_profiles(case, evaluation, order),
        coordination=_coordination(case, evaluation, figures),
        apart=_apart(case, evaluation, figures, drawn),
        curves=_curves(case),
        trials=_trials(case),
        sites=by_site(evaluation).rename(columns={"controller": "row"}),
        best_rule=best,
    )


def places(values: Mapping[str, float], drawn: Mapping[str, F64]) -> dict[str, tuple[int, int]]:
    """Return the rank of each row; rows share a rank unless confidence intervals separate them.

    The ranking is divided between two groups if each row of the upper group is better than each row
    of the lower group. A row is better than another if the 95 % interval of their paired difference
    is below 0.

    Args:
        values: figure of each row, lower is better.
        drawn: figures of each row in the bootstrap resamples, which have the same weeks for all
            rows.

    Returns:
        First and last of the ranks that a row shares, by row, best first. Rows with shared ranks
        are in the order of ``values``.
    """
    order = sorted(values, key=lambda name: values[name])
    position = {name: index for index, name in enumerate(values)}
    shared: dict[str, tuple[int, int]] = {}
    begin = 0
    for end in range(1, len(order) + 1):
        above, below = order[:end], order[end:]
        if all(_is_better(drawn[one], drawn[other]) for one in above for other in below):
            for name in sorted(order[begin:end], key=lambda name: position[name]):
                shared[name] = begin + 1, end
            begin = end
    return shared


def _has_intervals(case: CaseResults, evaluation: Evaluation, name: str) -> bool:
    """Return True if a row has enough weeks and seeds for confidence intervals and a rank."""
    seeds = len(case.rows[name])
    weeks = int(np.bincount(evaluation.strata[:, 0]).min())
    return weeks >= FEWEST and (seeds >= FEWEST or case.kinds[name] != LEARNER)


def _is_better(one: F64, other: F64) -> bool:
    """Return True if the interval of the difference is below 0, so that the first is better."""
    return percentile_interval(0.0, one - other).high < -_LEAST_POINTS


def _drawn_changes(evaluation: Evaluation, figures: _Samples) -> dict[str, F64]:
    """Return the change of each row against idle commands in each bootstrap resample, (draws,).

    If the seed determines the inputs, all rows have the same resampled seeds.
    """
    changes = {}
    for name, pair in figures.items():
        paired = len(pair[1]) > 1
        generator_name = "" if paired else name
        changes[name] = _bootstrap(evaluation, change_pct, pair, generator_name, paired=paired)
    return changes


def _generator(name: str = "") -> np.random.Generator:
    """Return a random generator whose seed depends on a name."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([_SEED, *name.encode()])))


def _standings(
    case: CaseResults,
    evaluation: Evaluation,
    placed: Mapping[str, tuple[int, int]],
    order: list[str],
) -> pd.DataFrame:
    """Return the ranking of the rows, with changes against idle commands and other metrics."""
    import pandas as pd

    table = summary(evaluation).rename(columns={"controller": "row"}).set_index("row").loc[order]
    ends = {name: placed.get(name) for name in order}
    texts = ["-" if x is None else str(x[0]) if x[0] == x[1] else f"{x[0]} to {x[1]}"
             for x in ends.values()]  # fmt: skip
    table.insert(0, "place", texts)
    for metric in CONSTRAINTS:
        values = column_samples(evaluation, metric)
        if any(np.nan_to_num(sample).any() for sample in values.values()):
            columns = []
            for name in order:
                drawn = _bootstrap(evaluation, sample_mean, (values[name],), name)
                mean = percentile_interval(float(sample_mean(values[name])), drawn)
                columns.append(mean.columns(metric))
            table[list(columns[0])] = pd.DataFrame(columns, index=order)
    table["core_min"] = [
        sum(result.record.core_s for result in case.rows[name]) / 60 for name in order
    ]
    budgets = pd.DataFrame([_budget(case.rows[name]) for name in order], index=order)
    table = table.join(budgets)
    unknown = [name for name in table if table[name].isna().all()]
    standings: pd.DataFrame = table.drop(columns=unknown).reset_index()
    return standings


def _budget(results: Sequence[RowResult]) -> dict[str, float]:
    """Return means over the seeds of a row: steps, gradient steps and core s of its trainings."""
    trainings = [result.trainings for result in results]
    if not any(trainings):
        return dict.fromkeys(("steps", "gradient_steps", "training_core_s"), math.nan)
    return {
        "steps": float(np.mean([sum(x.steps for x in each) for each in trainings])),
        "gradient_steps": float(np.mean([sum(x.gradient_steps for x in y) for y in trainings])),
        "training_core_s": float(np.mean([x.record.training_core_s for x in results])),
    }


def _curves(case: CaseResults) -> pd.DataFrame:
    """Return the validations of trained rows, as means over the seeds with their intervals.

    The core seconds of a training are divided evenly among its steps.
    """
    import pandas as pd

    table = []
    for name, results in case.rows.items():
        own = [x for x in results if x.submission is None and _CURVE in x.record.files_sha256]
        if not own:
            continue
        curves = [
            pd.read_csv(io.BytesIO(x.store.file(x.record.partition, _CURVE))).set_index("steps")
            for x in own
        ]
        changes = pd.concat([x["change_pct"] for x in curves], axis=1, join="inner").to_numpy().T
        core_s = float(np.mean([x.record.training_core_s for x in own]))
        generator = _generator(name)
        seeds = generator.integers(len(own), size=(DRAWS, len(own)))
        for at, steps in enumerate(curves[0].index[: changes.shape[1]]):
            values = changes[:, at]
            interval = percentile_interval(float(values.mean()), values[seeds].mean(axis=1))
            table.append(
                {"row": name, "seeds": len(own), "steps": int(steps)}
                | {"core_s": core_s * steps / curves[0].index[-1]}
                | interval.columns("change_pct")
            )
    return pd.DataFrame(table)


def _trials(case: CaseResults) -> pd.DataFrame:
    """Return the trials of settings, in the order of algorithms and trials."""
    import pandas as pd

    table = []
    for record in case.trials:
        metrics = TrialMetrics.model_validate(record.metrics)
        table.append(
            {
                "algorithm": record.partition["row"].removeprefix(f"{TRIAL}-"),
                "trial": int(record.partition["seed"]),
                "settings": json.dumps(metrics.learning, sort_keys=True),
                "change_pct": metrics.change_pct,
                "training_core_s": record.training_core_s,
            }
        )
    if not table:
        return pd.DataFrame()
    trials = pd.DataFrame(table).sort_values(["algorithm", "trial"], ignore_index=True)
    best = trials.groupby("algorithm")["change_pct"].idxmin()
    trials["best"] = trials.index.isin(best)
    return trials


def _pairs(
    evaluation: Evaluation,
    figures: _Samples,
    drawn: Mapping[str, F64],
    order: Sequence[str],
    best: str,
) -> pd.DataFrame:
    """Return the comparison of each row with the best rule and with the next row of the order."""
    import pandas as pd

    pairs = []
    for name, below in zip(order, [*order[1:], None], strict=True):
        others = dict.fromkeys([*([best] if best and best != name else []), *filter(None, [below])])
        pairs += [_difference(evaluation, figures, drawn, name, other) for other in others]
    return pd.DataFrame(pairs)


def _difference(
    evaluation: Evaluation, figures: _Samples, drawn: Mapping[str, F64], one: str, other: str
) -> dict[str, Any]:
    """Return difference and probability of improvement of two rows, as a table row."""
    (first, first_idle), (second, second_idle) = figures[one], figures[other]
    points = float(change_pct(first, first_idle) - change_pct(second, second_idle))
    pair, paired = (first, second), len(first_idle) > 1
    values = _bootstrap(evaluation, probability_of_improvement, pair, paired=paired)
    probability = float(probability_of_improvement(first, second))
    return {
        "row": one,
        "than": other,
        **percentile_interval(points, drawn[one] - drawn[other]).columns("points"),
        **percentile_interval(probability, values).columns("probability"),
    }


def _bootstrap(
    evaluation: Evaluation,
    statistic: Statistic,
    samples: tuple[F64, ...],
    name: str = "",
    *,
    paired: bool = False,
) -> F64:
    """Return a statistic in each bootstrap resample; all rows have the same resampled weeks.

    The name of a row determines its resampled trainings, which so do not depend on other rows.
    """
    weeks = drawn_weeks(evaluation.strata, _generator(), DRAWS)
    return bootstrap_values(statistic, samples, weeks, _generator(name), paired=paired)


def _profiles(case: CaseResults, evaluation: Evaluation, order: Sequence[str]) -> pd.DataFrame:
    """Return the share of weeks, in %, in which each row exceeds ``THRESHOLDS_PCT``."""
    import pandas as pd

    thresholds = np.array(THRESHOLDS_PCT)
    table = []
    shares = column_samples(evaluation, "share")
    for name in order:
        sample = 100.0 * shares[name]
        if case.kinds[name] in (ACHIEVED, BOUND) or not np.isfinite(sample).any():
            continue
        drawn = _bootstrap(
            evaluation, lambda x: performance_profile(x, thresholds), (sample,), name
        )
        profile = performance_profile(sample, thresholds)
        row: dict[str, Any] = {"row": name}
        for index, threshold in enumerate(THRESHOLDS_PCT):
            interval = percentile_interval(100.0 * float(profile[index]), 100.0 * drawn[:, index])
            row |= interval.columns(f"above_{threshold:g}_pct")
        table.append(row)
    return pd.DataFrame(table)


def _coordination(case: CaseResults, evaluation: Evaluation, figures: _Samples) -> pd.DataFrame:
    """Return the savings of each agent alone, with idle others, and of all agents together."""
    import pandas as pd

    agents = [x for x in ALL_AGENTS if x in AGENTS or x in evaluation.alone]
    by_agent = {agent: samples(evaluation, agent) for agent in AGENTS}
    table = []
    for name, (all_together, idle) in figures.items():
        if case.kinds[name] == ACHIEVED:
            alone = {agent: best[None] for agent, best in evaluation.alone.items()}
            ways = {way: best[None] for way, best in evaluation.uncoordinated.items()}
        else:
            alone = {agent: figure[name][0] for agent, figure in by_agent.items() if name in figure}
            ways = {}
        changes = {agent: float(change_pct(figure, idle)) for agent, figure in alone.items()}
        if not changes:
            continue
        together, parts = float(change_pct(all_together, idle)), sum(changes.values())
        table.append(
            {"row": name}
            | {agent: changes.get(agent, math.nan) for agent in agents}
            | {"parts_pct": parts, "together_pct": together, "worth_points": parts - together}
            | {way: float(change_pct(figure, idle)) for way, figure in ways.items()}
        )
    return pd.DataFrame(table)


def _apart(
    case: CaseResults, evaluation: Evaluation, figures: _Samples, drawn: Mapping[str, F64]
) -> pd.DataFrame:
    """Compare rows whose agents were trained together with those trained separately."""
    import pandas as pd

    trained = {
        name: dict(results[0].record.values["row"])
        for name, results in case.rows.items()
        if case.kinds[name] == LEARNER and results[0].submission is None
    }
    differences = []
    for name, row in trained.items():
        for other, spec in trained.items():
            if not row.get("apart") and spec.get("apart") and row["train"] == spec["train"]:
                differences.append(_difference(evaluation, figures, drawn, name, other))
    return pd.DataFrame(differences)
