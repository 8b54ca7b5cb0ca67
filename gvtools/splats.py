"""3D Gaussians as splat files hold them: one array of rows, harmonics of degree 0 to 3, their axes.

A row is position, natural logarithms of three standard deviations, quaternion w, x, y, z, opacity
before the sigmoid, and coefficients of real spherical harmonics, red, green and blue of each.

Harmonics of one degree turn into harmonics of the same degree. The matrix that does it follows from
what both say of a few directions: sixteen coefficients, and more directions than that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.errors import ShapeError

# The columns of a row: where each part begins.
POSITION, LOG_SCALE, QUATERNION, LOGIT, SH = 0, 3, 6, 10, 11
# Constants of real spherical harmonics of degree 0, 1 and, three of them, 2; and of degree 3.
HARMONICS = (
    0.28209479177387814, 0.4886025119029199,
    1.0925484305920792, 0.31539156525252005, 0.5462742152960396,
)  # fmt: skip
DEGREE_3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154,
            1.445305721320277)  # fmt: skip
# Coefficients of one colour up to a degree.
TERMS = (1, 4, 9, 16)
# Directions that the harmonics are compared in, and the seed that draws them.
DIRECTIONS, SEED = 64, 0
# By how much the axes of a frame may differ in length, or from right angles.
SKEW = 1e-3
# Files hold float32. Where its rounding is more than the share ROUNDING of the size of small
# Gaussians (the quantile SMALLEST), positions are relative to the middle of the scene.
ROUNDING, SMALLEST = 0.1, 0.01
# From right, down, forward to right, up, back.
TO_RUB = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class Splats:
    """N Gaussians with the axes of the world frame, or of the file that they come from."""

    # (N, SH + 3 H), H of ``TERMS``; positions are relative to ``origin``.
    values: NDArray[np.float32]
    origin: NDArray[np.float64]  # (3,) world frame; zero if float32 is precise enough
    # Number of fitted ones, which come first; the others are a memory's points. None: of a file.
    fitted: int | None
    further: int  # number of the run's other fits, which are left out
    rounds: NDArray[np.int32]  # (N,) in which each was added
    generated: NDArray[np.bool_]  # (N,) which are points that nobody observed
    up: NDArray[np.float64] | None = None  # (3,) unit vector, where the cameras or the file tell it
    mode: str = ""  # how a file wants them drawn: "mip" (antialiased), "2dgs"; "" as 3DGS does
    dropped: int = 0  # Gaussians of a file that are no numbers, which are left out
    cut: bool = False  # whether a file has harmonics above degree 3, which are left out

    def __len__(self) -> int:
        return len(self.values)

    @property
    def positions(self) -> NDArray[np.float32]:
        """(N, 3) relative to ``origin``, scene units."""
        return self.values[:, :LOG_SCALE]

    @property
    def log_scales(self) -> NDArray[np.float32]:
        """(N, 3) natural logarithms of the standard deviations, scene units."""
        return self.values[:, LOG_SCALE:QUATERNION]

    @property
    def quaternions(self) -> NDArray[np.float32]:
        """(N, 4) w, x, y, z of length 1."""
        q = self.values[:, QUATERNION:LOGIT]
        return q / np.linalg.norm(q, axis=1, keepdims=True)

    @property
    def logits(self) -> NDArray[np.float32]:
        """(N,) opacities before the sigmoid."""
        return self.values[:, LOGIT]

    @property
    def opacities(self) -> NDArray[np.float32]:
        """(N,) from 0 to 1."""
        return np.asarray(1 / (1 + np.exp(-np.clip(self.logits, -30, 30))), np.float32)

    @property
    def harmonics(self) -> NDArray[np.float32]:
        """(N, H, 3) coefficients."""
        return self.values[:, SH:].reshape(len(self), -1, 3)

    @property
    def degree(self) -> int:
        """Of the harmonics, 0 to 3."""
        return TERMS.index(self.harmonics.shape[1])

    @property
    def colors(self) -> NDArray[np.float32]:
        """(N, 3) the mean over all directions, from 0 to 1."""
        return np.clip(0.5 + HARMONICS[0] * self.harmonics[:, 0], 0, 1)

    def summary(self) -> str:
        """A line of text for the user."""
        text = f"{len(self)} Gaussians"
        if self.fitted is not None:
            points = len(self) - self.fitted
            parts = [f"{self.fitted} fitted"] if self.fitted else []
            if points or not parts:
                parts.append(f"{points} from {'further ' if self.fitted else ''}points")
            text += f" ({', '.join(parts)})"
        if self.further:
            text += f", the first of {self.further + 1} fits"
        if self.dropped:
            text += f", {self.dropped} without finite numbers left out"
        if self.cut:
            text += f", harmonics above degree {len(TERMS) - 1} left out"
        if self.origin.any():
            text += f", counted from {' '.join(f'{x:.10g}' for x in self.origin)}"
        return text


def harmonics(directions: ArrayLike, degree: int = 3) -> NDArray[np.float64]:
    """The spherical harmonics up to a degree, (N, TERMS[degree]), of unit directions (N, 3).

    >>> harmonics([[0, 0, 1]])[0, :3].round(3)
    array([ 0.282, -0.   ,  0.489])
    """
    x, y, z = np.asarray(directions, np.float64).T
    (k0, k1, k2, k3, k4), (c0, c1, c2, c3, c4) = HARMONICS, DEGREE_3
    xx, yy, zz = x * x, y * y, z * z
    terms = (
        np.full_like(x, k0), -k1 * y, k1 * z, -k1 * x,
        k2 * x * y, -k2 * y * z, k3 * (2 * zz - xx - yy), -k2 * x * z, k4 * (xx - yy),
        -c0 * y * (3 * xx - yy), c1 * x * y * z, -c2 * y * (4 * zz - xx - yy),
        c3 * z * (2 * zz - 3 * xx - 3 * yy), -c2 * x * (4 * zz - xx - yy), c4 * z * (xx - yy),
        -c0 * x * (xx - 3 * yy),
    )  # fmt: skip
    return np.stack(terms[: TERMS[degree]], axis=1)


def turn_harmonics(axes: ArrayLike, degree: int = 3) -> NDArray[np.float64]:
    """(H, H) matrix M: coefficients c in a frame are M c in one where its axes are ``axes`` (3, 3).

    >>> halfway = turn_harmonics(TO_RUB, 2)  # half a turn around x
    >>> np.diag(halfway).round().astype(int).tolist()
    [1, -1, -1, 1, -1, 1, 1, -1, 1]
    """
    drawn = np.random.default_rng(SEED).normal(size=(DIRECTIONS, 3))
    outer = drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
    inner = outer @ np.asarray(axes, np.float64)
    told, turned = harmonics(outer, degree), harmonics(inner, degree)
    return np.asarray(np.linalg.lstsq(told, turned, rcond=None)[0], np.float64)


def turn_gaussians(values: NDArray[np.float32], axes: NDArray[np.float64]) -> NDArray[np.float32]:
    """Rows of Gaussians in another frame of the same origin, where the axes are ``axes``."""
    from scipy.spatial.transform import Rotation

    out = values.copy()
    out[:, POSITION:LOG_SCALE] = values[:, POSITION:LOG_SCALE].astype(np.float64) @ axes.T
    w, x, y, z = values[:, QUATERNION:LOGIT].astype(np.float64).T
    rotation = Rotation.from_matrix(axes) * Rotation.from_quat(np.stack([x, y, z, w], axis=1))
    out[:, QUATERNION:LOGIT] = np.roll(rotation.as_quat(), 1, axis=1)
    sh = values[:, SH:].reshape(len(values), -1, 3)
    turn = turn_harmonics(axes, TERMS.index(sh.shape[1]))
    out[:, SH:] = np.einsum("ij,njc->nic", turn, sh).reshape(len(values), -1)
    return out


def place_gaussians(
    values: NDArray[np.float32], matrix: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Rows of Gaussians in a frame that a matrix (4, 4) leads to: turned and scaled; its origin."""
    axes, origin = matrix[:3, :3], matrix[:3, 3]
    size = float(np.cbrt(np.linalg.det(axes)))
    if not size > 0 or np.abs(axes @ axes.T / size**2 - np.eye(3)).max() > SKEW:
        raise ShapeError(
            "a frame that is mirrored, sheared or scaled differently along its axes; expected one "
            "scale; apply the others in the program that wrote it"
        )
    # A turn and its way back leave rounding.
    if np.abs(axes - np.eye(3)).max() < 1e-12:
        return values, origin
    out = turn_gaussians(values, axes / size)
    out[:, POSITION:LOG_SCALE] *= size
    out[:, LOG_SCALE:QUATERNION] += np.log(size)
    return out, origin


def box_middle(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3,) the middle of the box around positions (N, 3)."""
    return (positions.min(axis=0) + positions.max(axis=0)) / 2


def near_origin(
    values: NDArray[np.float32], origin: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Gaussians with positions relative to the world's origin, or to their middle, see ROUNDING.

    ``values`` count from ``origin`` and are changed; the origin that they count from now is
    returned beside them.
    """
    positions = values[:, :LOG_SCALE].astype(np.float64) + origin
    sizes = np.exp(values[:, LOG_SCALE:QUATERNION].max(axis=1))
    reach = float(np.abs(positions).max())
    if reach * 2.0**-24 > ROUNDING * float(np.quantile(sizes, SMALLEST)):
        origin = np.round(box_middle(positions))
    else:
        origin = np.zeros(3)
    values[:, :LOG_SCALE] = positions - origin
    return values, origin
