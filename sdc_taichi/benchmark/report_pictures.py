"""Pictures of a case in the report of suites: intervals, performance profiles, and a radar."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from sdc_taichi.benchmark.leaderboard import Leaderboard, row_samples, standard_scores
from sdc_taichi.benchmark.report_blocks import Block, Picture
from sdc_taichi.benchmark.suite_results import ACHIEVED, BOUND, LEARNER, OTHER, PLANNER
from sdc_taichi.learning.evaluation import ALL, IDLE
from sdc_taichi.learning.statistics import performance_profile
from sdc_taichi.viz.benchmark_figures import interval_plot, profile_plot, score_radar
from sdc_taichi.viz.fleet_figures import MAX_RUNS, RADAR_METRICS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LEAST_SHARE_PCT = -100.0
"""Share of the achievable below which rows are left out of pictures, which would show nothing
else."""
_THRESHOLDS_PCT = np.linspace(-25.0, 110.0, 136)


def case_pictures(board: Leaderboard) -> list[Block]:
    """Pictures of a case.

    Args:
        board: what its rows came to.
    """
    found: list[Block] = []
    if picture := _interval_picture(board):
        found.append(picture)
    names = _chosen(board)
    if not board.profiles.empty:
        found.append(_profile_picture(board, names))
    if picture := _radar_picture(board, names):
        found.append(picture)
    return found


def _interval_picture(board: Leaderboard) -> Picture | None:
    """Share of the achievable of each row, or its change against idle commands."""
    table = board.standings
    has_share = "share_pct" in table
    column = "share_pct" if has_share else "change_pct"
    kinds = board.case.kinds
    ends: dict[str, tuple[float, float, float]] = {}
    far, left = _far(board), []
    for values in table.to_dict("records"):
        name, value = str(values["row"]), float(values[column])
        if kinds[name] == BOUND or not math.isfinite(value):
            continue
        if name in far:
            left.append(f"{name} ({value:.0f} %)")
            continue
        label = f"{name} ({values['place']})" if values["place"] != "-" else name
        ends[label] = value, float(values[f"{column}_low"]), float(values[f"{column}_high"])
    if len(ends) < 2:
        return None
    what = "share of the achievable (%)" if has_share else "change against idle commands (%)"
    caption = f"{what[0].upper()}{what[1:]} with 95 % intervals; places in brackets."
    if left:
        caption += f" Left out: {', '.join(left)}."

    def draw() -> Figure:
        return interval_plot(ends, what, marks=(0.0, 100.0) if has_share else (0.0,))

    alt = "; ".join(f"{name} {value:.1f}" for name, (value, *_) in ends.items())
    return Picture(draw, f"{what}: {alt}", caption)


def _far(board: Leaderboard) -> set[str]:
    """Rows so far below idle commands that pictures are without them."""
    table = board.standings
    if "share_pct" not in table:
        return set()
    return {str(name) for name in table["row"][table["share_pct"] < _LEAST_SHARE_PCT]}


def _chosen(board: Leaderboard) -> list[str]:
    """Rows that pictures of lines show: as many as can be told apart, in the order of the table."""
    kinds = {name: kind for name, kind in board.case.kinds.items() if name not in _far(board)}
    ranks = {LEARNER: 0, OTHER: 0, PLANNER: 1, ACHIEVED: 5}
    rank = {name: ranks.get(kind, 4) for name, kind in kinds.items() if kind != BOUND}
    for name in (board.best_rule, IDLE):
        if name in rank:
            rank[name] = 2
    order = [name for name in map(str, board.standings["row"]) if name in rank]
    kept = sorted(order, key=lambda name: rank[name])[:MAX_RUNS]
    return [name for name in order if name in kept]


def _profile_picture(board: Leaderboard, names: list[str]) -> Picture:
    """Share of weeks above each share of the achievable."""
    shares = row_samples(board.evaluation, "share")
    shown = {
        name: performance_profile(100.0 * shares[name], _THRESHOLDS_PCT)
        for name in names
        if np.isfinite(shares[name]).any() and board.case.kinds[name] != ACHIEVED
    }

    def draw() -> Figure:
        return profile_plot(_THRESHOLDS_PCT, shown, "share of the achievable (%)")

    return Picture(
        draw,
        f"Performance profiles of {', '.join(shown)}.",
        "Weeks of all seeds in which a row reaches more than a share of the achievable: the higher "
        "the line, the better.",
    )


def _radar_picture(board: Leaderboard, names: list[str]) -> Picture | None:
    """Five metrics as standard scores, as figure 4 of SustainDC shows them."""
    rows = board.evaluation.rows
    rows = rows[rows["moves"] == ALL]
    metrics = [metric for metric, *_ in RADAR_METRICS]
    if not set(metrics) <= set(rows.columns):
        return None
    means = rows.groupby("controller", sort=False)[metrics].mean()
    values = {
        name: means.loc[name].to_numpy(np.float64).tolist()
        for name in names
        if np.isfinite(means.loc[name].to_numpy(np.float64)).all()
    }
    if len(values) < 2:
        return None

    scores = -standard_scores(np.array(list(values.values())))

    def draw() -> Figure:
        named = dict(zip(values, scores.tolist(), strict=True))
        return score_radar(named, [label for _, label, _ in RADAR_METRICS])

    return Picture(
        draw,
        f"Radar of {', '.join(values)}.",
        "Five metrics, each less its mean over the rows shown, over their standard deviation, the "
        "lowest outside, as in figure 4 of SustainDC. It magnifies differences however small they "
        "are, and tells nothing of their intervals: those are in the picture above.",
    )
