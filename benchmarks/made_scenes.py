"""Photographed places with exact geometry, made for the scene set: no file is downloaded.

Each is a COLMAP workspace with sparse points and noisy detections, without depth maps; the true
depth of each photograph lies beside it in ``truth.npz`` ((V, H, W) float32 z-depth, metres).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, invert_rigid
from gvtools.procedural.builder import Light, ProceduralScene, SceneBuilder
from gvtools.procedural.furnished_room import furnished_room
from gvtools.procedural.layouts import add_clutter
from gvtools.procedural.ray_cast import BALL, BOX, TUBE
from gvtools.procedural.room_sample import photograph_room
from gvtools.procedural.sample_workspace import SampleContent, write_sample
from gvtools.procedural.textures import photograph_names
from gvtools.trajectories import look_at

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class Place:
    """What to photograph, how, and how well.

    Attributes:
        build: draws the place, and gives (V, 3) eyes and (V, 3) aims of the cameras.
        seed: of everything random.
        views: how many photographs.
        size: width and height [px].
        focal: in widths.
        points: sparse points that each photograph contributes.
        pose_noise: standard deviation of positions (share of the distance) and turns [rad].
        exposure: standard deviation of the log of each photograph's brightness.
    """

    build: Callable[[np.random.Generator, int], tuple[ProceduralScene, Float64, Float64]]
    seed: int
    views: int
    size: tuple[int, int] = (480, 360)
    focal: float = 0.85
    points: int = 90
    pose_noise: float = 0.0
    exposure: float = 0.0


def write_place(folder: Path, place: Place) -> None:
    """Photograph a place, and write the workspace and its truth."""
    rng = np.random.default_rng([place.seed, 35])
    scene, eyes, aims = place.build(rng, place.views)
    width, height = place.size
    K = np.array([[place.focal * width, 0, width / 2], [0, place.focal * width, height / 2],
                  [0, 0, 1]])  # fmt: skip
    poses = invert_rigid(look_at(eyes, aims, up=[0.0, 0.0, 1.0]))
    count = len(poses)
    cameras = Cameras(
        np.repeat(K[None], count, axis=0), poses, np.full(count, width), np.full(count, height),
        tuple(f"{number:03d}.png" for number in range(count)),
    )  # fmt: skip
    shot = photograph_room(scene, cameras, rng, per_view=place.points)
    images = [
        _exposed(image, np.exp(rng.normal(0, place.exposure))) if place.exposure else image
        for image in shot.images
    ]
    truth = np.array(shot.depths)
    distance = float(np.median(truth[truth > 0]))
    tracks, points = shot.tracks, shot.points
    if place.pose_noise:
        cameras = _moved(cameras, place.pose_noise, distance, rng)
    # Real points are off by about a pixel along and across the ray.
    points = points + rng.normal(0, distance / K[0, 0], points.shape)
    content = SampleContent(cameras, images, [None] * count, points, shot.colors, tracks)
    write_sample(folder, content, record={"sample": "place", "seed": place.seed})
    np.savez_compressed(folder / "truth.npz", depth=truth, cam_from_world=poses)


def _exposed(image: NDArray[np.uint8], factor: float) -> NDArray[np.uint8]:
    table = np.clip(255 * ((np.arange(256) / 255) ** 2.2 * factor) ** (1 / 2.2), 0, 255)
    return np.rint(table).astype(np.uint8)[image]


def _moved(cameras: Cameras, noise: float, distance: float, rng: np.random.Generator) -> Cameras:
    from dataclasses import replace

    from scipy.spatial.transform import Rotation

    poses = cameras.cam_from_world.copy()
    turns = Rotation.from_rotvec(rng.normal(0, noise, (len(poses), 3))).as_matrix()
    poses[:, :3] = turns @ poses[:, :3]
    poses[:, :3, 3] += rng.normal(0, noise * distance, (len(poses), 3))
    return replace(cameras, cam_from_world=poses)


# What stands far away: a box of FAR metres with photographs on its walls.
FAR = 120.0
DAY = Light(
    ambient=np.array([[0.55, 0.58, 0.62], [0.35, 0.34, 0.32]]),
    sun=np.array([[0.48, 0.36, 0.8], [0.55, 0.53, 0.47]]),
    lamps=np.zeros((0, 2, 3)), reach=1.0, shadows=False,
)  # fmt: skip
INDOORS = Light(
    ambient=np.array([[0.5, 0.5, 0.5], [0.45, 0.44, 0.42]]),
    sun=np.array([[0.3, 0.5, 0.81], [0.2, 0.2, 0.19]]),
    lamps=np.array([[[0.0, 0.0, 2.4], [0.8, 0.76, 0.7]]]), reach=3.0, shadows=True,
)  # fmt: skip


def _builder(rng: np.random.Generator) -> SceneBuilder:
    return SceneBuilder(rng, photograph_names("train"))


def _done(kind: str, build: SceneBuilder, light: Light) -> ProceduralScene:
    return ProceduralScene(kind, build.geometry(), build.look(light), 0.2)


def _outdoors(build: SceneBuilder, ground: float, *, far: float = FAR) -> None:
    """Ground, distant pictures, a pale sky."""
    walls = [build.material(far / 1.5, only="picture") for _ in range(4)]
    sky = build.material(2 * far, gain=0.3, emission=0.8)
    floor = build.material(ground)
    build.room([-far, -far, 0], [far, far, 0.4 * far], [*walls, floor, sky])


def _around(rng: np.random.Generator, views: int, radius: float, *, height: tuple[float, float],
            sweep: float = 2 * np.pi, aim: float = 0.4) -> tuple[Float64, Float64]:  # fmt: skip
    angle = rng.uniform(0, 6) + sweep * np.arange(views) / views + rng.normal(0, 0.04, views)
    away = radius * rng.uniform(0.92, 1.08, views)
    up = rng.uniform(*height, views)
    eyes = np.stack([away * np.cos(angle), away * np.sin(angle), up], axis=1)
    aims = np.column_stack([rng.normal(0, 0.05 * radius, (views, 2)), np.full(views, aim)])
    return eyes, aims


def object_indoors(
    rng: np.random.Generator, views: int
) -> tuple[ProceduralScene, Float64, Float64]:
    """A walk around a small thing on a table in a furnished room."""
    build = _builder(rng)
    side = rng.uniform(5, 7)
    low, high = np.array([-side / 2, -side / 2, -0.8]), np.array([side / 2, side / 2, 1.9])
    walls = [build.material(rng.uniform(1, 4)) for _ in range(4)]
    build.room(low, high, [*walls, build.material(1.0), build.material(3.0, gain=1.2)])
    top = build.material(0.6)
    build.solid(TUBE, [0, 0, -0.03], [0.6, 0.6, 0.03], material=top)
    build.solid(TUBE, [0, 0, -0.42], [0.06, 0.06, 0.36], material=top)
    for number in range(5):
        place = rng.uniform(-0.16, 0.16, 2)
        half = rng.uniform(0.04, 0.11, 3)
        kind = (BOX, BALL, TUBE)[number % 3]
        build.solid(kind, [*place, half[2]], half, material=build.material(rng.uniform(0.1, 0.4)),
                    yaw=rng.uniform(0, 3))  # fmt: skip
    for angle in rng.uniform(0, 6.28, 6):
        half = rng.uniform(0.2, 0.5, 3)
        place = 0.4 * side * np.array([np.cos(angle), np.sin(angle)])
        build.solid(BOX, [*place, -0.8 + half[2]], half, material=build.material(0.7),
                    yaw=rng.uniform(0, 3))  # fmt: skip
    eyes, aims = _around(rng, views, 0.75, height=(0.25, 0.65), aim=0.05)
    return _done("object indoors", build, INDOORS), eyes, aims


def object_outdoors(
    rng: np.random.Generator, views: int
) -> tuple[ProceduralScene, Float64, Float64]:
    """A walk around a table-sized thing with a far background, as in a garden."""
    build = _builder(rng)
    _outdoors(build, 1.5)
    build.solid(TUBE, [0, 0, 0.35], [0.7, 0.7, 0.35], material=build.material(0.7))
    build.solid(BALL, [0, 0, 0.95], [0.3, 0.3, 0.28], material=build.material(0.4))
    build.solid(BOX, [0.35, 0.2, 0.8], [0.12, 0.15, 0.12], material=build.material(0.3), yaw=0.5)
    for _ in range(14):
        angle, away = rng.uniform(0, 6.28), rng.uniform(6, 28)
        half = rng.uniform(0.4, 2.0, 3) * [1, 1, 1.3]
        place = away * np.array([np.cos(angle), np.sin(angle)])
        kind = (BOX, BALL, TUBE)[int(rng.integers(3))]
        build.solid(kind, [*place, half[2]], half, material=build.material(rng.uniform(0.8, 3)),
                    yaw=rng.uniform(0, 3))  # fmt: skip
    eyes, aims = _around(rng, views, 2.4, height=(1.1, 1.9), aim=0.6)
    return _done("object outdoors", build, DAY), eyes, aims


def facade(rng: np.random.Generator, views: int) -> tuple[ProceduralScene, Float64, Float64]:
    """A house front seen from across the street, with niches, a ledge and posts before it."""
    build = _builder(rng)
    _outdoors(build, 2.0)
    wall = build.material(3.0)
    cuts = [
        ([x - 0.6, -1.2, z - 0.8], [x + 0.6, -0.6, z + 0.8])
        for x in (-6.0, -3.0, 0.0, 3.0, 6.0) for z in (-1.7, 1.4)
    ]  # fmt: skip
    build.solid(BOX, [0, 9.0, 3.5], [9, 1.0, 3.5], material=wall, cuts=cuts,
                cut_material=build.material(1.0))  # fmt: skip
    build.solid(BOX, [0, 7.7, 3.6], [9, 0.3, 0.12], material=build.material(1.0))
    for x in rng.uniform(-7, 7, 4):
        build.solid(TUBE, [x, rng.uniform(4.5, 6.5), 1.2], [0.12, 0.12, 1.2],
                    material=build.material(0.5))  # fmt: skip
    x = np.linspace(-6, 6, views) + rng.normal(0, 0.2, views)
    eyes = np.column_stack([x, rng.uniform(-3, -1.5, views), rng.uniform(1.4, 1.9, views)])
    aims = np.column_stack([0.6 * x + rng.normal(0, 0.5, views), np.full(views, 8.0),
                            rng.uniform(2.6, 3.4, views)])  # fmt: skip
    return _done("facade", build, DAY), eyes, aims


def corridor(rng: np.random.Generator, views: int) -> tuple[ProceduralScene, Float64, Float64]:
    """A walk along a corridor, looking ahead."""
    build = _builder(rng)
    length, width, height = 14.0, 2.4, 2.6
    skin = [build.material(rng.uniform(0.8, 3)) for _ in range(6)]
    low, high = np.array([0, -width / 2, 0]), np.array([length, width / 2, height])
    build.room(low, high, skin)
    for place in (3.5, 8.0, 11.0):
        side = rng.choice([-1, 1])
        far = [place + 1.1, side * (width / 2 + 2.2), 2.1]
        near = [place, side * width / 2, 0]
        corners = np.sort([near, far], axis=0)
        build.room(corners[0], corners[1], [build.material(1.5) for _ in range(6)])
    add_clutter(build, low + np.array([5, 0, 0]), high, 6, scale=0.45, palette=4)
    x = np.linspace(0.6, 6.5, views)
    eyes = np.column_stack([x, rng.normal(0, 0.12, views), rng.uniform(1.4, 1.6, views)])
    aims = eyes + np.column_stack([np.full(views, 4.0), rng.normal(0, 0.35, views),
                                   rng.normal(-0.3, 0.1, views)])  # fmt: skip
    return _done("corridor", build, INDOORS), eyes, aims


def street(rng: np.random.Generator, views: int) -> tuple[ProceduralScene, Float64, Float64]:
    """A walk forward along a street, with the horizon ahead."""
    build = _builder(rng)
    _outdoors(build, 2.5)
    for side in (-1, 1):
        begins = -4.0
        while begins < 45:
            half = np.array([rng.uniform(2, 4), 2.5, rng.uniform(2.5, 6)])
            build.solid(BOX, [begins + half[0], side * rng.uniform(7, 8.5), half[2]], half,
                        material=build.material(rng.uniform(1.5, 4)))  # fmt: skip
            begins += 2 * half[0] + rng.uniform(0, 2)
    for _ in range(9):
        half = np.array([*rng.uniform(0.2, 0.7, 2), rng.uniform(0.4, 1.2)])
        build.solid((BOX, TUBE)[int(rng.integers(2))],
                    [rng.uniform(5, 35), rng.choice([-1, 1]) * rng.uniform(2.4, 4.2), half[2]],
                    half, material=build.material(0.7))  # fmt: skip
    x = np.linspace(0, 9, views)
    eyes = np.column_stack([x, rng.normal(0, 0.2, views), rng.uniform(1.5, 1.8, views)])
    aims = eyes + np.column_stack([np.full(views, 6.0), rng.normal(0, 0.6, views),
                                   rng.normal(0.1, 0.1, views)])  # fmt: skip
    return _done("street", build, DAY), eyes, aims


def from_above(rng: np.random.Generator, views: int) -> tuple[ProceduralScene, Float64, Float64]:
    """Houses and trees from a drone, in two strips."""
    build = _builder(rng)
    _outdoors(build, 14.0)
    for _ in range(26):
        half = np.array([*rng.uniform(1.5, 4, 2), rng.uniform(1.2, 4)])
        kind = (BOX, BOX, BALL)[int(rng.integers(3))]
        build.solid(kind, [*rng.uniform(-26, 26, 2), half[2]], half,
                    material=build.material(rng.uniform(2, 6)), yaw=rng.uniform(0, 3))  # fmt: skip
    half_count = -(-views // 2)
    x = np.concatenate([np.linspace(-18, 18, half_count), np.linspace(18, -18, views - half_count)])
    y = np.repeat([-7.0, 7.0], [half_count, views - half_count])
    eyes = np.column_stack([x, y, rng.uniform(26, 29, views)]) + rng.normal(0, 0.5, (views, 3))
    aims = eyes + np.column_stack([rng.normal(0, 3, (views, 2)), np.full(views, -27.0)])
    aims[:, 1] += 8
    return _done("from above", build, DAY), eyes, aims


def room_inside(rng: np.random.Generator, views: int) -> tuple[ProceduralScene, Float64, Float64]:
    """A furnished room from its middle, looking outward, walls all around."""
    scene = furnished_room(int(rng.integers(1000)))
    size = scene.geometry.rooms[0, 1]
    angle = 2 * np.pi * np.arange(views) / views
    middle = np.array([*size[:2] / 2, 1.45])
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(views)], axis=1)
    eyes = middle - 0.28 * ring * [size[0], size[1], 0] + rng.normal(0, 0.06, (views, 3))
    aims = middle + 2.0 * ring + [0, 0, -0.35]
    return scene, eyes, aims


def plant(rng: np.random.Generator, views: int) -> tuple[ProceduralScene, Float64, Float64]:
    """Stems and thin leaves in a pot, in front of much else; few views see it from one side."""
    build = _builder(rng)
    _outdoors(build, 1.2)
    build.solid(TUBE, [0, 0, 0.15], [0.16, 0.16, 0.15], material=build.material(0.3))
    for _ in range(9):
        foot, tall = rng.uniform(-0.12, 0.12, 2), rng.uniform(0.2, 0.5)
        build.solid(TUBE, [*foot, 0.3 + tall], [0.006, 0.006, tall], material=build.material(0.2))
    leaves = [build.material(rng.uniform(0.1, 0.3)) for _ in range(6)]
    for number in range(90):
        angle, away, height = rng.uniform(0, 6.28), rng.uniform(0.02, 0.38), rng.uniform(0.4, 1.25)
        upright = [rng.uniform(0.03, 0.09), rng.uniform(0.004, 0.02), rng.uniform(0.02, 0.06)]
        flat = [rng.uniform(0.03, 0.09), rng.uniform(0.02, 0.05), 0.003]
        place = [away * np.cos(angle), away * np.sin(angle), height]
        build.solid(BOX, place, flat if number % 5 < 2 else upright, material=leaves[number % 6],
                    yaw=rng.uniform(0, 3))  # fmt: skip
    for _ in range(10):
        angle, away = rng.uniform(0, 6.28), rng.uniform(3, 15)
        half, material = rng.uniform(0.3, 1.5, 3), build.material(rng.uniform(0.8, 3))
        build.solid(BOX, [away * np.cos(angle), away * np.sin(angle), half[2]], half,
                    material=material, yaw=rng.uniform(0, 3))  # fmt: skip
    sweep = 2 * np.pi if views > 12 else 1.6
    eyes, aims = _around(rng, views, 1.7, height=(0.7, 1.4), sweep=sweep, aim=0.7)
    return _done("plant", build, DAY), eyes, aims


PLACES = {
    "object indoors": Place(object_indoors, 1, 24),
    "object outdoors": Place(object_outdoors, 2, 32),
    "object, noisy": Place(object_indoors, 3, 28, pose_noise=0.002, exposure=0.15),
    "object, close": Place(object_outdoors, 4, 16, points=60, focal=1.3),
    "facade": Place(facade, 5, 12),
    "facade, exposed": Place(facade, 6, 18, exposure=0.2),
    "corridor": Place(corridor, 7, 24),
    "street": Place(street, 8, 20),
    "street, 1600 pixels": Place(street, 13, 20, size=(1600, 1200)),
    "corridor, 240 pixels": Place(corridor, 14, 24, size=(240, 180)),
    "from above": Place(from_above, 9, 18),
    "from above, noisy": Place(from_above, 10, 30, pose_noise=0.0015),
    "plant": Place(plant, 15, 24, size=(640, 480)),
    "plant, few": Place(plant, 16, 9, size=(640, 480)),
    "facade, 960 pixels": Place(facade, 17, 12, size=(960, 640)),
    "object indoors, 1280 pixels": Place(object_indoors, 18, 40, size=(1280, 960)),
    "room inside": Place(room_inside, 11, 24),
    "room inside, 200": Place(room_inside, 12, 200, size=(240, 180), points=30),
}
