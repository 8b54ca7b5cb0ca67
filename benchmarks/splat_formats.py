"""Round trips of splat files through readers that share no code with gvtools.

Usage: python benchmarks/splat_formats.py RUN [--splat-transform PROGRAM] [--views 3]

RUN is one that fitted Gaussians. Each format is exported once and read by what there is of
splat-transform (npm, 3.7), Open3D, gsply, pygltflib and OpenUSD. A row tells how many Gaussians the
reader found, how far the farthest is from its own in the PLY [share of the median distance to the
next one], the median error of colours [of 255], and what pictures of the run's targets lose when
gvtools draws the file instead of the PLY [dB].
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from plyfile import PlyData
from scipy.spatial import cKDTree

from gvtools.appearance.splat.project_kernels import VALUES
from gvtools.appearance.splat.splat import Lens, Splat
from gvtools.evaluation.images import psnr
from gvtools.runs.run import load_run
from gvtools.splat_files import read_splats
from gvtools.splats import HARMONICS, Splats
from pipelines.cli import main as gvtools

ENDS = (".ply", ".compressed.ply", ".spz", ".sog", ".splat", ".ksplat", ".glb", ".usdc")
HALF_TURN = np.array([1.0, -1, -1])
KHR = "KHR_gaussian_splatting:"
Found = tuple[Any, Any]  # positions and colours from 0 to 1, (N, 3) each


def shade(dc: Any) -> Any:
    """Colours of coefficients of degree 0."""
    return np.clip(0.5 + HARMONICS[0] * np.asarray(dc, np.float64), 0, 1)


def by_plyfile(file: Path) -> Found:
    """A PLY."""
    vertex = PlyData.read(str(file))["vertex"]
    columns = [np.stack([vertex[n] for n in names], axis=1)
               for names in ("xyz", [f"f_dc_{k}" for k in range(3)])]  # fmt: skip
    return columns[0], shade(columns[1])


def by_gsply(file: Path) -> Found:
    """An SPZ, or a PLY, compressed or not."""
    package = import_module("gsply")
    data = package.read_spz(file) if file.suffix == ".spz" else package.plyread(file)
    return data.means, shade(data.sh0)


def by_open3d(file: Path) -> Found:
    """A PLY, SPZ or .splat."""
    cloud = import_module("open3d").t.io.read_point_cloud(str(file))
    return cloud.point.positions.numpy(), shade(cloud.point["f_dc"].numpy())


def by_pygltflib(file: Path) -> Found:
    """A GLB as gvtools writes it."""
    tree = import_module("pygltflib").GLTF2().load(str(file))
    body, attributes = tree.binary_blob(), vars(tree.meshes[0].primitives[0].attributes)

    def array(name: str) -> Any:
        accessor = tree.accessors[attributes[name]]
        view = tree.bufferViews[accessor.bufferView]
        return np.frombuffer(body, "<f4", 3 * accessor.count, view.byteOffset).reshape(-1, 3)

    return array("POSITION") + tree.nodes[0].translation, shade(array(f"{KHR}SH_DEGREE_0_COEF_0"))


def by_openusd(file: Path) -> Found:
    """A USD of one field of splats, in the axes from before its root turned them upright."""
    from pxr import Usd, UsdGeom, UsdVol

    stage = Usd.Stage.Open(str(file))
    (prim,) = (p for p in stage.Traverse() if p.IsA(UsdVol.ParticleField3DGaussianSplat))
    root = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetDefaultPrim()))
    world = np.array(prim.GetAttribute("positions").Get()) @ root[:3, :3] + root[3, :3]
    sh = np.array(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get())
    terms = (prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() + 1) ** 2
    return world @ root[:3, :3].T, shade(sh[::terms])


READERS: dict[str, tuple[tuple[str, Callable[[Path], Found]], ...]] = {
    ".ply": (("plyfile", by_plyfile), ("open3d", by_open3d), ("gsply", by_gsply)),
    ".compressed.ply": (("gsply", by_gsply),),
    ".spz": (("open3d", by_open3d), ("gsply", by_gsply)),
    ".splat": (("open3d", by_open3d),),
    ".glb": (("pygltflib", by_pygltflib),),
    ".usdc": (("pxr", by_openusd),),
}


def reads(file: Path, end: str, program: str | None) -> Iterator[tuple[str, Found]]:
    """What each reader of a file finds in it."""
    for package, reader in READERS.get(end, ()):
        if find_spec(package) is not None:
            yield package, reader(file)
    if program and end not in (".glb", ".usdc"):
        plain = file.with_name("read.ply")
        subprocess.run([program, "-w", "-q", str(file), str(plain)], check=True)
        yield "splat-transform", by_plyfile(plain)


def picture(splats: Splats, camera: Any) -> Any:
    """(H, W, 3) of a camera, from 0 to 1."""
    values = np.zeros((len(splats), VALUES), np.float32)
    kept = splats.values[:, :VALUES]
    values[:, : kept.shape[1]] = kept
    pose = camera.cam_from_world[0].copy()
    pose[:3, 3] += pose[:3, :3] @ splats.origin
    size = int(camera.width[0]), int(camera.height[0])
    drawn = Splat(values, Lens.of(pose, camera.K[0], size=size, near=0.05)).image
    return np.clip(drawn[:3].transpose(1, 2, 0), 0, 1)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--splat-transform")
    parser.add_argument("--views", type=int, default=3)
    options = parser.parse_args()
    run = load_run(options.run)
    _, truths = run.scenes
    targets = [target for target in run.views if target.camera.names[0] in truths.names]
    targets = targets[: options.views]
    with tempfile.TemporaryDirectory() as folder:
        plain, kept = Path(folder) / "a.ply", {}
        for end in ENDS:
            out = Path(folder) / f"a{end}"
            source = options.run if end == ".ply" else plain
            form = ("--format", "splat", "--out", str(out), "--quiet")
            if gvtools(["export", str(source), *form]):
                raise SystemExit(f"{end}: export failed")
            kept[end] = read_splats(out)
        positions, colors = by_plyfile(plain)
        apart = float(np.median(cKDTree(positions).query(positions, 2)[0][:, 1]))
        print("| file | MB | reader | Gaussians | positions | colours | loses |")
        print("|---|---|---|---|---|---|---|")
        wholes = [psnr(picture(kept[".ply"], t.camera), truths[t.camera.names[0]].load().rgb / 255)
                  for t in targets]  # fmt: skip
        for end in ENDS:
            file = Path(folder) / f"a{end}"
            lost = [whole - psnr(picture(kept[end], t.camera),
                                 truths[t.camera.names[0]].load().rgb / 255)
                    for whole, t in zip(wholes, targets, strict=True)]  # fmt: skip
            for reader, (found, shown) in reads(file, end, options.splat_transform):
                world = found * HALF_TURN if end == ".spz" else found
                distance, place = cKDTree(world).query(positions)
                error = np.median(np.abs(shown[place] - colors)) * 255
                print(f"| `{end}` | {file.stat().st_size / 1e6:.1f} | {reader} | {len(found):,} "
                      f"| {distance.max() / apart:.2g} | {error:.2g} "
                      f"| {np.mean(lost) if lost else float('nan'):.2f} |")  # fmt: skip
        print(f"PLY: {np.mean(wholes) if wholes else float('nan'):.2f} dB, {len(targets)} views")


if __name__ == "__main__":
    main()
