"""What the native Rerun viewer draws of a recording, without a screen."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

import rrd

pytestmark = [
    pytest.mark.repo,
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:.*racks of more than 60 kW"),
]

SCRIPT = Path(__file__).parent.parent / "docs" / "make" / "screenshots.py"
ROWS, RACKS_PER_ROW = 10, 16

Pixels = npt.NDArray[np.int64]


class Recorded(NamedTuple):
    path: Path
    classes: tuple[npt.NDArray[np.float64], npt.NDArray[np.uint32]]
    """Temperature and colour of every class of the map of inlets."""
    inlet_c: dict[str, npt.NDArray[np.float64]]
    """Hottest inlet of each rack at the times of the screenshots."""


@pytest.fixture(scope="module")
def shots() -> Iterator[ModuleType]:
    spec = importlib.util.spec_from_file_location("screenshots", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["screenshots"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["screenshots"]


@pytest.fixture(scope="module")
def recorded(shots: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    path = tmp_path_factory.mktemp("viewer") / "failure.rrd"
    steps = {at: shots.step_at(at) for at in (shots.START, *shots.HOT_SPOT)}
    with shots.failing_hall() as sim:
        results = shots.record(path, sim)
    inlet_c = {
        at: np.asarray(results[step].rack_inlet_max_c, dtype=np.float64)
        for at, step in steps.items()
    }
    return Recorded(path, rrd.classes(rrd.read(path)["/dc/hall/map/inlet"]), inlet_c)


def pixels(image: Image.Image) -> Pixels:
    return np.asarray(image.convert("RGB")).astype(np.int64)


def temperatures(image: Pixels, recorded: Recorded) -> npt.NDArray[np.float64]:
    """Temperatures that colours stand for, nan for colours that are none of the map."""
    values_c, colours = recorded.classes
    shifts = np.array([24, 16, 8], np.uint32)
    of_class = (colours[1:, None] >> shifts & 0xFF).astype(np.int64)
    flat, back = np.unique(image.reshape(-1, 3), axis=0, return_inverse=True)
    away = np.abs(flat[:, None, :] - of_class[None, :, :]).sum(axis=2)
    nearest_c = np.where(away.min(axis=1) <= 16, values_c[1:][away.argmin(axis=1)], np.nan)
    return np.asarray(nearest_c[back.reshape(-1)].reshape(image.shape[:2]))


def racks_c(heat_map: Pixels, recorded: Recorded) -> npt.NDArray[np.float64]:
    """Temperatures at the middle of each rack's tile."""
    seen_c = temperatures(heat_map, recorded)
    # Lines of text and the frame have few pixels in the colours of the map.
    is_map = np.isfinite(seen_c)
    rows, columns = (np.flatnonzero(is_map.mean(axis=axis) > 0.3) for axis in (1, 0))
    top, left = rows[0], columns[0]
    y = top + (np.arange(ROWS) + 0.48) / ROWS * (rows[-1] + 1 - top)
    x = left + (np.arange(RACKS_PER_ROW) + 0.48) / RACKS_PER_ROW * (columns[-1] + 1 - left)
    return seen_c[np.ix_(y.astype(int), x.astype(int))].reshape(-1)


def test_native_viewer(shots: ModuleType, recorded: Recorded) -> None:
    if not shots.has_vulkan():
        pytest.skip("no Vulkan driver (Debian: mesa-vulkan-drivers libvulkan1)")
    with shots.native_viewer(recorded.path) as viewer:

        def view(name: str, at: str = shots.BOTH_DOWN) -> Image.Image:
            image: Image.Image = shots.screenshot(viewer, at, name)
            return image

        before, *_, both, after = shots.HOT_SPOT
        for at in (before, both, after):
            seen = racks_c(pixels(view(shots.MAP, at)), recorded)
            np.testing.assert_allclose(seen, recorded.inlet_c[at], atol=0.8, err_msg=at)

        bar = pixels(view(f"colours of {shots.MAP}"))
        line_c = temperatures(bar[np.ptp(bar, axis=2).sum(axis=1).argmax()][None], recorded)[0]
        along = line_c[np.isfinite(line_c)]
        assert np.ptp(along) > 5.0
        assert np.all(np.diff(along) > -0.5), "colours run from cold to hot"

        # The first line of the power plot, IT, reaches from one end to the other.
        plot = pixels(view("power [kW]"))
        blue = np.abs(plot - [0x00, 0x72, 0xB2]).sum(axis=2) < 60
        columns = np.flatnonzero(blue.any(axis=0)) / plot.shape[1]
        assert columns.min() < 0.2
        assert columns.max() > 0.95

        state: Any = viewer.get_state()
        assert [view.reports for view in state.views if view.reports] == []
        (recording,) = state.recordings
        (line,) = [t for t in recording.timelines if t.name == "sim_time"]
        assert np.datetime64(line.start, "ns") == np.datetime64(shots.START)
