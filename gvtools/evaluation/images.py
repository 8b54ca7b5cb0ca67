"""Image and depth metrics of one view: PSNR, SSIM, LPIPS and relative depth error, by region.

Beside them stands under which other reading pictures would fit what they stand for far better.

Colours are compared in [0, 1] and in float64; the data range is 1. SSIM is that of Z. Wang et al.,
"Image quality assessment: from error visibility to structural similarity", IEEE TIP 13(4), 2004: a
Gaussian window of sigma 1.5 (11 x 11 pixels), population covariances, constants 0.01 and 0.03. A
figure without a pixel to compare is None, never a number.

LPIPS is that of R. Zhang et al., CVPR 2018, with weights from disk alone. The package ``lpips``
holds the calibrated last layers; no code of it is run, as it needs torchvision, whose compiled
operators often do not fit the installed torch. The network below them is published by torchvision's
authors and has to be on disk: in a folder that is named, or in torch's own cache. Without it there
is no LPIPS, and no other network's distance is given under that name. The layers, and with them the
names in a state dict, are those of torchvision's models: K. Simonyan, A. Zisserman, "Very deep
convolutional networks" (VGG-16), and A. Krizhevsky, "One weird trick for parallelizing
convolutional neural networks" (AlexNet).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.errors import CheckpointError, OptionError, ShapeError
from gvtools.evaluation.statistics import mean_of, median_of
from gvtools.glb import srgb_bytes
from gvtools.optional import package_folder

if TYPE_CHECKING:
    from torch import Tensor, nn

    from gvtools.scenes.scene import Frame

SIGMA, SIDE = 1.5, 11
K1, K2 = 0.01, 0.03
# Nearer to the border, windows would see pixels that are not there.
SSIM_BORDER = SIDE // 2
INNER = (slice(SSIM_BORDER, -SSIM_BORDER),) * 2
# Colours may lie outside [0, 1], as noise does, but not by more than the data range.
LOWEST, HIGHEST = -1.0, 2.0
SMALLEST = 32  # pixels a side, of a picture that LPIPS can be taken of
# Of each: the whole picture, what stands on observations, what a completer made.
REGIONS = ("", "_valid", "_generated")
FIGURES = (
    *(f"{figure}{region}" for region in REGIONS for figure in ("psnr", "ssim", "lpips")),
    "depth_rel_valid",
    "depth_rel_generated",
)


def psnr(image: ArrayLike, truth: ArrayLike, *, mask: ArrayLike | None = None) -> float | None:
    """Peak signal-to-noise ratio, dB, for a peak of 1, where an (H, W) mask is True.

    Images are (H, W, C) floats in [0, 1], or uint8, which stands for 255 times that. The ratio is
    infinite when the compared pixels are equal, and None when there are none.
    """
    first, second, where = _pair(image, truth, mask)
    if where is not None:
        first, second = first[where], second[where]
    return _decibels((first - second) ** 2)


def ssim(
    image: ArrayLike,
    truth: ArrayLike,
    *,
    mask: ArrayLike | None = None,
    sample_covariance: bool = False,
) -> float | None:
    """Structural similarity, -1 to 1: the mean of the SSIM map over the compared pixels.

    The outermost 5 pixels are never compared, with a mask or without, so that a mask of all pixels
    gives the figure of no mask. Windows at the rim of a mask see pixels outside it. Images and mask
    are as of ``psnr``; sample covariances are scikit-image's default and GLD's, the published
    definition has those of the population.
    """
    first, second, where = _pair(image, truth, mask)
    if min(first.shape[:2]) < SIDE:
        raise ShapeError(
            f"SSIM of {first.shape[1]}x{first.shape[0]} pixels; expected at least {SIDE}x{SIDE}"
        )
    return _mean(ssim_map(first, second, sample_covariance=sample_covariance), where)


def image_figures(
    image: ArrayLike, truth: ArrayLike, regions: Mapping[str, ArrayLike | None]
) -> dict[str, dict[str, float | None]]:
    """PSNR and SSIM over several regions of one image, for little more than the price of one.

    A region is an (H, W) mask as of ``psnr``. The SSIM of an image below 11 x 11 pixels is None.
    """
    first, second, _ = _pair(image, truth, None)
    square = ((first - second) ** 2).mean(axis=-1)
    similarity = ssim_map(first, second) if min(first.shape[:2]) >= SIDE else None
    out = {}
    for name, mask in regions.items():
        where = None if mask is None else np.asarray(mask, np.bool_)
        out[name] = {
            "psnr": _decibels(square if where is None else square[where]),
            "ssim": None if similarity is None else _mean(similarity, where),
        }
    return out


def ssim_map(
    image: NDArray[np.float64], truth: NDArray[np.float64], *, sample_covariance: bool = False
) -> NDArray[np.float64]:
    """SSIM of every whole window of (H, W, C) images in [0, 1], averaged over the channels.

    Of (H - 10, W - 10) entries, (i, j) is centred on pixel (i + 5, j + 5).
    """
    import cv2

    def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
        blurred = cv2.GaussianBlur(values, (SIDE, SIDE), SIGMA).reshape(values.shape)
        return np.asarray(blurred[INNER])

    norm = SIDE**2 / (SIDE**2 - 1) if sample_covariance else 1.0
    x, y = mean(image), mean(truth)
    squares = norm * (mean(image**2 + truth**2) - x**2 - y**2)
    product = norm * (mean(image * truth) - x * y)
    top = (2 * x * y + K1**2) * (2 * product + K2**2)
    return np.asarray((top / ((x**2 + y**2 + K1**2) * (squares + K2**2))).mean(axis=-1))


def relative_depth_error(
    depth: ArrayLike, truth: ArrayLike, *, mask: ArrayLike | None = None
) -> float | None:
    """Median of |depth - truth| / truth over the pixels where both are there; None without any.

    Depth maps are (H, W) z-depth in one unit, 0 = none; the mask is as of ``psnr``.
    """
    first, second = np.asarray(depth, np.float64), np.asarray(truth, np.float64)
    with np.errstate(invalid="ignore"):
        both = (first > 0) & (second > 0) & np.isfinite(first) & np.isfinite(second)
    if mask is not None:
        both &= np.asarray(mask, np.bool_)
    return median_of(np.abs(first[both] - second[both]) / second[both])


def view_figures(
    picture: NDArray[Any],
    truth: Frame,
    *,
    observed: NDArray[np.bool_],
    generated: NDArray[np.bool_],
    others: Mapping[str, NDArray[np.bool_]] | None = None,
    depth: ArrayLike | None = None,
    lpips: Lpips | None = None,
) -> dict[str, float | None]:
    """FIGURES of one picture, and those of ``others``; None where there is nothing to compare.

    The picture is uint8, or floats in [0, 1]; holes are black, and count so on the whole picture.
    The truth's mask limits every comparison. Regions are (H, W) bool: ``observed`` stands on
    observations, ``generated`` a completer made, and figures of ``others`` end in ``_NAME``. Depth
    is z-depth, scene units, 0 = none. LPIPS of a region is the mean of the distance's map, which
    has no meaning for regions much smaller than the network's view; pictures below 32 x 32 pixels
    have none.
    """
    use = np.ones(picture.shape[:2], np.bool_) if truth.mask is None else truth.mask
    regions = {"": use, "_valid": observed & use, "_generated": generated & ~observed & use}
    regions |= {f"_{name}": mask & use for name, mask in (others or {}).items()}
    out: dict[str, float | None] = dict.fromkeys(FIGURES)
    for region, figures in image_figures(picture, truth.rgb, regions).items():
        out |= {f"{name}{region}": value for name, value in figures.items()}
    if lpips is not None and min(use.shape) >= SMALLEST:
        if picture.dtype != np.uint8:
            picture = np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8)
        whole, spread = lpips.distance(picture, truth.rgb)
        for region, mask in regions.items():
            out[f"lpips{region}"] = float(spread[mask].mean()) if mask.any() else None
        if use.all():
            out["lpips"] = whole
    if depth is not None and truth.depth is not None:
        for region in ("_valid", "_generated"):
            error = relative_depth_error(depth, truth.depth, mask=regions[region])
            out[f"depth_rel{region}"] = error
    return out


def _mean(similarity: NDArray[np.float64], where: NDArray[np.bool_] | None) -> float | None:
    """Mean of an SSIM map over a mask of the whole image."""
    return mean_of(similarity if where is None else similarity[where[INNER]])


def _decibels(squares: NDArray[np.float64]) -> float | None:
    error = mean_of(squares)
    if not error:
        return None if error is None else float("inf")
    return float(-10 * np.log10(error))


def _pair(
    image: ArrayLike, truth: ArrayLike, mask: ArrayLike | None
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_] | None]:
    first, second = _unit(image), _unit(truth)
    if first.ndim != 3 or first.shape != second.shape:
        raise ShapeError(f"images of {first.shape} and {second.shape}; expected equal (H, W, C)")
    return first, second, None if mask is None else np.asarray(mask, np.bool_)


def _unit(image: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(image)
    if array.dtype == np.uint8:
        return array / 255.0
    if not np.issubdtype(array.dtype, np.floating):
        raise ShapeError(f"an image of {array.dtype}; expected uint8 or floats in [0, 1]")
    low, high = (float(array.min()), float(array.max())) if array.size else (0.0, 1.0)
    # NaN fails both.
    if not (low >= LOWEST and high <= HIGHEST):
        raise ShapeError(f"an image of values from {low:g} to {high:g}; expected floats in [0, 1]")
    return array.astype(np.float64)


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
        self.layers = backbone.build().requires_grad_(False).eval()
        stored = torch.load(file, map_location="cpu", weights_only=True).items()
        prefix = "features."
        own = {key.removeprefix(prefix): v for key, v in stored if key.startswith(prefix)}
        self.layers.load_state_dict(own)
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


Picture = NDArray[np.float32]  # (H, W, 3), 0 to 255
Reading = Callable[[Picture], Picture]

# A reading explains pictures where it leaves at most this share of their squared errors (3 dB).
EXPLAINED = 0.5
# Channels of grey pictures differ by less on average, of 255.
GREY = 2
# Motion is fitted to pictures of this width, in at most so many steps or up to this change.
MOTION_WIDTH, STEPS, CHANGE = 400, 60, 1e-5


def better_reading(pictures: Sequence[NDArray[np.uint8]], truths: Sequence[Frame]) -> str:
    """How pictures seem to be, other than they should be, all in one way; "" if nothing explains.

    Tried are mirrored and turned pictures, exchanged channels, negatives, linear light, one factor
    and offset of brightness, and one motion (shift, size, turn) in the picture.

    >>> truth = np.random.default_rng(0).integers(0, 255, (32, 32, 3), np.uint8)
    >>> from gvtools.scenes.scene import Frame
    >>> better_reading([truth[::-1]], [Frame(truth)])[:48]
    'upside down: otherwise PSNR would be 98.1 dB ins'
    """
    pairs = [
        (picture.astype(np.float32), frame.rgb.astype(np.float32), frame.mask)
        for picture, frame in zip(pictures, truths, strict=True)
        if frame.mask is None or frame.mask.any()
    ]

    def errors(change: Reading) -> NDArray[np.float64]:
        changed = ((change(one).clip(0, 255) - other, mask) for one, other, mask in pairs)
        return np.array([np.square(x if m is None else x[m]).mean() for x, m in changed]) + 1e-5

    readings = dict(FIXED)
    moments = [[x.mean(), x.std(), y.mean(), y.std()] for x, y, _ in pairs]
    dark, narrow, mean, spread = np.median(moments, axis=0) if pairs else np.zeros(4)
    if narrow > 0:
        factor, offset = spread / narrow, mean - spread / narrow * dark
        name = f"of another brightness (fitting times {factor:.3g} {offset:+.3g} of 255)"
        readings[name] = lambda picture: factor * picture + offset
        readings |= _motion(pairs)
    elif pairs:
        return "of one colour alone"
    given = errors(lambda picture: picture)
    left = {name: np.median(errors(change) / given) for name, change in readings.items() if pairs}
    best = min(left, key=left.__getitem__, default="")
    # Of pictures that do not show their truths at all, none.
    if not best or left[best] > EXPLAINED or left[best] * np.median(given) > EXPLAINED * spread**2:
        vivid = [[np.ptp(x, axis=2).mean() for x in pair[:2]] for pair in pairs]
        grey = pairs and 5 * max(own for own, _ in vivid) < 5 * GREY < np.median(vivid, axis=0)[1]
        return "grey, where their views have colour" if grey else ""
    before, after = (-10 * np.log10(np.median(e) / 255**2) for e in (given, errors(readings[best])))
    return f"{best}: otherwise PSNR would be {min(after, 100):.1f} dB instead of {before:.1f}"


FIXED: dict[str, Reading] = {
    "mirrored left to right": lambda picture: picture[:, ::-1],
    "upside down": lambda picture: picture[::-1],
    "turned by 180 degrees": lambda picture: picture[::-1, ::-1],
    "of red and blue exchanged": lambda picture: picture[..., ::-1],
    "negatives": lambda picture: 255 - picture,
    "in linear light, without the curve of sRGB": lambda picture: srgb_bytes(picture / 255).astype(
        np.float32
    ),
}


def _motion(pairs: Sequence[tuple[Picture, Picture, object]]) -> dict[str, Reading]:
    """What undoes the motion that pictures have in common against their truths, by its name."""
    import cv2

    height, width = pairs[0][0].shape[:2]
    scale, found = min(1.0, MOTION_WIDTH / width), []
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, STEPS, CHANGE)
    for one, other, _ in pairs:
        small = [cv2.resize(x, None, None, scale, scale, cv2.INTER_AREA) for x in (other, one)]
        first, second = (cv2.cvtColor(x, cv2.COLOR_RGB2GRAY) for x in small)
        start = np.eye(2, 3, dtype=np.float32)
        try:
            found.append(cv2.findTransformECC(first, second, start, cv2.MOTION_AFFINE, stop)[1])
        except cv2.error:  # the two have nothing in common
            continue
    if not found:
        return {}
    # Of pixels whose first centre is (0, 0), from the small pictures to the whole ones.
    motion = np.median(found, axis=0)
    motion[:, 2] = (motion[:, 2] + 0.5 - motion[:, :2].sum(axis=1) / 2) / scale
    motion[:, 2] += motion[:, :2].sum(axis=1) / 2 - 0.5
    middle = np.array([width - 1, height - 1]) / 2
    right, down = motion[:, :2] @ middle + motion[:, 2] - middle
    larger = np.sqrt(abs(np.linalg.det(motion[:, :2])))

    def undone(picture: Picture) -> Picture:
        flags, border = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, cv2.BORDER_REPLICATE
        moved = cv2.warpAffine(picture, motion, (width, height), None, flags, border)
        return np.asarray(moved, np.float32)

    return {f"shifted ({right:.2g} right, {down:.2g} down) and {larger:.3g} times as large": undone}
