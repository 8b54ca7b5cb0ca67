"""Posed photographs as a scene: the one builder of views, and its findings.

A reader lists the frames that a scene should have, present on disk or not, as ``PosedFrame``. Here
they are checked by file size and header alone, distorted cameras become pinholes, and depth of
another camera is registered. What is missing is left out and counted. A data set is read as far as
it can be: what is damaged is left out, too, and intrinsics follow pictures of another size. A
project of the user's own is read strictly: an impossible pose or camera is refused, a damaged
picture an error.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import ROTATION_ROUNDING, Cameras, invert_rigid, rigid_transform
from gvtools.errors import GvError, ProjectError
from gvtools.ranges import WHOLE
from gvtools.scenes.calibration import Float64, scaled_lens
from gvtools.scenes.images import (
    ALPHA,
    DEPTH_SUFFIXES,
    IMAGE_SUFFIXES,
    ImageHeader,
    check_size,
    fit_depth,
    read_depth,
    read_header,
    read_image,
    read_mask,
    resize_nearest,
    same_aspect,
    stored_depth_size,
    white_of_pictures,
)
from gvtools.scenes.matching import named, pictures_in
from gvtools.scenes.scene import Finding, Frame, Scene, View, counted, natural_key
from gvtools.scenes.undistort import LensParameters, Undistortion, perspective_views, undistortion
from gvtools.untrusted import named_file

Depth = NDArray[np.float32]

# Masks that a scene opens to see whether they tell anything.
MASKS = 8
# How what lies beside a project is given to it, by its kind.
HOW_TO_GIVE = {
    ("colmap", "depth"): "z-depth in scene units is read from stereo/depth_maps/NAME.npy, NAME as "
    "in the model",
    ("transforms", "depth"): "name them by depth_file_path in each frame, with "
    "depth_unit_scale_factor",
    ("colmap", "mask"): "give the folder with --masks (black = ignore)",
    ("transforms", "mask"): "give the folder with --masks (black = ignore)",
}
# Reasons for which a frame is left out, as findings have them.
NO_PICTURE = "have no picture"
NO_POSE = "have no pose"
NAN_POSE = "have NaN in their pose"
LOST = "were lost by the tracker"
NO_LENS = "have no intrinsics"
UNREADABLE = "have a damaged picture"
OTHER_ASPECT = "have a picture of another aspect than their camera"
BAD_POSE = "have an impossible pose"
BAD_CAMERA = "have an impossible camera"
# Pictures that may have 16 bits a channel, and what is done with them.
DEEP, UPPER = (".png", ".tif", ".tiff", ".ppm"), "the upper eight bits are used"
# A principal point is expected within so much of the middle, in sides of the picture; if it is so
# near to that of the picture on its side, within less.
CENTER, TURNED = 0.25, 0.1


@dataclass(frozen=True, eq=False)
class Registration:
    """The depth camera, when depth was not measured by the colour camera."""

    depth_K: Float64  # (3, 3), pixels, first pixel centre (0.5, 0.5)
    color_from_depth: Float64  # (4, 4), rigid, scene units


@dataclass(frozen=True, eq=False)
class PosedFrame:
    """A frame that a layout names, whether or not its files are there."""

    name: str  # the view's
    image: Path  # the picture, or the file that holds it among others
    # Of pictures of ``lens.size``; one of the same aspect and another size gets it scaled. Or the
    # way to the view itself. None where the layout lacks it.
    lens: LensParameters | Undistortion | None
    pose: Float64 | None  # (4, 4) or (3, 4), OpenCV axes, scene units; None where there is none
    depth: Path | None = None  # the depth map, or the file that holds it
    # To (h, w) float32 z-depth in scene units, 0 = none.
    read_depth: Callable[[Path], Depth] = read_depth
    mask: Path | None = None  # black = ignore
    registration: Registration | None = None
    # None: ``image`` is a picture file. What has a reader of its own is of ``lens.size``.
    read: Callable[[Path], Frame] | None = None
    where: str = ""  # the place of the pose in its file, for messages


class _LeftOut(Exception):
    """A frame is left out: the reason, and what it is in detail."""


@dataclass(eq=False)
class _Sieve:
    """Which frames are left out, why, and what else is to report."""

    total: int
    strict: bool
    dropped: dict[str, list[str]] = field(default_factory=dict)
    details: dict[str, list[str]] = field(default_factory=dict)
    headers: dict[Path, ImageHeader] = field(default_factory=dict)
    scaled: Counter[str] = field(default_factory=Counter)
    defects: list[float] = field(default_factory=list)
    sizes: dict[Path, int] = field(default_factory=dict)
    lenses: dict[LensParameters, tuple[Undistortion, ...]] = field(default_factory=dict)

    def present(self, path: Path | None) -> Path | None:
        """The file, if it is there with content; an interrupted download may leave it empty."""
        if path is not None and path not in self.sizes:
            try:
                size = path.stat().st_size if path.is_file() else 0
                self.sizes[path] = max(size, path.is_file() and self.strict)
            except (OSError, ValueError):
                self.sizes[path] = 0
        return path if path is not None and self.sizes[path] > 0 else None

    @contextmanager
    def minding(self, reason: str) -> Iterator[None]:
        """An error of a frame leaves it out for that reason, unless they are read strictly."""
        try:
            yield
        except GvError as error:
            if self.strict:
                raise
            raise _LeftOut(reason, str(error)) from None

    def header(self, path: Path) -> ImageHeader:
        if path not in self.headers:
            self.headers[path] = read_header(path)
        return self.headers[path]

    def findings(self) -> list[Finding]:
        found = []
        for reason, names in self.dropped.items():
            listed = "; ".join([named(names), *self.details[reason]])
            line = f"{len(names)} of {self.total} frames {reason}: dropped ({listed})"
            found.append(Finding("warning", line, len(names)))
        found += [Finding("info", f"{count} {line}") for line, count in self.scaled.items()]
        found += rotation_findings(self.defects)
        return found + conversion_findings([*self.headers.values()])


def posed_scene(
    root: Path,
    frames: Sequence[PosedFrame],
    *,
    poses: Literal["cam_from_world", "world_from_cam"],
    metric: bool,
    kind: str = "data set",
    strict: bool = False,
    findings: Sequence[Finding] = (),
    home: Path | None = None,
    unposed: str = NO_POSE,
    advice: str = "complete the download",
) -> Scene:
    """The scene of the frames that can be used.

    ``poses`` is which way those of the frames map. No file of a data set's frame may lie outside of
    ``home``, or else ``root``. ``unposed`` is the reason for which frames without a pose are left
    out, ``advice`` what to do where none can be used.
    """
    sieve = _Sieve(len(frames), strict)
    photographs, read = list[Photograph](), list[PosedFrame]()
    for frame in sorted(frames, key=lambda item: natural_key(item.name)):
        for path in () if strict else (frame.image, frame.depth, frame.mask):
            # A download may be kept elsewhere and linked; a name out of a file may not lead there.
            if path is not None:
                where = f"{root}, frame {frame.name}"
                named_file(home or root, path, where=where, follow_links=True)
        try:
            if left := _lacks(frame, sieve, unposed=unposed):
                raise _LeftOut(*left)
            pose, views = _rigid(frame, sieve), _views(frame, sieve)
        except _LeftOut as error:
            reason, *detail = error.args
            sieve.dropped.setdefault(reason, []).append(frame.name)
            sieve.details.setdefault(reason, detail)
            continue
        pose = pose if poses == "cam_from_world" else invert_rigid(pose)
        mask, depth = sieve.present(frame.mask), sieve.present(frame.depth)
        there = replace(frame, mask=mask, depth=depth)
        read.append(frame)
        photographs += [Photograph(there, lens, lens.pose(pose)) for lens in views]
    report = [*findings, *sieve.findings()]
    if not photographs:
        reasons = "; ".join(item.message for item in report if item.level != "info")
        raise ProjectError(
            f"{root}: none of {len(frames)} frames can be read{reasons and f' ({reasons})'}; "
            f"expected at least one with picture and pose; {advice}"
        )
    measured = any(frame.depth is not None for frame in read)
    unmasked = [frame.name for frame in read if frame.mask and not sieve.present(frame.mask)]
    without = [frame.name for frame in read if measured and not sieve.present(frame.depth)]
    for noun, missing in (("mask", unmasked), ("depth map", without)):
        line = f"of {len(read)} frames have no {noun} ({named(missing)})"
        report += counted(len(missing), line)
    photographs.sort(key=lambda item: natural_key(item.name))
    report += lens_findings([item.lens for item in photographs])
    report += mask_findings([item.frame for item in photographs])
    deep = [i.frame.image for i in photographs if i.frame.read is None]
    white = white_of_pictures([path for path in deep if path.suffix.lower() in DEEP])
    if white != WHOLE[-1]:
        photographs = [replace(item, white=white) for item in photographs]
    if strict:
        report += center_findings([item.lens for item in photographs])
        report += size_findings(photographs, sieve)
        report += map_findings(photographs)
        report += unread_findings(Path(root), frames, kind)
    if white != WHOLE[-1]:
        report = [item for item in report if not item.message.endswith(UPPER)]
        line = f"16-bit pictures hold no more than {white:g}: all are read as 0 to {white:g}"
        report.append(Finding("info", line))
    views_of_scene = tuple(item.view() for item in photographs)
    return Scene(Path(root), kind, views_of_scene, None, tuple(report), metric=metric)


def mask_findings(frames: Sequence[PosedFrame]) -> list[Finding]:
    """Warnings where masks, or alpha, of a few frames, evenly spread, take all or nothing out."""
    masks = [item.mask for item in frames if item.mask]
    pictures = [item.image for item in frames if item.read is None]
    findings = []
    for noun, files in (("masks", masks), (f"alpha channels, each {ALPHA['mask']},", pictures)):
        shares = {}
        for file in files[:: -(-len(files) // MASKS) or 1]:
            with suppress(GvError):  # said where its view is read
                used = read_mask(file) if files is masks else _opaque(file)
                shares[file.name] = float(used.mean())
        nothing = [name for name, share in shares.items() if share == 0]
        everything = [name for name, share in shares.items() if share == 1 and files is masks]
        if nothing or len(everything) == len(shares) > 0:
            what = "take everything out in" if nothing else "leave everything in in"
            line = (
                f"{noun} {what} {len(nothing or everything)} of {len(shares)} that were opened, "
                f"first {(nothing or everything)[0]}; expected black or transparent pixels where a "
                "picture is to be ignored, and others elsewhere"
            )
            findings.append(Finding("warning", line))
    return findings


def unread_findings(root: Path, frames: Sequence[PosedFrame], kind: str) -> list[Finding]:
    """A warning for each folder beside a project whose depth maps or masks nothing reads."""
    home, findings = root if root.is_dir() else root.parent, list[Finding]()
    folders = sorted(entry for entry in home.iterdir() if entry.is_dir())
    for key, noun, name, suffixes in (
        ("depth", "depth maps", r"depth|disparit", DEPTH_SUFFIXES),
        ("mask", "masks", r"mask|segmentation", IMAGE_SUFFIXES),
    ):
        if any(getattr(frame, key) is not None for frame in frames):
            continue
        for folder in (entry for entry in folders if re.search(name, entry.name.lower())):
            count = len(pictures_in(folder, suffixes))
            if 2 * count >= len(frames) and folder not in {item.image.parent for item in frames}:
                advice = HOW_TO_GIVE.get((kind, key), f"this kind of project has no {noun}")
                line = (
                    f"{folder.name} holds {count} files, as of {noun}, that are not read: {advice}"
                )
                findings.append(Finding("warning", line))
    return findings


def _opaque(picture: Path) -> NDArray[np.bool_]:
    mask = read_image(picture).mask if read_header(picture).has_alpha else None
    return np.ones(1, np.bool_) if mask is None else mask


def _lacks(frame: PosedFrame, sieve: _Sieve, *, unposed: str) -> tuple[str, ...]:
    """The reason for which a frame without something is left out, and details; () for none."""
    if sieve.present(frame.image) is None:
        return (NO_PICTURE, f"expected {frame.image}") if sieve.strict else (NO_PICTURE,)
    if frame.pose is None or (np.isnan(frame.pose).any() and not sieve.strict):
        return (unposed,)
    if np.isinf(frame.pose).any():
        return (LOST,)
    if np.isnan(frame.pose).any():
        return NAN_POSE, frame.where or frame.name
    return () if frame.lens is not None else (NO_LENS,)


def _rigid(frame: PosedFrame, sieve: _Sieve) -> Float64:
    """(4, 4), the frame's pose as it maps in its layout."""
    with sieve.minding(BAD_POSE):
        assert frame.pose is not None
        rigid, defect = rigid_transform(frame.pose, what=frame.where or frame.name)
    sieve.defects.append(defect)
    return rigid


def _views(frame: PosedFrame, sieve: _Sieve) -> tuple[Undistortion, ...]:
    """The frame's ways to pinhole cameras, several of a project's panorama or wide fisheye."""
    assert frame.lens is not None
    if isinstance(frame.lens, Undistortion):
        return (frame.lens,)
    size = frame.lens.size
    if frame.read is None:
        # Read strictly, an unreadable picture is an error of its own.
        with suppress(ProjectError), sieve.minding(UNREADABLE):
            header = sieve.header(frame.image)
            size = header.width, header.height
    line = f"{size[0]}x{size[1]} for cameras of {frame.lens.size[0]}x{frame.lens.size[1]}"
    if size != frame.lens.size and not same_aspect(size, frame.lens.size):
        if not sieve.strict:
            raise _LeftOut(OTHER_ASPECT, line)
        size = frame.lens.size
    if size != frame.lens.size:
        sieve.scaled[f"pictures of {line}: intrinsics scaled"] += 1
    with sieve.minding(BAD_CAMERA):
        lens = scaled_lens(frame.lens, size)
        if lens not in sieve.lenses:
            what = (frame.where or str(frame.image)) if sieve.strict else frame.name
            views = () if sieve.strict else (undistortion(*lens, what=what),)
            sieve.lenses[lens] = views or perspective_views(*lens, what=what)
    return sieve.lenses[lens]


def first_size(pictures: Iterable[Path]) -> tuple[int, int] | None:
    """Width and height of the first picture that can be read, pixels; None where none can."""
    for path in pictures:
        with suppress(ProjectError):
            header = read_header(path)
            return header.width, header.height
    return None


@dataclass(frozen=True, eq=False)
class Photograph:
    """One view of a frame whose files are there."""

    frame: PosedFrame
    lens: Undistortion  # from the recorded camera to the view's
    cam_from_world: Float64  # (4, 4), rigid, of the view
    white: float = WHOLE[-1]  # full brightness of 16 bits a channel

    @property
    def name(self) -> str:
        """The view's name."""
        return self.lens.name(self.frame.name)

    def view(self) -> View:
        """The photograph as a view that loads lazily."""
        camera = Cameras.alike(
            self.lens.K, self.cam_from_world, size=self.lens.size, names=(self.name,)
        )
        paths = (self.frame.image, self.frame.mask, self.frame.depth)
        files = tuple(dict.fromkeys(path for path in paths if path is not None))
        return View(self.name, camera, self.load, self.frame.depth is not None, files)

    def load(self, alpha: str = "mask") -> Frame:
        """The pixels in the pinhole camera."""
        frame, lens = self.frame, self.lens
        read = frame.read or partial(read_image, white=self.white, alpha=alpha)
        picture = read(frame.image)
        check_size(picture.rgb.shape[1::-1], lens.source_size, path=frame.image)
        masks = [] if picture.mask is None else [lens.nearest(picture.mask)]
        if frame.mask is not None:
            mask = read_mask(frame.mask)
            if same_aspect((mask.shape[1], mask.shape[0]), lens.source_size):
                mask = resize_nearest(mask, *lens.source_size)
            check_size(mask.shape[::-1], lens.source_size, path=frame.mask)
            masks.append(lens.nearest(mask))
        if lens.inside is not None:
            masks.append(lens.inside)
        usable = np.all(masks, axis=0) if masks else None
        return Frame(lens.image(picture.rgb), self._depth(), usable)

    def _depth(self) -> Depth | None:
        frame, lens = self.frame, self.lens
        if frame.depth is None:
            return None
        depth = frame.read_depth(frame.depth)
        if frame.registration is None:
            depth = fit_depth(depth, *lens.source_size, path=frame.depth)
            return np.ascontiguousarray(lens.depth(depth))
        from gvtools.scenes.registration import register_depth

        width, height = lens.size
        return register_depth(
            depth, frame.registration.depth_K, lens.K, width=width, height=height,
            color_from_depth=frame.registration.color_from_depth,
        )  # fmt: skip


def size_findings(photographs: Sequence[Photograph], sieve: _Sieve) -> list[Finding]:
    """An error for each unreadable picture or wrong size."""
    files = {i.frame.image: i.lens.source_size for i in photographs if i.frame.read is None}
    findings = []
    for path, expected in files.items():
        try:
            header = sieve.header(path)
            size = header.width, header.height
            check_size(size, expected, path=path, orientation=header.orientation)
        except ProjectError as error:
            findings.append(Finding("error", str(error)))
    return findings


def conversion_findings(headers: Sequence[ImageHeader]) -> list[Finding]:
    """One line for each kind of conversion that pictures with these headers will need."""
    kinds: Counter[str] = Counter()
    for header in headers:
        if header.mode.startswith("I;16"):
            kinds[f"16-bit grey: {UPPER}"] += 1
        elif header.mode in ("L", "1", "LA"):
            kinds["grey: repeated over red, green and blue"] += 1
        if header.has_alpha:
            kinds[f"with an alpha channel: {ALPHA['mask']}"] += 1
        if header.orientation != 1:
            kinds["with an EXIF orientation: not applied, cameras are of the stored pixels"] += 1
    return [Finding("info", f"{count} pictures {kind}") for kind, count in kinds.items()]


def map_findings(photographs: Sequence[Photograph]) -> list[Finding]:
    """An error for each unreadable map or mask or other aspect, and a line a size that differs."""
    findings: list[Finding] = []
    resized: Counter[str] = Counter()
    maps = dict[tuple[str, Path], tuple[int, int]]()
    for item in photographs:
        if item.frame.depth is not None and item.frame.registration is None:
            maps["depth maps", item.frame.depth] = item.lens.source_size
        if item.frame.mask is not None:
            maps["masks", item.frame.mask] = item.lens.source_size
    for (noun, path), expected in maps.items():
        try:
            found = (first_size([path]) if noun == "masks" else stored_depth_size(path)) or expected
        except ProjectError as error:
            findings.append(Finding("error", str(error)))
            continue
        line = f"{found[0]}x{found[1]} for pictures of {expected[0]}x{expected[1]}"
        if found != expected and same_aspect(found, expected):
            resized[f"{noun} of {line}: nearest pixel taken"] += 1
        elif found != expected:
            advice = "expected the same aspect, or of depth its camera's intrinsics (depth_K)"
            findings.append(Finding("error", f"{path}: {noun} of {line}; {advice}"))
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


def center_findings(lenses: Sequence[Undistortion]) -> list[Finding]:
    """A line when a principal point is far from the middle, as that of another size is."""
    found = Counter[str]()
    for lens in lenses:
        (x, y), (w, h) = lens.K[:2, 2], lens.size
        off, turned = (max(abs(x / a - 0.5), abs(y / b - 0.5)) for a, b in ((w, h), (h, w)))
        if off >= CENTER or 2 * turned < TURNED < off:
            of = "turned pictures" if turned < TURNED else "another size"
            place = f"({x:.1f}, {y:.1f}) is far from the middle of {w}x{h} pixels"
            found[f"{place}: are the intrinsics of {of}?"] += 1
    return [Finding("warning", f"{n} views: the principal point {at}") for at, n in found.items()]


def rotation_findings(defects: Sequence[float]) -> list[Finding]:
    """One line when rotations had to be made orthonormal."""
    mended = sum(defect > ROTATION_ROUNDING for defect in defects)
    line = (
        f"{mended} of {len(defects)} rotations made orthonormal; largest entry of R Rᵀ − I was "
        f"{max(defects, default=0):.2g}"
    )
    return [Finding("info", line)] if mended else []
