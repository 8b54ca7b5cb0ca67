"""Posed pictures of a data set as a scene: what readers of native layouts have in common.

A reader lists the frames that a scene should have, present on disk or not, as ``PosedPicture``;
here they are checked by file size and header alone, what is missing or damaged is left out and
counted, intrinsics follow pictures of another size, and distorted cameras become pinholes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.cameras import invert_rigid, rigid_transform
from gvtools.errors import GvError, ProjectError
from gvtools.scenes.images import ImageHeader, read_depth, read_header, read_image, same_aspect
from gvtools.scenes.photographs import (
    Depth,
    Photograph,
    Registration,
    conversion_findings,
    lens_findings,
    named,
    rotation_findings,
)
from gvtools.scenes.scene import Finding, Frame, Scene, natural_key
from gvtools.scenes.transforms_frame import LensParameters
from gvtools.scenes.undistort import Undistortion, camera_of, undistortion
from gvtools.untrusted import named_file

Float64 = NDArray[np.float64]
Poses = Literal["cam_from_world", "world_from_cam"]

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
# Reasons for which a frame is left out, as findings have them.
NO_PICTURE = "have no picture"
NO_POSE = "have no pose"
NO_LENS = "have no intrinsics"
UNREADABLE = "have a damaged picture"
OTHER_ASPECT = "have a picture of another aspect than their camera"
BAD_POSE = "have an impossible pose"
BAD_CAMERA = "have an impossible camera"


@dataclass(frozen=True, eq=False)
class PosedPicture:
    """A frame that a layout names, whether or not its files are there.

    Attributes:
        name: the view's name.
        image: the picture, or the file that holds it among others.
        lens: its camera, of pictures of ``lens.size``; a picture that has the same aspect and
            another size gets it scaled. None where the layout lacks it.
        pose: (4, 4) or (3, 4), OpenCV axes, scene units; None where the layout lacks it.
        depth: the depth map, or the file that holds it; None where the layout has none.
        read_depth: how ``depth`` is read, to (h, w) float32 z-depth in scene units, 0 = none.
        mask: black = ignore.
        registration: the depth camera, where it is another one than the picture's.
        read: how ``image`` is read; None: it is a picture file. With a reader of its own, the
            picture is taken to be of ``lens.size``.
    """

    name: str
    image: Path
    lens: LensParameters | None
    pose: Float64 | None
    depth: Path | None = None
    read_depth: Callable[[Path], Depth] = read_depth
    mask: Path | None = None
    registration: Registration | None = None
    read: Callable[[Path], Frame] | None = None


def pinhole_lens(K: Sequence[float] | Float64, size: tuple[int, int]) -> LensParameters:
    """A pinhole camera without distortion.

    Args:
        K: fx, fy, cx, cy, or a (3, 3) matrix without skew; pixels, first pixel centre (0.5, 0.5).
        size: width and height of the picture, pixels.

    >>> pinhole_lens([500, 500, 320, 240], (640, 480)).values
    (500.0, 500.0, 320.0, 240.0)
    """
    matrix = np.asarray(K, np.float64)
    if matrix.ndim == 2:
        matrix = matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    fx, fy, cx, cy = (float(value) for value in matrix)
    return LensParameters("PINHOLE", (fx, fy, cx, cy), (int(size[0]), int(size[1])))


def scaled_lens(lens: LensParameters, size: tuple[int, int]) -> LensParameters:
    """The camera of the same picture resampled to ``size`` (width and height, pixels).

    >>> scaled_lens(pinhole_lens([500, 500, 320, 240], (640, 480)), (320, 240)).values
    (250.0, 250.0, 160.0, 120.0)
    """
    if tuple(size) == lens.size:
        return lens
    width, height = size
    camera = camera_of(lens.model, lens.values, lens.size, what="a picture's camera")
    camera.rescale(int(width), int(height))
    values = tuple(float(value) for value in camera.params)
    return LensParameters(lens.model, values, (int(width), int(height)))


def quaternion_pose(wxyz: ArrayLike, translation: ArrayLike) -> Float64:
    """(4, 4) float64 of a quaternion, scalar first, and a translation; NaN where that is no pose.

    >>> quaternion_pose([1, 0, 0, 0], [1, 2, 3])[:3, 3]
    array([1., 2., 3.])
    """
    from scipy.spatial.transform import Rotation

    pose = np.eye(4)
    w, x, y, z = np.asarray(wxyz, np.float64)
    if not np.isfinite([w, x, y, z]).all() or w == x == y == z == 0:
        return np.full((4, 4), np.nan)
    pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    pose[:3, 3] = translation
    return pose


def natural(names: Iterable[str]) -> tuple[str, ...]:
    """Names in natural order, each once.

    >>> natural(["b10", "b9", "b9"])
    ('b9', 'b10')
    """
    return tuple(sorted(set(names), key=natural_key))


@dataclass(eq=False)
class _Sieve:
    """Which frames are left out, why, and what else is to report."""

    total: int
    dropped: dict[str, list[str]] = field(default_factory=dict)
    details: dict[str, str] = field(default_factory=dict)
    headers: list[ImageHeader] = field(default_factory=list)
    scaled: Counter[str] = field(default_factory=Counter)
    defects: list[float] = field(default_factory=list)
    sizes: dict[Path, int] = field(default_factory=dict)

    def drop(self, name: str, reason: str, detail: str = "") -> None:
        self.dropped.setdefault(reason, []).append(name)
        if detail:
            self.details.setdefault(reason, detail)

    def present(self, path: Path) -> bool:
        """Whether a file is there with content; an interrupted download may leave it empty."""
        if path not in self.sizes:
            try:
                self.sizes[path] = path.stat().st_size if path.is_file() else 0
            except (OSError, ValueError):
                self.sizes[path] = 0
        return self.sizes[path] > 0

    def findings(self) -> list[Finding]:
        found = []
        for reason, names in self.dropped.items():
            detail = f"; {self.details[reason]}" if reason in self.details else ""
            line = f"{len(names)} of {self.total} frames {reason}: dropped ({named(names)}{detail})"
            found.append(Finding("warning", line))
        found += [Finding("info", f"{count} {line}") for line, count in self.scaled.items()]
        return found + rotation_findings(self.defects) + conversion_findings(self.headers)


def posed_scene(
    root: Path,
    pictures: Sequence[PosedPicture],
    *,
    poses: Poses,
    metric: bool,
    findings: Sequence[Finding] = (),
    home: Path | None = None,
) -> Scene:
    """The scene of the frames that can be used.

    Args:
        root: the scene's folder or file.
        pictures: the frames that the layout names.
        poses: which way ``PosedPicture.pose`` maps.
        metric: whether the units of poses and depth are metres.
        findings: what the reader met.
        home: the folder that no file of a frame may lie outside of; None: ``root``.
    """
    sieve = _Sieve(len(pictures))
    for picture in pictures:
        for path in (picture.image, picture.depth, picture.mask):
            # A download may be kept elsewhere and linked; a name out of a file may not lead there.
            if path is not None:
                named_file(
                    home or root, path, where=f"{root}, frame {picture.name}", follow_links=True
                )
    lenses: dict[LensParameters, Undistortion] = {}
    photographs = []
    for picture in sorted(pictures, key=lambda item: natural_key(item.name)):
        cam_from_world = _pose(picture, poses, sieve)
        if cam_from_world is None:
            continue
        lens = _lens(picture, lenses, sieve)
        if lens is not None:
            photographs.append(_photograph(picture, lens, cam_from_world, sieve=sieve))
    missing = [item.name for item in photographs if item.depth is None]
    report = [*findings, *sieve.findings()]
    if not photographs:
        raise ProjectError(nothing_left(root, len(pictures), report))
    if any(picture.depth is not None for picture in pictures) and missing:
        line = f"{len(missing)} of {len(photographs)} frames have no depth map ({named(missing)})"
        report.append(Finding("warning", line))
    report += lens_findings([item.lens for item in photographs])
    views = tuple(item.view() for item in photographs)
    return Scene(Path(root), "data set", views, None, tuple(report), metric=metric)


def nothing_left(root: Path, total: int, findings: Sequence[Finding]) -> str:
    """The message of a scene of which no frame can be read."""
    reasons = "; ".join(item.message for item in findings if item.level != "info")
    return (
        f"{root}: none of {total} frames can be read{f' ({reasons})' if reasons else ''}; expected "
        "at least one with picture and pose; complete the download"
    )


def _pose(picture: PosedPicture, poses: Poses, sieve: _Sieve) -> Float64 | None:
    """(4, 4) cam_from_world, or None where the frame is left out."""
    if not sieve.present(picture.image):
        sieve.drop(picture.name, NO_PICTURE)
        return None
    if picture.pose is None or not np.isfinite(picture.pose).all():
        sieve.drop(picture.name, NO_POSE)
        return None
    try:
        rigid, defect = rigid_transform(picture.pose, what=picture.name)
    except GvError as error:
        sieve.drop(picture.name, BAD_POSE, str(error))
        return None
    sieve.defects.append(defect)
    return rigid if poses == "cam_from_world" else invert_rigid(rigid)


def _lens(
    picture: PosedPicture, lenses: dict[LensParameters, Undistortion], sieve: _Sieve
) -> Undistortion | None:
    """The frame's way to a pinhole camera, or None where the frame is left out."""
    if picture.lens is None:
        sieve.drop(picture.name, NO_LENS)
        return None
    size = picture.lens.size
    if picture.read is None:
        try:
            header = read_header(picture.image)
        except ProjectError as error:
            sieve.drop(picture.name, UNREADABLE, str(error))
            return None
        sieve.headers.append(header)
        size = header.width, header.height
    line = f"{size[0]}x{size[1]} for cameras of {picture.lens.size[0]}x{picture.lens.size[1]}"
    if size != picture.lens.size and not same_aspect(size, picture.lens.size):
        sieve.drop(picture.name, OTHER_ASPECT, line)
        return None
    if size != picture.lens.size:
        sieve.scaled[f"pictures of {line}: intrinsics scaled"] += 1
    try:
        params = scaled_lens(picture.lens, size)
        if params not in lenses:
            lenses[params] = undistortion(params.model, params.values, size, what=picture.name)
        return lenses[params]
    except ProjectError as error:
        sieve.drop(picture.name, BAD_CAMERA, str(error))
        return None


def _photograph(
    picture: PosedPicture, lens: Undistortion, cam_from_world: Float64, *, sieve: _Sieve
) -> Photograph:
    depth, mask = (
        path if path is not None and sieve.present(path) else None
        for path in (picture.depth, picture.mask)
    )
    return Photograph(
        picture.name,
        picture.image,
        lens,
        cam_from_world,
        mask,
        depth,
        picture.read_depth,
        picture.registration,
        picture.read or read_image,
    )
