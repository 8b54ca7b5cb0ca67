"""A followed camera shows what a projection of everything shows, and splats only what is new."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from gvtools import kernels as compiled
from gvtools.appearance.appearance import Appearance, Blend, Picture
from gvtools.appearance.gaussians import Gaussians
from gvtools.appearance.splat.project_kernels import VALUES
from gvtools.cameras import Cameras
from gvtools.guidance import Guidance
from gvtools.memory.back_projection import back_project
from gvtools.memory.projection import Projection
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.splat.api import SplatOptions
from gvtools.memory.splat.cpu import CpuSplatter
from pipelines.reconstruction.rounds import CachedProjection

SIZE = (48, 64)


def camera(x: float, turn: float = 0.0) -> Cameras:
    pose = np.eye(4)
    c, s = np.cos(turn), np.sin(turn)
    pose[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    pose[:3, 3] = pose[:3, :3] @ [-x, 0, 0]
    return Cameras.pinhole(64, 48, focal=60, cam_from_world=pose, name=f"{x}")


def fuse(memory: SpatialMemory, at: Cameras, seed: int, *, generated: bool, round: int = 0) -> None:
    """A rough wall with a post before it, from one camera; parts of it are not seen."""
    draw = np.random.default_rng(seed)
    depth = (2 + 0.02 * draw.random(SIZE)).astype(np.float32)
    depth[:, 20:26] = 1.2
    rgb = draw.integers(0, 256, (*SIZE, 3), dtype=np.uint8)
    points = back_project(rgb, depth, at, frame=memory.frame, mask=draw.random(SIZE) < 0.8)
    memory.fuse(points, round=round, generated=generated)


def same(one: Guidance, two: Guidance) -> bool:
    names = ("rgb", "depth", "valid", "confidence", "generated")
    return all(np.array_equal(getattr(one, n), getattr(two, n)) for n in names)


@pytest.fixture
def memory() -> SpatialMemory:
    out = SpatialMemory(0.03)
    for i, x in enumerate((0.0, 0.3, 0.5)):
        fuse(out, camera(x, 0.1 * i), i, generated=False)
    return out


@pytest.mark.parametrize("backend", ["cpu", "torch", "nearest"])
def test_the_picture_is_that_of_a_whole_projection_after_every_change(memory, backend):
    options = SplatOptions(backend=backend)
    target = CachedProjection(memory, camera(-1.2, -0.3), options=options)
    seen = [target.guidance()]

    def check() -> None:
        seen.append(target.guidance())
        assert same(seen[-1], memory.project(target.camera, options=options))
        assert not same(seen[-1], seen[-2])

    for number, x in enumerate((-1.0, -1.6, -0.6), 1):
        fuse(memory, camera(x, -0.4), 10 + number, generated=True, round=number)
        check()
    assert seen[-1].generated.any() and not seen[0].generated.any()
    # What was observed changes, and what was added is taken back.
    fuse(memory, camera(-1.0), 20, generated=False, round=4)
    check()
    memory.forget(round=4)
    check()
    memory.forget(round=1)
    check()


def test_an_unchanged_memory_gives_the_same_guidance(memory):
    target = CachedProjection(memory, camera(0.2))
    assert target.guidance() is target.guidance()


def test_observed_views_are_splatted_once(memory, monkeypatch):
    splatted: list[int] = []
    original = CpuSplatter.splat

    def counted(self, request):
        view = memory.segments.view[request.chosen]
        splatted.append(int((~memory.views.generated[view]).sum()))
        return original(self, request)

    monkeypatch.setattr(CpuSplatter, "splat", counted)
    options = SplatOptions(occluders=False)
    for reuse in (True, False):
        target = CachedProjection(memory, camera(-1.2, -0.3), options=options, reuse=reuse)
        target.guidance()
        assert sum(splatted) > 0
        splatted.clear()
        fuse(memory, camera(-1.0, -0.4), 11, generated=True, round=1)
        target.guidance()
        assert splatted and (sum(splatted) == 0) == reuse
        memory.forget(round=1)
        splatted.clear()


def test_holes_take_the_colours_of_gaussians_that_show_a_surface(memory, monkeypatch):
    plain = CachedProjection(memory, camera(-1.2, -0.3))
    known = plain.guidance()
    completed = np.full(known.rgb.shape, 0.25, np.float32)
    assert plain.colored(known, completed) is completed
    valid = known.valid[0]
    assert valid.any() and not valid.all()
    alpha = np.zeros(valid.shape, np.float32)
    alpha[:, ::2] = 1
    shown = Picture(np.full((*valid.shape, 3), 0.75, np.float32), alpha)

    monkeypatch.setattr(Appearance, "picture", lambda self, camera: shown)
    appearance = Appearance(Gaussians(np.zeros((1, VALUES), np.float32)), 0.1, Blend(share=0.0))
    target = CachedProjection(memory, camera(-1.2, -0.3), appearance=appearance)
    colors = target.colored(target.guidance(), completed)[0]
    guess = ~valid & (alpha > 0.5)
    assert (colors[guess] == 0.75).all() and (colors[~guess] == 0.25).all()


def test_looking_ahead_beside_fusions_gives_the_picture_of_a_whole_projection(memory):
    """As a run does: generated content of a round arrives while the next round is looked at."""
    fuse(memory, camera(-0.6, -0.2), 3, generated=True, round=1)
    targets = [CachedProjection(memory, camera(x, -0.2)) for x in np.linspace(-1.5, 1.5, 12)]
    snapshot = memory.snapshot()

    def look() -> None:
        for target in targets:
            target.prefetch(snapshot)

    with ThreadPoolExecutor(1) as pool:
        looked = pool.submit(look)
        for number in range(8):
            # Into the segments that are there, and into new ones.
            fuse(memory, camera(0.2 * number - 0.8, -0.2), 4 + number, generated=True, round=1)
        looked.result()

    def again(self) -> None:
        raise AssertionError("what was looked at is projected again")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Projection, "observe", again)
        seen = [target.guidance() for target in targets]
    for target, guidance in zip(targets, seen, strict=True):
        assert same(guidance, memory.project(target.camera))
    # What was observed since makes a look worthless.
    targets[0].prefetch(memory.snapshot())
    fuse(memory, camera(-1.5, -0.2), 99, generated=False, round=2)
    assert same(targets[0].guidance(), memory.project(targets[0].camera))


@pytest.mark.parametrize("layer", ["workqueue", None])
def test_no_round_is_looked_at_ahead_where_kernels_must_not_overlap(monkeypatch, layer):
    def said() -> str:
        if layer is None:
            raise ValueError("Threading layer is not initialized.")
        return str(layer)

    monkeypatch.setattr(compiled, "threading_layer", said)
    assert not compiled.parallel_kernels_may_overlap()
