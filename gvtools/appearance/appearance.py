"""Pictures of fitted Gaussians, for the pixels that the memory knows.

Gaussians are smooth, with small errors; the memory is sharp, with large errors where its depth is
wrong. The memory's detail is added to the Gaussians' colours where both agree after a blur.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.camera_corrections import Exposures
from gvtools.appearance.free_space import floaters, free_depth
from gvtools.appearance.gaussians import UNREADABLE, Gaussians
from gvtools.appearance.splat.splat import Lens, Splat, median_depth
from gvtools.cameras import Cameras
from gvtools.errors import MemoryFileError
from gvtools.guidance import Guidance
from gvtools.untrusted import load_arrays

# Gaussians show a surface where they stop this share of the light.
SOLID = 0.5
Float32 = NDArray[np.float32]

# Standard deviation of the blur [px].
BLUR = 3.0
# Values of Blend.share and Blend.tolerance that ``best_blend`` compares.
SHARES, TOLERANCES = (0.0, 0.2, 0.35, 0.5, 0.65, 0.8, 1.0), (0.05, 0.1, 0.2, 0.4, 1.0, 4.0)


@dataclass(frozen=True, eq=False)
class Picture:
    """Colours that one camera sees; darker where Gaussians stop less than all of the light.

    Of Gaussians that were fitted before random colours, only where they stop less than SOLID: what
    stops the light has its colour by itself then.
    """

    rgb: NDArray[np.float32]  # (H, W, 3) float32 from 0 to 1
    alpha: NDArray[np.float32]  # (H, W) float32, the share of light that they stop

    @classmethod
    def of(
        cls, splat: Splat, *, gain: NDArray[np.float32] | None = None, backdrop: bool = False
    ) -> Picture:
        """The picture of splatted Gaussians.

        Args:
            gain: (3,) multiplies its red, green and blue.
            backdrop: whether they were fitted before random colours.
        """
        alpha = splat.image[4]
        rgb = splat.image[:3] if gain is None else splat.image[:3] * gain[:, None, None]
        if backdrop:
            rgb = rgb / np.maximum(alpha, np.float32(SOLID))
        rgb = np.clip(rgb, 0, 1).transpose(1, 2, 0)
        return cls(np.ascontiguousarray(rgb), alpha)

    @property
    def solid(self) -> NDArray[np.bool_]:
        """(H, W) pixels that show a surface."""
        return self.alpha > SOLID


def mean_picture(pictures: Sequence[Picture]) -> Picture:
    """The mean of what several fits show.

    >>> dark, light = (
    ...     Picture(np.full((1, 1, 3), grey, np.float32), np.ones((1, 1), np.float32))
    ...     for grey in (0.2, 0.4)
    ... )
    >>> round(float(mean_picture([dark, light]).rgb[0, 0, 0]), 2)
    0.3
    """
    if len(pictures) == 1:
        return pictures[0]
    return Picture(
        np.mean([picture.rgb for picture in pictures], axis=0),
        np.mean([picture.alpha for picture in pictures], axis=0),
    )


@dataclass(frozen=True)
class Blend:
    """How much of the memory's colours is taken."""

    share: float = 0.5  # weight of the memory's colours where both agree after the blur, 0 to 1
    # Difference of the blurred colours (0 to 1) at which the weight has fallen to 37 % (1/e) of
    # that.
    tolerance: float = 0.2

    def __str__(self) -> str:
        detail = f" with {self.share:.0%} of the memory's detail" if self.share else ""
        return f"Gaussians{detail}"


def blend_colors(
    shown: Float32, memory: Float32, where: NDArray[np.bool_], *, blend: Blend
) -> Float32:
    """(H, W, 3) blended colours in the pixels ``where``, the memory's elsewhere; all from 0 to 1.

    >>> shown, everywhere = np.full((9, 9, 3), 0.5, np.float32), np.ones((9, 9), bool)
    >>> alike, unlike = shown + np.float32(0.02), shown + np.float32(0.4)
    >>> blend = Blend(share=1.0, tolerance=0.1)
    >>> round(float(blend_colors(shown, alike, everywhere, blend=blend)[4, 4, 0]), 2)
    0.52
    >>> round(float(blend_colors(shown, unlike, everywhere, blend=blend)[4, 4, 0]), 2)
    0.5
    """
    weight = blend.share * np.exp(-np.square(_difference(shown, memory, where) / blend.tolerance))
    mixed = shown + weight[..., None].astype(np.float32) * (memory - shown)
    return np.where(where[..., None], mixed, memory)


def best_blend(
    samples: Iterable[tuple[Float32, Float32, NDArray[np.bool_], Float32]],
    *,
    most_share: float = 1.0,
    tolerances: tuple[float, float] = (0.0, np.inf),
) -> Blend | None:
    """The blend with the highest mean PSNR on photographs; None without any sample.

    Samples are colours (H, W, 3) of the Gaussians and of the memory, both made without the
    photograph, pixels (H, W) that both know, and the photograph; from 0 to 1. Shares up to
    ``most_share`` are compared, and ``tolerances`` from the first to the last.
    """
    least, most = tolerances
    choices = list(
        product(
            [share for share in SHARES if share <= most_share],
            [tolerance for tolerance in TOLERANCES if least <= tolerance <= most],
        )
    )
    scores = np.zeros(len(choices))
    for shown, memory, where, truth in samples:
        if not where.any():
            continue
        apart = np.square(_difference(shown, memory, where)[where])
        off, detail = (shown - truth)[where], (memory - shown)[where]
        for number, (share, tolerance) in enumerate(choices):
            weight = share * np.exp(-apart / tolerance**2)
            scores[number] -= np.log10(np.square(off + weight[:, None] * detail).mean() + 1e-10)
    return Blend(*choices[int(scores.argmax())]) if scores.any() else None


def _difference(shown: Float32, memory: Float32, where: NDArray[np.bool_]) -> Float32:
    """(H, W) greatest difference of the blurred colours over the pixels ``where``."""
    change = np.dstack([memory - shown, np.ones_like(where, np.float32)])
    change[~where] = 0
    blurred = cv2.GaussianBlur(change, (0, 0), BLUR, borderType=cv2.BORDER_REPLICATE)
    red, green, blue, known = np.abs(blurred).transpose(2, 0, 1)
    most = np.maximum(np.maximum(red, green), blue)
    return np.asarray(most / np.maximum(known, np.float32(1e-3)))


@dataclass(frozen=True, eq=False)
class Appearance:
    """What a scene looks like, beside the memory that knows what was observed."""

    gaussians: Gaussians  # in their frame
    near: float  # nothing nearer is drawn, scene units
    blend: Blend = field(default_factory=Blend)  # how much of the memory's colours is taken
    splatter: type[Splat] = Splat  # draws the Gaussians
    # Of further fits to the same photographs, in the same frame; pictures are averaged.
    others: tuple[Gaussians, ...] = ()
    # Of the photographs, which tell those of other cameras; None takes all as equal.
    exposures: Exposures | None = None
    # (N, 3) points on surfaces, in the Gaussians' frame; what floats before them is not shown,
    # see free_space. None shows all.
    surface: NDArray[np.float32] | None = None
    backdrop: bool = False  # whether random colours were behind them in the fit, see Picture

    @classmethod
    def load(cls, path: Path) -> Appearance:
        """Read the appearance that a run keeps."""
        loaded = Gaussians.load(path)
        try:
            data = load_arrays(path)
            # Earlier versions knew no surfaces, and drew all over black.
            surface = data.setdefault("surface", np.zeros((0, 3), np.float32))
            data.setdefault("backdrop", np.zeros((), np.bool_))
            counts, count = data["counts"], len(data["poses"])
            shapes = {
                "counts": (len(counts),), "near": (), "blend": (2,), "poses": (count, 4, 4),
                "log_gains": (count, 3), "depth": (), "surface": (len(surface), 3), "backdrop": (),
            }  # fmt: skip
            for name, shape in shapes.items():
                array = data[name]
                finite = array.dtype.kind in "fiub" and np.isfinite(array).all()
                if array.shape != shape or not finite:
                    raise ValueError(f"{name} of shape {array.shape}, or not finite")
            if counts.min(initial=0) < 0 or counts.sum() != len(loaded):
                raise ValueError(f"counts {counts} of {len(loaded)} Gaussians")
            first, *others = (
                Gaussians(values, frame=loaded.frame)
                for values in np.split(loaded.values, np.cumsum(counts)[:-1])
            )
            blend = Blend(*data["blend"].tolist())
            exposures = Exposures(data["poses"], data["log_gains"], float(data["depth"]))
            return cls(
                first, float(data["near"]), blend, others=tuple(others),
                exposures=exposures if count else None,
                surface=surface.astype(np.float32) if len(surface) else None,
                backdrop=bool(data["backdrop"]),
            )  # fmt: skip
        except UNREADABLE as error:
            raise MemoryFileError(f"{path}: no readable appearance ({error})") from None

    @property
    def fits(self) -> tuple[Gaussians, ...]:
        """The Gaussians of all fits."""
        return (self.gaussians, *self.others)

    def arrays(self) -> dict[str, Any]:
        """What ``load`` reads, by name."""
        exposures = self.exposures
        return {
            "values": np.concatenate([fit.values for fit in self.fits]),
            "counts": [len(fit) for fit in self.fits],
            "origin": self.gaussians.frame.origin,
            "axes": self.gaussians.frame.axes,
            "near": self.near,
            "surface": np.zeros((0, 3), np.float32) if self.surface is None else self.surface,
            "backdrop": self.backdrop,
            "blend": [self.blend.share, self.blend.tolerance],
            "poses": exposures.poses if exposures else np.zeros((0, 4, 4)),
            "log_gains": exposures.log_gains if exposures else np.zeros((0, 3)),
            "depth": exposures.depth if exposures else 0.0,
        }

    def picture(self, camera: Cameras) -> Picture:
        """What a camera sees, a batch of one: the mean of all fits."""
        return mean_picture(self.pictures(camera))

    def pictures(self, camera: Cameras) -> list[Picture]:
        """What a camera sees, a batch of one, by each fit."""
        pose, lens = self._pose_and_lens(camera)
        gain = self.exposures.at(pose) if self.exposures else None
        drawn = (self.splatter(values, lens) for values in self._shown(lens))
        return [Picture.of(splat, gain=gain, backdrop=self.backdrop) for splat in drawn]

    def recolor(self, guidance: Guidance, picture: Picture) -> Guidance:
        """A guidance of one view with the Gaussians' colours where these show a surface.

        Scans keep their colours. Where memory is generated, as where nothing confirms the
        Gaussians' depth, half as much of its detail is added to Gaussians with a backdrop, none to
        others. Depth, and what is valid, generated and how confident, stays the memory's.
        """
        where = guidance.valid[0] & ~guidance.scanned[0] & picture.solid
        rgb = blend_colors(picture.rgb, guidance.rgb[0], where, blend=self.blend)
        less = (rgb + picture.rgb) / 2 if self.backdrop else picture.rgb
        rgb = np.where((where & guidance.generated[0])[..., None], less, rgb)
        return replace(guidance, rgb=rgb[None])

    def depth(self, camera: Cameras, *, opaque: float = 0.0) -> NDArray[np.float32]:
        """(H, W) z-depth that one camera sees, scene units; 0 where no fit has a surface.

        It is also 0 where they stop at most the share ``opaque`` of the light on average. With
        several fits it is the median of those that have one; with an even number the nearer of the
        middle two, since their mean may be where neither has a surface.
        """
        lens = self._pose_and_lens(camera)[1]
        shown = [Splat(values, lens) for values in self._shown(lens)]
        depths = np.array([median_depth(splat) for splat in shown])
        ordered = np.sort(np.where(depths > 0, depths, np.float32(np.inf)), axis=0)
        middle = np.maximum((depths > 0).sum(axis=0) - 1, 0) // 2
        found = np.take_along_axis(ordered, middle[None], axis=0)[0]
        alpha = np.mean([splat.image[4] for splat in shown], axis=0)
        return np.where(np.isfinite(found) & (alpha > opaque), found, np.float32(0))

    def _pose_and_lens(self, camera: Cameras) -> tuple[NDArray[np.float64], Lens]:
        """The pose in the Gaussians' frame, and the lens there."""
        pose = self.gaussians.frame.cam_from_local(camera.cam_from_world)[0]
        size = (int(camera.width[0]), int(camera.height[0]))
        return pose, Lens.of(pose, camera.K[0], size=size, near=self.near)

    def _shown(self, lens: Lens) -> list[NDArray[np.float32]]:
        """(M, VALUES) of each fit the Gaussians that do not float in the camera's free space."""
        free = None if self.surface is None else free_depth(self.surface, lens)
        every = [fit.values for fit in self.fits]
        if free is None:
            return every
        return [values[~floaters(values, lens, free)] for values in every]
