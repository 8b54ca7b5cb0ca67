"""The room of the demo, drawn from a seed: furniture along its walls, a table in its middle.

The world's z axis points up, the floor is z = 0, one corner of the room is the origin, and the
unit is the metre. Its textures are square sRGB pictures made of the photographs that the
scikit-image wheel ships; the renderer repeats them in mirrored copies, so that none shows a seam.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from scipy.ndimage import gaussian_filter

from gvtools.cameras import Float64
from gvtools.procedural.builder import Light, ProceduralScene, SceneBuilder
from gvtools.procedural.ray_cast import BALL, BOX, TUBE
from gvtools.procedural.textures import photograph

UInt8 = NDArray[np.uint8]
Color = tuple[float, float, float]

SIDE = 256

# Photographs that hang on walls.
PICTURES = (
    "astronaut",
    "chelsea",
    "coffee",
    "camera",
    "coins",
    "colorwheel",
    "hubble_deep_field",
    "immunohistochemistry",
    "moon",
    "page",
    "retina",
)


def picture(name: str) -> tuple[UInt8, float]:
    """A photograph to be shown once, and its width by its height."""
    image = photograph(name)
    return _resized(image), image.shape[1] / image.shape[0]


def globe(name: str) -> UInt8:
    """The middle of a photograph, to cover half a turn of a ball."""
    image = photograph(name)
    height, width = image.shape[:2]
    return _resized(image[height // 5 : -(height // 5), width // 5 : -(width // 5)])


def tiled(name: str, color: Color, *, contrast: float = 0.22) -> UInt8:
    """The relief of a photograph of a material in an sRGB tint.

    ``color``: sRGB in [0, 1], the mean. ``contrast``: standard deviation of the brightness, share
    of the mean.
    """
    return _tinted(1 + contrast * _relief(name), color)


def paint(color: Color, *, grain: float = 0.05) -> UInt8:
    """Weak texture: one sRGB colour with a faint relief."""
    return tiled("gravel", color, contrast=grain)


def planks(color: Color, rng: np.random.Generator, *, rows: int = 8) -> UInt8:
    """Boards cut from the table under the cup of coffee, ``rows`` of them one above another."""
    # The grain of that table runs 32 degrees up to the right; this quadrilateral (upper left,
    # lower left, lower right, upper right) follows it beside the saucer.
    corners = (424, 120, 424, 340, 510, 285, 510, 66)
    wood = Image.fromarray(photograph("coffee")).transform(
        (128, 256), Image.Transform.QUAD, corners, Image.Resampling.BICUBIC
    )
    grey = np.asarray(wood).astype(np.float64).mean(-1)
    grain = 1 + 0.8 * (grey / gaussian_filter(grey, (12, 20), mode="mirror") - 1)
    boards = []
    for _ in range(rows):
        top = rng.integers(0, 256 - 60)
        strip = grain[top : top + 60][:: rng.choice([-1, 1]), :: rng.choice([-1, 1])]
        board = np.asarray(
            Image.fromarray(strip.astype(np.float32)).resize(
                (SIDE, SIDE // rows), Image.Resampling.BICUBIC
            )
        )
        board = board * rng.uniform(0.8, 1.15)
        joint = int(rng.integers(SIDE - 2))
        board[:, joint : joint + 2] *= 0.45
        board[-1:] *= 0.45
        boards.append(board)
    return _tinted(np.concatenate(boards), color)


def _resized(image: UInt8) -> UInt8:
    whole = Image.fromarray(np.ascontiguousarray(image))
    return np.asarray(whole.resize((SIDE, SIDE), Image.Resampling.LANCZOS))


@cache
def _relief(name: str) -> Float64:
    """(SIDE, SIDE) grey photograph of mean 0 and deviation 1, slow gradients removed."""
    grey = _resized(photograph(name)).astype(np.float64).mean(-1)
    grey = grey - gaussian_filter(grey, SIDE / 4, mode="mirror")
    return grey / grey.std()


def _tinted(factors: Float64, color: Color) -> UInt8:
    """An sRGB colour times (SIDE, SIDE) factors."""
    values = np.clip(factors, 0.1, 2)[..., None] * np.array(color) * 255
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


TILE = 0.55  # length that a copy of a texture covers, metres
BOARDS = 1.1  # the same for wood
KEY = 0.19  # mean of the pictures, linear light

WALLS: tuple[Color, ...] = ((0.86, 0.82, 0.74), (0.74, 0.81, 0.84), (0.80, 0.84, 0.74))
ACCENTS: tuple[Color, ...] = ((0.66, 0.38, 0.29), (0.72, 0.66, 0.58), (0.45, 0.52, 0.60))
WOODS: tuple[Color, ...] = ((0.63, 0.45, 0.30), (0.50, 0.36, 0.25), (0.72, 0.58, 0.42))
RUGS: tuple[Color, ...] = ((0.55, 0.24, 0.22), (0.25, 0.36, 0.50), (0.36, 0.46, 0.30))
COATS: tuple[Color, ...] = (
    (0.80, 0.33, 0.25),
    (0.24, 0.48, 0.56),
    (0.88, 0.71, 0.32),
    (0.38, 0.54, 0.36),
    (0.85, 0.83, 0.80),
    (0.30, 0.28, 0.36),
)


@dataclass(frozen=True, eq=False)
class _Place:
    """A place in the room: its origin, and the angle of its first axis from the world's."""

    origin: ArrayLike
    yaw: float = 0.0

    def world(self, local: ArrayLike) -> Float64:
        """(3,) world position of a place's coordinates."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return self.origin + np.asarray(local) @ [[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]


class _Furnisher:
    """Puts furniture into a scene; ``rng`` draws what comes next."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.build = SceneBuilder(rng, ())
        self.lamps: list[Float64] = []

    def color(self, choices: Sequence[Color]) -> Color:
        """One of the colours, slightly varied."""
        color = np.array(choices[int(self.rng.integers(len(choices)))])
        red, green, blue = np.clip(color * self.rng.uniform(0.92, 1.06, 3), 0, 1).tolist()
        return red, green, blue

    def paint(self, choices: Sequence[Color], *, grain: float = 0.035) -> int:
        """A material of one colour."""
        return self.build.coated(paint(self.color(choices), grain=grain), TILE)

    def tiled(self, name: str, choices: Sequence[Color], *, contrast: float = 0.22) -> int:
        """A material with the relief of a photograph."""
        return self.build.coated(tiled(name, self.color(choices), contrast=contrast), TILE)

    def wood(self) -> int:
        """A material of boards."""
        return self.build.coated(planks(self.color(WOODS), self.rng), BOARDS)

    def box(
        self,
        at: _Place,
        low: ArrayLike,
        high: ArrayLike,
        *,
        material: int,
        cuts: Sequence[tuple[ArrayLike, ArrayLike]] = (),
        shades: bool = True,
    ) -> None:
        """A box between two corners in a place's axes, less boxes between such corners."""
        lowest, highest = np.asarray(low, np.float64), np.asarray(high, np.float64)
        middle = (lowest + highest) / 2
        self.build.solid(
            BOX, at.world(middle), (highest - lowest) / 2, material=material, yaw=at.yaw,
            cuts=[(np.asarray(a) - middle, np.asarray(b) - middle) for a, b in cuts],
            shades=shades,
        )  # fmt: skip

    def on_legs(
        self,
        at: _Place,
        low: ArrayLike,
        high: ArrayLike,
        *,
        board: float,
        leg: float,
        material: int,
    ) -> None:
        """A board on four legs: a box with two tunnels that cross below the board."""
        (x0, y0, z0), (x1, y1, z1) = np.asarray(low), np.asarray(high)
        top = z1 - board
        cuts = [
            ((x0 + leg, y0 - 1, z0 - 1), (x1 - leg, y1 + 1, top)),
            ((x0 - 1, y0 + leg, z0 - 1), (x1 + 1, y1 - leg, top)),
        ]
        self.box(at, low, high, material=material, cuts=cuts)

    def post(self, foot: Float64, radius: float, height: float, *, material: int) -> None:
        """An upright cylinder."""
        half = np.array([radius, radius, height / 2])
        self.build.solid(TUBE, foot + half * [0, 0, 1], half, material=material)

    def ball(self, centre: Float64, radius: float, names: Sequence[str]) -> None:
        """A sphere that shows one of the photographs."""
        image = globe(names[int(self.rng.integers(len(names)))])
        self.build.solid(BALL, centre, [radius] * 3, material=self.build.coated(image, 1.0))

    def face(
        self, at: _Place, middle: ArrayLike, width: float, name: str, *, light: float = 0.0
    ) -> float:
        """A photograph upright on a wall, seen from within the room; returns its height."""
        image, aspect = picture(name)
        half = np.array([width, 0.0, width / aspect]) / 2
        material = self.build.coated(image, 2 * half[[0, 2]], offset=-half[[0, 2]], emission=light)
        # Upright faces show textures unmirrored to who looks along their box's second axis.
        half[1] = 0.008
        self.build.solid(
            BOX, at.world(middle), half, material=material, yaw=at.yaw + np.pi, shades=False
        )
        return 2 * float(half[2])


def furnished_room(seed: int) -> ProceduralScene:
    """The room of a seed: another seed gives other sizes, materials, furniture and pictures."""
    rng = np.random.default_rng([seed, 20])
    room = _Furnisher(rng)
    size = np.array([rng.uniform(5.6, 6.8), rng.uniform(4.8, 5.6), rng.uniform(2.5, 2.9)])
    _shell(room, size)
    _walls(room, size)
    _corners(room, size)
    _middle(room, size)
    light = Light(
        ambient=np.array([[0.40, 0.40, 0.42], [0.66, 0.65, 0.62]]),
        sun=np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]),
        lamps=np.stack(room.lamps),
        reach=3.0,
        shadows=True,
    )
    return ProceduralScene("furnished", room.build.geometry(), room.build.look(light), KEY)


def _shell(room: _Furnisher, size: Float64) -> None:
    """Floor, ceiling and walls, one of them special, and the lamp on the ceiling."""
    rng = room.rng
    floor = (
        room.wood,
        lambda: room.tiled("gravel", ((0.62, 0.60, 0.57), (0.55, 0.50, 0.44))),
        lambda: room.tiled("brick", ((0.62, 0.52, 0.44), (0.58, 0.58, 0.56))),
    )[rng.choice(3, p=(0.6, 0.2, 0.2))]()
    walls = [room.paint(WALLS, grain=0.03)] * 4
    walls[rng.integers(4)] = room.tiled(("brick", "gravel")[rng.integers(2)], ACCENTS, contrast=0.2)
    ceiling = room.build.coated(paint((0.92, 0.91, 0.88), grain=0.015), TILE)
    room.build.room(np.zeros(3), size, [*walls, floor, ceiling])
    panel = room.build.coated(paint((1, 1, 0.97), grain=0.004), TILE, emission=2.4)
    half = np.array([0.65, 0.45, 0]) * rng.uniform(0.8, 1.1)
    middle = _Place(size * [0.5, 0.5, 1])
    room.box(middle, -half - [0, 0, 0.03], half, material=panel, shades=False)
    for x, y in ((-1, -0.5), (-0.4, 0.9), (0, -0.9), (0.5, 0.6), (1, -0.3)):
        place = middle.world(half * [x, y, 0] * 1.3 - [0, 0, 0.06])
        room.lamps.append(np.stack([place, np.array([1.0, 0.95, 0.86]) * 0.3]))


def _walls(room: _Furnisher, size: Float64) -> None:
    """Each wall gets slots; a slot gets one piece of furniture and what hangs above it."""
    rng = room.rng
    names = list(rng.permutation(PICTURES))
    pieces = [_shelf, _cabinet, _crates, _bench, _cabinet, None, _bench, _shelf, _crates]
    pieces = [pieces[i] for i in rng.permutation(len(pieces))]
    window_wall = int(rng.integers(4))
    corners = ((0.0, 0.0), (size[0], 0.0), (size[0], size[1]), (0.0, size[1]))
    for wall, corner in enumerate(corners):
        at = _Place(np.array([*corner, 0.0]), wall * np.pi / 2)
        count = 2 if size[wall % 2] < 5.3 else 3
        room_for = (size[wall % 2] - 1.7) / count
        for slot in range(count):
            start = 0.85 + slot * room_for + rng.uniform(0.05, 0.15)
            width = room_for - rng.uniform(0.25, 0.45)
            spot = _Place(at.world([start + width / 2, 0, 0]), at.yaw)
            if wall == window_wall and slot == count // 2:
                _window(room, spot, min(width, 1.7))
                continue
            piece = pieces.pop() if pieces else None
            top = piece(room, spot, width) if piece else 0.0
            if top < 1.2 and names:
                _hang(room, spot, str(names.pop()))


def _hang(room: _Furnisher, at: _Place, name: str) -> None:
    """A framed photograph."""
    rng = room.rng
    width = min(rng.uniform(0.65, 0.9) * picture(name)[1], 1.25)
    middle = 1.62 + rng.uniform(-0.05, 0.12)
    height = room.face(at, [0, 0.03, middle], width, name)
    wood = room.paint(((0.16, 0.13, 0.11), (0.80, 0.76, 0.68), (0.45, 0.31, 0.20)))
    half = np.array([width, height]) / 2 + 0.045
    room.box(
        at, (-half[0], 0, middle - half[1]), (half[0], 0.03, middle + half[1]),
        material=wood, shades=False,
    )  # fmt: skip


def _window(room: _Furnisher, at: _Place, width: float) -> None:
    """A window onto the launch pad at dusk, with slim bars, and the daylight that it lets in."""
    low, high, thick = 0.85, 0.85 + width / picture("rocket")[1], 0.035
    room.face(at, [0, 0, (low + high) / 2], width, "rocket", light=0.9)
    bar = room.build.coated(paint((0.93, 0.92, 0.90), grain=0.01), TILE)
    middle = low + 0.62 * (high - low)
    x = width / 2
    panes = [
        ((x0 + thick, -1, z0 + thick), (x1 - thick, 1, z1 - thick))
        for x0, x1 in ((-x, thick / 2), (-thick / 2, x))
        for z0, z1 in ((low, middle + thick / 2), (middle - thick / 2, high))
    ]
    room.box(at, (-x, 0, low), (x, 0.06, high), material=bar, cuts=panes, shades=False)
    room.box(at, (-x - 0.1, 0, low - 0.05), (x + 0.1, 0.16, low), material=bar)
    for side in (-0.25, 0.25):
        place = at.world([side * width, 0.2, (low + high) / 2])
        room.lamps.append(np.stack([place, np.array([0.75, 0.88, 1.1]) * 0.35]))


def _shelf(room: _Furnisher, at: _Place, width: float) -> float:
    """A bookcase with rows of books."""
    rng = room.rng
    half, deep, height, board = min(width, 1.15) / 2, 0.3, rng.uniform(1.75, 1.95), 0.03
    levels = np.linspace(0.06, height - board, 5)
    cuts = [
        ((-half + board, 0.02, low + board), (half - board, 1, high))
        for low, high in pairwise(levels)
    ]
    room.box(at, (-half, 0, 0), (half, deep, height), material=room.wood(), cuts=cuts)
    coats = [room.tiled("text", (color,), contrast=0.13) for color in COATS]
    for low in levels[:-1]:
        x = -half + board + rng.uniform(0.0, 0.1)
        while x < half - board - 0.13:
            thick, tall = rng.uniform(0.05, 0.12), rng.uniform(0.22, 0.33)
            room.box(
                at,
                (x, 0.02, low + board),
                (x + thick, deep - rng.uniform(0.03, 0.1), low + board + tall),
                material=coats[rng.integers(len(coats))],
                shades=False,
            )
            x += thick + (rng.uniform(0.1, 0.3) if rng.random() < 0.2 else 0.004)
    return height


def _cabinet(room: _Furnisher, at: _Place, width: float) -> float:
    """A painted chest with two drawers and a round thing on it."""
    rng = room.rng
    half, deep, height = width / 2, rng.uniform(0.4, 0.5), rng.uniform(0.7, 0.85)
    room.box(at, (-half, 0.02, 0), (half, deep, height), material=room.paint(COATS))
    lid = (half + 0.02, deep + 0.03, height + 0.03)
    room.box(at, (-half - 0.02, 0, height), lid, material=room.wood())
    metal = room.paint(((0.2, 0.19, 0.18),))
    for x in (-0.23 * width, 0.23 * width):
        low, high = (x - 0.06, deep, height * 0.62), (x + 0.06, deep + 0.025, height * 0.62 + 0.02)
        room.box(at, low, high, material=metal, shades=False)
    radius = rng.uniform(0.09, 0.14)
    middle = at.world([width * rng.uniform(-0.3, 0.3), deep / 2, height + 0.03 + radius])
    room.ball(middle, radius, ("moon", "retina", "coffee"))
    return height + 0.03 + 2 * radius


def _crates(room: _Furnisher, at: _Place, width: float) -> float:
    """Two or three boxes, one on another."""
    rng = room.rng
    sides = rng.uniform(0.38, 0.52, 3)[: 2 if rng.random() < 0.4 else 3]
    card = room.tiled("text", ((0.72, 0.58, 0.40), (0.66, 0.52, 0.36)), contrast=0.11)
    wood = room.wood()
    for i, side in enumerate(sides):
        foot = at.world([(-0.28, 0.3, -0.25)[i], 0.36, sides[0] if i == 2 else 0.0])
        spot = _Place(foot, at.yaw + rng.uniform(-0.25, 0.25))
        corner = np.array([side / 2, side / 2, side])
        room.box(spot, corner * [-1, -1, 0], corner, material=wood if i == 1 else card)
    return float(sides[0] + (sides[2] if len(sides) == 3 else 0))


def _bench(room: _Furnisher, at: _Place, width: float) -> float:
    """A padded bench on four legs."""
    cloth = room.tiled("grass", RUGS, contrast=0.1)
    half, deep, seat = width / 2, 0.5, 0.42
    room.on_legs(at, (-half, 0.13, 0), (half, deep, seat), board=0.14, leg=0.05, material=cloth)
    room.box(at, (-half, 0.03, seat - 0.14), (half, 0.13, seat + 0.38), material=cloth)
    return seat + 0.38


def _corners(room: _Furnisher, size: Float64) -> None:
    """A column in one corner, a floor lamp in another."""
    rng = room.rng
    inset = 0.42
    spots = [
        np.array([x, y, 0]) for x in (inset, size[0] - inset) for y in (inset, size[1] - inset)
    ]
    first, second = rng.permutation(4)[:2]
    stone = room.tiled(("brick", "gravel")[rng.integers(2)], ACCENTS)
    room.post(spots[first], rng.uniform(0.17, 0.22), float(size[2]), material=stone)
    metal = room.paint(((0.25, 0.24, 0.24),), grain=0.02)
    room.post(spots[second], 0.14, 0.025, material=metal)
    room.post(spots[second], 0.014, 1.45, material=metal)
    shade = room.build.coated(paint((0.93, 0.85, 0.66), grain=0.02), TILE, emission=0.4)
    room.post(spots[second] + [0, 0, 1.4], 0.18, 0.26, material=shade)


def _middle(room: _Furnisher, size: Float64) -> None:
    """A rug, a table with things on it, two chairs."""
    rng = room.rng
    at = _Place(size * [0.5, 0.5, 0], rng.uniform(-0.5, 0.5))
    rug = room.tiled("grass", RUGS, contrast=0.18)
    room.box(at, (-1.15, -0.85, 0), (1.15, 0.85, 0.012), material=rug, shades=False)
    half, deep, top = rng.uniform(0.55, 0.72), rng.uniform(0.36, 0.44), 0.74
    room.on_legs(
        at, (-half, -deep, 0), (half, deep, top), board=0.035, leg=0.05, material=room.wood()
    )
    room.ball(
        at.world([-half * 0.5, deep * 0.2, top + 0.15]), 0.15, ("moon", "retina", "astronaut")
    )
    room.post(at.world([half * 0.1, -deep * 0.5, top]), 0.045, 0.1, material=room.paint(COATS))
    spot = _Place(at.world([half * 0.6, deep * 0.25, top]), at.yaw + rng.uniform(-0.6, 0.6))
    z = 0.0
    for _ in range(3):
        x, y, thick = rng.uniform((0.1, 0.07, 0.025), (0.15, 0.1, 0.05))
        cover = room.tiled("text", COATS, contrast=0.11)
        room.box(spot, (-x, -y, z), (x, y, z + thick), material=cover)
        z += thick
    for side in (-1, 1):
        turn = at.yaw + (np.pi if side > 0 else 0.0) + rng.uniform(-0.35, 0.35)
        _chair(room, _Place(at.world([rng.uniform(-0.2, 0.2), side * (deep + 0.3), 0]), turn))


def _chair(room: _Furnisher, at: _Place) -> None:
    """A chair that faces its second axis."""
    coat = room.paint(COATS, grain=0.04)
    room.on_legs(at, (-0.21, -0.2, 0), (0.21, 0.2, 0.46), board=0.04, leg=0.035, material=coat)
    gaps = [((-0.17, -1, low), (0.17, 1, low + 0.08)) for low in (0.52, 0.68)]
    room.box(at, (-0.21, -0.2, 0.46), (0.21, -0.17, 0.86), material=coat, cuts=gaps)
