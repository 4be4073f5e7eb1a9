"""Pictures of what happens in a hall: load that moves, CRAC units that fail, memory of the air."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from sdc_taichi.config import HallConfig
from sdc_taichi.errors import SdcError
from sdc_taichi.hall.floor_plan import FloorPlan, floor_plan, unit_places_m
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64, StepResult
from sdc_taichi.viz.floor_plan_figure import rack_boxes, to_page
from sdc_taichi.viz.plotting import BLUE, GREEN, GREY, ORANGE, PINK, RED, SKY, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure

_MODE_COLOURS = {"quasi_steady": ORANGE, "transient": BLUE}


def load_shift(hall: HallConfig, change_k: F64, distance_m: F64, racks: tuple[int, int]) -> Figure:
    """How the inlets change when load moves from one rack to another: plan, and by distance.

    Args:
        hall: the hall of R racks.
        change_k: change of every inlet, in K, (R,).
        distance_m: distance from every inlet to the nearer exhaust of the two racks, in m, (R,).
        racks: the rack that loses load, and the one that gains it.

    Raises:
        SdcError: matplotlib is missing, or the arrays have no entry per rack.
    """
    _check_length("change_k", change_k, hall.racks)
    _check_length("distance_m", distance_m, hall.racks)
    figure = new_figure(11.0, 4.6)
    left, right = figure.subplots(1, 2, width_ratios=[5, 6])
    plan = floor_plan(hall)
    reach = float(np.abs(change_k).max())
    image = _draw_racks(left, hall, plan, change_k, "PuOr_r", (-reach, reach))
    for rack, sign in zip(racks, "−+", strict=True):
        ink = "white" if abs(change_k[rack]) > 0.6 * reach else "black"
        where = to_page(plan, plan.centre_m[rack])
        left.text(*where, sign, color=ink, ha="center", va="center", fontsize=13, weight="bold")
    left.set_title("Change of the inlet; load moves from − to +", fontsize=10, loc="left")
    figure.colorbar(
        image, ax=left, label="change of the inlet (K)", orientation="horizontal", shrink=0.8
    )
    for style, mine, label in (
        ({"marker": "o", "mfc": "none", "color": BLUE, "markersize": 8}, change_k < 0, "cooler"),
        ({"marker": "^", "color": RED, "markersize": 4}, change_k > 0, "warmer"),
    ):
        right.semilogy(
            distance_m[mine], np.abs(change_k[mine]), linestyle="none", label=label, **style
        )
    right.set(
        xlabel="distance from the inlet to the nearer of the two exhausts (m)",
        ylabel="change of the inlet (K)",
    )
    _style_axes(right)
    return figure


def failure_maps(
    results: Sequence[StepResult], fleet: Fleet, hours: Sequence[float], dc: int = 0
) -> Figure:
    """Inlet of every rack at some times of a run; units that are down are crossed out.

    Args:
        results: steps of the run, in order.
        fleet: the fleet they belong to.
        hours: times to show, in hours since reset.
        dc: index of the data center.

    Raises:
        SdcError: matplotlib is missing, or a time that the run does not have.
    """
    hall = fleet.configs[dc].hall
    plan = floor_plan(hall)
    racks, units = slice(*fleet.rack_offsets[dc : dc + 2]), slice(*fleet.unit_offsets[dc : dc + 2])
    shown = [_step_ending_at(results, hour) for hour in hours]
    values = [np.asarray(r.rack_inlet_c[racks], dtype=np.float64) for r in shown]
    limits = float(np.min(values)), float(np.max(values))
    columns = min(3, len(shown))
    lines = -(-len(shown) // columns)
    figure = new_figure(11.0, 0.4 + 2.6 * lines)
    grid = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes in grid[len(shown) :]:
        axes.set_visible(False)
    for axes, result, inlet in zip(grid, shown, values, strict=False):
        image = _draw_racks(axes, hall, plan, inlet, "inferno", limits)
        for place, runs in zip(
            unit_places_m(plan, len(result.unit_running[units])),
            result.unit_running[units],
            strict=True,
        ):
            marker, colour = ("s", GREY) if runs else ("X", RED)
            where = to_page(plan, place)
            axes.plot(*where, marker, color=colour, markersize=11, clip_on=False)
        minutes = round(60 * (result.step + 1) * result.step_h)
        axes.set(xlabel="", ylabel="")
        axes.set_title(f"{minutes // 60}:{minutes % 60:02d} h", fontsize=10, loc="left")
    figure.colorbar(image, ax=grid.tolist(), label="rack inlet (°C)", shrink=0.8)
    figure.suptitle(
        "■ CRAC unit, ✕ unit that is down; distances in m", fontsize=10, x=0.01, ha="left"
    )
    return figure


def failure_curves(runs: Mapping[str, Sequence[StepResult]], fleet: Fleet, dc: int = 0) -> Figure:
    """Temperatures and racks in protection over a run, one column per run.

    Args:
        runs: title to the steps of a run, in order.
        fleet: the fleet they belong to, or one of the same size.
        dc: index of the data center.

    Raises:
        SdcError: matplotlib is missing, or a run without steps.
    """
    figure = new_figure(11.0, 6.0)
    grid = figure.subplots(2, len(runs), sharex="col", height_ratios=[3, 2], squeeze=False)
    for (title, results), (top, bottom) in zip(runs.items(), grid.T, strict=True):
        if not results:
            raise SdcError(f"run {title!r} has no steps")
        hours = np.array([(r.step + 1) * r.step_h for r in results])
        for name, colour, label in (
            ("inlet_max_c", RED, "hottest inlet"),
            ("inlet_mean_c", ORANGE, "mean inlet"),
            ("supply_c", BLUE, "supply air"),
        ):
            top.plot(hours, [getattr(r, name)[dc] for r in results], color=colour, label=label)
        units = slice(*fleet.unit_offsets[dc : dc + 2])
        down = np.array([not np.all(r.unit_running[units]) for r in results])
        for axes in (top, bottom):
            axes.fill_between(
                hours, 0, 1, where=down, transform=axes.get_xaxis_transform(), color=GREY,
                alpha=0.15, linewidth=0, step="pre", label="down" if axes is top else None,
            )  # fmt: skip
        racks = fleet.rack_offsets[dc + 1] - fleet.rack_offsets[dc]
        for name, colour, label in (
            ("throttled_racks", ORANGE, "racks throttled"),
            ("tripped_racks", RED, "racks tripped"),
        ):
            share = [100.0 * getattr(r, name)[dc] / racks for r in results]
            bottom.plot(hours, share, color=colour, label=label, drawstyle="steps-pre")
        bottom.plot(hours, [r.executed_tasks[dc] for r in results], color=GREEN, label="work done")
        top.set_ylabel("temperature (°C)")
        top.set_title(title, fontsize=10, loc="left", pad=24)
        bottom.set(xlabel="time (h)", ylabel="% of racks, of capacity", ylim=(-3, 103))
        _style_axes(top)
        _style_axes(bottom)
    return figure


def thermal_modes(series: Mapping[str, tuple[F64, F64]], title: str) -> Figure:
    """Hottest inlet and HVAC power of quasi-steady and transient runs, step by step.

    Args:
        series: mode to hottest inlet (C) and HVAC power (W), (n,) each, at 15-minute steps.
        title: what is shown.

    Raises:
        SdcError: matplotlib is missing.
    """
    figure = new_figure(11.0, 5.0)
    top, bottom = figure.subplots(2, 1, sharex=True)
    for mode, (inlet_c, hvac_w) in series.items():
        edges = 0.25 * np.arange(len(inlet_c) + 1)
        colour, label = _MODE_COLOURS.get(mode, PINK), mode.replace("_", "-")
        for axes, values in ((top, inlet_c), (bottom, hvac_w / 1e3)):
            axes.stairs(values, edges, baseline=None, color=colour, label=label, linewidth=1.3)
    top.set_ylabel("hottest inlet (°C)")
    top.set_title(title, fontsize=10, loc="left", pad=24)
    bottom.set(xlabel="time (h)", ylabel="HVAC power (kW)")
    _style_axes(top)
    _style_axes(bottom)
    return figure


def _draw_racks(
    axes: Axes,
    hall: HallConfig,
    plan: FloorPlan,
    values: F64,
    cmap: str,
    limits: tuple[float, float],
) -> PolyCollection:
    """Draw racks to scale with their fronts, and the walls."""
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.patches import Rectangle

    boxes = rack_boxes(plan, hall.layout.rack_pitch_m, hall.layout.rack_depth_m)
    front_y = plan.front_m[:: hall.racks_per_row, 1]
    fronts = np.array([[(x, y) for x in plan.row_ends_m] for y in front_y])
    room = to_page(plan, np.array([plan.length_m, plan.width_m]))
    image = PolyCollection(
        list(boxes),
        array=values,
        cmap=cmap,
        clim=limits,
        edgecolor=GREY,
        linewidth=0.4,
    )
    axes.add_collection(image)
    axes.add_collection(LineCollection(list(to_page(plan, fronts)), colors=SKY, linewidths=2))
    axes.add_patch(Rectangle((0, 0), *room, fill=False, linewidth=1.2))
    rim = 0.04 * float(room.max())
    axes.set(aspect="equal", xlim=(-rim, room[0] + rim), ylim=(room[1] + rim, -rim))
    names = to_page(plan, np.array(["along the rows (m)", "across the rows (m)"]))
    axes.set(xlabel=names[0], ylabel=names[1])
    axes.spines[:].set_visible(False)
    return image


def _step_ending_at(results: Sequence[StepResult], hour: float) -> StepResult:
    """The step that ends at a time since reset, in h."""
    for result in results:
        if abs((result.step + 1) * result.step_h - hour) < result.step_h / 2:
            return result
    raise SdcError(f"hours {hour:g}: the run has no step that ends then")


def _check_length(name: str, values: F64, racks: int) -> None:
    """Refuse an array that has not one entry per rack."""
    if np.shape(values) != (racks,):
        raise SdcError(f"{name} has shape {np.shape(values)}, expected ({racks},), one per rack")


def _style_axes(axes: Axes) -> None:
    """Give axes a grid in place of a frame, and a legend above."""
    axes.spines[:].set_visible(False)
    axes.grid(alpha=0.25)
    axes.legend(
        loc="lower left",
        bbox_to_anchor=(0, 1),
        ncols=4,
        fontsize=9,
        frameon=False,
        borderaxespad=0.2,
        columnspacing=1.2,
    )
