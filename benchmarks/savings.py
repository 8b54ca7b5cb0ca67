"""What each of a run's savings saves, and what it costs.

    python benchmarks/savings.py PROJECT [--completer NAME] [--depth SOURCE] [--set KEY=VALUE ...]

Every second view of the project is context, those between are targets. The run is made with all
savings off, with each of them alone, and with all of them, in turns within one process; seconds are
medians over ``--repeats``. Figures are of whole pictures against the photographs.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gvtools.runs.folder import RunDirectory
from gvtools.scenes.project import open_project
from gvtools.scenes.scene import Scene
from gvtools.settings import with_texts, with_values
from pipelines.console import Console
from pipelines.reconstruction.run import reconstruct
from pipelines.reconstruction.settings import RunSettings

# Each saving's settings when it is off.
OFF: dict[str, dict[str, Any]] = {
    "voxel edge measured": {"fusion.max_psnr_drop_db": None},
    # With one edge throughout, the typical footprint's is the sensible one.
    "voxels as wide as footprints": {
        "memory.voxels_per_footprint": 0.0,
        "fusion.voxel_percentile": 50.0,
    },
    "alike observations merged": {
        "memory.merge_angle_deg": 0.0,
        "memory.observations_per_voxel": 64,
    },
    "four pixels a point where voxels are coarser": {"savings.pixel_binning": 0.0},
    "observed content projected once": {"savings.reuse": False},
    "small holes left to inpaint": {"effort.inpaint_below": 0.0},
    "explained views without computed depth": {"savings.depth_from_memory": None},
}


@dataclass
class Row:
    """One configuration's runs."""

    config: RunSettings
    whole: list[float] = field(default_factory=list)
    rounds: list[float] = field(default_factory=list)
    psnr: float = 0.0
    observations: int = 0

    def run(self, scene: Scene, folder: Path) -> None:
        """Once more."""
        out = folder / "run"
        start = time.perf_counter()
        reconstruct(scene, self.config, out, console=Console(quiet=True))
        self.whole.append(time.perf_counter() - start)
        reports = RunDirectory(out).reports()
        self.rounds.append(sum(report["seconds"]["total"] for report in reports))
        metrics = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
        self.psnr = metrics["psnr"]
        self.observations = reports[-1]["points"]
        shutil.rmtree(out)


def rows_of(config: RunSettings, *, computed: bool) -> dict[str, Row]:
    """All savings off, each alone, all on; those that this run does not have are left out."""
    idle = set()
    if config.completer != "geoverse":
        idle.add("small holes left to inpaint")
    if not computed:
        idle.add("explained views without computed depth")

    def without(names: set[str]) -> Row:
        changed = config
        for name in names:
            changed = with_values(changed, OFF[name])
        return Row(changed)

    used = set(OFF) - idle
    rows = {"none": without(set(OFF))}
    rows |= {name: without(set(OFF) - {name}) for name in OFF if name in used}
    return rows | {"all": without(set())}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("project", type=Path)
    parser.add_argument("--completer", default="inpaint")
    parser.add_argument("--depth", default="auto")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--repeats", type=int, default=1)
    args = parser.parse_args()
    scene = open_project(args.project)
    config = RunSettings(
        context="every:2", targets="every:2+1", completer=args.completer, depth=args.depth
    )
    config = with_texts(config, args.set)
    computed = args.depth not in ("sensor", "colmap")
    computed &= args.depth != "auto" or not all(view.has_depth for view in scene.views)
    with tempfile.TemporaryDirectory() as folder:
        # Compiled kernels load, and files come into the cache, untimed.
        warm = Row(config.replaced(targets=scene.views[1].name))
        warm.run(scene, Path(folder))
        rows = rows_of(config, computed=computed)
        for _ in range(args.repeats):
            for row in rows.values():
                row.run(scene, Path(folder))
    first = rows["none"]
    print("| savings | observations | PSNR, dB | rounds, s | whole, s |\n|---|---|---|---|---|")
    for name, row in rows.items():
        rounds, whole = statistics.median(row.rounds), statistics.median(row.whole)
        print(
            f"| {name} | {row.observations / 1e6:.2f} M, "
            f"{first.observations / row.observations:.1f} x fewer | {row.psnr:.2f} "
            f"({row.psnr - first.psnr:+.2f}) | {rounds:.1f}, "
            f"{statistics.median(first.rounds) / rounds:.2f} x less | {whole:.1f}, "
            f"{statistics.median(first.whole) / whole:.2f} x less |"
        )


if __name__ == "__main__":
    main()
