"""The chaser's discrete dynamics and their Jacobians, in Numba. Held against `problem.dynamics` by the tests.

Jacobians are taken in the 12-dimensional tangent space [dp, dv, dtheta, domega] with
q_true = q (x) exp(dtheta): A is 12 x 12 and B 12 x 6. The first six columns of A are those of a double
integrator (identity and dt), so only its last six, called C, are computed. They are stored beside B as M = [C B],
12 x 12: loops over rows of twelve are what LLVM turns into vector instructions.

Loops rather than written-out terms, throughout: Numba's compilation takes about 1.5 ms for each elementary
operation in the source, whatever the processor makes of it, and is most of a cold start.
"""

from __future__ import annotations

import numpy as np

from chaserdock_controller.nmpc.compiled import kernel, part

# Explicit Runge-Kutta tableaux with one sub-diagonal, which is all that euler and rk4 need.
RK_NODES = {"euler": np.array([0.0]), "rk4": np.array([0.0, 0.5, 0.5, 1.0])}
RK_WEIGHTS = {"euler": np.array([1.0]), "rk4": np.array([1.0, 2.0, 2.0, 1.0]) / 6.0}

# Scratch of a step: y (7) and its rates (10), rotation (9), I omega (3), the torque left (3), one spare.
_STEP_WORK = 33


@part
def _rates(y, u, mass, inertia, inverse, k, work):
    """k (10) = [q', omega', acceleration (WRF)] at y (7) = [q, omega]; work (15) gets R (9), I omega (3)."""
    w0, x0, y0, z0 = y[0], y[1], y[2], y[3]
    work[0] = 1.0 - 2.0 * (y0 * y0 + z0 * z0)
    work[4] = 1.0 - 2.0 * (x0 * x0 + z0 * z0)
    work[8] = 1.0 - 2.0 * (x0 * x0 + y0 * y0)
    work[1] = 2.0 * (x0 * y0 - w0 * z0)
    work[3] = 2.0 * (x0 * y0 + w0 * z0)
    work[2] = 2.0 * (x0 * z0 + w0 * y0)
    work[6] = 2.0 * (x0 * z0 - w0 * y0)
    work[5] = 2.0 * (y0 * z0 - w0 * x0)
    work[7] = 2.0 * (y0 * z0 + w0 * x0)
    k[0] = 0.0
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        k[0] -= 0.5 * y[1 + i] * y[4 + i]
        k[1 + i] = 0.5 * (w0 * y[4 + i] + y[1 + a] * y[4 + b] - y[1 + b] * y[4 + a])
        work[9 + i] = 0.0
        k[7 + i] = 0.0
        for j in range(3):
            work[9 + i] += inertia[i, j] * y[4 + j]
            k[7 + i] += work[3 * i + j] * u[j] / mass
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        work[12 + i] = u[3 + i] - (y[4 + a] * work[9 + b] - y[4 + b] * work[9 + a])
    for i in range(3):
        k[4 + i] = 0.0
        for j in range(3):
            k[4 + i] += inverse[i, j] * work[12 + j]


@part
def _runge_kutta_stage(x, u, b, c, mass, inertia, inverse, out, work):
    """One stage: rates at x + c k, added with weight b to out (13). work (33): y (7), k (10), scratch."""
    y, k = work[0:7], work[7:17]
    for i in range(7):
        y[i] = x[6 + i] + c * k[i]
    for i in range(3):
        out[i] += b * (x[3 + i] + c * k[7 + i])
    _rates(y, u, mass, inertia, inverse, k, work[17:33])
    for i in range(3):
        out[3 + i] += b * k[7 + i]
    for i in range(7):
        out[6 + i] += b * k[i]


@part
def _normalize(out):
    norm = 0.0
    for i in range(6, 10):
        norm += out[i] * out[i]
    norm = np.sqrt(norm)
    for i in range(6, 10):
        out[i] /= norm
    return norm


@part
def _step(x, u, h, nodes, weights, mass, inertia, inverse, out, work):
    """One step x (13), u (6) -> out (13); the quaternion is normalized. work (_STEP_WORK,)."""
    for i in range(13):
        out[i] = x[i]
    for i in range(17):
        work[i] = 0.0
    for s in range(len(nodes)):
        _runge_kutta_stage(x, u, h * weights[s], h * nodes[s], mass, inertia, inverse, out, work)
    _normalize(out)


@part
def _rate_jacobian(y, u, mass, inertia, inverse, work, g):
    """g (10, 7) = d[q', omega', acceleration] / d[q, omega]. work (15) as `_rates` left it.

    q' = 1/2 q (0, omega); omega' = I^-1 (tau - omega x I omega); a = q F q* / m, whose derivative is
    2/m [ s x F | (v . F) 1 + v F' - 2 F v' + s [F]x' ] for q = (s, v) (the terms of v v' - |v|^2 + s v x).
    """
    s = y[0]
    dot = 0.0
    for i in range(3):
        dot += y[1 + i] * u[i]
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        # q'
        g[0, 1 + i] = -0.5 * y[4 + i]
        g[1 + i, 0] = 0.5 * y[4 + i]
        g[1 + i, 1 + a] = 0.5 * y[4 + b]
        g[1 + i, 1 + b] = -0.5 * y[4 + a]
        g[0, 4 + i] = -0.5 * y[1 + i]
        g[1 + i, 4 + i] = 0.5 * s
        g[1 + i, 4 + a] = -0.5 * y[1 + b]
        g[1 + i, 4 + b] = 0.5 * y[1 + a]
        # acceleration
        f = 2.0 / mass
        g[7 + i, 0] = f * (y[1 + a] * u[b] - y[1 + b] * u[a])
        for j in range(3):
            g[7 + i, 1 + j] = f * (y[1 + i] * u[j] - 2.0 * u[i] * y[1 + j])
        g[7 + i, 1 + i] += f * dot
        g[7 + i, 1 + a] += f * s * u[b]
        g[7 + i, 1 + b] -= f * s * u[a]
    for j in range(3):
        # column j of [I omega]x - [omega]x I, then I^-1 in front
        a, b = (j + 1) % 3, (j + 2) % 3
        for i in range(3):
            m, n = (i + 1) % 3, (i + 2) % 3
            work[12 + i] = y[4 + n] * inertia[m, j] - y[4 + m] * inertia[n, j]
        work[12 + a] += work[9 + b]
        work[12 + b] -= work[9 + a]
        for i in range(3):
            g[4 + i, 4 + j] = 0.0
            for m in range(3):
                g[4 + i, 4 + j] += inverse[i, m] * work[12 + m]


@part
def _linearize(x, u, h, nodes, weights, mass, inertia, inverse, out, m_mat, work, g, sens):
    """One step as in `_step`, with its Jacobians M = [C B] (12, 12). g (10, 7): zeros where nothing is written.

    sens (28, 12), sensitivities to [dtheta, domega, force, torque]: those of [q, omega] at the step's start (7),
    at the stage (7), of the rates (10), and their sum for q (4); the other sums lie in m_mat.
    """
    start, here, rate, q_sum = sens[0:7], sens[7:14], sens[14:24], sens[24:28]
    for i in range(28):
        for j in range(12):
            sens[i, j] = 0.0
    for i in range(12):
        for j in range(12):
            m_mat[i, j] = 0.0
    for i in range(13):
        out[i] = x[i]
    for i in range(17):
        work[i] = 0.0
    # dq = 1/2 q (x) (0, dtheta)
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        start[0, i] = -0.5 * x[7 + i]
        start[1 + i, i] = 0.5 * x[6]
        start[1 + i, a] = -0.5 * x[7 + b]
        start[1 + i, b] = 0.5 * x[7 + a]
        start[4 + i, 3 + i] = 1.0
        m_mat[9 + i, 3 + i] = 1.0
    for i in range(4):
        for j in range(3):
            q_sum[i, j] = start[i, j]
    for s in range(len(nodes)):
        c, b = h * nodes[s], h * weights[s]
        for i in range(7):
            for j in range(12):
                here[i, j] = start[i, j] + c * rate[i, j]
        for i in range(3):
            for j in range(12):
                m_mat[i, j] += b * c * rate[7 + i, j]
        _runge_kutta_stage(x, u, b, c, mass, inertia, inverse, out, work)
        _rate_jacobian(work[0:7], u, mass, inertia, inverse, work[17:33], g)
        for i in range(10):
            for j in range(12):
                rate[i, j] = 0.0
            for m in range(4 if 4 <= i < 7 else 0, 7 if i < 7 else 4):
                f = g[i, m]
                for j in range(12):
                    rate[i, j] += f * here[m, j]
        for i in range(3):
            for j in range(3):
                rate[7 + i, 6 + j] += work[17 + 3 * i + j] / mass
                rate[4 + i, 9 + j] += inverse[i, j]
        for i in range(3):
            for j in range(12):
                m_mat[3 + i, j] += b * rate[7 + i, j]
                m_mat[9 + i, j] += b * rate[4 + i, j]
        for i in range(4):
            for j in range(12):
                q_sum[i, j] += b * rate[i, j]
    # dtheta_next = 2 vec(q_next* (x) dq) / |q|: the projection on the tangent space, normalization included
    scale = 2.0 / _normalize(out)
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(12):
            t = out[6] * q_sum[1 + i, j] - out[7 + i] * q_sum[0, j]
            m_mat[6 + i, j] = scale * (t - (out[7 + a] * q_sum[1 + b, j] - out[7 + b] * q_sum[1 + a, j]))


@kernel
def roll_linearized(x, u, limits, h, nodes, weights, mass, inertia, inverse, mats):
    """Rolls u (N, D, 6) from x[:, 0] through x (N, D+1, 13); mats (N, D, 12, 12) = [C B] along the way.

    B is that of the scaled inputs u / limits (N, 6): its columns are multiplied by the limits.
    """
    work = np.empty(_STEP_WORK)
    g = np.zeros((10, 7))
    sens = np.empty((28, 12))
    for i in range(u.shape[0]):
        for k in range(u.shape[1]):
            m = mats[i, k]
            _linearize(
                x[i, k], u[i, k], h, nodes, weights, mass, inertia, inverse, x[i, k + 1], m, work, g, sens
            )  # fmt: skip
            for row in range(12):
                for c in range(6):
                    m[row, 6 + c] *= limits[i, c]


@kernel
def roll(x, u, h, nodes, weights, mass, inertia, inverse):
    """Rolls u (N, D, 6) from x[:, 0] through x (N, D+1, 13)."""
    work = np.empty(_STEP_WORK)
    for i in range(u.shape[0]):
        for k in range(u.shape[1]):
            _step(x[i, k], u[i, k], h, nodes, weights, mass, inertia, inverse, x[i, k + 1], work)
