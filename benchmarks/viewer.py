"""How long the web viewer takes to the first drawn point, and how much it sends.

    python benchmarks/viewer.py
    python benchmarks/viewer.py --points 1e6 1e7 --repeats 3

A box with a point in each voxel of its walls is saved as a memory and shown by ``gvtools view`` to
a headless Chromium, which then drags the scene to and fro a few times. Bytes are counted by a proxy
between the two, frames by the page. Chromium computes every picture in software here, so frames per
second tell nothing of a machine with a graphics card. Needs chromium and chromedriver, and what the
tests need.
"""

from __future__ import annotations

import argparse
import asyncio
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests/fixtures"))

from browser import Browser, open_browser

from gvtools.memory.spatial_memory import SpatialMemory
from pipelines.bench.procedural_cloud import box_size, walls

VOXEL = 0.01
# Where the scene shows in a window of 1280 x 800, free of the controls and of the page's notes.
SCENE = np.s_[60:460, 20:930]
# Of the scene's pixels, when the first points are there.
DRAWN = 0.02
PATIENCE = 300.0
# Nothing more comes once so many seconds have passed without a byte.
REST = 5.0
# How often the scene is dragged, and for how long, seconds.
MOVES, DRAG = 5, 4.0
# Calls back with the page's frames per second while the scene is dragged; no further each time than
# a person who looks around a little.
ORBIT = """
    const [seconds, done] = arguments;
    const canvas = document.elementFromPoint(400, 300);
    const fire = (type, x, buttons) => canvas.dispatchEvent(new PointerEvent(type, {
        bubbles: true, clientX: x, clientY: 300, button: type == "pointermove" ? -1 : 0, buttons,
        pointerId: 1, pointerType: "mouse", isPrimary: true}));
    const begun = performance.now();
    let frames = 0;
    fire("pointerdown", 400, 1);
    requestAnimationFrame(function next() {
        const passed = (performance.now() - begun) / 1000;
        fire("pointermove", 400 + 150 * Math.min(1, passed / seconds), 1);
        if (passed < seconds) { frames++; requestAnimationFrame(next); return; }
        fire("pointerup", 550, 0);
        done(frames / passed);
    });
"""

MEASURES = (
    "command to address, s", "command to first point, s", "page to first point, s", "sent, MB",
    "frames a second in software", "sent for a move, MB",
)  # fmt: skip


class CountingProxy:
    """Passes a port's bytes on from another one, and counts what comes back."""

    def __init__(self, target: int) -> None:
        self.sent = 0
        self._target = target
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = int(probe.getsockname()[1])
        self._ready = threading.Event()
        threading.Thread(target=lambda: asyncio.run(self._serve()), daemon=True).start()
        self._ready.wait()

    async def _serve(self) -> None:
        server = await asyncio.start_server(self._connect, "127.0.0.1", self.port, limit=2**20)
        async with server:
            self._ready.set()
            await server.serve_forever()

    async def _connect(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            back, there = await asyncio.open_connection("127.0.0.1", self._target)
        except OSError:  # The viewer has ended, the page still asks for it.
            writer.close()
            return
        await asyncio.gather(self._pass(reader, there, False), self._pass(back, writer, True))

    async def _pass(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, counted: bool
    ) -> None:
        try:
            while data := await reader.read(2**16):
                self.sent += counted * len(data)
                writer.write(data)
                await writer.drain()
        except OSError:
            pass
        finally:
            writer.close()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=float, nargs="+", default=[1e6, 1e7])
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    columns = ("points", *MEASURES)
    print(f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}")
    with tempfile.TemporaryDirectory() as folder:
        for count in args.points:
            file = Path(folder) / "memory.npz"
            observations = save_box(int(count), file)
            rows = [measured(file) for _ in range(args.repeats)]
            cells = [
                f"{np.median(column):.1f} ({min(column):.1f} to {max(column):.1f})"
                for column in zip(*rows, strict=True)
            ]
            print(f"| {observations / 1e6:.2f} M | {' | '.join(cells)} |", flush=True)


def save_box(count: int, file: Path) -> int:
    """Save a box's walls as a memory of about ``count`` observations; returns how many."""
    memory = SpatialMemory(VOXEL)
    for wall in walls(box_size(count, VOXEL), VOXEL):
        memory.fuse(wall, round=0)
    memory.save(file)
    return len(memory)


def measured(file: Path) -> tuple[float, ...]:
    """One value for each of MEASURES; medians over the moves."""
    # A browser that is open already, as a user's is.
    with open_browser() as browser:
        begun = time.monotonic()
        command = [sys.executable, "-m", "pipelines.cli", "view", str(file)]
        viewer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            assert viewer.stdout is not None
            found = re.search(r"http://127\.0\.0\.1:(\d+)", viewer.stdout.readline())
            assert found is not None
            address = time.monotonic() - begun
            proxy = CountingProxy(int(found[1]))
            opened = time.monotonic()
            browser.driver.get(f"http://127.0.0.1:{proxy.port}")
            wait_for_points(browser)
            drawn = time.monotonic() - opened
            last_byte(proxy)
            sent = proxy.sent
            moves = [moved(browser, proxy) for _ in range(MOVES)]
            return address, address + drawn, drawn, sent / 1e6, *np.median(moves, axis=0).tolist()
        finally:
            viewer.send_signal(signal.SIGINT)
            viewer.wait()


def moved(browser: Browser, proxy: CountingProxy) -> tuple[float, float]:
    """Frames a second while the scene is dragged, and MB that this sends."""
    before, picture = proxy.sent, browser.picture()[SCENE]
    browser.driver.set_script_timeout(PATIENCE)
    frames = float(browser.driver.execute_async_script(ORBIT, DRAG))
    last_byte(proxy)
    if np.array_equal(browser.picture()[SCENE], picture):
        raise RuntimeError("the scene was dragged, but its picture is what it was")
    return frames, (proxy.sent - before) / 1e6


def last_byte(proxy: CountingProxy) -> float:
    """When the last byte came, once nothing more comes."""
    last, sent = time.monotonic(), proxy.sent
    while time.monotonic() - last < REST:
        time.sleep(0.01)
        if proxy.sent != sent:
            last, sent = time.monotonic(), proxy.sent
    return last


def wait_for_points(browser: Browser) -> None:
    """Look until points are drawn; a look takes as long as the page's next frame."""
    end = time.monotonic() + PATIENCE
    while (browser.picture()[SCENE] < 250).any(axis=2).mean() < DRAWN:
        if time.monotonic() > end:
            raise TimeoutError(f"no points after {PATIENCE:g} s")


if __name__ == "__main__":
    main()
