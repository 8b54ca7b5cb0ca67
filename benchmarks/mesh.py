"""How well a run's exported mesh meets the recorded depth, and the photographs, of held-out views.

Every pixel with recorded depth counts: the share within 2 cm, and of the misses those without a
hit, in front and behind; by distance, and at depth edges and elsewhere. Poses are those that the
run has for its targets; no held-out depth was used for any of them. With ``--icp`` each held-out
pose is moved to the mesh by that view's own depth, which tells shape from poses. Colours: PSNR
where rays meet the mesh. Usage:

    python benchmarks/mesh.py RUN MESH [MESH ...] [--within 0.02] [--icp] [--pictures DIR]
                              [--depth-from MESH] [--json FILE]

RUN was made from a part of an RGB-D project with the rest as targets (``--context every:2
--targets every:2+1``); MESH are its exports. ``--depth-from`` measures against that mesh's depth
instead of the recorded one, as after ``--max-triangles``.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import open3d as o3d
import trimesh
from numpy.typing import NDArray

from gvtools.errors import ProjectError
from gvtools.evaluation.images import psnr
from gvtools.files import write_json
from gvtools.runs.run import load_run
from pipelines.console import Console

# Depth edges: where depth within RADIUS pixels spreads by more than this [share of depth, units].
RADIUS, SPREAD, LEAST = 3, 0.03, 0.02
BOUNDS = (0, 1, 1.5, 2, 2.5, 3, np.inf)
# Points farther than this from the mesh do not count when a pose is moved, step by step; every
# STRIDE-th pixel and line does.
GATES, STRIDE = (0.1, 0.08, 0.06, 0.05, 0.04, 0.04), 3
SHOWN = 0.06


@dataclass(frozen=True, eq=False)
class HeldOutView:
    """A held-out view: rgb (H, W, 3) uint8, depth (H, W), K (3, 3), cam_from_world (4, 4)."""

    name: str
    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    K: NDArray[np.float64]
    pose: NDArray[np.float64]


class Surface:
    """A mesh that rays meet. Positions count from its middle, where float32 is fine enough."""

    def __init__(self, path: Path) -> None:
        loaded: Any = trimesh.load(path, process=False, force="mesh")
        self.mesh = loaded
        self.middle = self.mesh.bounds.mean(axis=0)
        self.rays = o3d.t.geometry.RaycastingScene()
        self.rays.add_triangles(
            o3d.core.Tensor((self.mesh.vertices - self.middle).astype(np.float32)),
            o3d.core.Tensor(self.mesh.faces.astype(np.uint32)),
        )

    def cast(self, view: HeldOutView, pose: NDArray[np.float64] | None = None) -> dict[str, Any]:
        """What Open3D's rays through a view's pixels meet."""
        pose = (view.pose if pose is None else pose).copy()
        pose[:3, 3] += pose[:3, :3] @ self.middle
        height, width = view.depth.shape
        lens, place = o3d.core.Tensor(view.K), o3d.core.Tensor(pose)
        found = self.rays.cast_rays(self.rays.create_rays_pinhole(lens, place, width, height))
        return {name: found[name].numpy() for name in found}

    def colors(self, hit: dict[str, Any]) -> NDArray[np.float64]:
        """(H, W, 3) 0 to 255, between the corners of what rays met; 0 where they met none."""
        met = np.isfinite(hit["t_hit"])
        corners = self.mesh.faces[hit["primitive_ids"][met]]
        at = hit["primitive_uvs"][met]
        weights = np.stack([1 - at.sum(axis=1), *at.T], axis=1)[..., None]
        out = np.zeros((*met.shape, 3))
        if self.mesh.visual.kind == "texture":
            uv = (self.mesh.visual.uv[corners] * weights).sum(axis=1)
            out[met] = _read(self.mesh.visual.material, uv)
        else:
            out[met] = (self.mesh.visual.vertex_colors[corners, :3] * weights).sum(axis=1)
        return out


def main() -> None:
    """Measure the meshes, print the figures, and write them as JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("meshes", type=Path, nargs="+")
    parser.add_argument("--within", type=float, default=0.02, help="scene units (0.02)")
    parser.add_argument("--icp", action="store_true", help="also with poses moved to the mesh")
    parser.add_argument("--depth-from", type=Path, metavar="MESH")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="write pictures of the misses")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    views = held_out_views(args.run)
    if args.depth_from is not None:
        other = Surface(args.depth_from)
        views = [_with_depth(view, other) for view in views]
    figures = {}
    for path in args.meshes:
        surface = Surface(path)
        figures[path.name] = measured(surface, views, within=args.within, pictures=args.pictures)
        if args.icp:
            moved = [_moved(surface, view) for view in views]
            figures[f"{path.name}, ICP"] = measured(surface, moved, within=args.within)
    console = Console()
    names = list(next(iter(figures.values())))
    console.table(
        ["", *figures], [[name, *(row[name] for row in figures.values())] for name in names]
    )
    if args.json is not None:
        write_json(args.json, figures)


def held_out_views(folder: Path) -> list[HeldOutView]:
    """The run's targets with their recorded pictures and depth, at the poses the run has."""
    run = load_run(folder)
    truths = run.scenes[1]
    if truths is None:
        raise ProjectError(f"{folder}: its targets have no recorded views; make them a selection")
    views = []
    for name in run.record["targets"]:
        view = truths[name]
        frame = view.load()
        if frame.depth is None:
            raise ProjectError(f"{name}: no depth; expected an RGB-D project")
        camera = view.camera
        views.append(
            HeldOutView(name, frame.rgb, frame.depth, camera.K[0], camera.cam_from_world[0])
        )
    return views


def measured(
    surface: Surface, views: list[HeldOutView], *, within: float, pictures: Path | None = None
) -> dict[str, float]:
    """Percentages of pixels with depth, and PSNR [dB]."""
    errors, depths, edges, levels = [], [], [], []
    for view in views:
        hit = surface.cast(view)
        known = view.depth > 0
        error = np.where(np.isfinite(hit["t_hit"]), hit["t_hit"] - view.depth, np.nan)
        errors.append(error[known])
        depths.append(view.depth[known])
        edges.append(_edges(view.depth)[known])
        level = psnr(surface.colors(hit) / 255, view.rgb, mask=np.isfinite(hit["t_hit"]))
        levels += [] if level is None else [level]
        if pictures is not None:
            _draw(pictures / f"{Path(view.name).stem}.png", view, np.where(known, error, np.nan))
    error, depth, edge = (np.concatenate(each) for each in (errors, depths, edges))
    near = np.abs(error) <= within
    figures = {
        "within": 100 * near.mean(),
        "no hit": 100 * np.isnan(error).mean(),
        "in front": 100 * (error < -within).mean(),
        "behind": 100 * (error > within).mean(),
    }
    groups = {f"{a:g} to {b:g}": (depth > a) & (depth <= b)
              for a, b in pairwise(BOUNDS)}  # fmt: skip
    groups |= {"at depth edges": edge, "elsewhere": ~edge}
    for name, rows in groups.items():
        figures[f"share {name}"] = 100 * rows.mean()
        figures[f"within, {name}"] = 100 * near[rows].mean() if rows.any() else float("nan")
    figures["PSNR"] = float(np.mean(levels)) if levels else float("nan")
    return {name: round(float(value), 2) for name, value in figures.items()}


def _read(material: Any, uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3) of a material's picture between its texels, at uv (N, 2) from the lower left."""
    image = getattr(material, "baseColorTexture", None) or material.image
    texels = np.asarray(image.convert("RGB"))
    x, y = (uv * [1, -1] + [0, 1]).T * [[texels.shape[1]], [texels.shape[0]]] - 0.5
    out = []
    for start in range(0, len(x), 30_000):  # remap takes no longer pictures
        some = slice(start, start + 30_000)
        xs, ys = (each[some, None].astype(np.float32) for each in (x, y))
        out.append(cv2.remap(texels, xs, ys, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    return np.concatenate(out)[:, 0].astype(np.float64)


def _edges(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    kernel = np.ones((2 * RADIUS + 1, 2 * RADIUS + 1), np.uint8)
    far = cv2.dilate(depth, kernel)
    near = cv2.erode(np.where(depth > 0, depth, np.float32(1e9)), kernel)
    return np.asarray(far - near > SPREAD * depth + LEAST)


def _with_depth(view: HeldOutView, surface: Surface) -> HeldOutView:
    depth = surface.cast(view)["t_hit"]
    return HeldOutView(
        view.name, view.rgb, np.where(np.isfinite(depth), depth, 0), view.K, view.pose
    )


def _moved(surface: Surface, view: HeldOutView) -> HeldOutView:
    """The view at the pose at which its depth fits the mesh best, point to plane."""
    line, column = np.mgrid[: view.depth.shape[0], : view.depth.shape[1]] + 0.5
    rays = np.stack([column, line, np.ones_like(line)], axis=-1) @ np.linalg.inv(view.K).T
    pose = view.pose
    for gate in GATES:
        hit = surface.cast(view, pose)
        apart = hit["t_hit"] - view.depth
        used = (view.depth > 0) & (np.abs(apart) < gate)
        used[np.arange(len(used)) % STRIDE > 0] = False
        used[:, np.arange(used.shape[1]) % STRIDE > 0] = False
        if used.sum() < 100:
            break
        z = view.depth[used].astype(np.float64)
        points = rays[used] * z[:, None]
        normals = hit["primitive_normals"][used] @ pose[:3, :3].T
        off = (rays[used] * -apart[used][:, None] * normals).sum(axis=1)
        # A depth camera's error grows with the square of the distance.
        noise = 0.002 + 0.0025 * z**2
        weight = 1 / noise**2 / (1 + (off / noise / 2) ** 2) ** 2
        rows = np.concatenate([np.cross(points, normals), normals], axis=1)
        step = -np.linalg.solve(
            rows.T @ (rows * weight[:, None]) + 1e-6 * np.eye(6), rows.T @ (weight * off)
        )
        move = np.eye(4)
        move[:3, :3], move[:3, 3] = cv2.Rodrigues(step[:3])[0], step[3:]
        # The camera's points move to the mesh: cam_from_world takes the inverse.
        pose = np.linalg.inv(move) @ pose
    return HeldOutView(view.name, view.rgb, view.depth, view.K, pose)


def _draw(path: Path, view: HeldOutView, error: NDArray[np.floating]) -> None:
    """The photograph beside the error: red in front, blue behind, grey without depth or hit."""
    share = np.clip(np.nan_to_num(error) / SHOWN, -1, 1)[..., None]
    color = np.where(share < 0, [255, 0, 0], [0, 0, 255]) * np.abs(share) + 255 * (1 - abs(share))
    color = np.where(np.isnan(error)[..., None], 128, color)
    path.parent.mkdir(parents=True, exist_ok=True)
    both = np.concatenate([view.rgb, color.astype(np.uint8)], axis=1)
    cv2.imwrite(str(path), both[..., ::-1])


if __name__ == "__main__":
    main()
