"""What decides a run's result, as digests and plain data; compared on resuming."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pipelines.reconstruction.plan import Plan
from pipelines.reconstruction.sampling import sampled


def run_identity(plan: Plan, reading: Mapping[str, Any]) -> dict[str, Any]:
    """The identity of a run.

    Args:
        plan: the run.
        reading: how the user said the project is to be read, JSON-ready.
    """
    files = [file for name in plan.context for file in plan.scene[name].files]
    files += [file for view in plan.targets.truth if view for file in view.files]
    return {
        "project": str(plan.scene.root.resolve()),
        "reading": dict(reading),
        "fingerprint": fingerprint([*files, *plan.targets.files]),
        "cameras": _camera_digest(plan),
        "points": _point_digest(plan),
        "pixels": _pixel_digest(plan),
        "weights": fingerprint(plan.weights),
        "settings": plan.settings.to_dict(),
        "derived": plan.derived,
        "context": list(plan.context),
        "targets": list(plan.targets.cameras.names),
        "targets_kind": plan.targets.kind,
        "targets_project": None if plan.targets.project is None else str(plan.targets.project),
        "schedule": [list(rows) for rows in plan.schedule],
    }


def fingerprint(files: Iterable[Path]) -> str:
    """A digest of the names, sizes and modification times of what a run reads."""
    digest = hashlib.sha256()
    for path in sorted(set(files)):
        try:
            status = path.stat()
        except OSError:
            digest.update(f"{path.name}:absent\n".encode())
            continue
        digest.update(f"{path.name}:{status.st_size}:{status.st_mtime_ns}\n".encode())
    return digest.hexdigest()


def _camera_digest(plan: Plan) -> str:
    """Of the intrinsics, poses and sizes of context and targets."""
    digest = hashlib.sha256()
    for cameras in (plan.scene.subset(plan.context).cameras, plan.targets.cameras):
        for array in (cameras.K, cameras.cam_from_world, cameras.width, cameras.height):
            digest.update(array.tobytes())
    return digest.hexdigest()


def _point_digest(plan: Plan) -> str | None:
    """Of the sparse points and their tracks, by which depth is sought and checked."""
    points = plan.scene.points
    if points is None:
        return None
    digest = hashlib.sha256()
    for array in (points.positions, points.point_index, points.view_index, points.xy):
        digest.update(array.tobytes())
    return digest.hexdigest()


def _pixel_digest(plan: Plan) -> str:
    """Of some context views as they are read: units, registration and masks show in the pixels."""
    digest = hashlib.sha256()
    for name in sampled(plan.context):
        frame = plan.scene[name].load()
        for array in (frame.rgb, frame.depth, frame.mask):
            digest.update(b"none" if array is None else array.tobytes())
    return digest.hexdigest()
