"""A merged run beside the run of the whole project: bits of observed content, PSNR, seams.

    python -m benchmarks.blocks WHOLE MERGED --blocks FOLDER

WHOLE and MERGED are runs with the same held-out views, FOLDER the split. A held-out view lies
across a seam where each of two blocks' cells holds at least a quarter of what it sees. Its PSNR is
also measured on the pixels near seams alone: those whose surface is within SEAM of a cell's face.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.runs.run import RunTarget, load_memory, load_run
from gvtools.scenes.scene import View
from pipelines.blocks.split import read_blocks

COLUMNS = ("positions", "colors", "confidence", "spacing", "round", "view", "level")
# Share of what a view sees, and distance from a face as a share of the cameras' extent.
ACROSS, SEAM = 0.25, 0.05


def observed(path: Path) -> SpatialMemory:
    """What round 0 left."""
    return load_memory(path, up_to=0)


def same_bits(one: SpatialMemory, two: SpatialMemory) -> dict[str, float]:
    """Of each column the share of equal rows; 0 where the numbers of rows differ."""
    if len(one) != len(two):
        return dict.fromkeys(COLUMNS, 0.0)
    shares = {}
    for name in COLUMNS:
        left, right = getattr(one.columns, name), getattr(two.columns, name)
        equal = left.view(np.uint8) == right.view(np.uint8)
        shares[name] = float(equal.reshape(len(one), -1).all(axis=1).mean())
    return shares


def psnr(target: RunTarget, truth: View, where: np.ndarray) -> float:
    """Of a completed picture on some pixels."""
    error = target.read().picture[where].astype(float) - truth.load().rgb[where].astype(float)
    return float(10 * np.log10(255**2 / np.square(error).mean()))


def main() -> None:
    """Print one table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("whole", type=Path)
    parser.add_argument("merged", type=Path)
    parser.add_argument("--blocks", type=Path, required=True)
    args = parser.parse_args()
    one, two = observed(args.whole), observed(args.merged)
    print(f"observations: {len(one):,} and {len(two):,}")
    print(f"equal rows: {same_bits(one, two)}")
    runs = [load_run(path) for path in (args.whole, args.merged)]
    blocks = [block for _, block in read_blocks(args.blocks)]
    centers = runs[0].scenes[0].subset(runs[0].context).cameras.centers
    margin = SEAM * float(np.ptp(centers, axis=0).max())
    others = {target.name: target for target in runs[1].views}
    rows = []
    for target, files, truth in runs[0].targets():
        if truth is None:
            continue
        known = files.depth > 0
        camera = target.camera
        pose = camera.world_from_cam[0]
        points = camera.rays(0)[known] * files.depth[known, None] @ pose[:3, :3].T + pose[:3, 3]
        shares = [block.cell.holds(points).mean() for block in blocks]
        near = np.zeros(len(points), bool)
        for block in blocks:
            inner = block.cell.low + margin, block.cell.high - margin
            near |= block.cell.holds(points) & ~((points >= inner[0]) & (points < inner[1])).all(
                axis=1
            )
        seam = np.zeros(known.shape, bool)
        seam[known] = near
        all_pixels = np.ones(known.shape, bool)
        pair = (target, others[target.name])
        figures = [psnr(item, truth, all_pixels) for item in pair]
        figures += [psnr(item, truth, seam) if seam.any() else np.nan for item in pair]
        across = sum(share >= ACROSS for share in shares) > 1
        rows.append([across, seam.mean(), *figures])
        print(target.name, "across" if across else "inside", *(f"{x:.3f}" for x in rows[-1][1:]))
    table = np.array(rows, float)
    for name, some in (("all views", table), ("views across seams", table[table[:, 0] > 0])):
        mean = np.nanmean(some[:, 2:], axis=0)
        print(
            f"{name} ({len(some)}): PSNR {mean[0]:.3f} whole, {mean[1]:.3f} merged; near seams "
            f"{mean[2]:.3f} whole, {mean[3]:.3f} merged"
        )


if __name__ == "__main__":
    main()
