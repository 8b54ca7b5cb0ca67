"""Hand-made levels as cases: walks from where players appear, seen at eye height."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.experiments.cases import SIZE, Case, case_of
from benchmarks.experiments.level_render import LevelScene
from benchmarks.experiments.level_textures import Pictures
from benchmarks.experiments.quake_levels import Archives, read_level
from gvtools.cameras import Cameras
from gvtools.training.corruption import CorruptionOptions, draw_strengths
from gvtools.training.samples import Clip
from gvtools.training.views import ContextChoice, SampleInputs

Float64 = NDArray[np.float64]
ATTEMPTS = 60
# Metres of a map's unit: a player is 56 units tall.
METRES = 1.75 / 56
# Above where a player appears, in the map's units, as the game has it.
EYES = 26.0
# Paths are drawn from these: fields of view in degrees, turns in degrees over a path, and lengths
# in mean depths of the first view.
FOV, TURN, TRAVEL = (55.0, 85.0), (5.0, 90.0), (0.1, 0.8)
# Limits of every view: share of sky, and of pixels nearer than NEAR map units; how far the middle
# of the picture's depths is at least; mean brightness.
MOST_SKY, MOST_NEAR, NEAR, LEAST_MEDIAN, LEAST_LIGHT = 0.05, 0.02, 24.0, 80.0, 0.03
# Map units that stay free between a camera and what it moves towards.
CLEARANCE = 40.0
# Mean brightness that a path is developed to, with an exposure of at most MOST_EXPOSURE.
KEY, MOST_EXPOSURE = 0.38, 4.0
# Along a side, of the pictures that a path is judged by.
PROBE = 16


def level_cases(
    folder: Path, count: int, *, seed: int = 0, size: int = SIZE, views: int = 8
) -> Iterator[Case]:
    """Cases of hand-made levels, named by their maps.

    Context and faults are drawn as for procedural scenes. A map gives one case at most, so that
    cases are independent; one without a free path gives none.

    Args:
        folder: with the packages' archives below it, see ``Archives``.
        count: of maps, spread evenly over all; no more than there are.
        seed: of paths, context and faults.
        size: of the square pictures, px.
        views: of a path, context and targets.

    Raises:
        ProjectError: no archive, or a damaged map.
    """
    archives = Archives(folder)
    pictures = Pictures(archives)
    choice = ContextChoice()
    chosen = np.linspace(0, len(archives.maps) - 1, min(count, len(archives.maps)))
    for number in chosen.round().astype(int).tolist():
        name = archives.maps[number]
        level = read_level(archives.read(name), name)
        scene = LevelScene(level, pictures.of(level.materials))
        rng = np.random.default_rng([seed, number])
        clip = walk(scene, rng, size=size, views=views)
        if clip is None:
            continue
        strength = draw_strengths(rng, CorruptionOptions())
        context = choice.choose(rng, views, int(rng.integers(1, choice.most + 1)))
        yield case_of(SampleInputs(clip, context, strength, rng), Path(name).stem)


def walk(
    scene: LevelScene, rng: np.random.Generator, *, size: int = SIZE, views: int = 8
) -> Clip | None:
    """The views of a walk, in metres; None where no attempt is free.

    Args:
        scene: a level.
        rng: decides everything.
        size: of the square pictures, px.
        views: of the walk.
    """
    starts = scene.level.starts
    for _ in range(ATTEMPTS if len(starts) else 0):
        start = starts[rng.integers(len(starts))] + np.array((0, 0, EYES))
        cameras = _path(scene, rng, start, size=size, views=views)
        if cameras is None or not _usable(scene, cameras):
            continue
        light, depth = scene.render(cameras)
        if light.mean((1, 2, 3)).min() < LEAST_LIGHT:
            continue
        exposure = min(KEY / float(light.mean()), MOST_EXPOSURE)
        rgb = np.rint(255 * np.clip(exposure * light, 0, 1)).astype(np.uint8)
        pose = cameras.cam_from_world.copy()
        pose[:, :3, 3] *= METRES
        metric = Cameras(cameras.K, pose, cameras.width, cameras.height, cameras.names)
        return Clip(rgb, depth * np.float32(METRES), metric)
    return None


def _path(
    scene: LevelScene, rng: np.random.Generator, start: Float64, *, size: int, views: int
) -> Cameras | None:
    """Cameras that step and turn, or None where the way is blocked."""
    focal = size / (2 * np.tan(np.radians(rng.uniform(*FOV)) / 2))
    yaw, pitch = rng.uniform(0, 2 * np.pi), rng.normal(-0.08, 0.12)
    turn = np.radians(rng.uniform(*TURN)) * rng.choice([-1, 1])
    along = np.linspace(0, 1, views)
    directions = _directions(yaw + turn * along, pitch)
    ahead, _ = scene.cast(start[None], directions[:1])
    # Ahead or back with a drift to the side.
    heading = _directions(np.array([yaw + rng.normal(0, 0.5) + np.pi * (rng.random() < 0.35)]), 0)
    free, _ = scene.cast(start[None], heading)
    travel = rng.uniform(*TRAVEL) * min(float(ahead[0]), 1000.0)
    if not np.isfinite(free[0]) or free[0] < CLEARANCE:
        return None
    travel = min(travel, float(free[0]) - CLEARANCE)
    places = start + along[:, None] * travel * heading
    poses = [_looking(place, toward) for place, toward in zip(places, directions, strict=True)]
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    sizes = np.full(views, size)
    return Cameras(np.repeat(K[None], views, 0), np.stack(poses), sizes, sizes, ())


def _usable(scene: LevelScene, cameras: Cameras) -> bool:
    """Whether no view is of the sky, of a wall before its lens, or from outside."""
    small = cameras.resized(PROBE, PROBE)
    for index in range(len(small)):
        toward = small.rays(index).reshape(-1, 3) @ small.world_from_cam[index, :3, :3].T
        depth, hit = scene.cast(np.broadcast_to(small.centers[index], toward.shape), toward)
        if (hit < 0).mean() > MOST_SKY or (depth < NEAR).mean() > MOST_NEAR:
            return False
        if np.median(depth) < LEAST_MEDIAN:
            return False
    return True


def _directions(yaw: Float64, pitch: float) -> Float64:
    """(V, 3) unit vectors; z is up."""
    level = np.cos(pitch)
    up = np.full_like(yaw, np.sin(pitch))
    return np.stack([level * np.cos(yaw), level * np.sin(yaw), up], axis=-1)


def _looking(place: Float64, toward: Float64) -> Float64:
    """(4, 4) cam_from_world of a level camera."""
    right = np.cross(toward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(toward, right), toward])
    pose[:3, 3] = -pose[:3, :3] @ place
    return pose
