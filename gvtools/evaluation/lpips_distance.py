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
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import CheckpointError, OptionError, ShapeError
from gvtools.optional import package_folder

if TYPE_CHECKING:
    from torch import Tensor, nn

# Below this, the networks' deepest layers have no pixels.
SMALLEST = 32
# Mean and spread of the colours, in [-1, 1], that the networks were trained with.
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
# Channels of VGG-16's convolutions, "M" for a halving of the resolution.
_VGG16 = (64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512, "M", 512, 512, 512)


def vgg16() -> nn.Sequential:
    """VGG-16's convolutional layers."""
    from torch import nn

    layers: list[nn.Module] = []
    channels = 3
    for width in _VGG16:
        if isinstance(width, str):
            layers.append(nn.MaxPool2d(2, 2))
            continue
        layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU(inplace=True)]
        channels = width
    return nn.Sequential(*layers)


def alexnet() -> nn.Sequential:
    """AlexNet's convolutional layers."""
    from torch import nn

    return nn.Sequential(
        nn.Conv2d(3, 64, 11, stride=4, padding=2),
        nn.ReLU(inplace=True),
        nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, padding=2),
        nn.ReLU(inplace=True),
        nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, padding=1),
        nn.ReLU(inplace=True),
        nn.Conv2d(384, 256, 3, padding=1),
        nn.ReLU(inplace=True),
        nn.Conv2d(256, 256, 3, padding=1),
        nn.ReLU(inplace=True),
    )


@dataclass(frozen=True)
class LpipsBackbone:
    """One network that LPIPS is defined on."""

    build: Callable[[], nn.Sequential]  # makes its layers
    compared: tuple[int, ...]  # numbers of the layers whose output is compared
    file: str  # the published weights; the name ends with the first digits of the file's SHA-256

    @property
    def url(self) -> str:
        """Where the weights are published."""
        return f"https://download.pytorch.org/models/{self.file}"

    @property
    def digest(self) -> str:
        """How the SHA-256 of the published file begins."""
        return self.file.rsplit("-", 1)[1].split(".")[0]


BACKBONES = {
    "vgg": LpipsBackbone(vgg16, (3, 8, 15, 22, 29), "vgg16-397923af.pth"),
    "alex": LpipsBackbone(alexnet, (1, 4, 7, 9, 11), "alexnet-owt-7be5be79.pth"),
}


@dataclass(frozen=True, eq=False)
class LpipsModel:
    """A network with its weights."""

    layers: nn.Sequential  # the convolutional ones
    compared: tuple[int, ...]  # numbers of those whose output is compared
    heads: Sequence[Tensor]  # (1, C, 1, 1) for each of these, what its channels weigh


class Lpips:
    """The distance of one network; about 0 for equal pictures, up to about 1.

    The network is "vgg", as view synthesis usually reports, or "alex"; its weights are in
    ``folder``, or else in torch's cache (``torch.hub.get_dir()``).
    """

    def __init__(self, net: str = "vgg", *, folder: Path | None = None) -> None:
        if net not in BACKBONES:
            raise OptionError(f"LPIPS network {net!r}; expected one of {', '.join(BACKBONES)}")
        self.net = net
        file = find_weights(net, folder)
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
        if not digest.startswith(BACKBONES[net].digest):
            raise CheckpointError(
                f"{file}: its SHA-256 begins with {digest[:8]}, the published file's with "
                f"{BACKBONES[net].digest}; download {BACKBONES[net].url} again"
            )
        self._model = load_model(net, file)

    def distance(
        self, image: NDArray[np.uint8], truth: NDArray[np.uint8]
    ) -> tuple[float, NDArray[np.float32]]:
        """The distance, and where it comes from.

        Args:
            image: (H, W, 3) uint8, at least 32 x 32 pixels.
            truth: likewise.

        Returns:
            The package's distance, and its map (H, W) float32: the layers' maps, upsampled. The
            map's mean differs from the distance by what upsampling changes at the border.
        """
        return distance(self._model, image, truth)


def find_weights(net: str, folder: Path | None = None) -> Path:
    """The file with the weights of a network below LPIPS."""
    import torch

    backbone = BACKBONES[net]
    place = Path(folder) if folder is not None else Path(torch.hub.get_dir()) / "checkpoints"
    file = place / backbone.file
    if not file.is_file():
        raise CheckpointError(
            f"LPIPS ({net}): {file} is absent; download {backbone.url} there"
            + ("" if folder is not None else ", or name its folder with --lpips-weights")
        )
    return file


def load_model(net: str, file: Path) -> LpipsModel:
    """The network on the weights of ``file``, with the package's last layers."""
    import torch

    backbone = BACKBONES[net]
    try:
        stored = torch.load(file, map_location="cpu", weights_only=True)
        layers = backbone.build().requires_grad_(False).eval()
        prefix = "features."
        own = {k[len(prefix) :]: v for k, v in stored.items() if k.startswith(prefix)}
        layers.load_state_dict(own)
    except Exception as error:
        first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise CheckpointError(
            f"{file}: does not hold the weights of LPIPS's network {net} ({first}); download "
            f"{backbone.url} again"
        ) from error
    package = package_folder("lpips", extra="lpips", purpose="LPIPS", error=CheckpointError)
    calibrated = package / "weights" / "v0.1" / f"{net}.pth"
    heads = torch.load(calibrated, map_location="cpu", weights_only=True)
    names = [f"lin{number}.model.1.weight" for number in range(len(backbone.compared))]
    return LpipsModel(layers, backbone.compared, [heads[name] for name in names])


def distance(
    model: LpipsModel, image: NDArray[np.uint8], truth: NDArray[np.uint8]
) -> tuple[float, NDArray[np.float32]]:
    """See ``Lpips.distance``; ``model`` is from ``load_model``."""
    import torch
    from torch.nn.functional import conv2d, interpolate

    if image.shape != truth.shape or image.ndim != 3 or image.shape[2] != 3:
        raise ShapeError(f"LPIPS of {image.shape} and {truth.shape}; expected equal (H, W, 3)")
    if min(image.shape[:2]) < SMALLEST or image.dtype != np.uint8 or truth.dtype != np.uint8:
        raise ShapeError(
            f"LPIPS of {image.dtype} {image.shape}; expected uint8, at least "
            f"{SMALLEST}x{SMALLEST} pixels"
        )
    with torch.inference_mode():
        maps = [
            conv2d((first - second) ** 2, head)
            for head, first, second in zip(
                model.heads, _features(model, image), _features(model, truth), strict=True
            )
        ]
        total = sum(float(layer.mean()) for layer in maps)
        size = image.shape[:2]
        spread = [interpolate(layer, size=size, mode="bilinear")[0, 0] for layer in maps]
    return total, np.sum([layer.numpy() for layer in spread], axis=0)


def _features(model: LpipsModel, picture: NDArray[np.uint8]) -> Iterator[Tensor]:
    """(1, C, h, w) of each compared layer, of length 1 at every pixel."""
    import torch

    x = torch.from_numpy(picture.copy()).permute(2, 0, 1)[None].float() / 127.5 - 1
    x = (x - torch.tensor(SHIFT)[:, None, None]) / torch.tensor(SCALE)[:, None, None]
    for number, layer in enumerate(model.layers):
        x = layer(x)
        if number in model.compared:
            yield x / ((x**2).sum(dim=1, keepdim=True).sqrt() + 1e-10)
