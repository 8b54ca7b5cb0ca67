"""Splatting on a CUDA device by gsplat (Ye et al. 2024), behind the interface of ``Splat``.

Both have the same Gaussians, camera convention, blur of 0.3 px^2 and harmonics. gsplat cuts a
Gaussian off where its alpha falls below 1 / 255, without ``Splat``'s ramp, and adds gradients up in
any order, so the last digits differ from run to run.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gvtools.appearance.splat.project_kernels import BLUR, LOG_SCALE, LOGIT, QUATERNION, SH, VALUES
from gvtools.appearance.splat.splat import EXACT, Lens, Splat
from gvtools.optional import installed


def gsplat_installed() -> bool:
    """Whether gsplat can be imported; whether it works on this machine's device shows in use."""
    return installed("gsplat")


def splatter_on(device: str) -> type[Splat]:
    """What draws Gaussians: gsplat on "cuda" where it is installed, else the CPU.

    >>> splatter_on("cpu").__name__
    'Splat'
    """
    return GsplatSplat if device == "cuda" and gsplat_installed() else Splat


class GsplatSplat(Splat):
    """One picture of Gaussians on the CUDA device; see ``Splat``, but for ``projected``."""

    def __init__(
        self, values: NDArray[Any], lens: Lens, *, degree: int = 2, faint: float = EXACT
    ) -> None:
        """Splat Gaussians; see ``Splat``. float32 alone; gradients leave nothing out."""
        from gsplat import rasterization

        self.values, self.lens, self.terms = values, lens, (degree + 1) ** 2
        self._values = torch.from_numpy(values).to("cuda").requires_grad_()
        viewmats, Ks = camera_arguments(lens, "cuda")
        self._viewmats = viewmats.requires_grad_()
        colors, alphas, found = rasterization(
            **gaussian_arguments(self._values), viewmats=self._viewmats, Ks=Ks,
            width=lens.width, height=lens.height, near_plane=float(lens.near), eps2d=BLUR,
            sh_degree=degree, packed=False, render_mode="RGB+D",
        )  # fmt: skip
        self._centers: Tensor = found["means2d"]
        if self._centers.requires_grad:
            self._centers.retain_grad()
        self._image = image_of(colors, alphas)
        self.image = self._image.detach().cpu().numpy()
        self.seen = np.flatnonzero((found["radii"][0] > 0).all(dim=-1).cpu().numpy())

    def backward(self, d_image: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Gradients of a loss; see ``Splat``. Once for each picture."""
        self._image.backward(torch.from_numpy(d_image).to("cuda"))
        grads = self._values.grad, self._centers.grad, self._viewmats.grad
        d_values, d_centers, d_viewmats = (
            torch.zeros_like(of) if grad is None else grad
            for grad, of in zip(grads, (self._values, self._centers, self._viewmats), strict=True)
        )
        return gradient_rows(d_values, d_centers, d_viewmats, seen=self.seen)


def gaussian_arguments(values: Tensor) -> dict[str, Tensor]:
    """Gsplat's arguments for Gaussians (N, VALUES): see project_kernels for the columns."""
    return {
        "means": values[:, :LOG_SCALE],  # (N, 3)
        "scales": values[:, LOG_SCALE:QUATERNION].exp(),  # (N, 3)
        "quats": values[:, QUATERNION:LOGIT],  # (N, 4) w, x, y, z
        "opacities": torch.sigmoid(values[:, LOGIT]),  # (N,)
        "colors": values[:, SH:].reshape(-1, (VALUES - SH) // 3, 3),  # (N, harmonics, 3)
    }


def camera_arguments(lens: Lens, device: str) -> tuple[Tensor, Tensor]:
    """Gsplat's poses (1, 4, 4) cam_from_world and intrinsics (1, 3, 3) [px].

    The centre of the first pixel is at (0.5, 0.5) here and there.
    """
    pose, K = np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32)
    pose[:3, :3], pose[:3, 3] = lens.numbers[:9].reshape(3, 3), lens.numbers[9:12]
    K[0, 0], K[1, 1], K[0, 2], K[1, 2] = lens.numbers[12:]
    return torch.from_numpy(pose)[None].to(device), torch.from_numpy(K)[None].to(device)


def image_of(colors: Tensor, alphas: Tensor) -> Tensor:
    """The image (5, H, W) of ``Splat`` from gsplat's colours with depth (1, H, W, 4) and alphas.

    "RGB+D" is depth times alpha already, as ``Splat`` has it.
    """
    return torch.cat([colors[0], alphas[0]], dim=-1).permute(2, 0, 1).contiguous()


def gradient_rows(
    d_values: Tensor, d_centers: Tensor, d_viewmats: Tensor, *, seen: NDArray[np.int64]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """The gradients that ``Splat.backward`` gives of the Gaussians ``seen``.

    From those by the parameters, by the centres (1, N, 2) [1/px] and by the pose (1, 4, 4).
    """
    rows = torch.cat([d_values, d_centers[0]], dim=1).cpu().numpy()[seen]
    pose = d_viewmats[0].cpu().numpy()
    return rows, np.concatenate([pose[:3, :3].ravel(), pose[:3, 3]])
