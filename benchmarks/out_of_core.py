"""A memory larger than its budget beside one in RAM: building, projecting, peak memory.

    NUMBA_NUM_THREADS=1 python -m benchmarks.out_of_core [--observations 20] [--budget 400MB]

A corridor of closed rooms, 4 m wide each, is seen by a camera that turns in every room; voxels are
5 mm wide. Each memory is built in a process of its own. Seconds are of the processor.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.guidance import Guidance
from gvtools.memory.spatial_memory import MemoryOptions, SpatialMemory, TiledMemory
from pipelines.bench.procedural_cloud import inside_camera, photograph

ROOM = np.array([4.0, 3.0, 4.0])
VOXEL = 0.005
VIEWS = 14
SIZE = {"width": 640, "height": 480}


def camera_in(room: int, turn: float) -> Cameras:
    """A camera in one of the rooms, which lie along x."""
    camera = inside_camera(ROOM, turn=turn, **SIZE)
    pose = camera.cam_from_world.copy()
    pose[:, :3, 3] -= pose[:, :3, 0] * (room * 1.05 * ROOM[0])
    return Cameras(camera.K, pose, camera.width, camera.height, (f"{room} {turn:.3f}",))


@cache
def seen(turn: float) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Colours and depth of a view; all rooms look alike."""
    return photograph(ROOM, inside_camera(ROOM, turn=turn, **SIZE))


class Building:
    """A memory that is built room by room, and the processor's seconds."""

    def __init__(self, memory: SpatialMemory) -> None:
        self.memory, self.rooms, self.seconds, self.frames = memory, 0, 0.0, 0

    def observe(self, room: int, turn: float) -> float:
        """Fuse one view; the processor's seconds of it."""
        rgb, depth = seen(turn)
        begin = time.process_time()
        self.memory.observe(rgb, depth, camera_in(room, turn), round=0)
        return time.process_time() - begin

    def add_room(self) -> None:
        """Look around in the next room."""
        for i in range(VIEWS):
            self.seconds += self.observe(self.rooms, 2 * np.pi * i / VIEWS)
            self.frames += 1
        self.rooms += 1


def projected(memory: SpatialMemory, room: int) -> tuple[float, float, Guidance]:
    """Seconds of a first projection and of the next, and what it shows."""
    camera = camera_in(room, 0.3)
    seconds = []
    for _ in range(4):
        begin = time.process_time()
        guidance = memory.project(camera)
        seconds.append(time.process_time() - begin)
    return seconds[0], min(seconds[1:]), guidance


def measure(observations: int, budget: str | None, scratch: Path) -> dict[str, Any]:
    """Build a memory and measure it."""
    options = MemoryOptions(budget=budget)
    memory = (
        SpatialMemory(VOXEL, options=options)
        if budget is None
        else TiledMemory(VOXEL, options=options, scratch=scratch)
    )
    # Kernels are compiled, and memory's own pages known, before.
    warm = Building(SpatialMemory(VOXEL))
    warm.observe(0, 0.0)
    projected(warm.memory, 0)
    building = Building(memory)
    building.add_room()
    turns = np.linspace(0.2, 1.0, 5)
    small = {"project": projected(memory, 0)[1]}
    small["fuse"] = float(np.median([building.observe(0, t) for t in turns]))
    while len(memory) < observations:
        building.add_room()
        print(f"{len(memory) / 1e6:.0f} M", file=sys.stderr, flush=True)
    cold, warm_, guidance = projected(memory, 0)
    grown = {"first project": cold, "project": warm_, "first fuse": building.observe(0, 1.5)}
    grown["fuse"] = float(np.median([building.observe(0, 1.5 + t) for t in turns]))
    last = projected(memory, building.rooms - 1)
    return {
        "observations": len(memory),
        "rooms": building.rooms,
        "build": building.seconds / building.frames,
        "small": small,
        "grown": grown,
        "last": {"first project": last[0], "project": last[1]},
        "mean": float(guidance.rgb.mean()),
        "coverage": guidance.coverage,
        "stored_MB": memory.stored_bytes / 1e6,
        "tiles": sum(1 for _ in memory.tiles),
        "peak_MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
    }


def alone(observations: int, budget: str | None, scratch: Path) -> dict[str, Any]:
    """``measure`` in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.out_of_core", "--scratch", str(scratch), "--one"]
    command += ["--observations", str(observations / 1e6)]
    command += ["--budget", "none" if budget is None else budget]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def main() -> None:
    """Print one JSON line a memory, and the ratios."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--observations", type=float, default=20, help="millions (%(default)s)")
    parser.add_argument("--budget", default="400MB", help="of the tiled memory (%(default)s)")
    parser.add_argument("--in-ram", type=float, help="millions of the memory in RAM (the same)")
    parser.add_argument("--scratch", type=Path, help="folder for tiles")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    count = int(args.observations * 1e6)
    if args.one:
        budget = None if args.budget == "none" else args.budget
        print(json.dumps(measure(count, budget, args.scratch)))
        return
    with TemporaryDirectory(dir=args.scratch) as scratch:
        tiled = alone(count, args.budget, Path(scratch))
        ram = alone(int((args.in_ram or args.observations) * 1e6), None, Path(scratch))
    for name, found in (("tiles", tiled), ("RAM", ram)):
        print(name, json.dumps(found))
    for key in ("small", "grown", "last"):
        for part in tiled[key]:
            print(f"{key} {part}: tiles / RAM {tiled[key][part] / ram[key][part]:.2f}")
    print(f"build: tiles / RAM {tiled['build'] / ram['build']:.2f}")
    for part in ("project", "fuse"):
        print(f"{part}: grown / small {tiled['grown'][part] / tiled['small'][part]:.2f}")


if __name__ == "__main__":
    main()
