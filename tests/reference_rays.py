"""A slow, plain reference of procedural geometry: where rays leave free space, by membership.

A point is free inside a room and outside every solid, cutters apart. Along a ray that can change
only where it crosses a plane or a quadric of the scene; between two crossings the middle decides.
Nothing here knows of intervals, rooms that are joined, or the order in which things are cut.
"""

from __future__ import annotations

import numpy as np

from gvtools.training.solid_geometry import BALL, BOX, TUBE, Geometry


def is_free(geometry: Geometry, points: np.ndarray) -> np.ndarray:
    """(...) bool for (..., 3) points."""
    free = np.zeros(points.shape[:-1], bool)
    for low, high in geometry.rooms:
        free |= ((points > low) & (points < high)).all(-1)
    for n, kind in enumerate(geometry.kind):
        local = (points - geometry.centre[n]) @ geometry.rotation[n].T
        scaled = local / geometry.half[n]
        if kind == BOX:
            inside = (np.abs(scaled) < 1).all(-1)
        elif kind == BALL:
            inside = (scaled**2).sum(-1) < 1
        else:
            inside = ((scaled[..., :2] ** 2).sum(-1) < 1) & (np.abs(scaled[..., 2]) < 1)
        for low, high in geometry.cutter[geometry.first_cutter[n] : geometry.first_cutter[n + 1]]:
            inside &= ~((local > low) & (local < high)).all(-1)
        free &= ~inside
    return free


def first_surface(geometry: Geometry, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """(P,) parameters at which rays (P, 3) from free places (3,) or (P, 3) leave free space."""
    origin = np.broadcast_to(origin, rays.shape)
    crossings = [_planes(origin, rays, corner) for room in geometry.rooms for corner in room]
    for n, kind in enumerate(geometry.kind):
        start = (origin - geometry.centre[n]) @ geometry.rotation[n].T
        ray = rays @ geometry.rotation[n].T
        half = geometry.half[n]
        if kind != BALL:
            crossings += [_planes(start, ray, half), _planes(start, ray, -half)]
        if kind != BOX:
            flat = np.array([1, 1, 0.0 if kind == TUBE else 1])
            crossings.append(_quadric(start / half * flat, ray / half * flat))
        for box in geometry.cutter[geometry.first_cutter[n] : geometry.first_cutter[n + 1]]:
            crossings += [_planes(start, ray, corner) for corner in box]
    t = np.concatenate(crossings, axis=1)
    t = np.sort(np.where(np.isfinite(t) & (t > 1e-9), t, np.inf), axis=1)
    t = np.concatenate([np.zeros((len(rays), 1)), t], axis=1)
    middle = np.where(np.isfinite(t[:, 1:]), 0.5 * (t[:, :-1] + t[:, 1:]), 0.0)
    free = is_free(geometry, origin[:, None] + middle[..., None] * rays[:, None])
    # Crossings of coplanar faces coincide up to rounding: nothing lies between them.
    with np.errstate(invalid="ignore"):
        apart = t[:, 1:] - t[:, :-1] > 1e-9 * t[:, 1:]
    blocked = ~free & apart & np.isfinite(t[:, 1:])
    return t[np.arange(len(rays)), blocked.argmax(1)]


def _planes(origin: np.ndarray, rays: np.ndarray, corner: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore", invalid="ignore"):
        return (corner - origin) / rays


def _quadric(origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    a, b = (rays**2).sum(1), (origin * rays).sum(1)
    with np.errstate(invalid="ignore"):
        root = np.sqrt(b**2 - a * ((origin**2).sum(1) - 1))
    return np.stack([(-b - root) / a, (-b + root) / a], axis=1)
