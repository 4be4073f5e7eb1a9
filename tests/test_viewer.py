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

pytestmark = [
    pytest.mark.repo,
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:.*racks of more than 60 kW"),
]

SCRIPT = Path(__file__).parent.parent / "docs" / "make" / "screenshots.py"
ROWS, RACKS_PER_ROW = 10, 16
LIMITS_C = (10.0, 45.0)

Pixels = npt.NDArray[np.int64]


class Recorded(NamedTuple):
    path: Path
    inlet_c: dict[str, npt.NDArray[np.float64]]
    """Rack inlets at the times of the screenshots."""


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
        at: np.asarray(results[step].rack_inlet_c, dtype=np.float64) for at, step in steps.items()
    }
    return Recorded(path, inlet_c)


def pixels(image: Image.Image) -> Pixels:
    return np.asarray(image.convert("RGB")).astype(np.int64)


def inferno() -> Pixels:
    matplotlib = pytest.importorskip("matplotlib")
    colours: Pixels = matplotlib.colormaps["inferno"](np.linspace(0, 1, 256), bytes=True)[:, :3]
    return colours.astype(np.int64)


def temperatures(image: Pixels) -> npt.NDArray[np.float64]:
    """Temperatures that colours stand for, nan for colours that are none of the map."""
    flat, back = np.unique(image.reshape(-1, 3), axis=0, return_inverse=True)
    away = np.abs(flat[:, None, :] - inferno()[None, :, :]).sum(axis=2)
    found = LIMITS_C[0] + away.argmin(axis=1) / 255 * (LIMITS_C[1] - LIMITS_C[0])
    found = np.where(away.min(axis=1) <= 16, found, np.nan)
    return np.asarray(found[back.reshape(-1)].reshape(image.shape[:2]))


def racks_c(heat_map: Pixels) -> npt.NDArray[np.float64]:
    """Temperatures at the middle of each rack's tile."""
    height, width, _ = heat_map.shape
    y = (np.arange(ROWS) + 0.48) / ROWS * height
    x = (np.arange(RACKS_PER_ROW) + 0.48) / RACKS_PER_ROW * width
    return temperatures(heat_map)[np.ix_(y.astype(int), x.astype(int))].reshape(-1)


def test_native_viewer(shots: ModuleType, recorded: Recorded) -> None:
    if not shots.has_vulkan():
        pytest.skip("no Vulkan driver (Debian: mesa-vulkan-drivers libvulkan1)")
    with shots.native_viewer(recorded.path) as viewer:

        def view(name: str, at: str = shots.BOTH_DOWN) -> Image.Image:
            image: Image.Image = shots.screenshot(viewer, at, name)
            return image

        before, *_, both, after = shots.HOT_SPOT
        for at in (before, both, after):
            seen = racks_c(pixels(shots.crop_to_racks(view(shots.MAP, at))))
            # Colours of the viewer differ a little from those of matplotlib.
            np.testing.assert_allclose(seen, recorded.inlet_c[at], atol=0.8, err_msg=at)

        (bar_name,) = [v.name for v in viewer.get_state().views if v.name.startswith("inlet scale")]
        bar = pixels(view(bar_name))
        found = temperatures(bar[np.ptp(bar, axis=2).sum(axis=1).argmax()][None])[0]
        along = found[np.isfinite(found) & (found > LIMITS_C[0] + 1)]
        assert along.max() > LIMITS_C[1] - 1
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
