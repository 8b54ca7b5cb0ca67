"""Intrinsics as a ``transforms.json`` names them, as COLMAP's model and parameter list."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from gvtools.errors import ProjectError

# nerfstudio's names; the fisheye ones share one model, the others the polynomial one.
PERSPECTIVE = ("", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")


class LensParameters(NamedTuple):
    """A camera model of COLMAP with its parameters, in COLMAP's order; pixels."""

    model: str
    values: tuple[float, ...]


def lens_parameters(
    values: Mapping[str, Any],
    coefficients: Sequence[float],
    *,
    focal: tuple[float, float],
    center: tuple[float, float],
    what: str,
) -> LensParameters:
    """The COLMAP camera of a frame's keys.

    Args:
        values: the frame's keys over the file's: ``camera_model``, ``is_fisheye``.
        coefficients: of COEFFICIENTS.
        focal: fx, fy, pixels.
        center: cx, cy, pixels; first pixel centre (0.5, 0.5).
        what: where they were read, for the message.

    Raises:
        ProjectError: a model that is not perspective, or coefficients that no model holds.
    """
    named = str(values.get("camera_model", ""))
    k1, k2, k3, k4, p1, p2 = coefficients
    if named in FISHEYE or (not named and values.get("is_fisheye")):
        return LensParameters("OPENCV_FISHEYE", (*focal, *center, k1, k2, k3, k4))
    if named not in PERSPECTIVE:
        raise ProjectError(
            f"{what}: the camera model {named} has no pinhole image; expected one of "
            f"{', '.join(name for name in (*PERSPECTIVE, *FISHEYE) if name)}; render perspective "
            "views first"
        )
    if k4:
        raise ProjectError(
            f"{what}: k4 = {k4} of a perspective camera; expected k1, k2, k3, p1, p2 at most "
            "(tools disagree on what a fourth one means); set camera_model to OPENCV_FISHEYE if "
            "it is one, or calibrate without k4"
        )
    if k3:
        extended = (*focal, *center, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
        return LensParameters("FULL_OPENCV", extended)
    return LensParameters("OPENCV", (*focal, *center, k1, k2, p1, p2))
