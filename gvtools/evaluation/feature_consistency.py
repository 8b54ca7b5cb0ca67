"""Feature consistency of two views: features of one, carried into the other by geometry, compared.

In the manner of MEt3R (M. Asim et al., "MEt3R: Measuring Multi-View Consistency in Generated
Images", CVPR 2025): the mean of 1 - cosine over the overlap; lower is better. MEt3R takes DINO
features and a geometry that MASt3R guesses from the two pictures; here features need no weights,
and depth and cameras are those of the pictures. Features are taken from where each place of the
first view falls in the second, with the occlusion test of `correspond`. The numbers are on another
scale than MEt3R's, which `met3r_score` calls as it is.

A score alone says little: pictures of nothing are consistent, and so are repeats. Beside it stands
what the same network and geometry give for content that does not belong there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import gaussian_filter

from gvtools.cameras import Float64
from gvtools.evaluation.posed_picture import PosedPicture, Seen, correspond

Float32 = NDArray[np.float32]

# Where unrelated content scores less, the features tell nothing apart and neither does the score.
LEAST_SCALE = 0.02
CELL = 4  # pixels
ORIENTATIONS = 8
REACH = 2  # cells between the middles of neighbouring histograms
SMOOTHING = 1.0  # pixels before the gradient, and cells after the histogram
# Descriptor length, in luminance (0 to 1) per pixel, at which structure weighs as much as noise:
# below it the gradients fade instead of being blown up to full length.
NOISE = 0.02
COLOR_WEIGHT = 1.0
# A constant component: two places without any structure are alike.
FLATNESS = 0.3


class DenseGradient:
    """Dense gradient-orientation and colour descriptors, which need no weights.

    For every 4 x 4 pixels, orientation histograms of the luminance gradient in a 3 x 3 layout of
    cells (in the manner of HOG: N. Dalal and B. Triggs, CVPR 2005; and of the dense layout of
    DAISY: E. Tola, V. Lepetit and P. Fua, PAMI 32(5), 2010), beside the local colour. They tell
    edges, their place to a few pixels, and colours; they know nothing of what things are, and an
    in-plane roll or a strong change of scale changes them.
    """

    name = "dense-gradient"

    def features(self, rgb: NDArray[np.uint8]) -> Float32:
        """(76, ceil(H / 4), ceil(W / 4)) features of an (H, W, 3) picture.

        They are 9 x 8 gradient components whose common length is at most 1 and whose mean is 0;
        luminance about mid-grey, red-green and yellow-blue; and the constant.
        """
        height, width = rgb.shape[:2]
        shape = -(-height // CELL), -(-width // CELL)
        image = gaussian_filter(rgb.astype(np.float32) / 255, (SMOOTHING, SMOOTHING, 0))
        cells = _means(_oriented_gradients(image.mean(-1)), shape)
        layout = _neighbours(gaussian_filter(cells, (0, SMOOTHING, SMOOTHING)))
        layout -= layout.mean(0)
        layout /= np.sqrt((layout**2).sum(0) + NOISE**2)
        red, green, blue = gaussian_filter(
            _means(np.moveaxis(image, -1, 0), shape), (0, SMOOTHING, SMOOTHING)
        )
        color = COLOR_WEIGHT * np.stack(
            [(red + green + blue) / 3 - 0.5, red - green, (red + green) / 2 - blue]
        )
        constant = np.full((1, *shape), FLATNESS)
        return np.concatenate([layout, color, constant]).astype(np.float32)


def _oriented_gradients(luminance: Float32) -> Float32:
    """(8, H, W): gradient length, shared linearly between the two nearest signed orientations."""
    along_y, along_x = (
        np.gradient(luminance, axis=axis) if luminance.shape[axis] > 1 else np.zeros_like(luminance)
        for axis in (0, 1)
    )
    length = np.hypot(along_x, along_y)
    turn = np.arctan2(along_y, along_x) * (ORIENTATIONS / (2 * np.pi)) % ORIENTATIONS
    out = np.zeros((ORIENTATIONS, *luminance.shape), np.float32)
    for orientation in range(ORIENTATIONS):
        gap = np.abs(turn - orientation)
        out[orientation] = length * np.clip(1 - np.minimum(gap, ORIENTATIONS - gap), 0, None)
    return out


def _means(channels: Float32, shape: tuple[int, int]) -> Float32:
    """(C, H, W) averaged over a grid of h x w cells that covers it evenly."""
    height, width = channels.shape[1:]
    top = np.arange(shape[0]) * height // shape[0]
    left = np.arange(shape[1]) * width // shape[1]
    total = np.add.reduceat(np.add.reduceat(channels, top, axis=1), left, axis=2)
    area = np.diff(np.append(top, height))[:, None] * np.diff(np.append(left, width))
    return (total / area).astype(np.float32)


def _neighbours(cells: Float32) -> Float32:
    """(C, h, w) to (9 C, h, w): each cell with those ``REACH`` cells away, edges repeated."""
    height, width = cells.shape[1:]
    padded = np.pad(cells, ((0, 0), (REACH, REACH), (REACH, REACH)), mode="edge")
    steps = (0, REACH, 2 * REACH)
    return np.concatenate(
        [padded[:, dy : dy + height, dx : dx + width] for dy in steps for dx in steps]
    )


class FeatureNetwork(Protocol):
    """Turns a picture into features."""

    name: str  # what the score is reported under

    def features(self, rgb: NDArray[np.uint8]) -> Float32:
        """(C, h, w) features of an (H, W, 3) picture, whose h x w cells cover it evenly."""


@dataclass(frozen=True)
class FeatureConsistency:
    """Agreement of the features of two views. Figures that no place stands behind are None."""

    first: str  # name of the view whose places were compared
    second: str  # name of the view whose features were carried there
    network: str
    # "measured", "empty: ..." where nothing could be compared, or "degenerate: ..." where the
    # network tells no content from any other.
    status: str
    score: float | None  # mean of 1 - cosine over the compared places: 0 is equal, lower is better
    overlap: float  # share of the first view's places (cells of its feature map) that were compared
    places: int  # how many
    undefined: int  # co-visible places left out because both features are zero there
    # The score with second's features rolled by half the picture to the right and half downwards:
    # the same colours and structures in the wrong places.
    unrelated: float | None

    @property
    def ok(self) -> bool:
        """Whether the score means something."""
        return self.status == "measured"


def feature_consistency(
    first: PosedPicture,
    second: PosedPicture,
    *,
    network: FeatureNetwork | None = None,
) -> FeatureConsistency:
    """Compare second's features, carried into first by depth and cameras, with first's.

    Both pictures need depth, second for the occlusion test. The network is `DenseGradient` unless
    another is given.
    """
    network = network or DenseGradient()
    ours, theirs = network.features(first.rgb), network.features(second.rgb)
    where = _places(first, ours)
    found = correspond(first, second, where=where)
    on = found.seen == Seen.COVISIBLE
    here = found.start[on] / (first.camera.width[0], first.camera.height[0])
    there = found.xy[on] / (second.camera.width[0], second.camera.height[0])
    own = _sample(ours, here)
    score, undefined = _dissimilarity(own, _sample(theirs, there))
    rolled = np.roll(theirs, [n // 2 for n in theirs.shape[1:]], (1, 2))
    unrelated, _ = _dissimilarity(own, _sample(rolled, there))
    if score is None and first.depth is not None and second.depth is not None:
        status = f"empty: {first.name} and {second.name} have no co-visible place with features"
    elif score is None:
        status = f"empty: {first.name if first.depth is None else second.name} has no depth"
    elif unrelated is not None and unrelated < LEAST_SCALE:
        status = (
            f"degenerate: {network.name} gives unrelated content {unrelated:.3g}; it tells nothing "
            "apart here"
        )
    else:
        status = "measured"
    compared = len(here) - undefined
    return FeatureConsistency(
        first=first.name,
        second=second.name,
        network=network.name,
        status=status,
        score=score if status == "measured" else None,
        overlap=compared / int(where.sum()),
        places=compared,
        undefined=undefined,
        unrelated=unrelated,
    )


@dataclass(frozen=True)
class Met3rScore:
    """What the original MEt3R says of two pictures."""

    first: str  # name of a view
    second: str  # name of the other
    status: str  # "measured", or "empty: ..." where MEt3R finds no overlap
    score: float | None  # lower is better; None unless measured
    overlap: float  # share of the first picture that MEt3R compares


def load_met3r(size: int = 256) -> tuple[Callable[..., Any] | None, str]:
    """The original ``met3r.MEt3R`` with its own defaults (on the GPU if there is one), and "ready".

    Without it, None and "unavailable: ..." with what is lacking. Making it fetches its weights. The
    size is in pixels, a multiple of 16.
    """
    import torch

    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        from met3r import MEt3R

        return MEt3R(img_size=size).to(device).eval(), "ready"
    except ImportError as error:
        return None, (
            f"unavailable: {error}; MEt3R needs PyTorch3D, FeatUp and "
            "`pip install git+https://github.com/mohammadasim98/met3r`"
        )
    except (OSError, RuntimeError) as error:
        return None, f"unavailable: MEt3R could not be made ({error}); check its weights"


def met3r_score(
    first: PosedPicture, second: PosedPicture, metric: Callable[..., Any], *, size: int = 256
) -> Met3rScore:
    """The original MEt3R of two pictures, by a module that was made for ``size``.

    The largest centred square of each picture, resampled to ``size``, goes in; cameras, depth and
    masks do not. MEt3R gives 0 (its best) where the pictures do not overlap; here that is None.
    """
    import torch

    device = torch.device("cpu")
    if isinstance(metric, torch.nn.Module):
        device = next((weight.device for weight in metric.parameters()), device)
    pair = torch.from_numpy(np.stack([_square(first.rgb, size), _square(second.rgb, size)])[None])
    with torch.no_grad():
        score, mask, *_ = metric(
            images=pair.to(device),
            return_overlap_mask=True,
            return_score_map=False,
            return_projections=False,
        )
    overlap = float(mask.float().mean())
    empty = overlap == 0
    status = "empty: MEt3R finds no overlap" if empty else "measured"
    value = None if empty else float(score.mean())
    return Met3rScore(first.name, second.name, status, value, overlap)


def _places(picture: PosedPicture, features: Float32) -> NDArray[np.bool_]:
    """(H, W) bool: the pixel in the middle of each cell of the feature map."""
    size, cells = picture.rgb.shape[:2], features.shape[1:]
    middle = [
        ((np.arange(count) + 0.5) * length / count).astype(np.int64)
        for length, count in zip(size, cells, strict=True)
    ]
    where = np.zeros(size, np.bool_)
    where[np.ix_(*middle)] = True
    return where


def _sample(features: Float32, places: Float64) -> Float64:
    """(N, C) features at places given as shares of width and height, bilinear, edges repeated."""
    import torch
    from torch.nn.functional import grid_sample

    given = torch.from_numpy(features.astype(np.float64))[None]
    grid = torch.from_numpy(2 * places - 1)[None, None]
    found = grid_sample(given, grid, padding_mode="border", align_corners=False)
    return found[0, :, 0].T.numpy()


def _dissimilarity(first: Float64, second: Float64) -> tuple[float | None, int]:
    """Mean of 1 - cosine of (N, C) rows, and how many are left out, both being zero.

    A feature against nothing has cosine 0.
    """
    lengths = np.linalg.norm(first, axis=1), np.linalg.norm(second, axis=1)
    defined = (lengths[0] > 0) | (lengths[1] > 0)
    if not defined.any():
        return None, int((~defined).sum())
    product = (lengths[0] * lengths[1])[defined]
    dot = np.einsum("nc,nc->n", first, second)[defined]
    cosine = np.divide(dot, product, out=np.zeros_like(dot), where=product > 0)
    return float(np.mean(1 - np.clip(cosine, -1, 1))), int((~defined).sum())


def _square(rgb: NDArray[np.uint8], size: int) -> Float32:
    """(3, size, size) float32 in [-1, 1]: the largest centred square, resampled."""
    height, width = rgb.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    square = Image.fromarray(np.ascontiguousarray(rgb[top : top + side, left : left + side]))
    pixels = np.asarray(square.resize((size, size), Image.Resampling.BICUBIC), np.float32)
    return np.ascontiguousarray(pixels.transpose(2, 0, 1)) / 127.5 - 1
