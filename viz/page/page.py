"""The page to share: Gaussians, cameras and their pictures in one HTML file.

What draws them is ``library.min.js``, which ``packaging/page/bundle.sh`` makes of npm packages; the
page's own script is ``page.js``. Names may come from a user's files: the template escapes them.
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
from gvtools.cameras import Cameras
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.poses.motions import centers_of
from viz.report.pictures import Thumbnail

HERE = Path(__file__).parent
# From the axes of a camera here (right, down, forward) to those of WebGL's (right, up, back).
TO_WEBGL = np.diag([1.0, -1.0, -1.0])
# The farthest that is drawn, in typical depths.
FARTHEST = 1000.0


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
    words: Sequence[NDArray[np.uint32]]  # (N, 4) each, see ``words.pack_gaussians``

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
