"""Scenes: views with cameras and lazily loaded pictures, sparse points, findings."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, concatenate
from gvtools.errors import ProjectError, printable
from gvtools.untrusted import number_key


@dataclass(frozen=True, eq=False)
class Frame:
    """The pixels of one view, already in its pinhole camera (undistorted, registered)."""

    rgb: NDArray[np.uint8]  # (H, W, 3) uint8
    # (H, W) float32 z-depth, scene units, 0 = none; None when the view has no depth
    depth: NDArray[np.float32] | None = None
    mask: NDArray[np.bool_] | None = None  # (H, W) bool, True = use; None means all


@dataclass(frozen=True, eq=False)
class View:
    """One posed picture; ``load`` reads its pixels when they are needed."""

    name: str  # unique within the scene: the image's path relative to the image folder
    camera: Cameras  # a batch of one
    # reads the pixels; raises ProjectError when a file is unreadable or of another size
    load: Callable[[], Frame]
    has_depth: bool = False  # whether ``load`` gives depth
    files: tuple[Path, ...] = ()  # what ``load`` reads, for fingerprints


@dataclass(frozen=True, eq=False)
class SparsePoints:
    """Triangulated points with their tracks."""

    positions: NDArray[np.float64]  # (N, 3) float64, world frame, scene units
    colors: NDArray[np.uint8]  # (N, 3) uint8
    # (N,) float32, mean reprojection error, pixels of the recorded (distorted) image
    errors: NDArray[np.float32]
    point_index: NDArray[np.int32]  # (M,) int32, for each track element its point
    view_index: NDArray[np.int32]  # (M,) int32, and its view in the scene
    # (M, 2) float64, where it was detected, pixels of the view's pinhole camera
    xy: NDArray[np.float64]

    def rows_of_views(self, count: int) -> list[NDArray[np.int64]]:
        """For each of ``count`` views its track elements, as indices in their order."""
        order = np.argsort(self.view_index, kind="stable")
        starts = np.searchsorted(self.view_index[order], np.arange(count + 1))
        return [order[low:high] for low, high in pairwise(starts)]


@dataclass(frozen=True)
class Finding:
    """Something that a reader met: ``level`` is "info", "warning" or "error"."""

    level: str
    message: str
    dropped: int = 0  # frames that are left out for what it tells

    def __post_init__(self) -> None:
        # Names and values of files are part of it.
        object.__setattr__(self, "message", printable(self.message))


def counted(count: int, line: str, *, level: str = "warning") -> list[Finding]:
    """A finding of how many there are of something; none for 0."""
    return [Finding(level, f"{count} {line}")] if count else []


@dataclass(frozen=True)
class Origin:
    """What opens a scene of a data set again."""

    address: str  # "spec:NAME:SCENE", the same for every way in which a user may write it
    root: Path  # the folder of the data set's download


@dataclass(frozen=True, eq=False)
class Scene:
    """Views in natural order of their names, what lies beside them, and what was met reading."""

    root: Path  # the project's folder
    # "colmap", "rgbd", "transforms", "data set" (a data set's native layout), or the app that
    # exported it from a phone ("Polycam")
    kind: str
    views: tuple[View, ...]  # in natural name order
    points: SparsePoints | None = None  # sparse points, where the project has them
    findings: tuple[Finding, ...] = ()  # everything dropped, converted, repaired or noteworthy
    metric: bool = False  # True when scene units are metres
    # of a scene that was opened as part of a data set; None: its folder opens it
    origin: Origin | None = None
    _index: dict[str, int] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        index = {view.name: i for i, view in enumerate(self.views)}
        if len(index) != len(self.views):
            names = [view.name for view in self.views]
            twice = next(name for name in names if names.count(name) > 1)
            raise ProjectError(
                f"{self.root}: two views have the same name, {twice!r}; names must be unique"
            )
        object.__setattr__(self, "_index", index)

    def __len__(self) -> int:
        return len(self.views)

    def __iter__(self) -> Iterator[View]:
        return iter(self.views)

    def __getitem__(self, name: str) -> View:
        if name not in self._index:
            raise ProjectError(f"{self.root}: no view named {name!r} among {len(self)} views")
        return self.views[self._index[name]]

    @property
    def names(self) -> tuple[str, ...]:
        """View names, in natural order."""
        return tuple(self._index)

    @property
    def cameras(self) -> Cameras:
        """All cameras, in the views' order."""
        return concatenate([view.camera for view in self.views])

    @property
    def address(self) -> str:
        """What ``open_project`` takes to open it again, as runs record it."""
        return str(self.root.resolve()) if self.origin is None else self.origin.address

    def subset(self, names: Iterable[str]) -> Scene:
        """The same scene with the named views alone (sparse points are left out)."""
        return replace(self, views=tuple(self[name] for name in names), points=None)


def natural_key(name: str) -> tuple[object, ...]:
    """Sort key under which img2 stands before img10."""
    parts = re.split(r"(\d+)", name)
    return tuple(number_key(part) if part.isdecimal() else part.lower() for part in parts), name
