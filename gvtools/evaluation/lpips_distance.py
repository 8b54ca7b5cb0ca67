"""LPIPS (R. Zhang et al., CVPR 2018) by the ``lpips`` package, with weights from disk alone.

The package holds the calibrated last layers; the network below them is published by torchvision's
authors and has to be on disk: in a folder that is named, or in torch's own cache. Without it there
is no LPIPS, and no other network's distance is given under that name.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import CheckpointError, OptionError, ShapeError

if TYPE_CHECKING:
    from torch import nn

# Below this, the networks' deepest layers have no pixels.
SMALLEST = 32


class Lpips:
    """The distance of one network; about 0 for equal pictures, up to about 1.

    Args:
        net: "vgg", as view synthesis usually reports, or "alex".
        folder: where the weights are; None looks into torch's cache (``torch.hub.get_dir()``).

    Raises:
        OptionError: an unknown network.
        CheckpointError: the package or the weights are absent, or the file is not the published
            one; the message says which file to put where.
    """

    def __init__(self, net: str = "vgg", *, folder: Path | None = None) -> None:
        from gvtools.evaluation.lpips_backbones import BACKBONES

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

        Raises:
            ShapeError: shapes or types that do not fit.
        """
        return distance(self._model, image, truth)


def find_weights(net: str, folder: Path | None = None) -> Path:
    """The file with the weights of a network below LPIPS.

    Raises:
        CheckpointError: it is not there.
    """
    import torch

    from gvtools.evaluation.lpips_backbones import BACKBONES

    backbone = BACKBONES[net]
    place = Path(folder) if folder is not None else Path(torch.hub.get_dir()) / "checkpoints"
    file = place / backbone.file
    if not file.is_file():
        raise CheckpointError(
            f"LPIPS ({net}): {file} is absent; download {backbone.url} there"
            + ("" if folder is not None else ", or name its folder with --lpips-weights")
        )
    return file


def load_model(net: str, file: Path) -> nn.Module:
    """The package's network on the weights of ``file``.

    Raises:
        CheckpointError: the package is absent, or the file does not hold the network's weights.
    """
    import torch

    from gvtools.evaluation.lpips_backbones import BACKBONES

    backbone = BACKBONES[net]
    try:
        stored = torch.load(file, map_location="cpu", weights_only=True)
        layers = backbone.build()
        prefix = "features."
        own = {k[len(prefix) :]: v for k, v in stored.items() if k.startswith(prefix)}
        layers.load_state_dict(own)
    except Exception as error:
        first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise CheckpointError(
            f"{file}: does not hold the weights of {backbone.model} ({first}); download "
            f"{backbone.url} again"
        ) from error
    with _torchvision_if_whole():
        try:
            import lpips
            from lpips import pretrained_networks
        except ImportError as error:
            raise CheckpointError(
                f"LPIPS: the package lpips is absent ({error}); pip install 'gvtools[lpips]'"
            ) from error
        published = pretrained_networks.tv
        pretrained_networks.tv = SimpleNamespace(
            **{backbone.model: lambda **_: SimpleNamespace(features=layers)}
        )
        try:
            model: nn.Module = lpips.LPIPS(net=net, pnet_rand=True, verbose=False)
        finally:
            pretrained_networks.tv = published
    return model.requires_grad_(False).eval()


def distance(
    model: Any, image: NDArray[np.uint8], truth: NDArray[np.uint8]
) -> tuple[float, NDArray[np.float32]]:
    """See ``Lpips.distance``; ``model`` is from ``load_model``."""
    import torch
    from torch.nn.functional import interpolate

    if image.shape != truth.shape or image.ndim != 3 or image.shape[2] != 3:
        raise ShapeError(f"LPIPS of {image.shape} and {truth.shape}; expected equal (H, W, 3)")
    if min(image.shape[:2]) < SMALLEST or image.dtype != np.uint8 or truth.dtype != np.uint8:
        raise ShapeError(
            f"LPIPS of {image.dtype} {image.shape}; expected uint8, at least "
            f"{SMALLEST}x{SMALLEST} pixels"
        )
    pair = [
        torch.from_numpy(x.copy()).permute(2, 0, 1)[None].float() / 127.5 - 1
        for x in (image, truth)
    ]
    with torch.inference_mode():
        features = [model.net(model.scaling_layer(x)) for x in pair]
        layers = [
            head((_unit(first) - _unit(second)) ** 2)
            for head, first, second in zip(model.lins, *features, strict=True)
        ]
        total = sum(float(layer.mean()) for layer in layers)
        size = image.shape[:2]
        spread = [interpolate(layer, size=size, mode="bilinear")[0, 0] for layer in layers]
    return total, np.sum([layer.numpy() for layer in spread], axis=0)


def _unit(features: Any) -> Any:
    """Features of length 1 at every pixel, as the package normalises them."""
    return features / ((features**2).sum(dim=1, keepdim=True).sqrt() + 1e-10)


@contextmanager
def _torchvision_if_whole() -> Iterator[None]:
    """Lets the package be imported where torchvision is absent or does not fit torch."""
    try:
        import torchvision  # noqa: F401
    except Exception:
        broken = [name for name in sys.modules if name.split(".")[0] == "torchvision"]
        for name in broken:
            del sys.modules[name]
        empty, models = ModuleType("torchvision"), ModuleType("torchvision.models")
        empty.models = models  # type: ignore[attr-defined]
        sys.modules |= {"torchvision": empty, "torchvision.models": models}
        try:
            yield
        finally:
            for name in ("torchvision", "torchvision.models"):
                sys.modules.pop(name, None)
        return
    yield
