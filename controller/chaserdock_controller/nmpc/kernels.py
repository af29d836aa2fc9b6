"""The chaser's discrete dynamics and their Jacobians, in Numba. Held against `problem.dynamics` by the tests.

Jacobians are taken in the 12-dimensional tangent space [dp, dv, dtheta, domega] with
q_true = q (x) exp(dtheta): A is 12 x 12 and B 12 x 6. The first six columns of A are those of a double
integrator (identity and dt), so only its last six, called C here, are computed and stored.
"""

from __future__ import annotations

import numpy as np
from numba import njit

# Explicit Runge-Kutta tableaux with one sub-diagonal, which is all that euler and rk4 need.
RK_NODES = {"euler": np.array([0.0]), "rk4": np.array([0.0, 0.5, 0.5, 1.0])}
RK_WEIGHTS = {"euler": np.array([1.0]), "rk4": np.array([1.0, 2.0, 2.0, 1.0]) / 6.0}


@njit(cache=True, error_model="numpy")
def body_rates(q, w, u, mass, inertia, inverse, a, kq, kw):
    """Writes the acceleration a (3, WRF), kq = q' (4) and kw = omega' (3)."""
    t0 = 2.0 * (q[2] * u[2] - q[3] * u[1])
    t1 = 2.0 * (q[3] * u[0] - q[1] * u[2])
    t2 = 2.0 * (q[1] * u[1] - q[2] * u[0])
    a[0] = (u[0] + q[0] * t0 + q[2] * t2 - q[3] * t1) / mass
    a[1] = (u[1] + q[0] * t1 + q[3] * t0 - q[1] * t2) / mass
    a[2] = (u[2] + q[0] * t2 + q[1] * t1 - q[2] * t0) / mass
    kq[0] = 0.5 * (-q[1] * w[0] - q[2] * w[1] - q[3] * w[2])
    kq[1] = 0.5 * (q[0] * w[0] + q[2] * w[2] - q[3] * w[1])
    kq[2] = 0.5 * (q[0] * w[1] + q[3] * w[0] - q[1] * w[2])
    kq[3] = 0.5 * (q[0] * w[2] + q[1] * w[1] - q[2] * w[0])
    l0 = inertia[0, 0] * w[0] + inertia[0, 1] * w[1] + inertia[0, 2] * w[2]
    l1 = inertia[1, 0] * w[0] + inertia[1, 1] * w[1] + inertia[1, 2] * w[2]
    l2 = inertia[2, 0] * w[0] + inertia[2, 1] * w[1] + inertia[2, 2] * w[2]
    n0 = u[3] - (w[1] * l2 - w[2] * l1)
    n1 = u[4] - (w[2] * l0 - w[0] * l2)
    n2 = u[5] - (w[0] * l1 - w[1] * l0)
    for i in range(3):
        kw[i] = inverse[i, 0] * n0 + inverse[i, 1] * n1 + inverse[i, 2] * n2


@njit(cache=True, error_model="numpy")
def step(x, u, h, nodes, weights, mass, inertia, inverse, out, work):
    """One step x (13), u (6) -> out (13); the quaternion is normalized. work (24,)."""
    q, w, kq, kw, a = work[0:4], work[4:7], work[7:11], work[11:14], work[14:17]
    kq[:] = 0.0
    kw[:] = 0.0
    a[:] = 0.0
    for i in range(13):
        out[i] = x[i]
    for s in range(len(nodes)):
        c = h * nodes[s]
        b = h * weights[s]
        for i in range(4):
            q[i] = x[6 + i] + c * kq[i]
        for i in range(3):
            w[i] = x[10 + i] + c * kw[i]
            out[i] += b * (x[3 + i] + c * a[i])
        body_rates(q, w, u, mass, inertia, inverse, a, kq, kw)
        for i in range(3):
            out[3 + i] += b * a[i]
            out[10 + i] += b * kw[i]
        for i in range(4):
            out[6 + i] += b * kq[i]
    norm = np.sqrt(out[6] * out[6] + out[7] * out[7] + out[8] * out[8] + out[9] * out[9])
    for i in range(4):
        out[6 + i] /= norm
    return norm


@njit(cache=True, error_model="numpy")
def linearize(x, u, h, nodes, weights, mass, inertia, inverse, out, c_mat, b_mat, work, sens):
    """One step as in `step`, with its Jacobians C (12, 6) and B (12, 6).

    work (54,) and sens (27, 9) are scratch. sens holds the sensitivities to [dtheta, domega, torque] of, in
    rows: q' (4), omega' (3) and acceleration (3) at the last stage; the sums for p (3), v (3), q (4) and
    omega (3); q at the start (4).
    """
    q, w, kq, kw, a = work[0:4], work[4:7], work[7:11], work[11:14], work[14:17]
    m, jac, rot = work[24:36].reshape((3, 4)), work[36:45].reshape((3, 3)), work[45:54].reshape((3, 3))
    dkq, dkw, da = sens[0:4], sens[4:7], sens[7:10]
    dp, dv, sum_q, sum_w, dq0 = sens[10:13], sens[13:16], sens[16:20], sens[20:23], sens[23:27]
    sens[:] = 0.0
    work[:] = 0.0
    c_mat[:] = 0.0
    b_mat[:] = 0.0
    for i in range(13):
        out[i] = x[i]
    per_mass = 1.0 / mass
    # dq = q (x) (0, dtheta / 2)
    w0, x0, y0, z0 = 0.5 * x[6], 0.5 * x[7], 0.5 * x[8], 0.5 * x[9]
    sum_q[0, 0], sum_q[0, 1], sum_q[0, 2] = -x0, -y0, -z0
    sum_q[1, 0], sum_q[1, 1], sum_q[1, 2] = w0, -z0, y0
    sum_q[2, 0], sum_q[2, 1], sum_q[2, 2] = z0, w0, -x0
    sum_q[3, 0], sum_q[3, 1], sum_q[3, 2] = -y0, x0, w0
    for i in range(4):
        for j in range(3):
            dq0[i, j] = sum_q[i, j]
    for i in range(3):
        sum_w[i, 3 + i] = 1.0
    for s in range(len(nodes)):
        c = h * nodes[s]
        b = h * weights[s]
        for i in range(4):
            q[i] = x[6 + i] + c * kq[i]
        for i in range(3):
            w[i] = x[10 + i] + c * kw[i]
            out[i] += b * (x[3 + i] + c * a[i])
            for j in range(3):
                b_mat[i, j] += b * c * rot[i, j]
        body_rates(q, w, u, mass, inertia, inverse, a, kq, kw)
        # d(acceleration)/dq, and the rotation over the mass, which is d(acceleration)/dF
        f0, f1, f2, qw, qx, qy, qz = u[0], u[1], u[2], q[0], q[1], q[2], q[3]
        dot = qx * f0 + qy * f1 + qz * f2
        m[0, 0] = 2.0 * (qy * f2 - qz * f1)
        m[1, 0] = 2.0 * (qz * f0 - qx * f2)
        m[2, 0] = 2.0 * (qx * f1 - qy * f0)
        m[0, 1] = 2.0 * (dot - qx * f0)
        m[0, 2] = 2.0 * (qw * f2 + qx * f1 - 2.0 * f0 * qy)
        m[0, 3] = 2.0 * (-qw * f1 + qx * f2 - 2.0 * f0 * qz)
        m[1, 1] = 2.0 * (-qw * f2 + qy * f0 - 2.0 * f1 * qx)
        m[1, 2] = 2.0 * (dot - qy * f1)
        m[1, 3] = 2.0 * (qw * f0 + qy * f2 - 2.0 * f1 * qz)
        m[2, 1] = 2.0 * (qw * f1 + qz * f0 - 2.0 * f2 * qx)
        m[2, 2] = 2.0 * (-qw * f0 + qz * f1 - 2.0 * f2 * qy)
        m[2, 3] = 2.0 * (dot - qz * f2)
        rot[0, 0] = 1.0 - 2.0 * (qy * qy + qz * qz)
        rot[0, 1] = 2.0 * (qx * qy - qw * qz)
        rot[0, 2] = 2.0 * (qx * qz + qw * qy)
        rot[1, 0] = 2.0 * (qx * qy + qw * qz)
        rot[1, 1] = 1.0 - 2.0 * (qx * qx + qz * qz)
        rot[1, 2] = 2.0 * (qy * qz - qw * qx)
        rot[2, 0] = 2.0 * (qx * qz - qw * qy)
        rot[2, 1] = 2.0 * (qy * qz + qw * qx)
        rot[2, 2] = 1.0 - 2.0 * (qx * qx + qy * qy)
        for i in range(3):
            for j in range(4):
                m[i, j] *= per_mass
            for j in range(3):
                rot[i, j] *= per_mass
        # d omega' / d omega = I^-1 ([I w]x - [w]x I)
        l0 = inertia[0, 0] * w[0] + inertia[0, 1] * w[1] + inertia[0, 2] * w[2]
        l1 = inertia[1, 0] * w[0] + inertia[1, 1] * w[1] + inertia[1, 2] * w[2]
        l2 = inertia[2, 0] * w[0] + inertia[2, 1] * w[1] + inertia[2, 2] * w[2]
        for j in range(3):
            g0 = -(w[1] * inertia[2, j] - w[2] * inertia[1, j])
            g1 = -(w[2] * inertia[0, j] - w[0] * inertia[2, j])
            g2 = -(w[0] * inertia[1, j] - w[1] * inertia[0, j])
            if j == 0:
                g1 += l2
                g2 -= l1
            elif j == 1:
                g0 -= l2
                g2 += l0
            else:
                g0 += l1
                g1 -= l0
            for i in range(3):
                jac[i, j] = inverse[i, 0] * g0 + inverse[i, 1] * g1 + inverse[i, 2] * g2
        bc = b * c
        for j in range(9):
            d0, d1 = dq0[0, j] + c * dkq[0, j], dq0[1, j] + c * dkq[1, j]
            d2, d3 = dq0[2, j] + c * dkq[2, j], dq0[3, j] + c * dkq[3, j]
            e0, e1, e2 = c * dkw[0, j], c * dkw[1, j], c * dkw[2, j]
            if j == 3:
                e0 += 1.0
            elif j == 4:
                e1 += 1.0
            elif j == 5:
                e2 += 1.0
            g0 = 0.5 * (-d1 * w[0] - d2 * w[1] - d3 * w[2] - qx * e0 - qy * e1 - qz * e2)
            g1 = 0.5 * (d0 * w[0] + d2 * w[2] - d3 * w[1] + qw * e0 + qy * e2 - qz * e1)
            g2 = 0.5 * (d0 * w[1] + d3 * w[0] - d1 * w[2] + qw * e1 + qz * e0 - qx * e2)
            g3 = 0.5 * (d0 * w[2] + d1 * w[1] - d2 * w[0] + qw * e2 + qx * e1 - qy * e0)
            dkq[0, j], dkq[1, j], dkq[2, j], dkq[3, j] = g0, g1, g2, g3
            sum_q[0, j] += b * g0
            sum_q[1, j] += b * g1
            sum_q[2, j] += b * g2
            sum_q[3, j] += b * g3
            for i in range(3):
                t = jac[i, 0] * e0 + jac[i, 1] * e1 + jac[i, 2] * e2
                if j >= 6:
                    t += inverse[i, j - 6]
                dkw[i, j] = t
                sum_w[i, j] += b * t
                t = m[i, 0] * d0 + m[i, 1] * d1 + m[i, 2] * d2 + m[i, 3] * d3
                dp[i, j] += bc * da[i, j]
                da[i, j] = t
                dv[i, j] += b * t
        for i in range(3):
            out[3 + i] += b * a[i]
            out[10 + i] += b * kw[i]
            for j in range(3):
                b_mat[3 + i, j] += b * rot[i, j]
        for i in range(4):
            out[6 + i] += b * kq[i]
    norm = np.sqrt(out[6] * out[6] + out[7] * out[7] + out[8] * out[8] + out[9] * out[9])
    for i in range(4):
        out[6 + i] /= norm
    # dtheta_next = 2 vec(q_next* (x) dq) / |q|: the projection on the tangent space, normalization included
    scale = 2.0 / norm
    qw, qx, qy, qz = scale * out[6], scale * out[7], scale * out[8], scale * out[9]
    for j in range(9):
        d0, d1, d2, d3 = sum_q[0, j], sum_q[1, j], sum_q[2, j], sum_q[3, j]
        t0 = qw * d1 - qx * d0 - (qy * d3 - qz * d2)
        t1 = qw * d2 - qy * d0 - (qz * d1 - qx * d3)
        t2 = qw * d3 - qz * d0 - (qx * d2 - qy * d1)
        for i in range(3):
            t = t0 if i == 0 else (t1 if i == 1 else t2)
            if j < 6:
                c_mat[i, j], c_mat[3 + i, j], c_mat[6 + i, j], c_mat[9 + i, j] = (
                    dp[i, j],
                    dv[i, j],
                    t,
                    sum_w[i, j],
                )
            else:
                b_mat[i, j - 3], b_mat[3 + i, j - 3], b_mat[6 + i, j - 3], b_mat[9 + i, j - 3] = (
                    dp[i, j],
                    dv[i, j],
                    t,
                    sum_w[i, j],
                )
    return norm


@njit(cache=True, error_model="numpy")
def roll_linearized(x, u, limits, h, nodes, weights, mass, inertia, inverse, c_mats, b_mats):
    """Rolls u (N, D, 6) from x[:, 0] through x (N, D+1, 13); c_mats, b_mats (N, D, 12, 6) along the way.

    B is that of the scaled inputs u / limits (N, 6): its columns are multiplied by the limits.
    """
    work = np.empty(54)
    sens = np.empty((27, 9))
    for i in range(u.shape[0]):
        for k in range(u.shape[1]):
            linearize(
                x[i, k], u[i, k], h, nodes, weights, mass, inertia, inverse, x[i, k + 1],
                c_mats[i, k], b_mats[i, k], work, sens,
            )  # fmt: skip
            for row in range(12):
                for c in range(6):
                    b_mats[i, k, row, c] *= limits[i, c]


@njit(cache=True, error_model="numpy")
def roll(x, u, h, nodes, weights, mass, inertia, inverse):
    """Rolls u (N, D, 6) from x[:, 0] through x (N, D+1, 13)."""
    work = np.empty(24)
    for i in range(u.shape[0]):
        for k in range(u.shape[1]):
            step(x[i, k], u[i, k], h, nodes, weights, mass, inertia, inverse, x[i, k + 1], work)
