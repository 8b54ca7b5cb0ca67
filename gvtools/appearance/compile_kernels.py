"""The kernels of fitting, compiled by one small picture."""

from __future__ import annotations

import numpy as np

from gvtools.kernels import KernelSet


def compile_splatting() -> None:
    """Call each kernel of splatting once."""
    from gvtools.appearance.gaussians import Gaussians
    from gvtools.appearance.splat.splat import Lens, Splat, median_depth

    some = Gaussians.at([[0.0, 0.0, 2.0]], [[255, 0, 0]], sizes=[0.5])
    lens = Lens.of(np.eye(4), np.diag([16.0, 16.0, 1.0]), size=(16, 16), near=0.1)
    picture = Splat(some.values, lens)
    picture.backward(np.ones_like(picture.image))
    median_depth(picture)


def compile_steps() -> None:
    """Call each kernel of the loss and of the optimiser once."""
    from gvtools.appearance import loss
    from gvtools.appearance.free_space import floaters
    from gvtools.appearance.loss import add_bending
    from gvtools.appearance.splat.project_kernels import VALUES
    from gvtools.appearance.splat.splat import Lens

    picture = np.zeros((3, 16, 16), np.float32)
    weight = np.ones((16, 16), np.float32)
    loss.loss_gradient(0, 3, picture, picture, weight, 0.2, np.zeros_like(picture))
    image = np.ones((5, 16, 16), np.float32)
    add_bending(image, picture, np.zeros_like(image), weight=1.0)
    # Of one row, a part of the columns would be of the type of a whole array.
    rows, gradients = np.zeros(2, np.int64), np.zeros((2, VALUES + 2), np.float32)
    values, moments = np.zeros((2, VALUES), np.float32), np.zeros((2, 2, VALUES), np.float32)
    rates, widths = np.zeros(VALUES, np.float32), np.ones(2, np.float32)
    loss.adam_rows(0, 2, rows, gradients[:, :VALUES], values, moments, rates, widths, 1)
    lens = Lens.of(np.eye(4), np.diag([16.0, 16.0, 1.0]), size=(16, 16), near=0.1)
    floaters(values, lens, weight)


def kernel_sets() -> tuple[KernelSet, ...]:
    """What fitting needs."""
    from gvtools.appearance import loss
    from gvtools.appearance.splat import tile_kernels

    return (
        KernelSet("splatting", compile_splatting, tile_kernels.median_tiles),
        KernelSet("fitting", compile_steps, loss.adam_rows),
    )
