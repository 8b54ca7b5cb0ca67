"""A recorded photograph with what lies beside it, brought into its pinhole camera."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import ROTATION_ROUNDING, Cameras
from gvtools.errors import ProjectError
from gvtools.scenes.images import (
    ImageHeader,
    check_size,
    fit_depth,
    read_header,
    read_image,
    read_mask,
    same_aspect,
)
from gvtools.scenes.scene import Finding, Frame, View
from gvtools.scenes.undistort import Undistortion

Depth = NDArray[np.float32]
NAMED_AT_MOST = 3  # a finding names this many files and counts the rest


@dataclass(frozen=True, eq=False)
class Registration:
    """Where the depth camera stands, when depth was not measured by the colour camera.

    Attributes:
        depth_K: (3, 3) float64, pixels, first pixel centre (0.5, 0.5).
        color_from_depth: (4, 4) float64, rigid, scene units.
    """

    depth_K: NDArray[np.float64]
    color_from_depth: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Photograph:
    """One picture on disk, its mask and its depth, of one recorded camera (or a depth camera).

    Attributes:
        name: the view's name.
        image: the picture.
        lens: from the recorded camera to the view's.
        cam_from_world: (4, 4) float64, rigid.
        mask: black = ignore; None when there is none.
        depth: the depth map; None when there is none.
        read_depth: how ``depth`` is read, to (h, w) float32 z-depth in scene units, 0 = none.
        registration: the depth camera, when it is another one than the picture's.
        read: how ``image`` is read; it may be a file that holds many pictures.
    """

    name: str
    image: Path
    lens: Undistortion
    cam_from_world: NDArray[np.float64]
    mask: Path | None = None
    depth: Path | None = None
    read_depth: Callable[[Path], Depth] | None = None
    registration: Registration | None = None
    read: Callable[[Path], Frame] = read_image

    def view(self) -> View:
        """The photograph as a view that loads lazily."""
        width, height = self.lens.size
        camera = Cameras(
            self.lens.K[None],
            np.asarray(self.cam_from_world, np.float64)[None],
            np.array([width]),
            np.array([height]),
            (self.name,),
        )
        paths = (path for path in (self.image, self.mask, self.depth) if path is not None)
        files = tuple(dict.fromkeys(paths))
        return View(self.name, camera, self.load, self.depth is not None, files)

    def load(self) -> Frame:
        """The pixels in the pinhole camera."""
        picture = self.read(self.image)
        check_size(picture.rgb.shape[1::-1], self.lens.source_size, path=self.image)
        masks = [] if picture.mask is None else [self.lens.nearest(picture.mask)]
        if self.mask is not None:
            mask = read_mask(self.mask)
            check_size(mask.shape[::-1], self.lens.source_size, path=self.mask)
            masks.append(self.lens.nearest(mask))
        if self.lens.inside is not None:
            masks.append(self.lens.inside)
        usable = np.all(masks, axis=0) if masks else None
        return Frame(self.lens.image(picture.rgb), self._depth(), usable)

    def _depth(self) -> Depth | None:
        if self.depth is None or self.read_depth is None:
            return None
        depth = self.read_depth(self.depth)
        if self.registration is None:
            depth = fit_depth(depth, *self.lens.source_size, path=self.depth)
            return np.ascontiguousarray(self.lens.depth(depth))
        from gvtools.scenes.registration import register_depth

        width, height = self.lens.size
        return register_depth(
            depth,
            self.registration.depth_K,
            self.lens.K,
            color_from_depth=self.registration.color_from_depth,
            width=width,
            height=height,
        )


def given_folder(folder: Path, held: str) -> Path:
    """The folder that the caller gave for what lies beside pictures.

    Args:
        folder: as it was given.
        held: what it should hold, in the plural, for the message.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ProjectError(f"{folder}: no such folder ({held} were expected there)")
    return folder


def mask_findings(unmasked: int, folder: Path | None) -> list[Finding]:
    """A warning when some views have no mask in the folder of masks."""
    if folder is None or not unmasked:
        return []
    return [Finding("warning", f"{unmasked} views have no mask in {folder.name}")]


def header_findings(pictures: Sequence[tuple[Path, tuple[int, int]]]) -> list[Finding]:
    """What the headers of pictures tell before any is decoded.

    Args:
        pictures: each file with the width and height that its camera expects.

    Returns:
        An error for each unreadable file or wrong size, and one line for each kind of conversion.
    """
    findings: list[Finding] = []
    headers: list[ImageHeader] = []
    for path, expected in dict.fromkeys(pictures):
        try:
            header = read_header(path)
            check_size(
                (header.width, header.height), expected, path=path, orientation=header.orientation
            )
        except ProjectError as error:
            findings.append(Finding("error", str(error)))
            continue
        headers.append(header)
    return findings + conversion_findings(headers)


def conversion_findings(headers: Sequence[ImageHeader]) -> list[Finding]:
    """One line for each kind of conversion that pictures with these headers will need."""
    kinds: Counter[str] = Counter()
    for header in headers:
        if header.mode.startswith("I;16"):
            kinds["16-bit grey: the upper eight bits are used"] += 1
        elif header.mode in ("L", "1", "LA"):
            kinds["grey: repeated over red, green and blue"] += 1
        if header.has_alpha:
            kinds["with an alpha channel: read as a mask"] += 1
        if header.orientation != 1:
            kinds["with an EXIF orientation: not applied, cameras are of the stored pixels"] += 1
    return [Finding("info", f"{count} pictures {kind}") for kind, count in kinds.items()]


def depth_findings(
    depths: Sequence[tuple[Path, tuple[int, int]]], size_of: Callable[[Path], tuple[int, int]]
) -> list[Finding]:
    """What the headers of depth maps tell before any is decoded.

    Args:
        depths: each file with the width and height of its picture.
        size_of: reads a file's width and height; raises ProjectError.

    Returns:
        An error for each unreadable file or other aspect, and one line for each size that differs.
    """
    findings: list[Finding] = []
    resized: Counter[str] = Counter()
    for path, expected in depths:
        try:
            found = size_of(path)
        except ProjectError as error:
            findings.append(Finding("error", str(error)))
            continue
        line = f"{found[0]}x{found[1]} for pictures of {expected[0]}x{expected[1]}"
        if found != expected and same_aspect(found, expected):
            resized[f"depth maps of {line}: nearest pixel taken"] += 1
        elif found != expected:
            message = (
                f"{path}: depth of {line}; expected the same aspect, or the depth camera's "
                "intrinsics (depth_K of RGB-D)"
            )
            findings.append(Finding("error", message))
    return findings + [Finding("info", f"{count} {line}") for line, count in resized.items()]


def lens_findings(lenses: Sequence[Undistortion]) -> list[Finding]:
    """One line for each distinct camera that is undistorted, and one for several sizes."""
    findings = []
    counts: Counter[str] = Counter()
    for lens in lenses:
        if not lens.untouched:
            (w, h), (width, height) = lens.source_size, lens.size
            way = "cut into" if lens.name("") else "undistorted to"
            counts[f"{lens.model} {w}x{h} {way} PINHOLE {width}x{height}"] += 1
    for line, count in sorted(counts.items()):
        findings.append(Finding("info", f"{line} ({count} views)"))
    sizes = sorted({lens.size for lens in lenses})
    if len(sizes) > 1:
        listed = named([f"{width}x{height}" for width, height in sizes])
        findings.append(Finding("info", f"views have {len(sizes)} different sizes: {listed}"))
    return findings


def rotation_findings(defects: Sequence[float]) -> list[Finding]:
    """One line when rotations had to be made orthonormal."""
    mended = sum(defect > ROTATION_ROUNDING for defect in defects)
    if not mended:
        return []
    return [
        Finding(
            "info",
            f"{mended} of {len(defects)} rotations made orthonormal; largest entry of R Rᵀ − I "
            f"was {max(defects):.2g}",
        )
    ]


def named(items: Sequence[object]) -> str:
    """The first few of ``items`` and how many more, for a message."""
    shown = ", ".join(str(item) for item in items[:NAMED_AT_MOST])
    rest = len(items) - NAMED_AT_MOST
    return shown + (f" and {rest} more" if rest > 0 else "")
