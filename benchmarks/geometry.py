"""Geometry from photographs: whether its confidence comes true, and how near surfaces are to truth.

    python -m benchmarks.geometry SHARED OUT [--scenes "facade;street"] [--plot FILE]

SHARED is the folder of real scenes; its kitchen is taken without the recorded depth, which only
judges. The other scenes are rendered, with exact depth; their clouds and meshes are compared with
the surfaces that the context shows. Runs fit Gaussians (fit) or only sweep planes (sweep). Kept in
OUT: scenes, runs, ``geometry.json`` and ``geometry.md``; scenes that are in the former are not
measured again.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import open3d as o3d
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmarks.made_scenes import PLACES, write_place
from benchmarks.reliability import reliability
from gvtools import open_project
from gvtools.cameras import Cameras, concatenate
from gvtools.depth.stereo.filtering import agreement
from gvtools.runs.context_depth import context_depth_files
from gvtools.runs.layout import round_folder
from gvtools.runs.run import Run, load_run
from gvtools.scenes.images import resize_nearest
from gvtools.view_selection import nearest_views
from pipelines.bench.open3d_peers import TsdfVolume, images

GVTOOLS = (sys.executable, "-m", "pipelines.cli")
REAL = "kitchen, photographs"
# Context of each scene.
SCENES = {
    REAL: "every:4", "room inside": "not:every:6", "object indoors": "not:every:8",
    "facade": "not:every:6", "street": "not:every:6",
}  # fmt: skip
# Steps and not seconds, so that it is the same however busy the machine.
RUNS = {"fit": ("--set", "refine.steps=1000"), "sweep": ("--refine", "0")}
# Relative errors of depth below which a pixel is right, and above which it is wrong.
RIGHT, WRONG = 0.05, 0.10
KEPT, BINS = (1.0, 0.9, 0.8), 20
# Neighbours that are asked about a pixel, and relative difference of depth that is agreement.
NEIGHBOURS, AGREE = 8, 0.03
# Shares of the extent: distances that count as met, cells that thin points, voxels of a TSDF.
WITHIN, CELL, VOXEL = (0.01, 0.02, 0.05), 0.0025, 0.002
# Surfaces up to so many medians of the true depth are to be found, and make the extent.
NEAR, POINTS = 3.0, 200_000
# Pixels that make a point in COLMAP's fusion, whose default of 5 is meant for many views.
LEAST_FUSED = 3

Float32 = NDArray[np.float32]


class DepthView(NamedTuple):
    """Depth, its confidence and the truth, (H, W) float32, scene units; camera of that size."""

    depth: Float32
    confidence: Float32
    true: Float32
    camera: Cameras


def main() -> None:
    """Measure what is missing, then write tables and the plot."""
    o3d.utility.random.seed(0)
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("shared", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", default=";".join(SCENES))
    parser.add_argument("--plot", type=Path, default=Path("docs/images/depth_calibration.png"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    kept = args.out / "geometry.json"
    found = json.loads(kept.read_text()) if kept.exists() else {}
    names = [name.strip() for name in args.scenes.split(";")]
    if not set(names) <= set(SCENES):
        parser.error(f"--scenes {args.scenes}; expected names of {'; '.join(SCENES)}")
    for name in names:
        if name not in found:
            place = args.out / name.replace(",", "").replace(" ", "-")
            found[name] = _measured(name, place, args.shared / "data" / "sevenscenes_reg")
            kept.write_text(json.dumps(found, indent=1))
    (args.out / "geometry.md").write_text(_tables(found))
    _plot(found, args.plot)


def kept_errors(error: NDArray[Any], confidence: NDArray[Any], share: float) -> list[float]:
    """Median error (N,) of the most confident share of pixels, and share of these that is wrong."""
    shuffled = np.random.default_rng(0).permutation(len(error))
    order = shuffled[np.argsort(-confidence[shuffled], kind="stable")]
    kept = error[order[: max(round(share * len(error)), 1)]]
    return [float(np.median(kept)), float((kept > WRONG).mean())]


def f1(
    found: NDArray[Any], true: NDArray[Any], near: NDArray[Any], within: Sequence[float]
) -> list[list[float]]:
    """Precision (N, 3) points have, recall of the near of (M, 3) true ones, and F1, by distance."""
    if not len(found):
        return [[0.0, 0.0, 0.0] for _ in within]
    pairs = ((found, true), (near, found))
    off = [cKDTree(b).query(a, distance_upper_bound=1.01 * max(within))[0] for a, b in pairs]
    shares = [[float((each <= distance).mean()) for each in off] for distance in within]
    return [[p, r, 2 * p * r / max(p + r, 1e-12)] for p, r in shares]


def _measured(name: str, place: Path, real: Path) -> dict[str, Any]:
    """Render or link a scene, run it, and judge depth and surfaces."""
    if name in PLACES and not place.exists():
        write_place(place, PLACES[name])
    elif not place.exists():
        place.mkdir()
        for file in real.resolve().iterdir():
            if not file.name.endswith(".depth.png"):
                (place / file.name).symlink_to(file)
    found: dict[str, Any] = {"clouds": {}}
    true, near, extent = np.zeros((0, 3)), np.zeros((0, 3)), 0.0
    for kind, options in RUNS.items():
        out = place.with_name(f"{place.name}_{kind}")
        if not (out / "metrics.json").exists():
            shutil.rmtree(out, ignore_errors=True)
            words = [str(place), "--context", SCENES[name], "--targets", "interpolate:2", *options]
            subprocess.run(
                [*GVTOOLS, "reconstruct", *words, "--quiet", "--out", str(out)], check=True
            )
        run = load_run(out)
        views = _depth_views(run, _truth(run, place if name in PLACES else real))
        found[kind] = _judged(views)
        if name not in PLACES:
            continue
        if not extent:
            far = NEAR * np.median(np.concatenate([v.true[v.true > 0] for v in views]))
            near = np.vstack([_lifted(v.true * (v.true < far), v.camera) for v in views])
            extent = float(np.linalg.norm(np.subtract(*np.percentile(near, [99, 1], axis=0))))
            true = _thinned(np.vstack([_lifted(v.true, v.camera) for v in views]), extent)
            near = _thinned(near, extent)[:POINTS]
        surfaces = {
            "memory": _exported(run.path, "ply"),
            "gvtools mesh": _exported(run.path, "mesh"),
            "Open3D TSDF": _tsdf(views, extent, 1.0),
            "Open3D TSDF, seen 3 times": _tsdf(views, extent, 3.0),
            "COLMAP fusion": _fused(views, run, place),
        }
        for label, points in surfaces.items():
            thin = _thinned(points, extent)[:POINTS]
            figures = f1(thin, true, near, [share * extent for share in WITHIN])
            found["clouds"][f"{kind}, {label}"] = figures
    return found | {"extent": extent}


def _truth(run: Run, project: Path) -> dict[str, Float32]:
    """True depth of the context, 0 where none is known."""
    scene, file = open_project(project), project / "truth.npz"
    if file.exists():
        with np.load(file, allow_pickle=False) as data:
            depths = data["depth"].astype(np.float32)
        return {view: depths[scene.names.index(view)] for view in run.context}
    recorded = {view: scene[view].load().depth for view in run.context}
    return {view: depth for view, depth in recorded.items() if depth is not None}


def _depth_views(run: Run, truth: dict[str, Float32]) -> list[DepthView]:
    views = []
    for view, path in context_depth_files(round_folder(run.path, 0), run.context).items():
        with np.load(path, allow_pickle=False) as data:
            depth, confidence = data["depth"], data["confidence"]
        height, width = depth.shape
        camera = run.scenes[0][view].camera.resized(width, height)
        true = resize_nearest(truth[view], width, height)
        views.append(DepthView(depth, confidence, true, camera))
    return views


def _judged(views: list[DepthView]) -> dict[str, Any]:
    """Errors of depth by its confidence and by how many neighbours agree."""
    columns = []
    for number, view in enumerate(views):
        others = views[:number] + views[number + 1 :]
        near = nearest_views(concatenate([o.camera for o in others]), view.camera, NEIGHBOURS)
        theirs = [(_inverse(others[row].depth), others[row].camera) for row in near]
        agree = agreement(_inverse(view.depth), view.camera, theirs, tolerance=AGREE).views.numpy()
        where = (view.depth > 0) & (view.true > 0)
        error = np.abs(view.depth[where] / view.true[where] - 1)
        columns.append(np.stack([error, view.confidence[where], agree[where]]))
    error, confidence, agree = np.concatenate(columns, axis=1)
    diagram = reliability(np.minimum(confidence, 1), error < RIGHT, bins=BINS)
    return {
        "known": len(error) / sum(int((view.true > 0).sum()) for view in views),
        "confident": [kept_errors(error, confidence, share) for share in KEPT],
        "agreeing": [kept_errors(error, agree, share) for share in KEPT],
        "calibration_error": diagram.error,
        "diagram": [diagram.predicted.tolist(), diagram.observed.tolist(), diagram.count.tolist()],
        "by_agreeing": [
            [float(of.mean()), float(((error > WRONG) & of).sum() / max(of.sum(), 1))]
            for of in (agree == count for count in range(NEIGHBOURS + 1))
        ],
    }  # fmt: skip


def _inverse(depth: Float32) -> torch.Tensor:
    return torch.from_numpy(np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0))


def _lifted(depth: Float32, camera: Cameras) -> NDArray[np.float64]:
    """(N, 3) points of a depth map, world frame."""
    points = camera.rays(0)[depth > 0] * depth[depth > 0, None]
    return camera.centers[0] + points @ camera.world_from_cam[0, :3, :3].T


def _thinned(points: NDArray[Any], extent: float) -> NDArray[Any]:
    """One point a cell, in random order."""
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    thin = np.asarray(cloud.voxel_down_sample(CELL * extent).points)
    return np.random.default_rng(0).permutation(thin)


def _exported(run: Path, form: str) -> NDArray[Any]:
    """Points of a run's observed cloud, or of its mesh."""
    file = str(run.with_name(f"{run.name}_{form}.ply"))
    words = ["export", str(run), "--format", form, "--observed", "--quiet", "--out", file]
    subprocess.run([*GVTOOLS, *words], check=True)
    if form == "ply":
        return np.asarray(o3d.io.read_point_cloud(file).points)
    mesh = o3d.io.read_triangle_mesh(file)
    return np.asarray(mesh.sample_points_uniformly(5 * POINTS).points)


def _tsdf(views: list[DepthView], extent: float, weight: float) -> NDArray[Any]:
    """Points where at least so many views meet in Open3D's TSDF."""
    volume = TsdfVolume(VOXEL * extent, blocks=8_000)
    for view in views:
        black = np.zeros((*view.depth.shape, 3), np.uint8)
        volume.integrate(*images(black, view.depth), view.camera)
    points: NDArray[Any] = volume.grid.extract_point_cloud(weight).point.positions.numpy()
    return points


def _fused(views: list[DepthView], run: Run, place: Path) -> NDArray[Any]:
    """Points by COLMAP's stereo fusion, on the CPU, of depth and normals given to it."""
    import pycolmap

    folder = run.path.with_name(f"{run.path.name}_workspace")
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(place / "images", folder / "images")
    shutil.copytree(place / "sparse" / "0", folder / "sparse")
    for name, view in zip(run.context, views, strict=True):
        points = view.camera.rays(0) * view.depth[..., None]
        normals = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
        normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-12)
        normals *= -np.sign((normals * points).sum(axis=2, keepdims=True))
        maps = {"depth_maps": view.depth[None], "normal_maps": np.moveaxis(normals, 2, 0)}
        for kind, array in maps.items():
            (folder / "stereo" / kind).mkdir(parents=True, exist_ok=True)
            header = "".join(f"{side}&" for side in array.shape[::-1]).encode()
            file = folder / "stereo" / kind / f"{name}.geometric.bin"
            file.write_bytes(header + array.astype(np.float32).tobytes())
    (folder / "stereo" / "fusion.cfg").write_text("\n".join(run.context))
    sources = "".join(f"{name}\n__auto__, 20\n" for name in run.context)
    (folder / "stereo" / "patch-match.cfg").write_text(sources)
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels = LEAST_FUSED
    out = str(folder / "fused.ply")
    pycolmap.stereo_fusion(out, str(folder), options=options, output_type="ply")
    return np.asarray(o3d.io.read_point_cloud(out).points)


def _percent(values: list[float]) -> str:
    return ", ".join(f"{100 * value:.1f}" for value in values)


def _tables(found: dict[str, Any]) -> str:
    depths = [(name, kind, row[kind]) for name, row in found.items() for kind in RUNS]
    orders = "confident", "agreeing"
    tables = {
        f"Median error, share off by more than {WRONG:.0%} [%] of pixels kept": [
            ["scene", "depth", "known [%]", *(f"{by}, {s:.0%}" for by in orders for s in KEPT),
             "calibration error"],
            *([name, kind, _percent([row["known"]]), *map(_percent, [*row[orders[0]],
               *row[orders[1]]]), f"{row['calibration_error']:.3f}"] for name, kind, row in depths),
        ],
        f"Share of pixels, wrong ones of them [%] by how many of {NEIGHBOURS} neighbours agree": [
            ["scene", "depth", *map(str, range(NEIGHBOURS + 1))],
            *([name, kind, *map(_percent, row["by_agreeing"])] for name, kind, row in depths),
        ],
        "Precision, recall, F1 [%] of points within shares of the extent": [
            ["place", "depth, surface", *(f"{share:.0%}" for share in WITHIN)],
            *([name, label, *map(_percent, figures)] for name, row in found.items()
              for label, figures in row["clouds"].items()),
        ],
    }  # fmt: skip
    text = ""
    for title, (head, *rows) in tables.items():
        lines = (f"| {' | '.join(cells)} |\n" for cells in (head, ["---"] * len(head), *rows))
        text += f"{title}:\n\n{''.join(lines)}\n"
    return text


def _plot(found: dict[str, Any], path: Path) -> None:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 4.2), sharey=True)
    titles = ("depth of fitted Gaussians", "plane sweep alone")
    for axis, kind, title in zip(axes, RUNS, titles, strict=True):
        axis.plot([0, 1], [0, 1], "k:", lw=1, label="as stated")
        for name, row in found.items():
            stated, right, count = np.array(row[kind]["diagram"])
            some = count > 0.005 * count.sum()
            axis.plot(stated[some], right[some], "o-", ms=3, label=name)
        axis.set(title=title, xlabel="stated confidence", xlim=(0, 1), ylim=(0, 1))
        axis.grid(alpha=0.3)
    axes[0].set_ylabel(f"share of pixels with an error below {RIGHT:.0%}")
    axes[0].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    main()
