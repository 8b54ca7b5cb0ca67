"""Corruption of clean observations, as sensors and poses corrupt real ones.

Every fault has its own range and switch. A sample draws each fault's strength once, uniformly, and
the fault itself for every context view. Targets and the truth stay clean.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from gvtools.cameras import Cameras, rigid_poses
from gvtools.settings import Settings

Float32 = NDArray[np.float32]
Share = Annotated[float, Field(ge=0, le=1)]
Strength = Annotated[float, Field(ge=0)]


class CorruptionOptions(Settings):
    """The largest strength of every fault; 0 switches it off."""

    section = "corruption"

    clean: Share = 0.25
    """Share of samples without any fault."""
    absent: Strength = 0.4
    """Chance that a fault is absent from a sample that has faults."""
    depth_noise: Strength = 0.02
    """Standard deviation of depth, as a share of the depth, at the view's mean depth; it grows in
    proportion to the depth. Half of its variance is smooth over the picture."""
    depth_scale: Strength = 0.015
    """Standard deviation of a factor on all depths of a view."""
    holes: Share = 0.25
    """Share of the pixels that lose their depth, in patches."""
    flying: Share = 0.5
    """Share of the pixels at depth edges that lie somewhere between front and back."""
    rotation: Strength = 0.4
    """Standard deviation of the rotation by which a view is lifted wrongly. [degrees]"""
    translation: Strength = 0.006
    """The same of its centre, as a share of the mean depth."""
    dropped: Share = 0.15
    """Chance that a context view has no depth at all; never the first."""
    exposure: Strength = 0.12
    """Standard deviation of the exposure, in natural logarithm; the first context view keeps its
    own, which is the targets'."""
    color: Strength = 0.03
    """Standard deviation of a gain a channel, likewise."""
    projection: Strength = 0.0
    """Standard deviation of noise on the colours of valid projections. The paper adds 0.1 to what
    the video prior gets; the model's own input has none."""


# Of recorded views, whose depth has faults of its own.
GENTLE = CorruptionOptions(depth_noise=0.01, holes=0.05, flying=0.0)
NOTHING = CorruptionOptions(
    **{name: 0.0 for name in CorruptionOptions.model_fields if name != "clean"}
)


def draw_strengths(rng: np.random.Generator, options: CorruptionOptions) -> CorruptionOptions:
    """The strengths of one sample's faults."""
    perfect = rng.random() < options.clean
    strengths = {}
    for name in CorruptionOptions.model_fields:
        if name in ("clean", "absent"):
            continue
        chance, share = rng.random(2)
        off = perfect or chance < options.absent
        strengths[name] = 0.0 if off else getattr(options, name) * share
    # A view has depth or has none: what is drawn for it is the chance itself.
    strengths["dropped"] = options.dropped if strengths["dropped"] > 0 else 0.0
    return NOTHING.replaced(**strengths)


def corrupted_depth(
    rng: np.random.Generator, depth: Float32, strength: CorruptionOptions
) -> Float32:
    """(H, W) depth with flying pixels, noise, a wrong scale and holes; 0 = none."""
    known = depth > 0
    if not known.any():
        return depth
    out = depth
    if strength.flying > 0:
        out = _flying(rng, out, strength.flying)
    if strength.depth_noise > 0:
        mean = depth[known].mean()
        noise = np.sqrt(0.5) * (_smooth(rng, depth.shape) + rng.standard_normal(depth.shape))
        spread = strength.depth_noise * out / mean
        out = out * np.clip(1 + spread * noise, 0.5, 1.5)
    out = out * np.exp(strength.depth_scale * rng.standard_normal())
    if strength.holes > 0:
        field = _smooth(rng, depth.shape)
        known = known & (field > np.quantile(field, strength.holes * rng.uniform(0, 1)))
    return np.where(known, out, 0).astype(np.float32)


def corrupted_color(
    rng: np.random.Generator, rgb: NDArray[np.uint8], strength: CorruptionOptions
) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 in another exposure and white balance."""
    if strength.exposure == 0 and strength.color == 0:
        return rgb
    gain = np.exp(strength.exposure * rng.standard_normal())
    gain = gain * np.exp(strength.color * rng.standard_normal(3))
    table = np.clip(np.rint(np.arange(256)[:, None] * gain), 0, 255).astype(np.uint8)
    return np.stack([table[rgb[..., c], c] for c in range(3)], axis=-1)


def corrupted_camera(
    rng: np.random.Generator, camera: Cameras, unit: float, *, strength: CorruptionOptions
) -> Cameras:
    """A camera that is turned and shifted a little.

    ``unit``: mean depth, scene units.
    """
    from scipy.spatial.transform import Rotation

    turn = np.radians(strength.rotation) * rng.standard_normal(3)
    shift = strength.translation * unit * rng.standard_normal(3)
    error = rigid_poses(Rotation.from_rotvec(turn).as_matrix(), shift)
    return replace(camera, cam_from_world=error @ camera.cam_from_world)


def _smooth(rng: np.random.Generator, shape: tuple[int, ...]) -> Float32:
    """(H, W) smooth noise of about unit variance."""
    from PIL import Image

    cells = int(rng.integers(4, 13))
    grid = Image.fromarray(rng.standard_normal((cells, cells)).astype(np.float32))
    field = np.asarray(grid.resize((shape[1], shape[0]), Image.Resampling.BICUBIC))
    return (field / max(float(field.std()), 1e-6)).astype(np.float32)


def _flying(rng: np.random.Generator, depth: Float32, share: float) -> Float32:
    """Some pixels at depth edges between the nearest and the farthest of their neighbours."""
    from scipy.ndimage import maximum_filter, minimum_filter

    near, far = minimum_filter(depth, 3), maximum_filter(depth, 3)
    edge = (near > 0) & (far > 1.1 * near) & (rng.random(depth.shape) < share)
    mixed = near + (far - near) * rng.random(depth.shape, np.float32)
    return np.where(edge, mixed, depth)
