"""Fusion in plain Python: a dictionary from voxel to its list of observations, oldest first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gvtools.memory.points import PointSet
from gvtools.memory.spatial_memory import MemoryOptions, SpatialMemory

single = np.float32


# Level and place of a voxel.
Cell = tuple[int, int, int, int]


@dataclass
class Observation:
    position: np.ndarray
    color: np.ndarray
    confidence: float
    spacing: float
    view: int
    agreement: float = 0.0


class ReferenceMemory:
    """The definitions of fusion, one point set after the other."""

    def __init__(self, voxel: float, options: MemoryOptions) -> None:
        self.voxel, self.options = voxel, options
        self.chains: dict[Cell, list[Observation]] = {}
        self.centers: list[np.ndarray] = []
        self.rounds: list[int] = []
        self.made: list[bool] = []

    def fuse(self, points: PointSet, *, round: int, generated: bool = False) -> dict[str, int]:
        """Free space is not looked at."""
        self.centers.append(points.frame.from_world(points.camera.centers)[0])
        self.rounds.append(round)
        self.made.append(generated)
        cells: dict[Cell, list[int]] = {}
        for i, p in enumerate(points.positions.astype(float)):
            ratio = self.options.footprints * float(points.spacing[i]) / self.voxel
            level = max(0, min(7, int(np.floor(np.log2(max(ratio, 1e-9) * (1 + 2**-10))))))
            cells.setdefault(self._cell(p, level), []).append(i)
        tally = {"added": 0, "merged": 0, "rejected_observed": 0, "voxels": 0, "agreed": 0}
        blocks: dict[Cell, list[Cell]] = {}
        for level, x, y, z in cells:
            blocks.setdefault((level, x >> 4, y >> 4, z >> 4), []).append((level, x, y, z))
        for cell in (cell for members in blocks.values() for cell in members):
            rows = cells[cell]
            w = points.confidence[rows].astype(float)
            fresh = Observation(
                w @ points.positions[rows].astype(float) / w.sum(),
                w @ points.colors[rows].astype(float) / w.sum(),
                w.max(),
                max(w @ points.spacing[rows].astype(float) / w.sum(), self.voxel * 2 ** cell[0]),
                len(self.centers) - 1,
            )
            self._take(self.chains.setdefault(cell, []), fresh, len(rows), tally)
            if not self.chains[cell]:
                del self.chains[cell]
        return tally

    def _cell(self, p: np.ndarray, level: int) -> Cell:
        x, y, z = np.floor(p * (1.0 / self.voxel) / 2**level).astype(int).tolist()
        return level, x, y, z

    def _take(self, chain: list[Observation], fresh: Observation, count: int, tally) -> None:
        generated, options = self.made[-1], self.options
        if generated and self._observed_at(fresh.position.astype(single)):
            tally["rejected_observed"] += count
            return
        rivals = [o for o in reversed(chain) if generated or not self.made[o.view]]
        if rivals:
            best = max(rivals, key=lambda o: self._likeness(o, fresh)[0])
            same = self._likeness(best, fresh)[1] >= np.cos(np.radians(options.same_direction))
            fine = fresh.spacing >= options.finer * best.spacing
            if len(rivals) >= options.observations_per_voxel or (same and fine):
                tally["merged"] += count
                if self.rounds[best.view] == self.rounds[-1]:
                    old = best.position
                    self._average(best, fresh)
                    if generated and self._observed_at(best.position):
                        best.position = old
                else:
                    best.agreement += fresh.confidence
                    tally["agreed"] += 1
                return
        fresh.color = np.floor(fresh.color + 0.5)
        fresh.position = fresh.position.astype(single)
        fresh.confidence = min(fresh.confidence, options.weight_cap)
        tally["voxels"] += not chain
        chain.append(fresh)
        tally["added"] += 1
        tally["merged"] += count - 1

    def _observed_at(self, p: np.ndarray) -> bool:
        """Whether a voxel of any level around a point holds observed content."""
        around = (self.chains.get(self._cell(p.astype(float), level), []) for level in range(8))
        return any(not self.made[o.view] for there in around for o in there)

    def _likeness(self, old: Observation, fresh: Observation) -> tuple[float, float]:
        a = self.centers[fresh.view] - fresh.position
        b = self.centers[old.view] - fresh.position
        cosine = float(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)))
        ratio = max(old.spacing / fresh.spacing, fresh.spacing / old.spacing)
        return cosine - 0.01 * (ratio - 1), cosine

    def _average(self, old: Observation, fresh: Observation) -> None:
        share = fresh.confidence / (fresh.confidence + old.confidence)
        old.position = (old.position + share * (fresh.position - old.position)).astype(single)
        old.color = np.floor(old.color + share * (fresh.color - old.color) + 0.5)
        old.spacing += share * (fresh.spacing - old.spacing)
        if fresh.confidence > old.confidence:
            old.view = fresh.view
        old.confidence = min(old.confidence + fresh.confidence, self.options.weight_cap)


def chains_of(memory: SpatialMemory) -> dict[Cell, list[Observation]]:
    """The same dictionary, read from the real memory's arrays."""
    chains: dict[Cell, list[Observation]] = {}
    records = memory.records
    for i, p in enumerate(records.position):
        level = int(records.level[i])
        x, y, z = np.floor(p.astype(float) * (1.0 / memory.voxel) / 2**level).astype(int).tolist()
        chains.setdefault((level, x, y, z), []).append(
            Observation(
                p,
                records.color[i].astype(float),
                float(records.confidence[i]),
                float(records.spacing[i]),
                int(records.view[i]),
                float(records.agreement[i]),
            )
        )
    return chains
