"""Floor plans are to scale, show the right racks, and leave out labels that would not fit."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from sdc_taichi import load_config
from sdc_taichi.sim.design_hall import DesignHall, solve_design_hall
from sdc_taichi.viz.floor_plan_figure import floor_plan_figure

WIDE = ["hall.supply_approach_k=5.15", "hall.return_approach_k=-3.1", "servers.power_w=[250, 25]"]
HALLS = {
    "tiny": ("tiny", []),
    "paper": ("corrected", ["hvac.crac.units=4", "hall.layout.returns=end_wall"]),
    "long rows": ("corrected", ["hall.rows=3", "hall.racks_per_row=30", *WIDE]),
    "no end margin": ("corrected", ["hall.layout.end_margin_m=0"]),
    "large": ("large", ["hvac.crac.units=12"]),
    "strip": ("large", ["hall.rows=300", "hall.racks_per_row=10", "hvac.crac.units=30"]),
}


@pytest.fixture(scope="module", params=list(HALLS))
def drawn(request: pytest.FixtureRequest) -> tuple[DesignHall, Any, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    source, overrides = HALLS[request.param]
    found = solve_design_hall(load_config(source, overrides))
    figure = floor_plan_figure(found)
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    return found, figure, canvas.get_renderer()


def racks_of(figure: Any) -> Any:
    (racks,) = [c for c in figure.axes[0].collections if c.get_array() is not None]
    return racks


def turned(found: DesignHall) -> bool:
    return found.plan.width_m > found.plan.length_m


def on_page(found: DesignHall, xy: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return xy[..., ::-1] if turned(found) else xy


def test_racks_stand_where_the_layout_puts_them(drawn: tuple[DesignHall, Any, Any]) -> None:
    found, figure, _ = drawn
    racks = racks_of(figure)
    np.testing.assert_array_equal(racks.get_array(), found.inlet_c)
    corners = np.array([path.vertices[:4] for path in racks.get_paths()])
    np.testing.assert_allclose(corners.mean(axis=1), on_page(found, found.plan.centre_m))
    size = found.config.hall.layout
    spans = on_page(found, np.ptp(corners, axis=1))
    close = "too close to draw their aisles" in figure.axes[0].get_xlabel()
    assert close == (found.config.hall.rows == 300)
    # Rows that are too close fill the space up to each other.
    gap = size.rack_depth_m + (size.cold_aisle_m + size.hot_aisle_m) / 2
    depth = gap if close else size.rack_depth_m
    np.testing.assert_allclose(spans, [[size.rack_pitch_m, depth]] * len(spans), rtol=1e-6)
    fronts = [c for c in figure.axes[0].collections if "front" in str(c.get_label())]
    assert len(fronts) == (not close)


def test_plan_is_to_scale_or_says_by_how_much_not(drawn: tuple[DesignHall, Any, Any]) -> None:
    found, figure, renderer = drawn
    axes = figure.axes[0]
    (x0, y0), (x1, y1) = axes.transData.transform([(0.0, 0.0), (1.0, 1.0)])
    scale = abs(y1 - y0) / abs(x1 - x0)
    said = re.search(r"stretched (\S+) times", axes.get_ylabel())
    assert scale == pytest.approx(float(said[1]) if said else 1.0, rel=0.05)
    # The room lies within the axes, with its longer side to the right.
    room = sorted((found.plan.length_m, found.plan.width_m))[::-1]
    assert axes.get_xlim()[0] <= 0 < room[0] <= axes.get_xlim()[1]
    assert axes.get_ylim()[1] <= 0 < room[1] <= axes.get_ylim()[0]
    assert figure.get_size_inches().max() * figure.dpi <= 1400
    assert renderer.width == pytest.approx(figure.get_size_inches()[0] * figure.dpi, abs=1)


def test_labels_fit_what_they_label(drawn: tuple[DesignHall, Any, Any]) -> None:
    found, figure, renderer = drawn
    axes = figure.axes[0]
    size = found.config.hall.layout

    def pixels(x_m: float, y_m: float) -> Any:
        ends = on_page(found, np.array([[0.0, 0.0], [x_m, y_m]]))
        return np.abs(np.diff(axes.transData.transform(ends), axis=0))[0]

    rack = pixels(size.rack_pitch_m, size.rack_depth_m)
    across = pixels(0.0, min(size.cold_aisle_m, size.hot_aisle_m, size.side_margin_m))
    numbers, aisles = [], []
    for text in axes.texts:
        box = text.get_window_extent(renderer)
        if re.fullmatch(r"\d+\.\d", text.get_text()):
            numbers.append(text.get_text())
            assert box.width <= rack[0]
            assert box.height <= rack[1]
        if text.get_text().endswith("aisle"):
            aisles.append(text.get_text())
            if turned(found):
                assert box.width <= across[0]
            else:
                assert box.height <= across[1]
    if found.config.hall.racks <= 20:
        assert numbers == [f"{t:.1f}" for t in found.inlet_c]
        rows = found.config.hall.rows
        assert aisles.count("cold aisle") == (rows + 1) // 2
        assert aisles.count("hot aisle") == rows // 2 + 1
    if found.config.hall.racks >= 1000:
        assert not numbers


def test_units_stand_outside_their_wall(drawn: tuple[DesignHall, Any, Any]) -> None:
    found, figure, _ = drawn
    (units,) = [c for c in figure.axes[0].collections if c.get_label() == "CRAC unit"]
    boxes = np.array([path.vertices[:4] for path in units.get_paths()])
    boxes = on_page(found, boxes)
    assert len(boxes) == len(found.unit_m3s)
    for box, (x, y) in zip(boxes, found.unit_places_m, strict=True):
        inner, outer = (box[:, 0].max(), box[:, 0].min()) if x == 0 else (
            box[:, 0].min(), box[:, 0].max())  # fmt: skip
        assert inner == pytest.approx(x)
        assert (outer < x) == (x == 0)
        assert box[:, 1].mean() == pytest.approx(y)
    # Neighbours on a wall do not overlap.
    for wall in (0, 1):
        mine = boxes[wall::2, :, 1]
        assert np.all(mine[1:].min(axis=1) >= mine[:-1].max(axis=1))
