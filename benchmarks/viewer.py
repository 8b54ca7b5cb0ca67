"""How long the web viewer takes to the first drawn point, and how much it sends.

    python benchmarks/viewer.py
    python benchmarks/viewer.py --points 1e6 1e7 --repeats 3

A box with a point in each voxel of its walls is saved as a memory and shown by ``gvtools view`` to
a headless Chromium. Bytes are counted by a proxy between the two. Needs chromium and chromedriver,
and what the tests need.
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

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

from browser import Browser, open_browser

from gvtools.memory.spatial_memory import SpatialMemory
from pipelines.procedural_cloud import box_size, walls

VOXEL = 0.01
# Where the scene shows in a window of 1280 x 800, free of the controls and of the page's notes.
SCENE = np.s_[60:460, 20:930]
# Of the scene's pixels, when the first points are there.
DRAWN = 0.02
PATIENCE = 300.0
# Nothing more comes once so many seconds have passed without a byte.
REST = 5.0


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
    print("| points | command to address, s | command to first point, s | page to first point, s "
          "| sent, MB |\n|---|---|---|---|---|")  # fmt: skip
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


def measured(file: Path) -> tuple[float, float, float, float]:
    """Seconds to the address, from command and from page to the first point, and megabytes."""
    # A browser that is open already, as a user's is.
    with open_browser() as browser:
        begun = time.monotonic()
        command = [sys.executable, "-m", "pipelines.cli", "view", str(file)]
        viewer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            assert viewer.stdout is not None
            found = re.search(r"http://127\.0\.0\.1:(\d+)", viewer.stdout.readline())
            assert found is not None
            address = time.monotonic()
            proxy = CountingProxy(int(found[1]))
            opened = time.monotonic()
            browser.driver.get(f"http://127.0.0.1:{proxy.port}")
            wait_for_points(browser)
            drawn = time.monotonic()
            before, quiet = -1, 0.0
            while quiet < REST:
                quiet = quiet + 0.5 if proxy.sent == before else 0.0
                before = proxy.sent
                time.sleep(0.5)
            return (
                address - begun,
                (address - begun) + (drawn - opened),
                drawn - opened,
                (proxy.sent / 1e6),
            )
        finally:
            viewer.send_signal(signal.SIGINT)
            viewer.wait()


def wait_for_points(browser: Browser) -> None:
    """Look until points are drawn; a look takes as long as the page's next frame."""
    end = time.monotonic() + PATIENCE
    while (browser.picture()[SCENE] < 250).any(axis=2).mean() < DRAWN:
        if time.monotonic() > end:
            raise TimeoutError(f"no points after {PATIENCE:g} s")


if __name__ == "__main__":
    main()
