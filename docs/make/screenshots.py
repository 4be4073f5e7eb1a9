"""Screenshots of recordings in the native Rerun viewer, which needs no screen.

    python docs/make/screenshots.py docs/img

Two of six CRAC units go down one after the other on a July day. FOLDER/rerun_failure.webp shows the
viewer while both are down, FOLDER/rerun_hot_spot.webp the heat map before, during and after.
FOLDER/rerun_airflow.webp shows the airflow of a mixed hall and FOLDER/rerun_zones.webp the zones of
102,400 racks, each while a CRAC unit is down; FOLDER/rerun_liquid.webp shows liquid-cooled racks
while facility pumps have failed. The viewer needs a Vulkan driver; one that computes on the CPU is
enough (Debian: mesa-vulkan-drivers).
"""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageDraw

from sdc_taichi import Actions, Recorder, Simulator, StepResult, load_config
from sdc_taichi.cli.view import viewer_program
from sdc_taichi.viz.recording_output import HOST, check_port, listens, served_at

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient

START = "2018-07-01"
STEPS_PER_HOUR = 12
BOTH_DOWN = f"{START}T16:30"
HOT_SPOT = {
    f"{START}T13:55": "13:55, before",
    f"{START}T14:00": "14:00, unit 1 goes down",
    f"{START}T14:55": "14:55",
    f"{START}T15:00": "15:00, unit 3 goes down",
    f"{START}T16:55": "16:55",
    f"{START}T17:10": "17:10, both run again",
}
MAP = "rack inlet [C]"
"""Name of the view with the heat map."""
BATTERY_SHARE = 0.1
UNIT_DOWN = "events.scheduled=[{{kind: crac_down, unit: {}, start_h: 14, duration_h: 3}}]"
"""Failure of a CRAC unit, as a value of the configuration."""
LARGE_HALL = (
    "name=hall",
    "site.start=07-01",
    "hall.rows=320",
    "hall.racks_per_row=320",
    "hall.supply_approach_k=5",
    "hall.return_approach_k=-3",
    "hall.servers_per_rack=4",
    "servers.power_w=[4000, 400]",
    "hvac.crac.units=40",
    UNIT_DOWN.format(9),
)
LIQUID_HALL = (
    "name=hall",
    "site.start=07-01",
    "events.scheduled=[{kind: facility_pump_down, share: 0.35, start_h: 14, duration_h: 4}]",
)
MIXED_HALL = ("name=hall", "site.start=07-01", UNIT_DOWN.format(2))
DAY = 96
"""Steps of a day, of 15 minutes each."""
LARGE_HALL_STEPS = 68
"""Steps of the run of the large hall, which ends with the failure of its CRAC unit."""
MARGIN = 8
"""Margin around the coloured part of the heat maps, in pixels."""
GREETING_S = 5.0
"""Time for which the viewer shows a note on top of the picture after its start, in s."""
WAIT_S = 60.0
"""Longest wait for the viewer, in s."""


def failing_hall() -> Simulator:
    """A hall of 10 rows of 16 equal racks with steps of 5 minutes; two CRAC units fail."""
    values = [
        "name=hall",
        "description=two of six CRAC units go down on a July afternoon",
        f"site.start={START[5:]}",
        "hall.rows=10",
        "hall.racks_per_row=16",
        "hall.supply_approach_k=5",
        "hall.return_approach_k=-3",
        "servers.power_w=[400, 40]",
        "hvac.crac.units=6",
        "hvac.setpoint.initial_c=20",
        "protection.ashrae_class=A2",
        "simulation.thermal=transient",
        "simulation.substep_s=30",
        f"simulation.steps_per_hour={STEPS_PER_HOUR}",
        "events.scheduled=[{kind: crac_down, unit: 1, start_h: 14, duration_h: 3},"
        "{kind: crac_down, unit: 3, start_h: 15, duration_h: 2}]",
    ]
    return Simulator(load_config("corrected", values))


def record_idle(path: Path, sim: Simulator, steps: int) -> None:
    """Record steps of a run without commands."""
    sim.reset()
    with Recorder(path) as recorder:
        recorder.begin(sim)
        for _ in range(steps):
            recorder.add(sim.step())


def record(path: Path, sim: Simulator) -> list[StepResult]:
    """Record a day in which the battery supplies the hall while the grid emits much carbon."""
    sim.reset()
    ci = np.array([sim.drivers.at(step).ci_g_per_kwh[0] for step in range(24 * STEPS_PER_HOUR)])
    results = []
    with Recorder(path) as recorder:
        recorder.begin(sim)
        for command in BATTERY_SHARE * np.clip((ci.mean() - ci) / ci.std(), -1.0, 1.0):
            results.append(sim.step(Actions(battery=command)))
            recorder.add(results[-1])
    return results


def step_at(moment: str) -> int:
    """Index of the step that begins at a time of the day."""
    since = np.datetime64(moment) - np.datetime64(START)
    return int(since / np.timedelta64(60 // STEPS_PER_HOUR, "m"))


def has_vulkan() -> bool:
    """Whether the viewer finds a Vulkan driver."""
    folders = [Path(folder, "vulkan/icd.d") for folder in ("/usr/share", "/etc")]
    return sys.platform != "linux" or any(list(folder.glob("*.json")) for folder in folders)


@contextlib.contextmanager
def native_viewer(recording: Path) -> Iterator[ViewerClient]:
    """The native viewer with a loaded recording.

    Raises:
        RuntimeError: the viewer does not start, or does not load the recording.
    """
    from rerun.experimental import ViewerClient

    port = check_port(0)
    options = ["--headless", "--window-size", "1600x1000", "--hide-welcome-screen"]
    command = [str(viewer_program()), *options, "--bind", HOST, "--port", str(port)]
    process = subprocess.Popen(
        command,
        env={**os.environ, "RERUN_ANALYTICS": "0"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        wait_for(lambda: process.poll() is not None or listens(served_at(port)))
        if process.poll() is not None:
            raise RuntimeError(f"{command[0]}: ended with exit code {process.returncode}")
        viewer = ViewerClient.connect(served_at(port))
        viewer.open(str(recording.resolve()))
        wait_for(lambda: not viewer.get_state().loading)
        yield viewer
    finally:
        process.terminate()
        process.wait(10)


def wait_for(condition: Callable[[], bool]) -> None:
    """Wait until a condition holds.

    Raises:
        RuntimeError: it does not hold after ``WAIT_S``.
    """
    deadline = time.monotonic() + WAIT_S
    while not condition():
        if time.monotonic() > deadline:
            raise RuntimeError(f"the viewer is not ready after {WAIT_S:g} s")
        time.sleep(0.1)


def screenshot(viewer: ViewerClient, moment: str, view: str | None = None) -> Image.Image:
    """The whole viewer or one of its views at a time, once the picture no longer changes."""
    viewer.set_time("sim_time", timestamp=np.datetime64(moment, "ns"))
    views = viewer.get_state().views
    chosen = None if view is None else next(v.view_id for v in views if v.name == view)
    pictures = [b"", viewer.take_screenshot(chosen)]

    def is_steady() -> bool:
        time.sleep(0.2)
        pictures.append(viewer.take_screenshot(chosen))
        return pictures[-1] == pictures[-2]

    wait_for(is_steady)
    return Image.open(io.BytesIO(pictures[-1])).convert("RGB")


def open_tabs(viewer: ViewerClient, *names: str) -> None:
    """Open tabs of the recording by their names."""
    blueprint = viewer.get_blueprint().blueprint
    for parts in blueprint.values():
        container = parts.get("ContainerBlueprint", {})
        if container.get("container_kind") != "Tabs":
            continue
        contents = container["contents"]
        for part in [contents] if isinstance(contents, str) else contents:
            fields = blueprint[part].get("ContainerBlueprint", blueprint[part].get("ViewBlueprint"))
            if fields.get("display_name") in names:
                container["active_tab"] = part
    viewer.set_blueprint(blueprint, "recording")


def crop_to_racks(views: Mapping[str, Image.Image]) -> dict[str, Image.Image]:
    """The part of views of one size that is coloured in any of them, with a margin."""
    pixels = np.stack([np.asarray(view).astype(int) for view in views.values()])
    coloured = (np.ptp(pixels, axis=3) > 30).any(axis=0)
    (top, *_, bottom), (left, *_, right) = (np.flatnonzero(coloured.any(axis=a)) for a in (1, 0))
    part = int(left), int(top), int(right) + 1 + MARGIN, int(bottom) + 1 + MARGIN
    part = max(part[0] - MARGIN, 0), max(part[1] - MARGIN, 0), part[2], part[3]
    return {name: view.crop(part) for name, view in views.items()}


def side_by_side(pictures: Mapping[str, Image.Image], columns: int = 3) -> Image.Image:
    """Pictures of one size, each below its name."""
    width, height = next(iter(pictures.values())).size
    space, line = 16, 28
    rows = -(-len(pictures) // columns)
    size = columns * (width + space) + space, rows * (height + space + line) + space
    whole = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(whole)
    for i, (name, picture) in enumerate(pictures.items()):
        x = space + i % columns * (width + space)
        y = space + i // columns * (height + space + line)
        draw.text((x, y), name, fill="black", font_size=18)
        whole.paste(picture, (x, y + line))
    return whole


def draw_failure(recording: Path) -> dict[str, Image.Image]:
    """Screenshots of the hall of which two CRAC units fail."""
    with failing_hall() as sim:
        record(recording, sim)
    with native_viewer(recording) as viewer:
        maps = {label: screenshot(viewer, moment, MAP) for moment, label in HOT_SPOT.items()}
        time.sleep(GREETING_S)
        whole = screenshot(viewer, BOTH_DOWN)
    return {"failure": whole, "hot_spot": side_by_side(crop_to_racks(maps))}


def draw_tabs(recording: Path, *tabs: str) -> Image.Image:
    """Screenshot of tabs of a recording while devices of its hall are down."""
    with native_viewer(recording) as viewer:
        open_tabs(viewer, *tabs)
        time.sleep(GREETING_S)
        return screenshot(viewer, BOTH_DOWN)


def main(folder: Path) -> None:
    """Write the screenshots."""
    with tempfile.TemporaryDirectory() as scratch:
        recording = Path(scratch) / "failure.rrd"
        pictures = draw_failure(recording)
        for name, preset, values, steps, tabs in (
            ("airflow", "hall_of_2026", MIXED_HALL, DAY, ["airflow"]),
            ("liquid", "ai_hall_2026", LIQUID_HALL, DAY, ["liquid", "junction"]),
            ("zones", "large", LARGE_HALL, LARGE_HALL_STEPS, ["zones", "zone 5"]),
        ):
            recording = Path(scratch) / f"{name}.rrd"
            with Simulator(load_config(preset, list(values))) as sim:
                record_idle(recording, sim, steps)
            pictures[name] = draw_tabs(recording, *tabs)
    for name, picture in pictures.items():
        picture.save(folder / f"rerun_{name}.webp", quality=75, method=6)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
