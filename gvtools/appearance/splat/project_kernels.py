"""Kernels that project Gaussians into a camera, and carry gradients back through it.

The mathematics is that of "3D Gaussian Splatting" (Kerbl et al. 2023), after "EWA Volume Splatting"
(Zwicker et al. 2001): a Gaussian with covariance S becomes a 2D Gaussian with covariance T S T',
where T is the linearised projection; its colour is a sum of spherical harmonics of the direction
from the camera's centre.

A camera is a vector of 16 numbers: the rotation of cam_from_world row by row (9), its translation
(3), then fx, fy, cx, cy in pixels, with the centre of the first pixel at (0.5, 0.5).
"""

from __future__ import annotations

import math

import numpy as np

from gvtools.kernels import FAST, compiled
from gvtools.splats import HARMONICS, LOGIT, SH
from gvtools.splats import LOG_SCALE as LOG_SCALE
from gvtools.splats import POSITION as POSITION
from gvtools.splats import QUATERNION as QUATERNION

# Columns of a projected Gaussian: its centre and the inverse of its 2D covariance in pixels,
# opacity, colour, depth, half the squared distance (in standard deviations) at which it ends, and
# how far that is to the left and right and up and down in pixels.
(X, Y, CONIC_XX, CONIC_XY, CONIC_YY, OPACITY, RED, GREEN, BLUE, DEPTH, END,
 RADIUS_X, RADIUS_Y) = range(13)  # fmt: skip
COLUMNS = 13
# Of a row (see gvtools.splats) whose harmonics have degree 2.
VALUES = 38
# Gradients of one Gaussian in one tile: of colour, depth, and the sums over its pixels of
# dL/d(log alpha), alone and times dx, dy, dx dx, dx dy, dy dy (pixel minus centre).
SUMS = 10
# Where its alpha would be smaller than this, a Gaussian ends.
LEAST_ALPHA = 1 / 255
# Added to the 2D covariance, so that a Gaussian is never narrower than a pixel [px^2].
BLUR = 0.3
# The linearisation is taken at most this far outside the picture, in shares of its size.
MARGIN = 0.15


@compiled(inline="always")
def _rotation(one, w, x, y, z):
    """Rotation matrix of a quaternion of any length, the quaternion normalised, and 1 / length."""
    inverse = one / math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    x2, y2, z2 = x + x, y + y, z + z
    R = (
        one - y * y2 - z * z2, x2 * y - w * z2, x2 * z + w * y2,
        x2 * y + w * z2, one - x * x2 - z * z2, y2 * z - w * x2,
        x2 * z - w * y2, y2 * z + w * x2, one - x * x2 - y * y2,
    )  # fmt: skip
    return R, w, x, y, z, inverse


@compiled(inline="always")
def _covariance(R, s0, s1, s2):
    """The six different entries of R diag(s)^2 R': xx, xy, xz, yy, yz, zz."""
    a, b, c = s0 * s0, s1 * s1, s2 * s2
    return (
        R[0] * R[0] * a + R[1] * R[1] * b + R[2] * R[2] * c,
        R[0] * R[3] * a + R[1] * R[4] * b + R[2] * R[5] * c,
        R[0] * R[6] * a + R[1] * R[7] * b + R[2] * R[8] * c,
        R[3] * R[3] * a + R[4] * R[4] * b + R[5] * R[5] * c,
        R[3] * R[6] * a + R[4] * R[7] * b + R[5] * R[8] * c,
        R[6] * R[6] * a + R[7] * R[7] * b + R[8] * R[8] * c,
    )


@compiled(inline="always")
def _limits(c, width, height, margin):
    """Least and greatest x / z and y / z at which projection is linearised."""
    return (
        (-margin * width - c[14]) / c[12], (width + margin * width - c[14]) / c[12],
        (-margin * height - c[15]) / c[13], (height + margin * height - c[15]) / c[13],
    )  # fmt: skip


@compiled(inline="always")
def _linearised(c, limits, px, py, z):
    """Rows of T = J R (2 x 3), J's four entries, and whether x and y lie within the limits."""
    ux, uy = px / z, py / z
    vx, vy = min(max(ux, limits[0]), limits[1]), min(max(uy, limits[2]), limits[3])
    j00, j11 = c[12] / z, c[13] / z
    j02, j12 = -j00 * vx, -j11 * vy
    T = (
        j00 * c[0] + j02 * c[6], j00 * c[1] + j02 * c[7], j00 * c[2] + j02 * c[8],
        j11 * c[3] + j12 * c[6], j11 * c[4] + j12 * c[7], j11 * c[5] + j12 * c[8],
    )  # fmt: skip
    return T, j00, j02, j11, j12, vx == ux, vy == uy


@compiled(inline="always")
def _flat(T, S):
    """T S T' (xx, xy, yy), and T S row by row."""
    a0 = T[0] * S[0] + T[1] * S[1] + T[2] * S[2]
    a1 = T[0] * S[1] + T[1] * S[3] + T[2] * S[4]
    a2 = T[0] * S[2] + T[1] * S[4] + T[2] * S[5]
    b0 = T[3] * S[0] + T[4] * S[1] + T[5] * S[2]
    b1 = T[3] * S[1] + T[4] * S[3] + T[5] * S[4]
    b2 = T[3] * S[2] + T[4] * S[4] + T[5] * S[5]
    xx = a0 * T[0] + a1 * T[1] + a2 * T[2]
    xy = a0 * T[3] + a1 * T[4] + a2 * T[5]
    yy = b0 * T[3] + b1 * T[4] + b2 * T[5]
    return xx, xy, yy, a0, a1, a2, b0, b1, b2


@compiled(inline="always")
def _harmonics(k, x, y, z):
    """The nine spherical harmonics of degree 0 to 2 of a unit direction; ``k`` are HARMONICS."""
    return (
        k[0], -k[1] * y, k[1] * z, -k[1] * x,
        k[2] * x * y, -k[2] * y * z, k[3] * (z * z + z * z - x * x - y * y), -k[2] * x * z,
        k[4] * (x * x - y * y),
    )  # fmt: skip


@compiled(error_model="numpy", fastmath=FAST)
def project_gaussians(first, last, values, terms, camera, width, height, near, out):
    """Project Gaussians (N, VALUES); ``terms`` harmonics count, 1, 4 or 9.

    ``out`` (N, COLUMNS) is written; DEPTH is 0 for what does not reach the picture or is nearer
    than ``near``.
    """
    dtype = values.dtype.type
    # Constants of the arrays' type: other ones make double precision of single.
    one, half, two, blur, least = dtype(1), dtype(0.5), dtype(2), dtype(BLUR), dtype(LEAST_ALPHA)
    zero, seven, four = dtype(0), dtype(7), dtype(4)
    width, height = dtype(width), dtype(height)
    c = camera
    h = (
        dtype(HARMONICS[0]), dtype(HARMONICS[1]), dtype(HARMONICS[2]), dtype(HARMONICS[3]),
        dtype(HARMONICS[4]),
    )  # fmt: skip
    limits = _limits(c, dtype(width), dtype(height), dtype(MARGIN))
    center_x = -(c[0] * c[9] + c[3] * c[10] + c[6] * c[11])
    center_y = -(c[1] * c[9] + c[4] * c[10] + c[7] * c[11])
    center_z = -(c[2] * c[9] + c[5] * c[10] + c[8] * c[11])
    for i in range(first, last):
        row, g = out[i], values[i]
        row[DEPTH] = 0
        m0, m1, m2 = g[0], g[1], g[2]
        z = c[6] * m0 + c[7] * m1 + c[8] * m2 + c[11]
        if not z > near:
            continue
        x = c[0] * m0 + c[1] * m1 + c[2] * m2 + c[9]
        y = c[3] * m0 + c[4] * m1 + c[5] * m2 + c[10]
        opacity = one / (one + math.exp(-g[LOGIT]))
        if not opacity > least:
            continue
        u, v = c[12] * x / z + c[14], c[13] * y / z + c[15]
        s0, s1, s2 = math.exp(g[3]), math.exp(g[4]), math.exp(g[5])
        # No Gaussian reaches farther than 3.4 of its greatest standard deviations; the factor 2
        # allows for oblique rays.
        reach = seven * max(s0, s1, s2) / z * max(c[12], c[13]) + four
        if u < -reach or u > width + reach or v < -reach or v > height + reach:
            continue
        R = _rotation(one, g[6], g[7], g[8], g[9])[0]
        T = _linearised(c, limits, x, y, z)[0]
        xx, xy, yy, _, _, _, _, _, _ = _flat(T, _covariance(R, s0, s1, s2))
        xx, yy = xx + blur, yy + blur
        det = xx * yy - xy * xy
        if not det > 0:
            continue
        end = math.log(opacity / least)
        radius_x, radius_y = math.sqrt(two * end * xx), math.sqrt(two * end * yy)
        if u + radius_x < half or u - radius_x > width - half:
            continue
        if v + radius_y < half or v - radius_y > height - half:
            continue
        dx, dy, dz = m0 - center_x, m1 - center_y, m2 - center_z
        n = one / math.sqrt(dx * dx + dy * dy + dz * dz)
        basis = _harmonics(h, dx * n, dy * n, dz * n)
        red, green, blue = half, half, half
        for k in range(terms):
            red += basis[k] * g[SH + 3 * k]
            green += basis[k] * g[SH + 3 * k + 1]
            blue += basis[k] * g[SH + 3 * k + 2]
        row[X], row[Y] = u, v
        row[CONIC_XX], row[CONIC_XY], row[CONIC_YY] = yy / det, -xy / det, xx / det
        row[OPACITY] = opacity
        row[RED], row[GREEN], row[BLUE] = max(red, zero), max(green, zero), max(blue, zero)
        row[DEPTH], row[END] = z, end
        row[RADIUS_X], row[RADIUS_Y] = radius_x, radius_y


@compiled(error_model="numpy", fastmath=FAST)
def backward_gaussians(
    first, last, bounds, seen, starts, sums, values, terms, camera, width, height, projected,
    d_values, d_camera,
):  # fmt: skip
    """Gradients of the parameters of Gaussians that were splatted.

    The parts of ``seen`` begin and end at ``bounds``; the rows of ``sums`` (pairs, SUMS) of each,
    one a tile, are ``starts[j]`` to ``starts[j + 1]``. Written: ``d_values`` (len(seen), VALUES +
    2), by the parameters and by the centre in the picture [1/px], harmonics from ``terms`` on get
    none; and ``d_camera`` (parts, 12), by rotation and translation that each part adds.
    """
    dtype = values.dtype.type
    zero, one, half, two = dtype(0), dtype(1), dtype(0.5), dtype(2)
    c = camera
    h = (
        dtype(HARMONICS[0]), dtype(HARMONICS[1]), dtype(HARMONICS[2]), dtype(HARMONICS[3]),
        dtype(HARMONICS[4]),
    )  # fmt: skip
    limits = _limits(c, dtype(width), dtype(height), dtype(MARGIN))
    center_x = -(c[0] * c[9] + c[3] * c[10] + c[6] * c[11])
    center_y = -(c[1] * c[9] + c[4] * c[10] + c[7] * c[11])
    center_z = -(c[2] * c[9] + c[5] * c[10] + c[8] * c[11])
    d, camera_sum = np.empty(SUMS, values.dtype), np.empty(12, values.dtype)
    for part in range(first, last):
        camera_sum[:] = zero
        for j in range(bounds[part], bounds[part + 1]):
            i = seen[j]
            row, g, out = projected[i], values[i], d_values[j]
            for k in range(SUMS):
                d[k] = zero
            for pair in range(starts[j], starts[j + 1]):
                for k in range(SUMS):
                    d[k] += sums[pair, k]
            m0, m1, m2 = g[0], g[1], g[2]
            # Colour: harmonics and, through the direction, the position.
            dx, dy, dz = m0 - center_x, m1 - center_y, m2 - center_z
            n = one / math.sqrt(dx * dx + dy * dy + dz * dz)
            x, y, z = dx * n, dy * n, dz * n
            basis = _harmonics(h, x, y, z)
            g0 = d[0] if row[RED] > 0 else zero
            g1 = d[1] if row[GREEN] > 0 else zero
            g2 = d[2] if row[BLUE] > 0 else zero
            for k in range(terms):
                out[SH + 3 * k] = basis[k] * g0
                out[SH + 3 * k + 1] = basis[k] * g1
                out[SH + 3 * k + 2] = basis[k] * g2
            gx = gy = gz = zero
            if terms > 1:
                h1 = g[14] * g0 + g[15] * g1 + g[16] * g2
                h2 = g[17] * g0 + g[18] * g1 + g[19] * g2
                h3 = g[20] * g0 + g[21] * g1 + g[22] * g2
                gx, gy, gz = -h[1] * h3, -h[1] * h1, h[1] * h2
            if terms > 4:
                h4 = h[2] * (g[23] * g0 + g[24] * g1 + g[25] * g2)
                h5 = -h[2] * (g[26] * g0 + g[27] * g1 + g[28] * g2)
                h6 = h[3] * (g[29] * g0 + g[30] * g1 + g[31] * g2)
                h7 = -h[2] * (g[32] * g0 + g[33] * g1 + g[34] * g2)
                h8 = h[4] * (g[35] * g0 + g[36] * g1 + g[37] * g2)
                gx += h4 * y - two * h6 * x + h7 * z + two * h8 * x
                gy += h4 * x + h5 * z - two * h6 * y - two * h8 * y
                gz += h5 * y + dtype(4) * h6 * z + h7 * x
            along = gx * x + gy * y + gz * z
            gx, gy, gz = (gx - along * x) * n, (gy - along * y) * n, (gz - along * z) * n
            # Opacity: d alpha / alpha was summed, and d opacity = opacity (1 - opacity) d logit.
            out[LOGIT] = d[4] * (one - row[OPACITY])
            # The centre, and the conic (its off-diagonal entry counts twice in the exponent).
            A, B, C = row[CONIC_XX], row[CONIC_XY], row[CONIC_YY]
            du, dv = A * d[5] + B * d[6], B * d[5] + C * d[6]
            out[VALUES], out[VALUES + 1] = du, dv
            ga, gb, gc = -half * d[7], -half * d[8], -half * d[9]
            # The covariance V is the conic's inverse: dV = -Q dQ Q.
            p00, p01 = A * ga + B * gb, A * gb + B * gc
            p10, p11 = B * ga + C * gb, B * gb + C * gc
            v00, v01, v11 = -(p00 * A + p01 * B), -(p00 * B + p01 * C), -(p10 * B + p11 * C)
            # Through V = T S T'.
            px = c[0] * m0 + c[1] * m1 + c[2] * m2 + c[9]
            py = c[3] * m0 + c[4] * m1 + c[5] * m2 + c[10]
            pz = c[6] * m0 + c[7] * m1 + c[8] * m2 + c[11]
            s0, s1, s2 = math.exp(g[3]), math.exp(g[4]), math.exp(g[5])
            R, qw, qx, qy, qz, inverse = _rotation(one, g[6], g[7], g[8], g[9])
            T, j00, j02, j11, j12, free_x, free_y = _linearised(c, limits, px, py, pz)
            _, _, _, a0, a1, a2, b0, b1, b2 = _flat(T, _covariance(R, s0, s1, s2))
            t0, t1, t2 = (
                two * (v00 * a0 + v01 * b0),
                two * (v00 * a1 + v01 * b1),
                two * (v00 * a2 + v01 * b2),
            )
            t3, t4, t5 = (
                two * (v01 * a0 + v11 * b0),
                two * (v01 * a1 + v11 * b1),
                two * (v01 * a2 + v11 * b2),
            )
            w0, w1, w2 = v00 * T[0] + v01 * T[3], v00 * T[1] + v01 * T[4], v00 * T[2] + v01 * T[5]
            w3, w4, w5 = v01 * T[0] + v11 * T[3], v01 * T[1] + v11 * T[4], v01 * T[2] + v11 * T[5]
            e00, e01, e02 = T[0] * w0 + T[3] * w3, T[0] * w1 + T[3] * w4, T[0] * w2 + T[3] * w5
            e11, e12, e22 = T[1] * w1 + T[4] * w4, T[1] * w2 + T[4] * w5, T[2] * w2 + T[5] * w5
            # Through S = M M', M = R diag(s): dM = 2 dS M.
            q0 = two * (e00 * R[0] + e01 * R[3] + e02 * R[6])
            q3 = two * (e01 * R[0] + e11 * R[3] + e12 * R[6])
            q6 = two * (e02 * R[0] + e12 * R[3] + e22 * R[6])
            q1 = two * (e00 * R[1] + e01 * R[4] + e02 * R[7])
            q4 = two * (e01 * R[1] + e11 * R[4] + e12 * R[7])
            q7 = two * (e02 * R[1] + e12 * R[4] + e22 * R[7])
            q2 = two * (e00 * R[2] + e01 * R[5] + e02 * R[8])
            q5 = two * (e01 * R[2] + e11 * R[5] + e12 * R[8])
            q8 = two * (e02 * R[2] + e12 * R[5] + e22 * R[8])
            k0, k1, k2 = s0 * s0, s1 * s1, s2 * s2
            out[3] = k0 * (q0 * R[0] + q3 * R[3] + q6 * R[6])
            out[4] = k1 * (q1 * R[1] + q4 * R[4] + q7 * R[7])
            out[5] = k2 * (q2 * R[2] + q5 * R[5] + q8 * R[8])
            q0, q3, q6 = q0 * k0, q3 * k0, q6 * k0
            q1, q4, q7 = q1 * k1, q4 * k1, q7 * k1
            q2, q5, q8 = q2 * k2, q5 * k2, q8 * k2
            r0 = two * (qz * (q3 - q1) + qy * (q2 - q6) + qx * (q7 - q5))
            r1 = two * (qy * (q1 + q3) + qz * (q2 + q6) + qw * (q7 - q5) - two * qx * (q4 + q8))
            r2 = two * (qx * (q1 + q3) + qw * (q2 - q6) + qz * (q5 + q7) - two * qy * (q0 + q8))
            r3 = two * (qx * (q2 + q6) + qw * (q3 - q1) + qy * (q5 + q7) - two * qz * (q0 + q4))
            along = r0 * qw + r1 * qx + r2 * qy + r3 * qz
            out[6] = (r0 - along * qw) * inverse
            out[7] = (r1 - along * qx) * inverse
            out[8] = (r2 - along * qy) * inverse
            out[9] = (r3 - along * qz) * inverse
            # Through T = J R to the point in the camera's frame.
            dj00 = t0 * c[0] + t1 * c[1] + t2 * c[2]
            dj02 = t0 * c[6] + t1 * c[7] + t2 * c[8]
            dj11 = t3 * c[3] + t4 * c[4] + t5 * c[5]
            dj12 = t3 * c[6] + t4 * c[7] + t5 * c[8]
            iz = one / pz
            cx, cy = j00 * du, j11 * dv
            cz = d[3] - (px * cx + py * cy) * iz - (j00 * dj00 + j11 * dj11) * iz
            if free_x:
                cx -= j00 * iz * dj02
                cz -= two * j02 * iz * dj02
            else:
                cz -= j02 * iz * dj02
            if free_y:
                cy -= j11 * iz * dj12
                cz -= two * j12 * iz * dj12
            else:
                cz -= j12 * iz * dj12
            out[0] = c[0] * cx + c[3] * cy + c[6] * cz + gx
            out[1] = c[1] * cx + c[4] * cy + c[7] * cz + gy
            out[2] = c[2] * cx + c[5] * cy + c[8] * cz + gz
            # The camera: by its point, by T, and by its centre -R't.
            camera_sum[0] += cx * m0 + j00 * t0 + c[9] * gx
            camera_sum[1] += cx * m1 + j00 * t1 + c[9] * gy
            camera_sum[2] += cx * m2 + j00 * t2 + c[9] * gz
            camera_sum[3] += cy * m0 + j11 * t3 + c[10] * gx
            camera_sum[4] += cy * m1 + j11 * t4 + c[10] * gy
            camera_sum[5] += cy * m2 + j11 * t5 + c[10] * gz
            camera_sum[6] += cz * m0 + j02 * t0 + j12 * t3 + c[11] * gx
            camera_sum[7] += cz * m1 + j02 * t1 + j12 * t4 + c[11] * gy
            camera_sum[8] += cz * m2 + j02 * t2 + j12 * t5 + c[11] * gz
            camera_sum[9] += cx + c[0] * gx + c[1] * gy + c[2] * gz
            camera_sum[10] += cy + c[3] * gx + c[4] * gy + c[5] * gz
            camera_sum[11] += cz + c[6] * gx + c[7] * gy + c[8] * gz
        d_camera[part] = camera_sum
