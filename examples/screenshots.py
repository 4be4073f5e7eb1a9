"""A cooling failure in the Rerun viewer, photographed without a screen.

    python examples/screenshots.py FOLDER [--web]

records a day in which two of six CRAC units go down one after the other, and writes
FOLDER/rerun_failure.webp, the viewer while both are down, and FOLDER/rerun_hot_spot.webp, its heat
map before, during and after. With --web it writes FOLDER/rerun_web.webp instead, the viewer in a
browser.

The native viewer needs a Vulkan driver, of which one that computes on the CPU will do (Debian:
mesa-vulkan-drivers), the other one Chromium.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import io
import json
import os
import select
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image, ImageDraw

from sdc_taichi import Actions, Recorder, Simulator, StepResult, load_config

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient

FAILURES_H = {1: 14, 3: 15}
"""CRAC units and the hour in which they go down; both are back at `BACK_H`."""
BACK_H = 17
START = "2001-07-01"
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
SIZE = (1600, 1000)
"""Of the pictures, in pixels."""
GREETING_S = 5.0
"""How long the native viewer shows a note over the picture when it starts."""
WAIT_S = 60.0
WEB_WAIT_S = 240.0
"""A browser without a graphics card draws a frame in seconds."""


def failing_hall(rows: int = 10, racks_per_row: int = 16) -> Simulator:
    """A hall of servers alike, 5 min per step, whose units 1 and 3 go down on a July afternoon."""
    failures = ", ".join(
        f"{{kind: crac_down, unit: {unit}, start_h: {at}, duration_h: {BACK_H - at}}}"
        for unit, at in FAILURES_H.items()
    )
    config = load_config(
        "corrected",
        [
            "name=hall",
            "description=two of six CRAC units go down on a July afternoon",
            f"site.start={START[5:]}",
            f"hall.rows={rows}",
            f"hall.racks_per_row={racks_per_row}",
            "hall.supply_approach_k=5",
            "hall.return_approach_k=-3",
            "servers.power_w=[400, 40]",
            "hvac.crac.units=6",
            "hvac.setpoint.initial_c=20",
            "protection.ashrae_class=A2",
            "simulation.thermal=transient",
            "simulation.substep_s=30",
            f"simulation.steps_per_hour={STEPS_PER_HOUR}",
            f"events.scheduled=[{failures}]",
        ],
    )
    return Simulator(config)


def record(path: Path, sim: Simulator) -> list[StepResult]:
    """Record a day; the battery feeds the hall while the grid is dirtier than its mean."""
    sim.reset()
    steps = 24 * STEPS_PER_HOUR
    ci = np.array([sim.drivers.at(step).ci_g_per_kwh[0] for step in range(steps)])
    cleaner = np.clip((ci.mean() - ci) / ci.std(), -1.0, 1.0)
    with Recorder(path) as recorder:
        recorder.begin(sim)
        results = []
        for command in BATTERY_SHARE * cleaner:
            results.append(sim.step(Actions(battery=command)))
            recorder.add(results[-1])
    return results


def step_at(time_of_day: str) -> int:
    """Step of a time."""
    since = np.datetime64(time_of_day) - np.datetime64(START)
    return int(since / np.timedelta64(60 // STEPS_PER_HOUR, "m"))


@contextlib.contextmanager
def native_viewer(recording: Path, size: tuple[int, int] = SIZE) -> Iterator[ViewerClient]:
    """The native viewer with a recording, drawn on the CPU where there is no graphics card.

    Raises:
        RuntimeError: it does not start or does not load the recording.
    """
    from rerun.experimental import ViewerClient

    check_vulkan()
    port = free_port()
    options = ["--headless", "--window-size", "{}x{}".format(*size), "--hide-welcome-screen"]
    where = ["--bind", "127.0.0.1", "--port", str(port)]
    with rerun_process(*options, *where) as process:
        wait_for(port, process)
        viewer = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
        viewer.open(str(recording.resolve()))
        deadline = time.monotonic() + WAIT_S
        while viewer.get_state().loading:
            if time.monotonic() > deadline:
                raise RuntimeError(f"{recording}: still loading after {WAIT_S:g} s")
            time.sleep(0.1)
        yield viewer


def native_shots(recording: Path) -> dict[str, Image.Image]:
    """The whole viewer, and its heat map over time.

    Raises:
        RuntimeError: it does not start, or a view reports something.
    """
    with native_viewer(recording) as viewer:
        maps = {label: heat_map(native_shot(viewer, at, MAP)) for at, label in HOT_SPOT.items()}
        time.sleep(GREETING_S)
        whole = native_shot(viewer, BOTH_DOWN)
        if troubled := [(v.name, v.reports) for v in viewer.get_state().views if v.reports]:
            raise RuntimeError(f"{recording}: the viewer reports {troubled}")
    return {"failure": whole, "hot_spot": side_by_side(maps)}


def heat_map(view: Image.Image) -> Image.Image:
    """The racks alone of the view of a heat map."""
    drawn = np.ptp(np.asarray(view).astype(int), axis=2) > 30  # coloured, unlike the background
    (top, *_, bottom), (left, *_, right) = (np.flatnonzero(drawn.any(axis=a)) for a in (1, 0))
    return view.crop((int(left), int(top), int(right) + 1, int(bottom) + 1))


def side_by_side(pictures: Mapping[str, Image.Image], columns: int = 3) -> Image.Image:
    """Pictures of one size, each under its name."""
    width, height = next(iter(pictures.values())).size
    space, line = 16, 28
    rows = -(-len(pictures) // columns)
    out = Image.new(
        "RGB", (columns * (width + space) + space, rows * (height + space + line) + space), "white"
    )
    draw = ImageDraw.Draw(out)
    for i, (name, picture) in enumerate(pictures.items()):
        x = space + i % columns * (width + space)
        y = space + i // columns * (height + space + line)
        draw.text((x, y), name, fill="black", font_size=18)
        out.paste(picture, (x, y + line))
    return out


def native_shot(viewer: ViewerClient, at: str, view: str | None = None) -> Image.Image:
    """The viewer, or one of its views by name, at a time."""
    viewer.set_time("sim_time", timestamp=np.datetime64(at, "ns"))
    views = viewer.get_state().views
    chosen = None if view is None else next(v.view_id for v in views if v.name == view)
    return steady(lambda: viewer.take_screenshot(chosen))


def web_shot(recording: Path, at: str | None = None, size: tuple[int, int] = SIZE) -> Image.Image:
    """The viewer in a browser, drawn without a graphics card, at a time or as it opens.

    Raises:
        RuntimeError: the viewer does not start or does not load the recording.
    """
    port, page_port = free_port(), free_port()
    options = ["--serve-web", "--bind", "127.0.0.1", "--port", str(port)]
    with rerun_process(str(recording), *options, "--web-viewer-port", str(page_port)) as process:
        wait_for(page_port, process)
        with Browser() as browser:
            stream = f"rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{port}%2Fproxy"
            browser.open(f"http://127.0.0.1:{page_port}/?url={stream}&renderer=webgl", size)
            # The state is a protocol buffer, in which names are plain text.
            browser.wait_until(
                "window._handle && new TextDecoder('latin1').decode(_handle.viewer_state())"
                ".includes('sim_time')"
            )
            first = steady(browser.screenshot)
            if at is None:
                return first
            # The page has no other way to set the time than the field at the bottom right.
            browser.click(size[0] - 90, size[1] - 14)
            browser.press("a", "KeyA", 65, modifiers=2)
            browser.call("Input.insertText", text=at.replace("T", " ") + ":00Z")
            browser.press("Enter", "Enter", 13)
            browser.screenshot()  # starts drawing
            return steady(browser.screenshot)


class Browser:
    """Chromium without a window, driven through a pair of pipes by its DevTools protocol."""

    def __init__(self) -> None:
        self._profile = tempfile.mkdtemp()
        read, self._to = os.pipe()
        self._from, write = os.pipe()
        # Chromium expects its end of the pipes as descriptors 3 and 4.
        self._process = subprocess.Popen(
            [
                "bash",
                "-c",
                f'exec "$@" 3<&{read} 4>&{write}',
                "bash",
                chromium(),
                "--headless=new",
                "--no-sandbox",  # needed as root, and nothing but our own page is opened
                "--use-angle=swiftshader",
                "--enable-unsafe-swiftshader",
                "--ignore-gpu-blocklist",
                "--remote-debugging-pipe",
                f"--user-data-dir={self._profile}",
                "--no-first-run",
                "about:blank",
            ],
            pass_fds=(read, write),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(read)
        os.close(write)
        self._received = b""
        self._calls = 0
        self._session: str | None = None

    def open(self, url: str, size: tuple[int, int]) -> None:
        """Open a page of a width and height in pixels."""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)[
            "sessionId"
        ]
        width, height = size
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        self.call("Page.navigate", url=url)

    def evaluate(self, script: str) -> Any:
        """Value of an expression in the page."""
        found = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        if "exceptionDetails" in found:
            raise RuntimeError(f"{script}: {found['exceptionDetails']}")
        return found["result"].get("value")

    def wait_until(self, script: str) -> None:
        """Wait until an expression holds in the page."""
        deadline = time.monotonic() + WEB_WAIT_S
        while not self.evaluate(script):
            if time.monotonic() > deadline:
                raise RuntimeError(f"the page did not come to {script} within {WEB_WAIT_S:g} s")
            time.sleep(0.5)

    def screenshot(self) -> bytes:
        """The page as PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def click(self, x: float, y: float) -> None:
        """Click at a place, in pixels from the top left."""
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
        time.sleep(1.0)  # the viewer takes input once per frame

    def press(self, key: str, code: str, number: int, modifiers: int = 0) -> None:
        """Press and release a key."""
        for kind in ("keyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent",
                type=kind,
                key=key,
                code=code,
                windowsVirtualKeyCode=number,
                modifiers=modifiers,
            )
        time.sleep(1.0)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Result of a method of the protocol.

        Raises:
            RuntimeError: the browser refuses it, or does not answer.
        """
        self._calls += 1
        message: dict[str, Any] = {"id": self._calls, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        while (answer := self._next()).get("id") != self._calls:
            pass
        if "error" in answer:
            raise RuntimeError(f"{method}: {answer['error']['message']}")
        result: dict[str, Any] = answer["result"]
        return result

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._received:
            ready, _, _ = select.select([self._from], [], [], WEB_WAIT_S)
            part = os.read(self._from, 1 << 20) if ready else b""
            if not part:
                state = "has ended" if ready else f"did not answer within {WEB_WAIT_S:g} s"
                raise RuntimeError(f"the browser {state}")
            self._received += part
        first, self._received = self._received.split(b"\0", 1)
        message: dict[str, Any] = json.loads(first)
        return message

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        # Without its pipes the browser ends.
        os.close(self._to)
        os.close(self._from)
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        shutil.rmtree(self._profile, ignore_errors=True)


def steady(shoot: Callable[[], bytes]) -> Image.Image:
    """A picture that is no longer changing."""
    last, deadline = b"", time.monotonic() + WEB_WAIT_S
    while (now := shoot()) != last:
        if time.monotonic() > deadline:
            raise RuntimeError("the viewer did not come to rest")
        last = now
        time.sleep(0.3)
    return Image.open(io.BytesIO(now)).convert("RGB")


def chromium() -> str:
    """Path of the browser.

    Raises:
        RuntimeError: there is none.
    """
    for name in ("chromium", "chromium-browser", "google-chrome"):
        if (found := shutil.which(name)) is not None:
            return found
    raise RuntimeError("no chromium on the path; install it (Debian: apt-get install chromium)")


def check_vulkan() -> None:
    """Make sure that the native viewer can draw.

    Raises:
        RuntimeError: there is no Vulkan driver.
    """
    folders = [Path(folder, "vulkan/icd.d") for folder in ("/usr/share", "/etc")]
    if sys.platform == "linux" and not any(list(folder.glob("*.json")) for folder in folders):
        raise RuntimeError(
            "no Vulkan driver; install one (Debian: apt-get install mesa-vulkan-drivers libvulkan1)"
        )


def missing_packages() -> list[str]:
    """Debian packages that the viewers need here and do not find."""
    missing = []
    for check, packages in (
        (chromium, ["chromium", "fonts-dejavu-core"]),
        (check_vulkan, ["mesa-vulkan-drivers", "libvulkan1"]),
    ):
        try:
            check()
        except RuntimeError:
            missing += packages
    return missing


@contextlib.contextmanager
def rerun_process(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """The viewer's own program, for as long as the context lasts."""
    import rerun_cli

    # The script of this name is a wrapper whose child would outlive it.
    program = Path(rerun_cli.__file__).with_name("rerun" + (".exe" if os.name == "nt" else ""))
    with tempfile.TemporaryFile("w+") as log:
        process = subprocess.Popen(
            [program, *arguments],
            env={**os.environ, "RERUN_ANALYTICS": "0", "NO_COLOR": "1"},
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            text=True,
        )
        try:
            yield process
        except (RuntimeError, ConnectionError) as error:
            log.seek(0)
            told = log.read().split("stack backtrace:")[0][-2000:]
            raise RuntimeError(f"{error}; the viewer wrote:\n{told}") from error
        finally:
            process.terminate()
            process.wait(10)


def free_port() -> int:
    """A port of this machine that nothing listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def wait_for(port: int, process: subprocess.Popen[str]) -> None:
    """Wait until a process listens on a port.

    Raises:
        RuntimeError: it ends, or takes too long.
    """
    deadline = time.monotonic() + WAIT_S
    while process.poll() is None and time.monotonic() < deadline:
        try:
            socket.create_connection(("127.0.0.1", port), 1.0).close()
        except OSError:
            time.sleep(0.1)
        else:
            return
    raise RuntimeError(f"the viewer does not listen on port {port}")


def main(folder: Path, web: bool) -> None:
    """Write the pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        recording = Path(scratch) / "failure.rrd"
        with failing_hall() as sim:
            record(recording, sim)
        shots = {"web": web_shot(recording, BOTH_DOWN)} if web else native_shots(recording)
    for name, image in shots.items():
        path = folder / f"rerun_{name}.webp"
        image.save(path, quality=75, method=6)
        print(f"{path}: {image.width} x {image.height}, {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--web", action="store_true", help="the viewer in a browser")
    arguments = parser.parse_args()
    main(arguments.folder, arguments.web)
