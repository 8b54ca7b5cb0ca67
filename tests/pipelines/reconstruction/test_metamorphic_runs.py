"""Whole runs that must agree: the world moved, or views listed otherwise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from tiny_scan import write_scan

from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.scenes.project import open_project
from gvtools.scenes.scene import Frame, Scene, View
from gvtools.settings import with_texts
from pipelines.console import Console
from pipelines.reconstruction.run import reconstruct
from pipelines.reconstruction.settings import RunSettings

CONTEXT = [f"frame-{i:06d}.color.png" for i in (0, 2, 4, 6)]
TARGETS = [f"frame-{i:06d}.color.png" for i in (1, 3, 5, 7)]
SAME = 60.0


@dataclass(frozen=True)
class World:
    """new = scale rotation old + shift."""

    scale: float = 1.0
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def points(self, old: np.ndarray) -> np.ndarray:
        turn = Rotation.from_rotvec(self.rotation).as_matrix()
        return np.asarray(self.scale * old @ turn.T + np.array(self.shift))

    def view(self, view: View) -> View:
        pose = view.camera.world_from_cam.copy()
        pose[0, :3, :3] = Rotation.from_rotvec(self.rotation).as_matrix() @ pose[0, :3, :3]
        pose[0, :3, 3] = self.points(view.camera.world_from_cam[0, :3, 3])
        camera = replace(view.camera, cam_from_world=np.linalg.inv(pose).astype(np.float64))

        def load() -> Frame:
            frame = view.load()
            assert frame.depth is not None
            return replace(frame, depth=(frame.depth * self.scale).astype(np.float32))

        return replace(view, camera=camera, load=load)


@dataclass(frozen=True, eq=False)
class Run:
    """What a run left."""

    memory: SpatialMemory
    pictures: dict[str, np.ndarray]
    bytes: bytes


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    return open_project(write_scan(tmp_path_factory.mktemp("scan"), views=8))


@pytest.fixture(scope="module")
def plain(scene, tmp_path_factory) -> Run:
    return run(scene, tmp_path_factory.mktemp("plain") / "run", GIVEN)


# Of ``scene``, whose poses are exact; those of ``busy`` are refined.
GIVEN = "refine.poses=false"


def run(scene: Scene, out: Path, *more: str, targets: Sequence[str] = TARGETS) -> Run:
    texts = [f"context={','.join(CONTEXT)}", f"targets={','.join(targets)}", "views_per_round=2"]
    config = with_texts(RunSettings(), ["refine.steps=0", *texts, *more])
    reconstruct(scene, config, out, console=Console(quiet=True))
    pictures = {
        path.name: np.asarray(Image.open(path))
        for path in out.glob("round_*/*.png")
        if path.name.startswith(("guidance_", "generated_", "after_"))
    }
    stored = out / "memory.npz"
    return Run(SpatialMemory.load(stored), pictures, stored.read_bytes())


def worst(one: Run, two: Run) -> float:
    """PSNR of the pictures that differ most, dB; infinite where none does."""
    assert one.pictures.keys() == two.pictures.keys() and len(one.pictures) == 3 * len(TARGETS)
    error = max(
        float(np.mean((picture.astype(float) - two.pictures[name]) ** 2))
        for name, picture in one.pictures.items()
    )
    return 10 * np.log10(255**2 / error) if error else np.inf


@pytest.mark.parametrize(
    "world",
    [
        World(scale=1e-4),
        World(scale=41.0, rotation=(-0.7, 0.2, 2.0), shift=(800.0, 0.3, -7000.0)),
    ],
    ids=str,
)
def test_a_moved_world_gives_the_same_memory_moved_and_the_same_pictures(
    scene, plain, tmp_path, world
):
    moved = replace(scene, views=tuple(world.view(view) for view in scene.views))
    found = run(moved, tmp_path / "run", GIVEN)
    assert worst(plain, found) >= SAME
    assert len(found.memory) == pytest.approx(len(plain.memory), rel=1e-3)
    assert found.memory.voxels == pytest.approx(plain.memory.voxels, rel=1e-3)
    low, middle, high = (
        np.percentile(world.points(plain.memory.positions), share, axis=0) for share in (1, 50, 99)
    )
    edge = found.memory.voxel
    for share, wanted in ((1, low), (50, middle), (99, high)):
        there = np.percentile(found.memory.positions, share, axis=0)
        np.testing.assert_allclose(there, wanted, atol=0.05 * edge)


def test_views_listed_in_another_order_give_the_same_run(scene, plain, tmp_path):
    order = np.random.default_rng(0).permutation(len(scene.views))
    listed = replace(scene, views=tuple(scene.views[i] for i in order))
    found = run(listed, tmp_path / "run", GIVEN)
    assert found.bytes == plain.bytes and worst(plain, found) == np.inf
