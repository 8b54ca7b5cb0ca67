"""The native layouts of data sets: which scenes a download holds, and how one is read.

To add a layout, write a module of this package that defines a ``Layout`` named LAYOUT, and add a
line to LAYOUTS. Several data sets may share a layout.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

from gvtools.errors import OptionError, ProjectError
from gvtools.scenes.data_sets.address import FORM, SPEC
from gvtools.scenes.data_sets.spec import DataSetSpec, load_spec, name_key
from gvtools.scenes.scene import Origin, Scene

# The ``layout`` of a data set's spec (data_sets/*.yaml): the module of this package that reads it.
LAYOUTS: dict[str, str] = {
    "gta_sfm": "gta_sfm",
    "mvs_synth": "mvs_synth",
    "omniworld": "omniworld",
    "sevenscenes": "sevenscenes",
    "aria_digital_twin": "aria_digital_twin",
    "arkitscenes": "arkitscenes",
    "dl3dv": "dl3dv",
    "dtu": "dtu",
    "eth3d": "eth3d",
    "hypersim": "hypersim",
    "llff": "llff",
    "mapfree": "mapfree",
    "mipnerf360": "mipnerf360",
    "realestate10k": "realestate10k",
    "scannet": "scannet",
    "scannetpp": "scannetpp",
    "tanks_and_temples": "tanks_and_temples",
    "waymo": "waymo",
    "spring": "spring",
    "tartanair": "tartanair",
    "tartanair_v2": "tartanair_v2",
    "virtual_kitti": "virtual_kitti",
}


@dataclass(frozen=True)
class Layout:
    """How a data set lies on disk, as its authors publish it.

    Attributes:
        looks_like: what the root folder of a download holds, for error messages.
        scenes: takes the root; returns the names of the scenes that are there at least in part, in
            natural order. A name is a relative path with "/". A partial download is no error.
        read: takes the root, a scene's name and the data set's spec; returns the scene. What is
            missing or damaged is left out and reported in ``Scene.findings``; ProjectError if
            nothing is left.
        variants: takes the root; returns further names that ``read`` takes: the same scenes with
            reduced pictures, such as SCENE/images_4. ``scenes`` does not list them.
    """

    looks_like: str
    scenes: Callable[[Path], tuple[str, ...]]
    read: Callable[[Path, str, DataSetSpec], Scene]
    variants: Callable[[Path], tuple[str, ...]] = lambda _: ()


def layout_of(spec: DataSetSpec) -> Layout:
    """The layout that a spec names."""
    return import_module(f"gvtools.scenes.data_sets.{LAYOUTS[spec.layout]}").LAYOUT


def scenes_of(name: str, root: Path) -> tuple[str, ...]:
    """The scenes of a data set that a folder holds."""
    spec = load_spec(name)
    layout = layout_of(spec)
    if not Path(root).is_dir():
        raise ProjectError(f"{root}: no such folder; expected {layout.looks_like}")
    found = layout.scenes(Path(root))
    if not found:
        raise ProjectError(f"{root}: no scene of {spec.name}; expected {layout.looks_like}")
    return found


def open_data_set(name: str, scene: str, root: Path) -> Scene:
    """One scene of a data set as it was downloaded.

    Args:
        name: of the data set, see ``spec.load_spec``.
        scene: as ``scenes_of`` names it, or a variant; "" for the only one of the folder.
        root: the folder of the download.
    """
    spec = load_spec(name)
    known = scenes_of(name, root)
    if not scene and len(known) == 1:
        scene = known[0]
    if not scene:
        raise ProjectError(
            f"{root}: holds {len(known)} scenes of {spec.name}, first {known[0]!r}; say which, as "
            f"{FORM}"
        )
    _check_is_there(spec, scene, Path(root), known=known)
    return read_scene(spec, scene, Path(root))


def open_address(address: Path | str, root: Path | None) -> Scene:
    """The scene of a data set that an address names.

    Args:
        address: ``spec:NAME:SCENE``; ":SCENE" may be left out where the folder holds only one.
        root: the folder of the data set's download.
    """
    name, _, scene = str(address).removeprefix(SPEC).partition(":")
    if not name:
        raise OptionError(f"{address}: names no data set; expected {FORM}")
    spec = load_spec(name)
    if root is None:
        raise OptionError(
            f"{address}: where {spec.name} lies is not said; give the folder of its download by "
            "--root DIR (root= in Python)"
        )
    return open_data_set(name, scene, Path(root))


def chosen_scenes(name: str, root: Path, scenes: Sequence[str] = ()) -> tuple[str, ...]:
    """The scenes of a download that a user names, without repeats; all of them if none is named."""
    spec = load_spec(name)
    known = scenes_of(name, root)
    for scene in scenes:
        _check_is_there(spec, scene, Path(root), known=known)
    return tuple(dict.fromkeys(scenes)) or known


def _check_is_there(spec: DataSetSpec, scene: str, root: Path, *, known: Sequence[str]) -> None:
    if scene in known or scene in layout_of(spec).variants(root):
        return
    near = difflib.get_close_matches(scene, known, n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"first of {len(known)}: {known[0]!r}"
    raise ProjectError(f"{root}: {spec.name} has no scene {scene!r} there; {hint}")


def read_scene(spec: DataSetSpec, scene: str, root: Path) -> Scene:
    """A scene by its name, without listing the others first, as ``open_data_set`` does."""
    opened = layout_of(spec).read(root, scene, spec)
    origin = Origin(f"{SPEC}{name_key(spec.name)}:{scene}", root.resolve())
    return replace(opened, origin=origin)
