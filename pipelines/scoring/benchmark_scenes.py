"""Scenes and pictures of a benchmark: views, picture sizes, object masks, thumbnails."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gvtools.errors import ProjectError
from gvtools.evaluation.images import Lpips, psnr, ssim
from gvtools.evaluation.published import Benchmark, SceneSplit, split_scene
from gvtools.files import make_folder, replaced_when_written

if TYPE_CHECKING:
    from gvtools.scenes.scene import Scene

# Longer side of a thumbnail, pixels.
SIDE = 400


def scene_names(benchmark: Benchmark, root: Path) -> tuple[str, ...]:
    """The benchmark's scenes; where it names none, all that lie below the root."""
    if benchmark.scenes:
        if not root.is_dir():
            raise ProjectError(f"{root}: no such folder; expected the scenes of {benchmark.name}")
        return benchmark.scenes
    if benchmark.data_set.spec:
        from gvtools.scenes.data_sets.catalogue import scenes_of

        return scenes_of(benchmark.data_set.spec, root)
    from gvtools.scenes.project import is_project
    from gvtools.scenes.scene import natural_key

    if not root.is_dir():
        raise ProjectError(f"{root}: no such folder; expected projects, one folder each")
    names = [path.name for path in root.iterdir() if path.is_dir() and is_project(path)]
    if not names:
        raise ProjectError(f"{root}: no project in its folders; expected one folder a project")
    return tuple(sorted(names, key=natural_key))


def open_benchmark_scene(benchmark: Benchmark, name: str, root: Path) -> Scene:
    """One scene of a benchmark with one number of context views, as it is recorded."""
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
    """The views of a recorded scene that are given, and those that are completed."""
    return split_scene(
        benchmark.split_of(benchmark.context),
        scene.names,
        views=benchmark.context,
        targets=benchmark.targets,
        rounds=benchmark.rounds,
        folder=scene.root if scene.root.is_dir() else scene.root.parent,
    )


def picture_size(benchmark: Benchmark, scene: Scene) -> tuple[int, int] | None:
    """Width and height that the benchmark gives all pictures of a recorded scene, pixels.

    None leaves them as they are: recorded, or in the data set's reduced copies.
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


def at_benchmark_size(scene: Scene, split: SceneSplit, *, size: tuple[int, int] | None) -> Scene:
    """A recorded scene at a benchmark's picture size, with the sparse points of its context alone.

    Without a size, pictures are reduced to what a run takes by default.
    """
    from gvtools.scenes.resized import reduced, resized, seen_by
    from pipelines.reconstruction.settings import RunSettings

    scene = reduced(scene, RunSettings().max_side) if size is None else resized(scene, *size)
    return seen_by(scene, split.context)


def reading_of(scene: Scene, size: tuple[int, int] | None) -> dict[str, Any]:
    """By this, every command opens a run's scene as it was; JSON-ready."""
    reading: dict[str, Any] = {} if size is None else {"resolution": list(size)}
    if scene.origin is not None:
        reading["root"] = str(scene.origin.root)
    return reading


def pictures_folder(folder: Path, scene: str, *, views: int) -> Path:
    """Where another method's pictures of a scene lie: DIR/SCENE/N_views, DIR/SCENE or DIR."""
    places = (folder / scene / f"{views}_views", folder / scene)
    return next((place for place in places if place.is_dir()), folder)


def object_mask(
    benchmark: Benchmark, root: Path, *, scene: str, index: int, shape: tuple[int, int]
) -> np.ndarray | None:
    """(H, W) bool, the object (white) in a scene's view of this number; None without a mask."""
    from PIL import Image

    paths = [root / pattern.format(scene=scene, index=index) for pattern in benchmark.masks]
    path = next((path for path in paths if path.is_file()), None)
    if path is None:
        return None
    try:
        with Image.open(path) as picture:
            levels = picture.convert("RGB").resize(shape[::-1], Image.Resampling.NEAREST)
            return np.array(levels).min(axis=2) == 255
    except (OSError, SyntaxError, ValueError) as error:
        raise ProjectError(f"{path}: no readable mask ({error})") from None


def masked_figures(
    pictures: Mapping[str, np.ndarray],
    scene: Scene,
    masks: Mapping[str, np.ndarray | None],
    *,
    lpips: Lpips | None,
) -> dict[str, float | None]:
    """PSNR of the object's pixels; SSIM and LPIPS of pictures that are white outside it."""
    if not masks or any(mask is None for mask in masks.values()):
        return {}
    rows: list[dict[str, float | None]] = []
    for name, picture in pictures.items():
        truth, mask = scene[name].load().rgb, masks[name]
        assert mask is not None
        outside = ~mask[..., None]
        ours, true = (np.where(outside, np.uint8(255), p) for p in (picture, truth))
        distance = None if lpips is None else lpips.distance(ours, true)[0]
        row = {"psnr": psnr(picture, truth, mask=mask), "ssim": ssim(ours, true), "lpips": distance}
        rows.append(row)
    known = {n: [value for row in rows if (value := row[n]) is not None] for n in rows[0]}
    return {f"{n}_masked": float(np.mean(v)) if v else None for n, v in known.items()}


def write_thumbnails(
    result: Path, pictures: Mapping[str, np.ndarray], scene: Scene, *, context: Sequence[str]
) -> None:
    """Small pictures of the middle target beside a cell's figures, for the page.

    ``METHOD.jpg`` and ``METHOD.error.jpg`` are the method's, ``.truth.jpg`` and ``.context.jpg``
    are shared by all methods. Pictures are (H, W, 3) uint8 by target.
    """
    from PIL import Image

    from viz.report.pictures import error_map

    name = middle(list(pictures))
    truth = scene[name].load()
    error = error_map(pictures[name], truth.rgb, mask=truth.mask)
    given = scene[middle(context)].load().rgb
    for ending, picture in {
        f"{result.stem}.jpg": pictures[name],
        f"{result.stem}.error.jpg": error,
        ".truth.jpg": truth.rgb,
        ".context.jpg": given,
    }.items():
        image = Image.fromarray(picture)
        image.thumbnail((SIDE, SIDE), Image.Resampling.BOX)
        make_folder(result.parent)
        with replaced_when_written(result.parent / ending) as temporary:
            image.save(temporary, format="JPEG", quality=85)


def middle(names: Sequence[str]) -> str:
    """The one in the middle: chosen before anything is measured."""
    return names[len(names) // 2]
