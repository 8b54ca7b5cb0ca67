"""The page to share: Gaussians, cameras and their pictures in one HTML file.

What draws them is ``library.min.js``, which ``packaging/page/bundle.sh`` makes of npm packages; the
page's own script is ``page.js``. Names may come from a user's files: the template escapes them.

Gaussians are kept as Spark's ``ExtSplats``, arrays of 32-bit words, four a Gaussian: positions in
single precision, opacities, colours and logarithms of sizes in half precision, rotations in 32
bits, and of harmonics above degree 0 three 8-bit magnitudes with one exponent and three signs.
Spark's own reader of PLYs takes the exponent one too small and cuts coefficients off, which costs
0.3 dB; here it is the right one.
"""

from __future__ import annotations

import base64
import gzip
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gvtools.appearance.camera_corrections import COUNT, SHIFT, TURN, Exposures
from gvtools.appearance.splat.project_kernels import HARMONICS
from gvtools.cameras import Cameras
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.poses.motions import centers_of
from viz.report.pictures import Thumbnail

HERE = Path(__file__).parent
# From the axes of a camera here (right, down, forward) to those of WebGL's (right, up, back).
TO_WEBGL = np.diag([1.0, -1.0, -1.0])
# The farthest that is drawn, in typical depths.
FARTHEST = 1000.0
# Arrays of harmonics: which coefficients above degree 0 each holds, by the degree that needs it.
PARTS = ((0, 4), (4, 8), (8, 12), (12, 15))
PARTS_OF_DEGREE = (0, 1, 2, 4)
# Steps of a rotation's axis and angle, and of a coefficient; what exponents are counted from.
AXIS, ANGLE, MAGNITUDE, BIAS = 1023, 4095, 255, 15
# The largest number in half precision.
MOST = 65504.0

Float32 = NDArray[np.float32]
Words = NDArray[np.uint32]


@dataclass(frozen=True, eq=False)
class PageCamera:
    """A camera to fly to."""

    camera: Cameras  # a batch of one, world frame
    picture: Thumbnail | None = None

    @property
    def name(self) -> str:
        """Its view's."""
        return self.camera.names[0]

    def view(self, origin: NDArray[np.float64]) -> dict[str, list[float]]:
        """Position, turn and lens as ``page.js`` has them; positions count from ``origin``."""
        pose, K = self.camera.world_from_cam[0], self.camera.K[0]
        lens = np.array([self.camera.width[0], K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
        lens = lens / self.camera.height[0]
        turn = Rotation.from_matrix(pose[:3, :3] @ TO_WEBGL).as_quat()
        return {
            "position": (pose[:3, 3] - origin).tolist(),
            "turn": turn.tolist(),
            "lens": lens.tolist(),
        }


@dataclass(frozen=True, eq=False)
class PageGroup:
    """Gaussians of one round and source."""

    round: int
    generated: bool
    fitted: bool  # to photographs, so that exposures count; else points
    words: Sequence[NDArray[np.uint32]]  # (N, 4) each, see ``pack_gaussians``

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self.words[0])

    @property
    def packed(self) -> str:
        """The words as the page holds them."""
        data = b"".join(each.astype("<u4").tobytes() for each in self.words)
        return base64.b64encode(gzip.compress(data, 6, mtime=0)).decode("ascii")


@dataclass(frozen=True, kw_only=True, eq=False)
class SharedPage:
    """All that the page shows."""

    title: str
    summary: str
    groups: Sequence[PageGroup]  # positions count from ``origin``
    cameras: Sequence[PageCamera]
    start: PageCamera  # where the page opens
    origin: NDArray[np.float64]  # (3,) world frame
    up: NDArray[np.float64]  # (3,) unit vector, world frame
    depth: float  # typical, scene units
    near: float  # nothing nearer is drawn, scene units
    mip: bool = False  # whether the low-pass keeps a Gaussian's light, as files may ask for
    backdrop: bool = False  # whether colours are of what stops the light, see Appearance
    # Of the photographs, in the frame ``exposed_in``; None takes all as equal.
    exposures: Exposures | None = None
    exposed_in: LocalFrame | None = None

    @property
    def rounds(self) -> list[int]:
        """Rounds up to the last that something came with."""
        return list(range(max(group.round for group in self.groups) + 1))

    @property
    def mixed(self) -> bool:
        """Whether there is both observed and generated content."""
        return len({group.generated for group in self.groups}) == 2

    @property
    def data(self) -> dict[str, Any]:
        """What ``page.js`` reads."""
        return {
            "up": self.up.tolist(),
            "depth": self.depth,
            "near": self.near,
            "mip": self.mip,
            "backdrop": self.backdrop,
            "far": FARTHEST * self.depth,
            "rounds": self.rounds,
            "start": self.start.view(self.origin),
            "cameras": [each.view(self.origin) for each in self.cameras],
            "exposures": self._exposures(),
        }

    def _exposures(self) -> dict[str, Any] | None:
        """What predicts a view's exposure, see ``Exposures.at``."""
        exposures, frame = self.exposures, self.exposed_in
        if exposures is None or frame is None or exposures.shrinkage == 0:
            return None
        poses = frame.cam_from_world(exposures.poses)
        logs = exposures.shrinkage * exposures.log_gains
        return {
            "shift": SHIFT * exposures.depth,
            "turn": TURN,
            "count": COUNT,
            "of": [
                {"position": (center - self.origin).tolist(), "forward": pose[2, :3].tolist(),
                 "log": log.tolist()}
                for center, pose, log in zip(centers_of(poses), poses, logs, strict=True)
            ],
        }  # fmt: skip


def page_html(page: SharedPage) -> str:
    """The page."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        loader=FileSystemLoader(HERE), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    parts = {"style": "page.css", "script": "page.js", "library": "library.min.js",
             "licence": "library.LICENSE.txt"}  # fmt: skip
    own = {key: Markup((HERE / name).read_text("utf-8")) for key, name in parts.items()}
    return environment.get_template("page.html").render(page=page, **own)


def pack_gaussians(
    positions: Float32,
    *,
    log_scales: Float32,
    quaternions: Float32,
    logits: Float32,
    harmonics: Float32,
) -> list[Words]:
    """Two arrays (N, 4), and as many for harmonics (N, H, 3) as their degree needs.

    Quaternions are w, x, y, z of length 1, opacities before the sigmoid.
    """
    opacity = 1 / (1 + np.exp(-logits.astype(np.float64)))
    color = 0.5 + HARMONICS[0] * harmonics[:, 0]
    numbers = np.concatenate([color, log_scales], axis=1).clip(-MOST, MOST)
    halves = numbers.astype("<f2").view("<u2").astype(np.uint32)
    first = np.empty((len(positions), 4), np.uint32)
    first[:, :3] = positions.astype("<f4").view("<u4")
    first[:, 3] = opacity.astype("<f2").view("<u2")
    second = np.empty_like(first)
    second[:, :3] = halves[:, ::2] | halves[:, 1::2] << 16
    second[:, 3] = _turns(quaternions)
    above = _shared_exponents(harmonics[:, 1:])
    degree = round(harmonics.shape[1] ** 0.5) - 1
    rest = []
    for start, stop in PARTS[: PARTS_OF_DEGREE[degree]]:
        part = np.zeros_like(first)
        part[:, : above[:, start:stop].shape[1]] = above[:, start:stop]
        rest.append(part)
    return [first, second, *rest]


def _turns(quaternions: Float32) -> Words:
    """(N,) axes by an octahedron, 10 bits each of two numbers, and 12 bits of the angle."""
    q = quaternions.astype(np.float64)
    q = np.where(q[:, :1] < 0, -q, q)
    length = np.linalg.norm(q[:, 1:], axis=1, keepdims=True)
    axis = np.where(length > 0, q[:, 1:] / np.where(length > 0, length, 1), (1.0, 0.0, 0.0))
    x, y, z = (axis / np.abs(axis).sum(axis=1, keepdims=True)).T
    # The lower half is folded outwards.
    u = np.where(z < 0, (1 - np.abs(y)) * np.where(x >= 0, 1, -1), x)
    v = np.where(z < 0, (1 - np.abs(x)) * np.where(y >= 0, 1, -1), y)
    angle = 2 * np.arctan2(length[:, 0], q[:, 0])
    steps = [
        np.rint(AXIS * (u + 1) / 2),
        np.rint(AXIS * (v + 1) / 2),
        np.rint(ANGLE * angle / np.pi),
    ]
    low, middle, high = (step.astype(np.uint32) for step in steps)
    return low | middle << 10 | high << 20


def _shared_exponents(coefficients: Float32) -> Words:
    """(N, K) of coefficients (N, K, 3)."""
    size = np.abs(coefficients.astype(np.float64))
    # 2 to this power is above the largest of the three.
    power = np.clip(np.frexp(size.max(axis=2))[1], -BIAS, 31 - BIAS)
    steps = np.minimum(np.rint(MAGNITUDE * np.ldexp(size, -power[..., None])), MAGNITUDE)
    red, green, blue = np.moveaxis(steps.astype(np.uint32), 2, 0)
    signs = (coefficients < 0).astype(np.uint32) << np.arange(3, dtype=np.uint32)
    exponents = (power + BIAS).astype(np.uint32) << 3 | signs.sum(axis=2, dtype=np.uint32)
    return red | green << 8 | blue << 16 | exponents << 24
