"""Local features: what a matcher has to do, and SIFT with mutual nearest neighbours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr

from gvtools.errors import ShapeError
from gvtools.evaluation.consistency.colmap_matching import quiet_colmap
from gvtools.settings import Settings

# Lightness of BT.601, as grey pictures are commonly made for SIFT.
LUMA = np.array([0.299, 0.587, 0.114], np.float32)


@dataclass(frozen=True, eq=False)
class Features:
    """Keypoints of one picture, the most prominent first.

    Attributes:
        xy: (N, 2) float64, pixels; the first pixel's centre is (0.5, 0.5).
        descriptors: (N, D) float32 of unit length: their products are cosines.
        width: of the picture, pixels.
        height: of the picture, pixels.
    """

    xy: NDArray[np.float64]
    descriptors: NDArray[np.float32]
    width: int
    height: int

    def __post_init__(self) -> None:
        count = len(self.xy)
        if self.xy.shape != (count, 2) or len(self.descriptors) != count:
            raise ShapeError(
                f"features: xy {self.xy.shape} and descriptors {self.descriptors.shape}; "
                "expected (N, 2) and (N, D)"
            )

    def __len__(self) -> int:
        return len(self.xy)

    def __getitem__(self, rows: slice | NDArray[Any]) -> Features:
        """The features of ``rows``: a slice, indices or a mask."""
        return Features(self.xy[rows], self.descriptors[rows], self.width, self.height)


class FeatureMatcher(Protocol):
    """Finds keypoints of a picture, and which of them show the same thing in two pictures."""

    def extract(self, rgb: NDArray[np.uint8]) -> Features:
        """The keypoints of a picture, the most prominent first.

        Args:
            rgb: (H, W, 3) uint8.
        """
        ...

    def match(self, first: Features, second: Features) -> NDArray[np.int64]:
        """(M, 2) int64: rows of ``first`` and of ``second`` that show the same thing."""
        ...


class SiftMatcher(Settings):
    """SIFT through pycolmap, matched by mutual nearest neighbours and the ratio test.

    The detector is COLMAP's (VLFeat's, on a picture of twice the size); descriptors are RootSIFT
    (R. Arandjelović and A. Zisserman, "Three things everyone should know to improve object
    retrieval", CVPR 2012). The ratio test is that of D. Lowe, IJCV 60(2), 2004, section 7.1.
    """

    section = "sift"

    max_features: int = Field(3000, ge=1)
    """Of a picture; those of the largest scale are kept."""
    ratio: float = Field(0.8, gt=0, le=1)
    """A match is kept when its distance is below this share of the second nearest's."""
    max_distance: float = Field(0.7, gt=0, le=2)
    """Between the unit descriptors of a match (0.7 is COLMAP's)."""
    _extractor: list[Any] = PrivateAttr(default_factory=list)

    def extract(self, rgb: NDArray[np.uint8]) -> Features:
        """The keypoints of a picture, those of the largest scale first.

        Args:
            rgb: (H, W, 3) uint8.
        """
        if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
            raise ShapeError(f"SIFT of {rgb.dtype} {rgb.shape}; expected uint8 (H, W, 3)")
        height, width = rgb.shape[:2]
        grey = np.rint(rgb.astype(np.float32) @ LUMA).astype(np.uint8)
        keypoints, described = self._sift().extract_from_uint8_array(grey)
        rows = np.array([(p.x, p.y, p.compute_scale()) for p in keypoints], np.float64)
        rows = rows.reshape(-1, 3)
        order = np.argsort(-rows[:, 2], kind="stable")[: self.max_features]
        descriptors = np.asarray(described.data, np.float32).reshape(len(rows), 128)[order]
        length = np.linalg.norm(descriptors, axis=1, keepdims=True)
        return Features(rows[order, :2], descriptors / np.maximum(length, 1e-12), width, height)

    def match(self, first: Features, second: Features) -> NDArray[np.int64]:
        """(M, 2) int64: rows of ``first`` and of ``second`` that are each other's nearest."""
        return mutual_nearest(
            first.descriptors, second.descriptors, ratio=self.ratio, max_distance=self.max_distance
        )

    def _sift(self) -> Any:
        """The extractor, made once; its creation is no news."""
        import pycolmap

        if not self._extractor:
            options = pycolmap.FeatureExtractionOptions()
            options.use_gpu = False
            options.sift.max_num_features = max(8192, self.max_features)
            with quiet_colmap():
                self._extractor.append(
                    pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
                )
        return self._extractor[0]


def mutual_nearest(
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    *,
    ratio: float = 0.9,
    max_distance: float = 2.0,
) -> NDArray[np.int64]:
    """Pairs of unit descriptors that are each other's nearest and pass the ratio test.

    Args:
        first: (N, D).
        second: (M, D).
        ratio: largest distance to the nearest, as a share of that to the second nearest.
        max_distance: largest distance to the nearest.

    Returns:
        (K, 2) int64: rows of ``first``, ascending, and of ``second``.
    """
    import torch

    if not len(first) or len(second) < 2:
        return np.zeros((0, 2), np.int64)
    cosine = torch.from_numpy(first) @ torch.from_numpy(second).T
    values, columns = cosine.topk(2, dim=1)
    column = columns[:, 0].numpy()
    back = cosine.argmax(dim=0).numpy()
    rows = np.arange(len(first))
    distance, other = (np.sqrt(np.maximum(2 - 2 * c, 0)) for c in values.numpy().T)
    keep = (back[column] == rows) & (distance <= max_distance) & (distance < ratio * other)
    return np.stack([rows[keep], column[keep]], axis=1)
