"""The convolutional layers below LPIPS, without torchvision.

The ``lpips`` package takes them from torchvision, whose compiled operators have to match the
installed torch and do not where torch is a CPU build of another channel; no operator is needed
here. The layers, and with them the names in a state dict, are those of torchvision's models:
K. Simonyan, A. Zisserman, "Very deep convolutional networks" (VGG-16), and A. Krizhevsky, "One
weird trick for parallelizing convolutional neural networks" (AlexNet).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import nn

# Channels of the convolutions, "M" for a halving of the resolution.
_VGG16 = (64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512, "M", 512, 512, 512, "M")


def vgg16() -> nn.Sequential:
    """VGG-16's layers before its classifier."""
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
    """AlexNet's layers before its classifier."""
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
        nn.MaxPool2d(3, 2),
    )


@dataclass(frozen=True)
class Backbone:
    """One network that LPIPS is defined on.

    Attributes:
        build: makes its layers.
        model: what the ``lpips`` package calls it in torchvision.
        file: the published weights; the name ends with the first digits of the file's SHA-256.
    """

    build: Callable[[], nn.Sequential]
    model: str
    file: str

    @property
    def url(self) -> str:
        """Where the weights are published."""
        return f"https://download.pytorch.org/models/{self.file}"

    @property
    def digest(self) -> str:
        """How the SHA-256 of the published file begins."""
        return self.file.rsplit("-", 1)[1].split(".")[0]


BACKBONES = {
    "vgg": Backbone(vgg16, "vgg16", "vgg16-397923af.pth"),
    "alex": Backbone(alexnet, "alexnet", "alexnet-owt-7be5be79.pth"),
}
