"""One step of a fit beside one of plain Gaussian splatting: same Gaussians, same photographs.

    python benchmarks/fit_step.py SHARED PROJECT RUN [--sides 480,960] [--count 100000]

SHARED is the folder of real scenes; its ``tools/peer_gaussians`` is plain 3D Gaussian splatting and
is compiled by its own ``train.py`` when that first runs. RUN is a finished run of PROJECT with
fitted Gaussians. Those of its largest fit are taken: the first COUNT, or all and copies of some,
moved a little and smaller. Both make steps at the end of a fit, with all harmonics and all of the
Gaussians (no dropout), in turns. A step of gvtools also keeps surfaces smooth and fits the
photograph's exposure.
"""

from __future__ import annotations

import argparse
import ctypes
import time
from collections.abc import Callable, Sequence
from hashlib import sha1
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import numpy as np

from gvtools import open_project
from gvtools.appearance.appearance import Appearance
from gvtools.appearance.fit import Fit
from gvtools.appearance.gaussians import Gaussians
from gvtools.poses.refinement import FitView
from gvtools.scenes.resized import reduced

REPEATS = 5
# Progress of a fit at which no Gaussians are added any more.
NEARLY_OVER = 0.999
TOLD = (
    "{}x{}: gvtools {:.1f} ms, {:.1f} of the processor; plain splatting {:.1f}, {:.1f}; "
    "{:.2f} x, {:.2f} x"
)
PAUSE = 0.25


class Peer:
    """Plain Gaussian splatting, compiled: its step with tiny step lengths."""

    def __init__(self, shared: Path, values: Any, views: Sequence[FitView], near: float) -> None:
        """Load it and prepare the photographs."""
        source = shared / "tools" / "peer_gaussians" / "gs.cpp"
        built = Path(gettempdir()) / f"libgs_{sha1(source.read_bytes()).hexdigest()[:10]}.so"
        if not built.exists():
            raise SystemExit(f"no {built}; run {source.with_name('train.py')} once, which makes it")
        self.compiled = ctypes.CDLL(str(built))
        parts = np.split(values, [3, 6, 10, 11], axis=1)
        self.values = [np.ascontiguousarray(part) for part in parts]
        moments = [np.zeros_like(part) for part in self.values for _ in range(2)]
        self.moments = moments, (ctypes.c_void_p * 10)(*[part.ctypes.data for part in moments])
        self.sums = [np.zeros(len(values), np.float32) for _ in range(2)]
        self.rates, self.stats = np.full(6, 1e-6, np.float32), np.zeros(2, np.int64)
        self.views = [self._prepared(view, near) for view in views]
        self.steps = 0

    def _prepared(self, view: FitView, near: float) -> tuple[Any, ...]:
        picture = np.ascontiguousarray((view.rgb / np.float32(255)).transpose(2, 0, 1))
        mean, square = np.empty_like(picture), np.empty_like(picture)
        height, width = picture.shape[1:]
        self.compiled.ssim_pre(*map(_pointer, (picture, mean, square)), width, height)
        pose, K = view.cam_from_local, view.K
        lens = [*pose[:3, :3].ravel(), *pose[:3, 3], K[0, 0], K[1, 1], K[0, 2], K[1, 2], near]
        return picture, mean, square, np.array(lens, np.float32)

    def step(self) -> None:
        """One step on the next photograph."""
        picture, mean, square, lens = self.views[self.steps % len(self.views)]
        self.steps += 1
        height, width = picture.shape[1:]
        self.compiled.step(
            ctypes.c_long(len(self.values[0])), 9, 2, *map(_pointer, self.values),
            self.moments[1], _pointer(lens), width, height, _pointer(picture), _pointer(mean),
            _pointer(square), ctypes.c_float(0.2), _pointer(self.rates),
            ctypes.c_long(self.steps), *map(_pointer, self.sums), None, _pointer(self.stats),
        )  # fmt: skip


def main() -> None:
    """Print one line for each size."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name in ("shared", "project", "run"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--sides", default="480,960")
    parser.add_argument("--count", type=int, default=100_000)
    args = parser.parse_args()
    appearance = Appearance.load(args.run / "round_000" / "appearance.npz")
    frame = appearance.gaussians.frame
    values = _filled(max(appearance.fits, key=len).values, args.count)
    scene = open_project(args.project)
    for side in map(int, args.sides.split(",")):
        views = []
        for view in reduced(scene, side).views[::5]:
            pose = frame.cam_from_local(view.camera.cam_from_world)[0]
            views.append(FitView(view.load().rgb, view.camera.K[0], pose, None, None))
        fit = Fit(Gaussians(values.copy(), frame=frame), views, begin=0.9)
        fit._dropout, fit._fading = 0.0, False
        peer = Peer(args.shared, values, views, fit.near)

        def step(fit: Fit = fit) -> None:
            fit.step(NEARLY_OVER)

        for _ in views:
            step(), peer.step()
        turns = [[_timed(one, 2 * len(views)) for one in (step, peer.step)] for _ in range(REPEATS)]
        # Some that are faint are removed; were any added, the peer would draw fewer.
        assert 0.9 * args.count < len(fit.population) <= args.count, len(fit.population)
        (wall, own), (peer_wall, peer_own) = np.median(turns, axis=0)
        height, width = views[0].rgb.shape[:2]
        ratios = wall / peer_wall, own / peer_own
        print(TOLD.format(width, height, wall, own, peer_wall, peer_own, *ratios))


def _filled(values: Any, count: int) -> Any:
    """As many Gaussians as asked: the first ones, or all and copies of some."""
    rng = np.random.default_rng(0)
    more = values[rng.integers(len(values), size=max(count - len(values), 0))].copy()
    more[:, :3] += 0.5 * rng.normal(size=(len(more), 3)) * np.exp(more[:, 3:6])
    more[:, 3:6] -= 0.3
    return np.ascontiguousarray(np.concatenate([values, more])[:count], np.float32)


def _timed(step: Callable[[], None], count: int) -> tuple[float, float]:
    """Milliseconds of a step, by the clock and of the processor."""
    time.sleep(PAUSE)
    wall, own = time.perf_counter(), time.process_time()
    for _ in range(count):
        step()
    took = time.perf_counter() - wall, time.process_time() - own
    return took[0] / count * 1e3, took[1] / count * 1e3


def _pointer(array: Any) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


if __name__ == "__main__":
    main()
