"""Fusion in plain Python: a dictionary from voxel to its list of observations, oldest first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gvtools.memory.points import PointSet
from gvtools.memory.spatial_memory import MemoryOptions, SpatialMemory

single = np.float32


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
        self.chains: dict[tuple[int, int, int], list[Observation]] = {}
        self.centers: list[np.ndarray] = []
        self.rounds: list[int] = []
        self.made: list[bool] = []

    def fuse(self, points: PointSet, *, round: int, generated: bool = False) -> dict[str, int]:
        """Free space is not looked at."""
        self.centers.append(points.frame.from_world(points.camera.centers)[0])
        self.rounds.append(round)
        self.made.append(generated)
        cells: dict[tuple[int, int, int], list[int]] = {}
        for i, p in enumerate(points.positions.astype(float)):
            x, y, z = np.floor(p * (1.0 / self.voxel)).astype(int).tolist()
            cells.setdefault((x, y, z), []).append(i)
        tally = {"added": 0, "merged": 0, "rejected_observed": 0, "voxels": 0, "agreed": 0}
        for cell, rows in cells.items():
            w = points.confidence[rows].astype(float)
            fresh = Observation(
                w @ points.positions[rows].astype(float) / w.sum(),
                w @ points.colors[rows].astype(float) / w.sum(),
                w.max(),
                max(w @ points.spacing[rows].astype(float) / w.sum(), self.voxel),
                len(self.centers) - 1,
            )
            tally["voxels"] += cell not in self.chains
            self._take(self.chains.setdefault(cell, []), fresh, len(rows), tally)
        return tally

    def _take(self, chain: list[Observation], fresh: Observation, count: int, tally) -> None:
        generated, options = self.made[-1], self.options
        if generated and any(not self.made[o.view] for o in chain):
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
                    self._average(best, fresh)
                else:
                    best.agreement += fresh.confidence
                    tally["agreed"] += 1
                return
        fresh.color = np.floor(fresh.color + 0.5)
        fresh.position = fresh.position.astype(single)
        fresh.confidence = min(fresh.confidence, options.weight_cap)
        chain.append(fresh)
        tally["added"] += 1
        tally["merged"] += count - 1

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


def chains_of(memory: SpatialMemory) -> dict[tuple[int, int, int], list[Observation]]:
    """The same dictionary, read from the real memory's arrays."""
    chains: dict[tuple[int, int, int], list[Observation]] = {}
    records = memory.records
    for i, p in enumerate(records.position):
        x, y, z = np.floor(p.astype(float) * (1.0 / memory.voxel)).astype(int).tolist()
        chains.setdefault((x, y, z), []).append(
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
