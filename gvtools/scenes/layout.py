"""Layouts of posed pictures on disk: RGB-D folders, phones' exports, downloads of data sets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gvtools.scenes.rgbd import RgbdOptions
    from gvtools.scenes.scene import Scene

# A scene of a data set as a project is named, beside folders and files.
SPEC = "spec:"
FORM = f"{SPEC}NAME:SCENE"
# Files that a project may be.
ARCHIVES = (".zip", ".r3d", ".tar.gz", ".tgz")


def is_address(path: Path | str) -> bool:
    """Whether it names a scene of a data set rather than a file or folder.

    >>> is_address("spec:7-Scenes:chess/seq-01"), is_address("scans/kitchen")
    (True, False)
    """
    return str(path).startswith(SPEC)


def holds_views(path: Path | str) -> bool:
    """Whether a place is opened as a project, rather than read as a trajectory."""
    packed = str(path).lower().endswith((".json", *ARCHIVES))
    return is_address(path) or Path(path).is_dir() or packed


@dataclass(frozen=True)
class Layout:
    """A layout and its reader.

    Names of scenes are relative paths with "/", in natural order; "" is the folder itself. A
    partial download is no error: ``scenes`` names what is there at least in part, and what is
    missing of a scene is reported in its findings.
    """

    name: str
    holds: str  # what its folder holds, for messages
    scenes: Callable[[Path], tuple[str, ...]]
    reader: Callable[..., Scene]  # takes the root, the scene's name and, if any, ``options``
    # Further names that it reads: the same scenes with reduced pictures, such as SCENE/images_4.
    variants: Callable[[Path], tuple[str, ...]] = lambda _: ()

    @classmethod
    def of_folder(
        cls, name: str, holds: str, *, matches: Callable[[Path], bool], read: Callable[..., Scene]
    ) -> Layout:
        """A layout of which a folder or file is one scene."""
        return cls(
            name,
            f"{name} ({holds})",
            lambda root: ("",) if matches(root) else (),
            lambda root, scene, **options: read(root, **options),
        )

    @classmethod
    def of_reader(
        cls,
        holds: str,
        scenes: Callable[[Path], tuple[str, ...]],
        *,
        variants: Callable[[Path], tuple[str, ...]] = lambda _: (),
    ) -> Callable[[Callable[..., Scene]], Layout]:
        """The layout of the reader that it decorates, which has its name."""
        return lambda read: cls(read.__name__.strip("_"), holds, scenes, read, variants)

    def matches(self, root: Path) -> bool:
        """Whether a folder or file is of this layout, at least in part."""
        return bool(self.scenes(root))

    def read(self, root: Path, scene: str = "", *, options: RgbdOptions | None = None) -> Scene:
        """A scene; ProjectError where nothing of it can be read."""
        return self.reader(Path(root), scene, **({} if options is None else {"options": options}))
