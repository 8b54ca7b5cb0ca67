"""The scenes of a benchmark: which there are, and each with its views and picture size."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.errors import ProjectError

if TYPE_CHECKING:
    from gvtools.evaluation.published import Benchmark
    from gvtools.evaluation.splits import SceneSplit
    from gvtools.scenes.scene import Scene


def scene_names(benchmark: Benchmark, root: Path) -> tuple[str, ...]:
    """The benchmark's scenes; where it names none, all that lie below the root."""
    if benchmark.scenes:
        if not root.is_dir():
            raise ProjectError(f"{root}: no such folder; expected the scenes of {benchmark.name}")
        return benchmark.scenes
    if benchmark.data_set.spec:
        from gvtools.scenes.data_sets.catalogue import scenes_of

        return scenes_of(benchmark.data_set.spec, root)
    return _projects(root)


def _projects(root: Path) -> tuple[str, ...]:
    from gvtools.scenes.project import is_project
    from gvtools.scenes.scene import natural_key

    if not root.is_dir():
        raise ProjectError(f"{root}: no such folder; expected projects, one folder each")
    found = sorted(
        (path.name for path in root.iterdir() if path.is_dir() and is_project(path)),
        key=natural_key,
    )
    if not found:
        raise ProjectError(f"{root}: no project in its folders; expected one folder a project")
    return tuple(found)


def open_benchmark_scene(benchmark: Benchmark, name: str, root: Path) -> Scene:
    """One scene of a benchmark as it is recorded.

    Args:
        benchmark: with one number of context views.
        name: of the scene.
        root: the folder of the data set, or of the projects.
    """
    from gvtools.scenes.data_sets.catalogue import open_data_set
    from gvtools.scenes.project import open_project

    released = benchmark.split_of(benchmark.context).kind == "files"
    if released or not benchmark.data_set.spec:
        return open_project(root / name)
    return open_data_set(benchmark.data_set.spec, _name_there(benchmark, name, root), root)


def _name_there(benchmark: Benchmark, name: str, root: Path) -> str:
    """A scene's name in the download: in whichever folder it lies, and of the reduced pictures."""
    from gvtools.scenes.data_sets.catalogue import layout_of, load_spec, scenes_of

    rule = benchmark.split_of(benchmark.context)
    known = scenes_of(benchmark.data_set.spec, root)
    name = next((one for one in known if one.rpartition("/")[2] == name), name)
    variants = layout_of(load_spec(benchmark.data_set.spec)).variants(root)
    if rule.copies and f"{name}/{rule.copies}" in variants:
        return f"{name}/{rule.copies}"
    if rule.divided_by and name in known and f"{name}/images" not in variants:
        raise ProjectError(
            f"{root / name}: neither {rule.copies} nor images; expected one, since other copies do "
            "not tell the recorded size"
        )
    return name


def split_of_scene(benchmark: Benchmark, scene: Scene) -> SceneSplit:
    """Which of its views are given and which are completed.

    Args:
        benchmark: with one number of context views.
        scene: as recorded.
    """
    from gvtools.evaluation.splits import split_scene

    return split_scene(
        benchmark.split_of(benchmark.context),
        scene.names,
        views=benchmark.context,
        targets=benchmark.targets,
        rounds=benchmark.rounds,
        folder=scene.root if scene.root.is_dir() else scene.root.parent,
    )


def picture_size(benchmark: Benchmark, scene: Scene) -> tuple[int, int] | None:
    """Width and height that the benchmark gives all pictures of a scene, pixels.

    Args:
        benchmark: with one number of context views.
        scene: as recorded.

    Returns:
        None where it leaves them as they are: recorded, or in the data set's reduced copies.
    """
    rule = benchmark.split_of(benchmark.context)
    if benchmark.resolution is not None:
        return benchmark.resolution
    if rule.divided_by is None:
        return None
    if scene.origin is not None and scene.origin.address.endswith(f"/{rule.copies}"):
        return None
    camera = scene.views[0].camera
    width, height = int(camera.width[0]), int(camera.height[0])
    return round(width / rule.divided_by), round(height / rule.divided_by)


def prepared(scene: Scene, split: SceneSplit, *, size: tuple[int, int] | None) -> Scene:
    """The scene at a benchmark's picture size, with the sparse points of its context alone.

    Args:
        scene: as recorded.
        split: of its views.
        size: see ``picture_size``; None reduces pictures to what a run takes by default.
    """
    from gvtools.scenes.reduced import reduced
    from gvtools.scenes.resized import resized, seen_by
    from pipelines.reconstruction.settings import RunSettings

    scene = reduced(scene, RunSettings().max_side) if size is None else resized(scene, *size)
    return seen_by(scene, split.context)


def reading_of(scene: Scene, size: tuple[int, int] | None) -> dict[str, Any]:
    """With this, every command opens a run's scene as it was; JSON-ready.

    Args:
        scene: as recorded.
        size: see ``picture_size``.
    """
    reading: dict[str, Any] = {} if size is None else {"resolution": list(size)}
    if scene.origin is not None:
        reading["root"] = str(scene.origin.root)
    return reading


def object_mask_path(benchmark: Benchmark, root: Path, *, scene: str, index: int) -> Path | None:
    """Where the object mask of a view lies; None where there is none.

    Args:
        benchmark: whose ``masks`` say where to look.
        root: the folder of the data set.
        scene: its name.
        index: the view's number in the scene's order, from 0 on.
    """
    paths = [root / pattern.format(scene=scene, index=index) for pattern in benchmark.masks]
    return next((path for path in paths if path.is_file()), None)
