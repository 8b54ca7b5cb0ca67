"""Frames of an RGB-D recording as odometry wants them: small, with depth, cached."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.features import root_sift
from gvtools.scenes.scene import Scene

if TYPE_CHECKING:
    from open3d.t.geometry import RGBDImage

# Frames are compared at this length of the longer side [px]: 640 takes four times as long and is
# no more exact (7-Scenes clip: errors of positions of 2.4 mm at 640, 2.2 mm at 320).
SIDE = 320
# Features are found at this length of the longer side [px].
FEATURE_SIDE, MAX_FEATURES = 640, 1500
# Side of the thumbnails by which frames are told to look alike [px].
THUMBNAIL = (32, 24)
# Frames in memory at a time, of about 0.7 MB each.
CACHED = 400


@dataclass(frozen=True, eq=False)
class SmallFrame:
    """One frame at the reduced size.

    Attributes:
        image: as Open3D's tensor odometry takes it, depth in metres.
        depth: (h, w) float32 z-depth in metres, 0 = none.
    """

    image: RGBDImage
    depth: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Features:
    """What a frame is recognised by.

    Attributes:
        pixels: (N, 2) at FEATURE_SIDE, the first pixel's centre being (0, 0).
        descriptors: (N, 128) float32, RootSIFT.
        points: (N, 3) in the camera's frame, metres; NaN where there is no depth.
        thumbnail: grey, of zero mean and unit length.
    """

    pixels: NDArray[np.float32]
    descriptors: NDArray[np.float32]
    points: NDArray[np.float64]
    thumbnail: NDArray[np.float64]


class RgbdFrames:
    """The frames of a scene, whose poses are not used.

    Args:
        scene: RGB-D, every view with depth, all of one camera.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        camera = scene.views[0].camera
        self._size = _reduced(camera.width[0], camera.height[0], side=SIDE)
        #: (3, 3) at the reduced size, the first pixel's centre being (0, 0) as Open3D counts.
        self.K = _centre_origin(camera.resized(*self._size).K[0])
        self.feature_size = _reduced(camera.width[0], camera.height[0], side=FEATURE_SIDE)
        #: (3, 3) of the features' pixels.
        self.feature_K = _centre_origin(camera.resized(*self.feature_size).K[0])
        self._frames: OrderedDict[int, SmallFrame] = OrderedDict()
        self._features: dict[int, Features] = {}

    def __len__(self) -> int:
        return len(self.scene)

    def __getitem__(self, index: int) -> SmallFrame:
        """A frame."""
        if index not in self._frames:
            self._frames[index] = self._load(index)
            if len(self._frames) > CACHED:
                self._frames.popitem(last=False)
        self._frames.move_to_end(index)
        return self._frames[index]

    def _load(self, index: int) -> SmallFrame:
        import cv2
        import open3d as o3d

        frame = self.scene.views[index].load()
        assert frame.depth is not None
        rgb = cv2.resize(frame.rgb, self._size, interpolation=cv2.INTER_AREA)
        depth = np.asarray(
            cv2.resize(frame.depth, self._size, interpolation=cv2.INTER_NEAREST), np.float32
        )
        image = o3d.t.geometry.RGBDImage(
            o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(rgb))),
            o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(depth[..., None]))),
        )
        return SmallFrame(image, depth)

    def features(self, index: int) -> Features:
        """What a frame is recognised by; kept, so ask for keyframes alone."""
        if index not in self._features:
            self._features[index] = self._find(index)
        return self._features[index]

    def _find(self, index: int) -> Features:
        import cv2

        frame = self.scene.views[index].load()
        assert frame.depth is not None
        grey = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        grey = cv2.resize(grey, self.feature_size, interpolation=cv2.INTER_AREA)
        depth = cv2.resize(frame.depth, self.feature_size, interpolation=cv2.INTER_NEAREST)
        keypoints, descriptors = cv2.SIFT.create(MAX_FEATURES).detectAndCompute(grey, None)
        thumbnail = _thumbnail(grey)
        if not keypoints:
            empty = np.zeros((0, 3))
            return Features(
                np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), empty, thumbnail
            )
        pixels = np.array([keypoint.pt for keypoint in keypoints], np.float32)
        column, line = np.rint(pixels).astype(int).T
        z = depth[line.clip(0, depth.shape[0] - 1), column.clip(0, depth.shape[1] - 1)]
        rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(self.feature_K).T
        points = rays * np.where(z > 0, z, np.nan)[:, None]
        rooted = root_sift(np.asarray(descriptors, np.float32))
        return Features(pixels, rooted, points, thumbnail)


def _thumbnail(grey: NDArray[Any]) -> NDArray[np.float64]:
    """A grey picture's small copy as a row of zero mean and unit length."""
    import cv2

    small = cv2.resize(grey, THUMBNAIL, interpolation=cv2.INTER_AREA)
    row = np.asarray(cv2.GaussianBlur(small, (0, 0), 1.0), np.float64).ravel()
    row -= row.mean()
    return row / max(float(np.linalg.norm(row)), 1e-9)


def _reduced(width: int, height: int, *, side: int) -> tuple[int, int]:
    scale = min(1.0, side / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def _centre_origin(K: NDArray[np.float64]) -> NDArray[np.float64]:
    """Intrinsics whose first pixel centre is (0.5, 0.5), moved to (0, 0)."""
    moved = K.copy()
    moved[:2, 2] -= 0.5
    return moved
