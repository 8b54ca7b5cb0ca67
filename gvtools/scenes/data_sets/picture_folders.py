"""Folders that hold the same pictures at several sizes: ``images``, ``images_2``, ``images_4``."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from gvtools.errors import ProjectError
from gvtools.scenes.rgbd_recording import PICTURES
from gvtools.scenes.scene import natural_key

FULL = "images"


def picture_folders(scene: Path) -> list[Path]:
    """The folders of pictures that a scene has, the largest pictures first."""
    found = [path for path in scene.glob(f"{FULL}*") if path.is_dir() and _factor(path.name)]
    return sorted((path for path in found if holds_picture(path)), key=lambda p: _factor(p.name))


def variants_of(root: Path, scenes: Iterable[str], *, inside: str = "") -> tuple[str, ...]:
    """Every scene's folders of pictures as names, such as ``garden/images_4``.

    Args:
        root: of the download.
        scenes: their names.
        inside: where a scene's folders of pictures are.
    """
    return tuple(
        f"{scene}/{folder.name}"
        for scene in scenes
        for folder in picture_folders(root / scene / inside)
    )


def chosen_folder(root: Path, scene: str, *, inside: str = "") -> tuple[Path, Path]:
    """A scene's folder, and the pictures that its name chooses: of a variant, else the largest."""
    named = root / scene
    if inside and named.parent.joinpath(inside, named.name).is_dir() and _factor(named.name):
        return named.parent, named.parent / inside / named.name
    if named.is_dir() and _factor(named.name):
        return named.parent, named
    folders = picture_folders(named / inside)
    if not folders:
        raise ProjectError(
            f"{named / inside}: no pictures in a folder {FULL} or {FULL}_N; complete the download"
        )
    return named, folders[0]


def holds_picture(folder: Path) -> bool:
    """Whether there is at least one picture in a folder."""
    return any(path.suffix.lower() in PICTURES for path in folder.iterdir())


def pictures_by_stem(folder: Path) -> dict[str, Path]:
    """Pictures of a folder by their names without suffix, in natural order.

    Smaller copies often have another suffix than the originals.
    """
    paths = (path for path in folder.iterdir() if path.suffix.lower() in PICTURES)
    return {path.stem: path for path in sorted(paths, key=lambda path: natural_key(path.name))}


def _factor(name: str) -> int:
    """By how much the pictures of a folder of that name are reduced; 0 for any other name."""
    if name == FULL:
        return 1
    number = name.removeprefix(f"{FULL}_")
    return int(number) if number.isdecimal() and number != name else 0
