"""Back-projection of depth images to points, with confidence and pixel binning."""

# mypy: no-check-untyped-defs

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from gvtools.cameras import Cameras, check_usable
from gvtools.errors import ShapeError
from gvtools.kernels import compiled
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.memory.store.views import PointSet
from gvtools.memory.store.voxel_index import VoxelLevels, level_of
from gvtools.settings import Settings

# Side of a cell of the free-space grid, pixels.
FREE_CELL = 4
# Cosine that generated pixels at depth edges and on grazing surfaces are weighted by.
LEAST_COSINE = 0.05
# Side of a block of pixels that may become one point.
SIDE = 2
# A block may be so many times wider along its surface than across the line of sight: slanted
# surfaces keep their points, and nothing is averaged across a step. Noise widens blocks, too.
SLANTED = 4.0


class BackProjectionOptions(Settings):
    """How a depth image becomes points."""

    section = "back_projection"

    edge: float = Field(0.05, gt=0)
    """Limit for depth edges, in relative change of inverse depth per pixel. Along each image axis,
    a pixel is dropped if its two one-sided changes differ by more than this, if both exceed it, if
    the only one exceeds it, or if neither neighbour has depth. Such pixels mix foreground and
    background ("flying pixels")."""
    depth_max: float | None = Field(None, gt=0)
    """Drop what is farther, scene units; None keeps all."""
    grazing: float = Field(0.05, ge=0, lt=1)
    """The smallest cosine between ray and surface normal that is still kept."""


def back_project(
    rgb: NDArray[np.uint8],
    depth: NDArray[np.float32],
    camera: Cameras,
    *,
    frame: LocalFrame | None = None,
    confidence: NDArray[np.float32] | None = None,
    mask: NDArray[np.bool_] | None = None,
    options: BackProjectionOptions | None = None,
    levels: VoxelLevels | None = None,
    pixel_binning: float = 0.0,
    generated: bool = False,
) -> PointSet:
    """Lift the pixels of one view, a batch of one, to points.

    Confidence is the source's (None: 1), times the cosine between ray and surface (oblique surfaces
    are measured badly); depth edges are dropped. The spacing is the pixel's footprint, z / f.

    Args:
        depth: (H, W) z-depth, scene units; 0, NaN and inf mean none.
        frame: ``memory.frame``; None for the world's.
        mask: (H, W), True = use.
        levels: ``memory.levels``, for ``pixel_binning``.
        pixel_binning: merge 2 x 2 pixels into one point, their mean, if together they are at most
            this many voxel edges wide (of the voxel that they fall into) and the surface is not
            steep; 0, or no ``levels``, keeps every pixel.
        generated: a completer made the depth: it has no measured pixel that mixes foreground and
            background, so depth edges and grazing surfaces are kept, with a small confidence.
    """
    check_usable(camera)
    height, width = int(camera.height[0]), int(camera.width[0])
    images: dict[str, NDArray[Any] | None] = {
        "rgb": rgb, "depth": depth, "confidence": confidence, "mask": mask,
    }  # fmt: skip
    for name, array in images.items():
        shape = (height, width, 3) if name == "rgb" else (height, width)
        if array is not None and array.shape != shape:
            raise ShapeError(
                f"{camera.names[0]}: {name} has shape {array.shape}; its camera needs {shape}"
            )
    options = options or BackProjectionOptions()
    far = np.inf if options.depth_max is None else options.depth_max
    frame = frame or LocalFrame.at()
    z = np.ascontiguousarray(depth, np.float32)
    use = np.ones((0, 0), np.bool_) if mask is None else np.ascontiguousarray(mask, np.bool_)
    trust = np.ascontiguousarray(np.ones((0, 0)) if confidence is None else confidence, np.float32)
    total, single = height * width, np.float32
    positions, colors = np.empty((total, 3), single), np.empty((total, 3), np.uint8)
    weight, spacing = np.empty(total, single), np.empty(total, single)
    pixels = np.empty(total if levels and pixel_binning > 0 else 0, np.int64)
    count, invalid, edges, masked = _lift(
        np.ascontiguousarray(rgb, np.uint8), z, trust, use, np.ascontiguousarray(camera.K[0]),
        np.ascontiguousarray(frame.local_from_cam(camera.world_from_cam[0])),
        options.edge, far, options.grazing, LEAST_COSINE if generated else 0.0,
        positions, colors, weight, spacing, pixels,
    )  # fmt: skip
    columns: list[NDArray[Any]] = [array[:count] for array in (positions, colors, weight, spacing)]
    if levels and pixel_binning > 0:
        count = _bin(
            pixels[:count], np.full((height + SIDE - 1, width + SIDE - 1), -1, np.int32), width,
            pixel_binning * levels.edge, levels.per_spacing, *(a.copy() for a in columns), *columns,
        )  # fmt: skip
    return PointSet(
        positions[:count].copy(), colors[:count].copy(), weight[:count].copy(),
        spacing[:count].copy(), camera, frame, _free_depth(z, trust, use, np.float32(far)),
        {"no depth": invalid, "depth edge": edges, "masked": masked},
    )  # fmt: skip


@compiled(inline="always")
def _usable(z):
    return z > 0 and z < np.inf


@compiled()
def _lift(rgb, depth, trust, mask, K, local_from_cam, edge, depth_max, grazing, least_cosine,
          positions, colors, weight, spacing, pixels):  # fmt: skip
    """Back-project all usable pixels; pixel (row, col) has its centre at (col + 0.5, row + 0.5).

    ``trust`` and ``mask`` are (H, W), or empty where unused. Edges and grazing surfaces are dropped
    where ``least_cosine`` is 0, else they have this cosine. Out, filled from row 0: positions,
    colors, weight, spacing, pixels (row * W + col). Returns the numbers of points, of pixels
    without usable depth or confidence, of edges and grazing surfaces, and of masked pixels.
    """
    height, width = depth.shape
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    skew = K[0, 1]
    focal = np.sqrt(fx * fy)
    n = 0
    invalid = 0
    edges = 0
    masked = 0
    for row in range(height):
        ry = (row + 0.5 - cy) / fy
        for col in range(width):
            z = depth[row, col]
            if not _usable(z) or z > depth_max:
                invalid += 1
                continue
            if mask.size and not mask[row, col]:
                masked += 1
                continue
            cosine = _surface_cosine(depth, row, col, edge, fx, fy, cx, cy)
            if cosine < grazing:
                if least_cosine == 0:
                    edges += 1
                    continue
                cosine = least_cosine
            w = np.float32(cosine)
            if trust.size:
                w *= trust[row, col]
                if not (w > 0 and w < np.inf):
                    invalid += 1
                    continue
            rx = (col + 0.5 - cx - skew * ry) / fx
            for k in range(3):
                positions[n, k] = (
                    z
                    * (local_from_cam[k, 0] * rx + local_from_cam[k, 1] * ry + local_from_cam[k, 2])
                    + local_from_cam[k, 3]
                )
                colors[n, k] = rgb[row, col, k]
            weight[n] = w
            spacing[n] = z / focal
            if pixels.size:
                pixels[n] = row * width + col
            n += 1
    return n, invalid, edges, masked


@compiled()
def _surface_cosine(depth, row, col, edge, fx, fy, cx, cy):
    """|cos| of the angle between ray and surface normal, 0 to 1; -1 at a depth edge.

    On a plane, inverse depth is linear in image coordinates, so its relative changes from the
    neighbour before and to the one after, z (1/z - 1/z_before) and z (1/z_after - 1/z), are equal;
    ``edge`` bounds their difference.
    """
    height, width = depth.shape
    z = depth[row, col]
    inverse = 1.0 / z
    slope_x = 0.0
    slope_y = 0.0
    for axis in range(2):
        step_row = axis
        step_col = 1 - axis
        before = 0.0
        after = 0.0
        has_before = False
        has_after = False
        if row >= step_row and col >= step_col:
            zb = depth[row - step_row, col - step_col]
            if _usable(zb):
                before = (inverse - 1.0 / zb) * z
                has_before = True
        if row + step_row < height and col + step_col < width:
            za = depth[row + step_row, col + step_col]
            if _usable(za):
                after = (1.0 / za - inverse) * z
                has_after = True
        if has_before and has_after:
            if abs(after - before) > edge or min(abs(after), abs(before)) > edge:
                return -1.0
            slope = before if abs(before) < abs(after) else after
        elif has_before or has_after:
            slope = before + after
            if abs(slope) > edge:
                return -1.0
        else:
            return -1.0
        if axis == 0:
            slope_x = slope
        else:
            slope_y = slope
    # The plane 1/z = a·x + b·y + c over normalised image coordinates has the normal (a, b, c).
    a = slope_x * inverse * fx
    b = slope_y * inverse * fy
    x = (col + 0.5 - cx) / fx
    y = (row + 0.5 - cy) / fy
    c = inverse - a * x - b * y
    return inverse / (np.sqrt(a * a + b * b + c * c) * np.sqrt(x * x + y * y + 1.0))


@compiled()
def _free_depth(depth, trust, mask, depth_max):
    """(ceil(H/4), ceil(W/4)): nearest depth in each cell of 4 x 4 pixels, at most ``depth_max``.

    0 if a pixel has no depth, is masked, or has no confidence: the space before it is unknown.
    """
    height, width = depth.shape
    rows = (height + FREE_CELL - 1) // FREE_CELL
    cols = (width + FREE_CELL - 1) // FREE_CELL
    out = np.zeros((rows, cols), np.float32)
    for i in range(rows):
        for j in range(cols):
            nearest = np.float32(np.inf)
            for row in range(i * FREE_CELL, min((i + 1) * FREE_CELL, height)):
                for col in range(j * FREE_CELL, min((j + 1) * FREE_CELL, width)):
                    z = depth[row, col]
                    known = _usable(z) and (not mask.size or mask[row, col])
                    if not known or (trust.size and not trust[row, col] > 0):
                        nearest = np.float32(0)
                    elif z < nearest:
                        nearest = min(z, depth_max)
            out[i, j] = nearest
    return out


@compiled()
def _bin(
    pixels, point, width, largest, per_spacing, old_positions, old_colors, old_weight, old_spacing,
    positions, colors, weight, spacing,
):  # fmt: skip
    """Each block of 2 x 2 lifted pixels becomes one point where it is small enough.

    Its width is that of its pixels across the line of sight; along the surface it may be SLANTED
    times as wide. ``largest`` is the width where voxels are the finest; it doubles with them.
    Returns how many points are left, at the arrays' beginning, in the order of their blocks.
    """
    for i in range(len(pixels)):
        point[pixels[i] // width, pixels[i] % width] = i
    n = 0
    for row in range(0, point.shape[0] - 1, SIDE):
        for col in range(0, point.shape[1] - 1, SIDE):
            a, b = point[row, col], point[row, col + 1]
            c, d = point[row + 1, col], point[row + 1, col + 1]
            if a >= 0 and b >= 0 and c >= 0 and d >= 0:
                widest = max(
                    _apart(old_positions, a, b),
                    _apart(old_positions, c, d),
                    _apart(old_positions, a, c),
                    _apart(old_positions, b, d),
                )
                apart = _mean(old_spacing[a], old_spacing[b], old_spacing[c], old_spacing[d])
                most = largest * (1 << level_of(apart, per_spacing))
                if SIDE * apart <= most and SIDE * widest <= SLANTED * most:
                    for k in range(3):
                        positions[n, k] = _mean(
                            old_positions[a, k], old_positions[b, k],
                            old_positions[c, k], old_positions[d, k],
                        )  # fmt: skip
                        color = _mean(
                            old_colors[a, k], old_colors[b, k], old_colors[c, k], old_colors[d, k]
                        )
                        colors[n, k] = np.uint8(color + 0.5)
                    weight[n] = _mean(old_weight[a], old_weight[b], old_weight[c], old_weight[d])
                    spacing[n] = apart
                    n += 1
                    continue
            for i in (a, b, c, d):
                if i >= 0:
                    for k in range(3):
                        positions[n, k] = old_positions[i, k]
                        colors[n, k] = old_colors[i, k]
                    weight[n], spacing[n] = old_weight[i], old_spacing[i]
                    n += 1
    return n


@compiled()
def _apart(positions, p, q):
    """The distance of two points by their rows."""
    total = 0.0
    for k in range(3):
        total += (np.float64(positions[p, k]) - np.float64(positions[q, k])) ** 2
    return np.sqrt(total)


@compiled()
def _mean(a, b, c, d):
    """In float64, where the sum of the greatest float32 has room."""
    return (np.float64(a) + np.float64(b) + np.float64(c) + np.float64(d)) / 4
