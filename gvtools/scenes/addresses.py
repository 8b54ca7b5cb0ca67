"""What users name scenes by: a project, a folder of shards, or a data set of those with a spec."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

from gvtools.errors import OptionError
from gvtools.files import digest
from gvtools.scenes.collection import SceneCollection, of_scenes
from gvtools.scenes.data_sets.address import SPEC
from gvtools.scenes.scene import Scene


def open_collection(address: str, root: Path | None = None) -> SceneCollection:
    """The scenes that an address names.

    A project and a single scene of a data set are opened at once; the scenes of shards and of a
    whole data set when they are needed.

    Args:
        address: the folder of a project or of shards, "spec:NAME" for all scenes of a data set, or
            "spec:NAME:SCENE" for one.
        root: the folder of the data set's download.
    """
    if not address.startswith(SPEC):
        if root is not None:
            raise OptionError(
                f"{address}: a root {root} is given; expected one for spec:NAME alone"
            )
        return _project_or_shards(Path(address))
    from gvtools.scenes.data_sets.catalogue import load_spec, name_key, open_data_set, scenes_of

    name, colon, scene = address.removeprefix(SPEC).partition(":")
    spec = load_spec(name)
    if root is None:
        raise OptionError(f"{address}: no root; give the folder of the download of {spec.name}")
    key = name_key(name)
    if colon:
        opened = open_data_set(name, scene, root)
        return replace(of_scenes([opened], title=f"{spec.name} {scene}".strip()), data_set=key)
    names = scenes_of(name, root)
    read = partial(_read, key, root=Path(root))
    return SceneCollection(spec.name, names, read, None, digest(list(names)), key)


def _read(data_set: str, scene: str, *, root: Path) -> Scene:
    from gvtools.scenes.data_sets.catalogue import load_spec, read_scene

    return read_scene(load_spec(data_set), scene, root)


def _project_or_shards(path: Path) -> SceneCollection:
    from gvtools.scenes.project import open_project
    from gvtools.scenes.shards.index import is_shards
    from gvtools.scenes.shards.reader import open_shards

    return open_shards(path) if is_shards(path) else of_scenes([open_project(path)])
