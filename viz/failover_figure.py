"""What the loss of CRAC units or plant does to a hall: floor plan of the worst loss, and curves."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sdc_taichi.hall.air_metrics import allowable_c
from sdc_taichi.hall.floor_plan import FloorPlan, floor_plan, unit_places_m
from sdc_taichi.run.failover import MINUTES, SHOWN_AFTER_MIN, Failover
from sdc_taichi.types import F64

from .floor_plan_figure import rack_boxes, to_page
from .plotting import (
    GREEN,
    GREY,
    LINE_COLOURS,
    LINE_STYLES,
    ORANGE,
    RED,
    colour_range,
    literal_text,
    new_figure,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CURVES = 6
"""Losses whose hottest inlet is drawn over time, the worst ones, beside that without a loss."""
LABELLED_UNITS = 24
"""Most CRAC units that show how long the hall lasts without them."""
UNIT_M = (0.06, 0.5)
"""Size of the symbol of a CRAC unit: off the wall as a share of the longer side of the room, and
along it as a share of the distance between units."""


def failover_figure(study: Failover) -> Figure:
    """Floor plan with the inlets of the worst loss, and the hottest inlet of the worst over time.

    Units are coloured by what their own loss does: racks trip, throttle, or neither.

    Args:
        study: What ``study_failover`` found.

    Raises:
        SdcError: matplotlib is missing.
    """
    figure = new_figure(13.0, 5.6)
    left, right = figure.subplots(1, 2, width_ratios=(1.15, 1.0))
    _draw_plan(left, study)
    _draw_curves(right, study)
    return figure


def _draw_plan(axes: Axes, study: Failover) -> None:
    """Racks by their hottest inlet a quarter of an hour after the worst loss, and the units."""
    from matplotlib.collections import PolyCollection

    hall, plan = study.config.hall, floor_plan(study.config.hall)
    worst = study.worst[0]
    inlet_c = study.rack_inlet_c[worst]
    racks = PolyCollection(
        list(rack_boxes(plan, hall.layout.rack_pitch_m, hall.layout.rack_depth_m)),
        array=inlet_c,
        cmap="inferno",
        clim=colour_range(inlet_c),
        edgecolor="white",
        linewidth=0.4,
    )
    axes.add_collection(racks)
    room = to_page(plan, np.array([(0, 0), (plan.length_m, 0), (plan.length_m, plan.width_m),
                                   (0, plan.width_m)]))  # fmt: skip
    axes.add_collection(PolyCollection([room], facecolor="none", edgecolor="black", linewidth=1.5))
    rim = _draw_units(axes, study, plan) if any(loss.units for loss in study.losses) else 0.0
    wide, high = room.max(axis=0)
    axes.set(aspect="equal", xlim=(-rim, wide + rim), ylim=(high + rim, -rim), xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    after = SHOWN_AFTER_MIN[0]
    axes.set_title(
        f"{literal_text(study.config.name)}: {after} minutes after the loss of "
        f"{study.losses[worst].name}",
        fontsize=10,
        loc="left",
    )
    axes.figure.colorbar(racks, ax=axes, label="hottest inlet of the rack (°C)", shrink=0.8)


def _draw_units(axes: Axes, study: Failover, plan: FloorPlan) -> float:
    """CRAC units outside of the end walls, by what their loss does; return the rim, in m."""
    from matplotlib.collections import PolyCollection
    from matplotlib.patches import Patch

    count = study.config.hvac.crac.units
    places = unit_places_m(plan, count)
    deep = UNIT_M[0] * max(plan.length_m, plan.width_m)
    wide = UNIT_M[1] * plan.width_m / ((count + 1) // 2)
    single = {loss.units[0]: i for i, loss in enumerate(study.losses) if len(loss.units) == 1}
    down = study.losses[study.worst[0]].units
    boxes, colours, edges = [], [], []
    for unit, (x, y) in enumerate(places):
        near, far = (-0.15 * deep, -deep) if x == 0.0 else (x + 0.15 * deep, x + deep)
        low, high = y - wide / 2, y + wide / 2
        box: F64 = np.array([(near, low), (far, low), (far, high), (near, high)])
        boxes.append(to_page(plan, box))
        colours.append(_unit_colour(study, single.get(unit)))
        edges.append(3.0 if unit in down else 0.6)
        if count <= LABELLED_UNITS:
            across, up = to_page(plan, np.array([(near + far) / 2, y]))
            axes.text(float(across), float(up), f"{unit}", ha="center", va="center", fontsize=8)
    axes.add_collection(
        PolyCollection(boxes, facecolor=colours, edgecolor="black", linewidth=edges)
    )
    shown = ((RED, "racks trip"), (ORANGE, "racks throttle"), (GREEN, "neither"))
    keys = [Patch(facecolor=colour, edgecolor="black", label=text) for colour, text in shown]
    axes.legend(
        handles=keys, loc="upper left", bbox_to_anchor=(0, 0), ncols=3, frameon=False, fontsize=8.5,
        title="loss of this CRAC unit alone (thick: lost here)", title_fontsize=8.5,
        alignment="left",
    )  # fmt: skip
    return 1.2 * deep


def _unit_colour(study: Failover, loss: int | None) -> str:
    """Colour of a CRAC unit by what its loss does; grey for one that was not lost."""
    if loss is None:
        return GREY
    if np.isfinite(study.trip_min[loss]):
        return RED
    return ORANGE if np.isfinite(study.throttle_min[loss]) else GREEN


def _draw_curves(axes: Axes, study: Failover) -> None:
    """Hottest inlet over time after the worst losses, with the limits of the class."""
    minutes = np.arange(MINUTES + 1)
    # All begin in the steady state of a hall in order.
    inlet_c = study.inlet_max_c[[0, *range(MINUTES)]]
    inlet_c[0] = inlet_c[0, 0]
    drawn = [i for i in study.worst if i != 0][:CURVES]
    for n, i in enumerate(drawn):
        style = LINE_STYLES[n // len(LINE_COLOURS) % len(LINE_STYLES)]
        axes.plot(minutes, inlet_c[:, i], style, color=LINE_COLOURS[n],
                  label=study.losses[i].name)  # fmt: skip
    axes.plot(minutes, inlet_c[:, 0], color=GREY, linewidth=2.5, label="no loss")
    protection = study.config.protection
    assert protection.ashrae_class is not None
    limit_c = allowable_c(protection.ashrae_class)[1]
    for level_c, text in (
        (limit_c, "throttle"),
        (limit_c + protection.trip_margin_k, "trip"),
    ):
        axes.axhline(level_c, color="black", linestyle=":", linewidth=1.0)
        axes.text(MINUTES, level_c, f"{text}, {level_c:g} °C", ha="right", va="bottom", fontsize=8)
    axes.set(
        xlim=(0, MINUTES), xlabel="minutes after the loss", ylabel="hottest inlet of the hall (°C)"
    )
    axes.spines[:].set_visible(False)
    axes.grid(alpha=0.25)
    axes.set_title(
        f"full load, supply {study.supply_c:g} °C, class {protection.ashrae_class}",
        fontsize=10,
        loc="left",
    )
    axes.legend(loc="upper left", bbox_to_anchor=(0, -0.12), ncols=3, frameon=False, fontsize=8.5)
