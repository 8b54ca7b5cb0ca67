"""Opening of projects: recognition of folders, and options as plain data that a run records."""

from __future__ import annotations

import difflib
import shlex
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MethodType
from typing import Any

from gvtools.errors import OptionError, ProjectError, UnposedError
from gvtools.scenes.calibration import file_text, load_matrix
from gvtools.scenes.collection import SceneCollection, of_scenes
from gvtools.scenes.colmap_model import find_model
from gvtools.scenes.images import ALPHA, IMAGE_SUFFIXES
from gvtools.scenes.layout import ARCHIVES, FORM, SPEC, is_address
from gvtools.scenes.matching import named, pictures_in
from gvtools.scenes.phones import POLYCAM, RECORD3D, SCANNER_APP, STRAY_SCANNER
from gvtools.scenes.photographs import Photograph
from gvtools.scenes.rgbd import RgbdOptions
from gvtools.scenes.rgbd_layouts import LAYOUTS, count_unposed
from gvtools.scenes.scene import Finding, Scene
from gvtools.scenes.transforms import FILE as TRANSFORMS
from gvtools.scenes.transforms import SPLITS, is_transforms, read_transforms
from gvtools.untrusted import unpacked

VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg")
# A recording of a RealSense camera.
BAG = ".bag"
# What apps export; nothing has to be said about how they are read.
PHONES = (RECORD3D, POLYCAM, SCANNER_APP, STRAY_SCANNER)
LOOKED_FOR = (
    "a COLMAP model (cameras.bin or .txt in sparse/N, sparse, sparse_txt or the folder itself)",
    f"{TRANSFORMS}, or {SPLITS['train']} and others beside it",
    *(layout.holds for layout in (*LAYOUTS, *PHONES)),
)


def open_project(
    path: Path | str,
    *,
    images: Path | None = None,
    masks: Path | None = None,
    rgbd: RgbdOptions | None = None,
    root: Path | None = None,
    model: int | None = None,
    alpha: str = "mask",
) -> Scene:
    """The scene of a COLMAP workspace, a posed RGB-D folder, a phone's or a ``transforms.json``.

    Args:
        path: the folder, a ``.zip`` of it, a ``transforms.json``, an ``.r3d``, or
            ``spec:NAME:SCENE`` for a scene of a data set.
        images: the image folder, where the project does not say it (COLMAP, transforms).
        masks: the mask folder (COLMAP, transforms).
        rgbd: what a posed RGB-D folder does not tell by itself.
        root: the folder of the data set's download.
        model: number of the COLMAP model, where there are several; None takes the largest.
        alpha: what a picture's alpha channel is: a "mask", to "ignore", or what it is laid on
            "white" or "black" by.

    Raises:
        ProjectError: nothing there that can be read, or what is there is damaged.
        UnposedError: pictures, a video or a recording without cameras.
        OptionError: an option of another kind of project.
        ShapeError: a pose with a scale or a mirror.
    """
    if alpha not in ALPHA:
        raise OptionError(f"alpha {alpha!r}; expected one of {', '.join(ALPHA)}")
    if alpha != "mask":
        scene = open_project(path, images=images, masks=masks, rgbd=rgbd, root=root, model=model)
        return _with_alpha(scene, alpha)
    given = {"images": images, "masks": masks, "model's number": model, "RGB-D options": rgbd}
    if is_address(path):
        _refuse(path, "the data set's spec says how it is read", given)
        from gvtools.scenes.data_sets.catalogue import open_address

        return open_address(path, root)
    _refuse(path, f"no scene of a data set, {FORM}", {"root": root})
    path = Path(path)
    if not path.is_dir() and not path.is_file():
        what = "neither a folder nor a file" if path.exists() else "no such folder" + _nearest(path)
        raise ProjectError(f"{path}: {what}")
    if is_archive(path):
        try:
            scene = open_project(unpacked(path), images=images, masks=masks, rgbd=rgbd, model=model)
        except UnposedError as error:
            raise UnposedError(path, error.found, _capture(path)) from None
        return replace(scene, root=path)
    if path.suffix.lower() in (*VIDEOS, BAG) and path.is_file():
        kind = "a recording" if path.suffix.lower() == BAG else "a video"
        raise UnposedError(path, f"{kind} without cameras", _capture(path))
    folder = find_model(path, number=model) if path.is_dir() else None
    if folder is None:
        _refuse(path, "no COLMAP workspace", {"model's number": model})
    told = folder is not None or is_transforms(path)
    phone = None if told else next((layout for layout in PHONES if layout.matches(path)), None)
    if phone is not None:
        _refuse(path, f"an export of {phone.name} says how it is read", given)
        return phone.read(path)
    if told or path.is_file():
        _refuse(path, "no posed RGB-D folder", {"RGB-D options": rgbd})
        if not told and path.suffix.lower() != ".json":
            raise ProjectError(
                f"{path}: no project by its suffix; expected a folder, a .zip or a transforms.json "
                f"(gvtools capture also takes {', '.join(VIDEOS)} and {BAG})"
            )
        if folder is None:
            return read_transforms(path, images=images, masks=masks)
        from gvtools.scenes.colmap import read_colmap

        scene = read_colmap(path, images=images, masks=masks, model=model)
        if not is_transforms(path):
            return scene
        note = f"the COLMAP model is read, {TRANSFORMS} is not: give that file to read it instead"
        return replace(scene, findings=(*scene.findings, Finding("info", note)))
    for layout in LAYOUTS:
        if layout.matches(path):
            own = {"images": images, "masks": masks}
            _refuse(path, "a posed RGB-D folder holds its own pictures", own)
            return layout.read(path, options=rgbd)
    raise _unknown(path)


def _refuse(path: Path | str, why: str, options: Mapping[str, object]) -> None:
    """Refuse options that are given for a project that takes none of them."""
    names = [name for name, value in options.items() if value is not None]
    if names:
        raise OptionError(f"{path}: {why}; expected no {' and no '.join(names)}")


def _with_alpha(scene: Scene, alpha: str) -> Scene:
    """The scene with the alpha of its pictures taken otherwise than as a mask."""
    views = tuple(
        replace(view, load=partial(view.load.__self__.load, alpha))
        if isinstance(view.load, MethodType) and isinstance(view.load.__self__, Photograph)
        else view
        for view in scene.views
    )
    findings = (
        replace(found, message=found.message.replace(ALPHA["mask"], ALPHA[alpha]))
        for found in scene.findings
        if found.level == "info" or ALPHA["mask"] not in found.message
    )
    return replace(scene, views=views, findings=tuple(findings))


def _capture(path: Path) -> str:
    return f"find the cameras first: gvtools capture {shlex.quote(str(path))} --out PROJECT"


def is_archive(path: Path) -> bool:
    """Whether a path is of an archive, which is read as the folder that it holds."""
    return path.name.lower().endswith(ARCHIVES) and path.is_file()


def is_recording(folder: Path) -> bool:
    """Whether a folder holds colour, depth and poses, going by its files' names."""
    return any(layout.matches(folder) for layout in (*LAYOUTS, *PHONES))


def is_project(folder: Path) -> bool:
    """Whether ``open_project`` would take the folder for a project, going by its files' names."""
    told = find_model(folder) is not None or is_transforms(folder) or is_recording(folder)
    return told or is_archive(folder)


def _nearest(path: Path) -> str:
    if not path.parent.is_dir():
        return ""
    near = difflib.get_close_matches(path.name, [p.name for p in path.parent.iterdir()], n=1)
    return f"; did you mean {path.parent / near[0]}?" if near else ""


def _unknown(path: Path) -> ProjectError:
    lists = [p.name for p in sorted(path.glob("*.json")) if '"transform_matrix"' in file_text(p)]
    if lists:
        line = f"{named(lists)} lists frames with poses and is no {TRANSFORMS} by its name"
        return ProjectError(f"{path}: {line}; give its path")
    unposed = count_unposed(path)
    if unposed:
        texts = {p.parent.name for p in path.glob("*/*") if p.suffix in (".txt", ".npy")}
        texts -= {"intrinsic", "intrinsics"}
        many = [
            f"{name}/" for name in sorted(texts) if len([*(path / name).iterdir()]) >= unposed / 2
        ]
        advice = _capture(path)
        if many:
            advice = (
                f"if {named(many)} holds them, camera-to-world, call it pose/ (invert matrices "
                f"that map the other way); else {advice}"
            )
        return UnposedError(path, f"{unposed} RGB-D frames without poses", advice)
    for lens in sorted(p for form in ("", "*/", "*/*/") for p in path.glob(f"{form}sensor.yaml")):
        if count := len(pictures_in(lens.parent / "data")):
            line = f"{count} pictures of a EuRoC recording, whose lens and poses are not read"
            return UnposedError(path, line, _capture(lens.parent / "data"))
    entries = sorted(entry.name + "/" * entry.is_dir() for entry in path.iterdir())
    there = (place for form in ("*/", "dense/*/", "*.r3d", "*.zip") for place in path.glob(form))
    inside = [str(place) for place in sorted(there) if is_project(place)]
    pictures = [name for name in entries if Path(name).suffix.lower() in IMAGE_SUFFIXES]
    others = [p for p in path.iterdir() if p.suffix.lower() not in IMAGE_SUFFIXES]
    if not inside and all(entry.is_dir() for entry in others if entry.name[0] != "."):
        pictures += [p.name for p in path.glob("*/*") if p.suffix.lower() in IMAGE_SUFFIXES]
    if len(pictures) > 1:
        return UnposedError(path, f"{len(pictures)} pictures without cameras", _capture(path))
    held = f"holds {named(entries)}" if entries else "is empty"
    advice = f"did you mean {named(inside)}?" if inside else "give the project's folder"
    return ProjectError(f"{path}: {held}; expected one of: {'; '.join(LOOKED_FOR)}; {advice}")


# --- options and addresses as users and runs have them -----------------------------------------

# Options of a project by name, with the name that RgbdOptions has for those of RGB-D folders.
READING = {
    "root": None,
    "images": None,
    "masks": None,
    "model": None,
    "alpha": None,
    "depth_unit": "depth_unit",
    "depth_max": "depth_max",
    "color_intrinsics": "color_K",
    "depth_intrinsics": "depth_K",
    "color_from_depth": "color_from_depth",
    "max_time_difference": "max_time_difference",
}


def open_as(path: Path, reading: Mapping[str, Any]) -> Scene:
    """The project at ``path``, with options by the names of READING as a run records them.

    Absent and None leave the default. ``resolution``, width and height in pixels, is that of a
    benchmark: see ``gvtools.scenes.resized``.
    """
    folders = {
        name: None if reading.get(name) is None else Path(reading[name])
        for name in ("images", "masks", "root")
    }
    scene = open_project(
        path,
        **folders,
        rgbd=rgbd_options(reading),
        model=reading.get("model"),
        alpha=reading.get("alpha") or "mask",
    )
    if reading.get("resolution") is None:
        return scene
    from gvtools.scenes.resized import resized

    width, height = reading["resolution"]
    return resized(scene, width, height)


def open_recorded(project: str, reading: Mapping[str, Any], *, moved: Path | None = None) -> Scene:
    """A project as a run recorded it.

    ``moved`` is where it lies now, or where the download of its data set does; None: where it lay.
    """
    if moved is None:
        return open_as(Path(project), reading)
    if is_address(project) and not is_address(moved):
        return open_as(Path(project), {**reading, "root": str(moved)})
    return open_as(moved, reading)


def rgbd_options(reading: Mapping[str, Any]) -> RgbdOptions | None:
    """The options of RGB-D folders; None where there are none."""
    options = {
        option: reading[name]
        for name, option in READING.items()
        if option is not None and reading.get(name) is not None
    }
    if not options:
        return None
    if "color_from_depth" in options:
        path = Path(options["color_from_depth"])
        try:
            options["color_from_depth"] = load_matrix(path, (4, 4))
        except ProjectError as error:
            raise OptionError(f"--color-from-depth {error}") from None
    return RgbdOptions(**options)


def open_collection(address: str, root: Path | None = None) -> SceneCollection:
    """The scenes that an address names.

    It is the folder of a project or of shards, "spec:NAME" for all scenes of a data set, or
    "spec:NAME:SCENE" for one, in the folder ``root`` of its download. A project and a single scene
    are opened at once; the scenes of shards and of a whole data set when they are needed.
    """
    if not address.startswith(SPEC):
        if root is not None:
            raise OptionError(
                f"{address}: a root {root} is given; expected one for spec:NAME alone"
            )
        from gvtools.scenes.shards import is_shards, open_shards

        path = Path(address)
        return open_shards(path) if is_shards(path) else of_scenes([open_project(path)])
    from gvtools.scenes.data_sets.catalogue import open_scenes

    return open_scenes(address, root)
