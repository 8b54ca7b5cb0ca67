"""Public data sets by name: what is known of each, and the scenes of its download.

A spec records what is known of a data set, one YAML each in ``data_specs/data_sets``; every fact
names its source, and what could not be verified stands under ``not_verified``. Its layout, the
reader of a download as the authors publish it, is one of LAYOUTS: several data sets may share one.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationError

from gvtools.errors import OptionError, ProjectError
from gvtools.files import digest
from gvtools.scenes.collection import SceneCollection, of_scenes
from gvtools.scenes.data_sets import aria, captures, hypersim, mvs, reconstructed, synthetic, waymo
from gvtools.scenes.layout import FORM, SPEC, Layout
from gvtools.scenes.scene import Origin, Scene
from gvtools.specs import SpecRecord, Texts, name_key, spec_file, spec_texts
from gvtools.untrusted import parse_yaml


class SceneCounts(SpecRecord):
    """How large a data set is, and who says so."""

    # Scenes, sequences or trajectories, as the source counts them.
    scenes: int | None = Field(None, ge=1)
    images: int | None = Field(None, ge=1)  # colour images
    source: str  # where the counts are published
    # What the data set's authors count, where the source counts a part or in another way.
    whole: str | None = None


class CameraConvention(SpecRecord):
    """The convention in which cameras are stored."""

    axes: str  # directions of x, y and z of a camera, such as "x right, y down, z forward"
    # Which way a stored pose maps; "none" where poses are not published.
    pose: Literal["world_from_cam", "cam_from_world", "none"]
    # Metres in a unit of translation; None where the scale is not known.
    unit_m: float | None = Field(None, gt=0)
    # Where the centre of the first pixel lies: at (0, 0) or at (0.5, 0.5).
    pixel_centre: Literal["integer", "half", "not stated"]
    distortion: str = "none"  # the lens model of the published images
    intrinsics: str | None = None  # where intrinsics are stored, and in which unit


class DepthEncoding(SpecRecord):
    """How depth is stored; a data set without depth has none of this."""

    encoding: str  # file type and number type, such as "16-bit PNG"
    # Depth along z, distance from the camera's centre, 1 / z, disparity in pixels, or what a
    # renderer's depth buffer holds.
    measures: Literal["z", "distance", "inverse", "disparity", "buffer"]
    # Metres in a stored unit; None where the scale is not known or does not apply.
    unit_m: float | None = Field(None, gt=0)
    # How z follows from a stored value, where the unit alone does not say it.
    formula: str | None = None
    invalid: Texts = ()  # stored values that mean "no depth", in words or numbers
    # Whether every pixel has depth (rendered scenes), so that nothing has to be estimated.
    complete: bool


class Licence(SpecRecord):
    """On what terms the data can be had, and from where."""

    terms: str  # name of the licence, or the terms in short
    obtain: str  # where to ask or to download
    # Whether copies may be passed on; None where that could not be verified.
    redistribution: bool | None = None


class GeometrySource(SpecRecord):
    """Where the poses and depth of training samples come from (the paper's appendix)."""

    # Own: the data set's. Estimated: by a network alone. Mixed: sampled at ``own_share``.
    source: Literal["own", "estimated", "mixed"]
    # Probability of the data set's own geometry: 2/3 where own and estimated mix 2:1.
    own_share: float = Field(ge=0, le=1)
    fallback: str  # what stands in where depth is missing or incomplete


class DataSetSpec(SpecRecord):
    """A data set: what it holds, how it is stored, on what terms, and how it is sampled."""

    name: str  # as printed
    # Such as "real / RGB-D" or "synthetic / indoor", in the paper's words where it has them.
    kind: str
    # What the paper, or the field, uses it for.
    roles: Annotated[tuple[Literal["training", "benchmark"], ...], Field(strict=False)]
    cited_as: str  # authors and year, or the key of the citation
    home: str  # the data set's own page
    counts: SceneCounts  # of the paper's table where that lists the data set
    layout: str  # the native layout: a name in ``LAYOUTS``
    # What each kind of file is called, relative to the root; {scene} stands for a scene's
    # name.
    files: dict[str, str]
    camera: CameraConvention  # conventions of the cameras
    depth: DepthEncoding | None = None  # of stored depth; None where the data set has none
    licence: Licence  # terms and address
    # Official splits: name, and which file or rule defines it.
    splits: dict[str, str] = Field(default_factory=dict)
    # Of training; None for data sets that serve as benchmarks alone.
    geometry: GeometrySource | None = None
    sources: Texts  # where each of these facts was read
    not_verified: Texts = ()  # which facts could not be verified, and why
    traps: Texts = ()  # what readers of this data set get wrong

    @property
    def weight(self) -> float:
        """Sampling weight in a mixture: the root of the number of images, 0 if that is unknown."""
        return math.sqrt(self.counts.images or 0)


def spec_names() -> tuple[str, ...]:
    """The data sets there are, as ``load_spec`` takes them."""
    return tuple(spec_texts("data_sets"))


@cache
def load_spec(name: str) -> DataSetSpec:
    """A data set by its file's name or its printed one, however it is written.

    >>> load_spec("7-Scenes").depth.unit_m
    0.001
    """
    texts = spec_texts("data_sets")
    file = spec_file("data set", name, texts)
    return parse_spec(texts[file], where=f"{file}.yaml")


def parse_spec(text: str, *, where: str = "spec") -> DataSetSpec:
    """A data set from its YAML."""
    try:
        return DataSetSpec.model_validate(parse_yaml(text))
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise OptionError(f"{where}, {place}: {first['msg']}") from None
    except ValueError as error:
        raise OptionError(f"{where}: {error}; expected the YAML of a data set") from None


# The ``layout`` of a data set's spec, by name.
LAYOUTS: dict[str, Layout] = {
    layout.name: layout
    for module in (captures, reconstructed, mvs, synthetic, hypersim, aria, waymo)
    for layout in module.LAYOUTS
}


def layout_of(spec: DataSetSpec) -> Layout:
    """The layout that a spec names."""
    return LAYOUTS[spec.layout]


def scenes_of(name: str, root: Path) -> tuple[str, ...]:
    """The scenes of a data set that a folder holds."""
    spec = load_spec(name)
    layout = layout_of(spec)
    found = layout.scenes(Path(root)) if Path(root).is_dir() else ()
    if not found:
        what = f"no scene of {spec.name}" if Path(root).is_dir() else "no such folder"
        raise ProjectError(f"{root}: {what}; expected {layout.holds}")
    return found


def open_data_set(name: str, scene: str, root: Path) -> Scene:
    """One scene of the data set ``name`` as it was downloaded to ``root``.

    ``scene`` is as ``scenes_of`` names it, or a variant; "" for the only one of the folder.
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


def _parse_address(address: Path | str, root: Path | None) -> tuple[DataSetSpec, str | None, Path]:
    """The data set, scene (None for all) and folder that an address and a root name."""
    name, colon, scene = str(address).removeprefix(SPEC).partition(":")
    if not name:
        raise OptionError(f"{address}: names no data set; expected {FORM}")
    spec = load_spec(name)
    if root is None:
        raise OptionError(
            f"{address}: where {spec.name} lies is not said; give the folder of its download by "
            "--root DIR (root= in Python)"
        )
    return spec, scene if colon else None, Path(root)


def open_address(address: Path | str, root: Path | None) -> Scene:
    """The scene that ``spec:NAME[:SCENE]`` names in the folder of the data set's download."""
    spec, scene, folder = _parse_address(address, root)
    return open_data_set(spec.name, scene or "", folder)


def open_scenes(address: str, root: Path | None) -> SceneCollection:
    """The scenes that ``spec:NAME`` names, or the one that ``spec:NAME:SCENE`` does."""
    spec, scene, folder = _parse_address(address, root)
    key = name_key(spec.name)
    if scene is not None:
        opened = open_data_set(key, scene, folder)
        return replace(of_scenes([opened], title=f"{spec.name} {scene}".strip()), data_set=key)
    names, read = scenes_of(key, folder), partial(read_scene, spec, root=folder)
    return SceneCollection(spec.name, names, read, None, digest(list(names)), key)


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
    opened = layout_of(spec).read(root, scene)
    origin = Origin(f"{SPEC}{name_key(spec.name)}:{scene}", root.resolve())
    return replace(opened, origin=origin)
