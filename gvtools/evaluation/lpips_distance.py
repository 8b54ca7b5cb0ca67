"""LPIPS (R. Zhang et al., CVPR 2018), with weights from disk alone.

The package ``lpips`` holds the calibrated last layers; no code of it is run, as it needs
torchvision, whose compiled operators often do not fit the installed torch. The network below them
is published by torchvision's authors and has to be on disk: in a folder that is named, or in
torch's own cache. Without it there is no LPIPS, and no other network's distance is given under that
name. The layers, and with them the names in a state dict, are those of torchvision's models:
K. Simonyan, A. Zisserman, "Very deep convolutional networks" (VGG-16), and A. Krizhevsky, "One
weird trick for parallelizing convolutional neural networks" (AlexNet).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import CheckpointError, OptionError, ShapeError
from gvtools.evaluation.images import SMALLEST
from gvtools.optional import package_folder

if TYPE_CHECKING:
    from torch import Tensor, nn

# Mean and spread of the colours, in [-1, 1], that the networks were trained with.
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
# Channels of VGG-16's convolutions, 0 for a halving of the resolution.
_VGG16 = (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512)


@dataclass(frozen=True)
class LpipsBackbone:
    """One network that LPIPS is defined on."""

    # Channels, kernel, stride and padding of its convolutions; of a pooling its kernel alone.
    stages: tuple[tuple[int, int, int, int] | int, ...]
    compared: tuple[int, ...]  # numbers of the layers whose output is compared
    file: str  # the published weights; the name ends with the first digits of the file's SHA-256

    @property
    def url(self) -> str:
        """Where the weights are published."""
        return f"https://download.pytorch.org/models/{self.file}"

    def build(self) -> nn.Sequential:
        """Its convolutional layers."""
        from torch import nn

        layers: list[nn.Module] = []
        channels = 3
        for stage in self.stages:
            if isinstance(stage, int):
                layers.append(nn.MaxPool2d(stage, 2))
            else:
                layers += [nn.Conv2d(channels, *stage), nn.ReLU(inplace=True)]
                channels = stage[0]
        return nn.Sequential(*layers)


BACKBONES = {
    "vgg": LpipsBackbone(
        tuple((width, 3, 1, 1) if width else 2 for width in _VGG16),
        (3, 8, 15, 22, 29),
        "vgg16-397923af.pth",
    ),
    "alex": LpipsBackbone(
        ((64, 11, 4, 2), 3, (192, 5, 1, 2), 3, *((width, 3, 1, 1) for width in (384, 256, 256))),
        (1, 4, 7, 9, 11),
        "alexnet-owt-7be5be79.pth",
    ),
}


class Lpips:
    """The distance of one network; about 0 for equal pictures, up to about 1.

    The network is "vgg", as view synthesis usually reports, or "alex"; its weights are in
    ``folder``, or else in torch's cache (``torch.hub.get_dir()``).
    """

    def __init__(self, net: str = "vgg", *, folder: Path | None = None) -> None:
        import torch

        if net not in BACKBONES:
            raise OptionError(f"LPIPS network {net!r}; expected one of {', '.join(BACKBONES)}")
        backbone = BACKBONES[net]
        place = Path(folder) if folder is not None else Path(torch.hub.get_dir()) / "checkpoints"
        file = place / backbone.file
        if not file.is_file():
            raise CheckpointError(
                f"LPIPS ({net}): {file} is absent; download {backbone.url} there"
                + ("" if folder is not None else ", or name its folder with --lpips-weights")
            )
        found = hashlib.sha256(file.read_bytes()).hexdigest()
        expected = backbone.file.rsplit("-", 1)[1].split(".")[0]
        if not found.startswith(expected):
            raise CheckpointError(
                f"{file}: its SHA-256 begins with {found[:8]}, the published file's with "
                f"{expected}; download {backbone.url} again"
            )
        self.net, self._compared = net, backbone.compared
        self.layers = _load_layers(net, file)
        package = package_folder("lpips", extra="lpips", purpose="LPIPS", error=CheckpointError)
        calibrated = package / "weights" / "v0.1" / f"{net}.pth"
        heads = torch.load(calibrated, map_location="cpu", weights_only=True)
        # (1, C, 1, 1) for each compared layer, what its channels weigh.
        self._heads = [heads[f"lin{i}.model.1.weight"] for i in range(len(backbone.compared))]

    def distance(
        self, image: NDArray[np.uint8], truth: NDArray[np.uint8]
    ) -> tuple[float, NDArray[np.float32]]:
        """The distance of two pictures, and where it comes from.

        Args:
            image: (H, W, 3) uint8, at least 32 x 32 pixels.
            truth: likewise.

        Returns:
            The package's distance, and its map (H, W) float32: the layers' maps, upsampled. The
            map's mean differs from the distance by what upsampling changes at the border.
        """
        import torch
        from torch.nn.functional import conv2d, interpolate

        alike = image.shape == truth.shape and image.dtype == truth.dtype == np.uint8
        if not alike or image.shape[2:] != (3,) or min(image.shape[:2]) < SMALLEST:
            raise ShapeError(
                f"LPIPS of {image.dtype} {image.shape} and {truth.dtype} {truth.shape}; expected "
                f"equal uint8 (H, W, 3), at least {SMALLEST}x{SMALLEST} pixels"
            )
        with torch.inference_mode():
            features = zip(self._heads, self._features(image), self._features(truth), strict=True)
            maps = [conv2d((first - second) ** 2, head) for head, first, second in features]
            total = sum(float(layer.mean()) for layer in maps)
            size = image.shape[:2]
            spread = [interpolate(layer, size=size, mode="bilinear")[0, 0] for layer in maps]
        return total, np.sum([layer.numpy() for layer in spread], axis=0)

    def _features(self, picture: NDArray[np.uint8]) -> Iterator[Tensor]:
        """(1, C, h, w) of each compared layer, of length 1 at every pixel."""
        import torch

        x = torch.from_numpy(picture.copy()).permute(2, 0, 1)[None].float() / 127.5 - 1
        x = (x - torch.tensor(SHIFT)[:, None, None]) / torch.tensor(SCALE)[:, None, None]
        for number, layer in enumerate(self.layers):
            x = layer(x)
            if number in self._compared:
                yield x / ((x**2).sum(dim=1, keepdim=True).sqrt() + 1e-10)


def _load_layers(net: str, file: Path) -> nn.Sequential:
    """The convolutional layers with their published weights."""
    import torch

    backbone, prefix = BACKBONES[net], "features."
    try:
        stored = torch.load(file, map_location="cpu", weights_only=True)
        layers = backbone.build().requires_grad_(False).eval()
        own = {k[len(prefix) :]: v for k, v in stored.items() if k.startswith(prefix)}
        layers.load_state_dict(own)
    except Exception as error:
        first = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise CheckpointError(
            f"{file}: does not hold the weights of LPIPS's network {net} ({first}); download "
            f"{backbone.url} again"
        ) from error
    return layers
