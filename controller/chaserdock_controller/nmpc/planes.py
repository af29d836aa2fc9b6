"""Distance constraints as half-spaces about a rollout, so that the chasers' problems separate.

A chaser-target constraint becomes the plane tangent to the keep-out ball; a chaser-chaser constraint a
separating plane at the midpoint, half the distance to each side; the outer bound a plane tangent to the
ball about the reference. Row m of stage k reads a' dp_k >= c with dp_k the change of the rolled position.
"""

from __future__ import annotations

import numpy as np
from numba import njit

# Linearization gave away 2 mm of a distance; the plan keeps this much more.
MARGIN_M = 5e-3
# A chaser heading for the centre within this angle has no side to pass on; the normal is tilted by TILT.
COS_HEAD_ON = np.cos(np.deg2rad(10.0))
TILT = 0.2
# Deeper than this share of the distance the rollout counts as inside and the last normal is kept, so that a
# rollout which crosses does not come out with the normal of the far side.
INSIDE = 0.8
# Rows that no admissible input can reach are left out; the bound is taken this much wider.
REACH_SAFETY = 1.5


@njit(cache=True, error_model="numpy")
def _normalize(v):
    norm = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    if norm < 1e-9:
        return 0.0
    for i in range(3):
        v[i] /= norm
    return norm


@njit(cache=True, error_model="numpy")
def _tilt(n):
    """Turns the unit normal ``n`` sideways by TILT. Odd in n: both chasers of a pair tilt the same plane.

    The side is n x e, e the axis that n has least of.
    """
    t = np.zeros(3)
    least = 0
    for i in range(1, 3):
        if abs(n[i]) < abs(n[least]):
            least = i
    j, k = (least + 1) % 3, (least + 2) % 3
    t[j] = n[k]
    t[k] = -n[j]
    _normalize(t)
    for i in range(3):
        n[i] += TILT * t[i]
    _normalize(n)


@njit(cache=True, error_model="numpy")
def _push(row_a, row_c, n_rows, k, n, sign, room, reach):
    """Adds the row sign n' dp >= -room unless no admissible input can use up the room."""
    if room > reach:
        return
    m = n_rows[k]
    for i in range(3):
        row_a[k, m, i] = sign * n[i]
    row_c[k, m] = -room
    n_rows[k] = m + 1


@njit(cache=True, error_model="numpy")
def build_rows(x, references, targets, to_target, between, outer, reach, row_a, row_c, n_rows):
    """Writes rows for all chasers.

    x (N, D+1, 13) rollouts; references (N, D+1, 7); targets (D+1, 3); to_target (N,), between (N, N), outer: m;
    reach (N, D+1): how far admissible inputs can move a chaser from its rollout, m.
    Out: row_a (N, D+1, N+1, 3), row_c (N, D+1, N+1), n_rows (N, D+1); none at stage 0.
    """
    n_chasers, nodes = x.shape[0], x.shape[1]
    n_rows[:] = 0
    n = np.empty(3)
    use = np.empty(3)
    last = np.empty(3)
    want = np.empty(3)
    for i in range(n_chasers):
        for k in range(1, nodes):
            for c in range(3):
                n[c] = references[i, k, c] - x[i, k, c]
            gap = _normalize(n)
            _push(row_a[i], row_c[i], n_rows[i], k, n, 1.0, outer - gap, reach[i, k])
        d = to_target[i]
        if d > 0.0:
            for c in range(3):
                last[c] = x[i, 0, c] - targets[0, c]
            if _normalize(last) == 0.0:
                for c in range(3):
                    last[c] = references[i, 0, c] - targets[0, c]
                if _normalize(last) == 0.0:
                    last[0] = 1.0
            held = False
            for k in range(1, nodes):
                for c in range(3):
                    n[c] = x[i, k, c] - targets[k, c]
                    want[c] = references[i, k, c] - x[i, k, c]
                gap = _normalize(n)
                ahead = n[0] * last[0] + n[1] * last[1] + n[2] * last[2]
                if held or gap < INSIDE * d or ahead < 0.0:
                    held = True
                    gap *= ahead
                    for c in range(3):
                        n[c] = last[c]
                for c in range(3):
                    last[c] = n[c]
                    use[c] = n[c]
                away = 0.0
                for c in range(3):
                    away += (references[i, k, c] - targets[k, c]) ** 2
                length = _normalize(want)
                heading = -(want[0] * n[0] + want[1] * n[1] + want[2] * n[2])
                if heading > COS_HEAD_ON and length > gap and away >= d * d:
                    _tilt(use)
                room = -(d + MARGIN_M)
                for c in range(3):
                    room += use[c] * (x[i, k, c] - targets[k, c])
                _push(row_a[i], row_c[i], n_rows[i], k, use, 1.0, room, reach[i, k])
        for j in range(i + 1, n_chasers):
            d = between[i, j]
            if d <= 0.0:
                continue
            for c in range(3):
                last[c] = x[i, 0, c] - x[j, 0, c]
            if _normalize(last) == 0.0:
                for c in range(3):
                    last[c] = references[i, 0, c] - references[j, 0, c]
                if _normalize(last) == 0.0:
                    last[0] = 1.0
            held = False
            for k in range(1, nodes):
                for c in range(3):
                    n[c] = x[i, k, c] - x[j, k, c]
                    want[c] = references[i, k, c] - references[j, k, c]
                gap = _normalize(n)
                if held or gap < INSIDE * d or n[0] * last[0] + n[1] * last[1] + n[2] * last[2] < 0.0:
                    held = True
                    for c in range(3):
                        n[c] = last[c]
                for c in range(3):
                    last[c] = n[c]
                    use[c] = n[c]
                apart = _normalize(want)
                if apart >= d and -(want[0] * n[0] + want[1] * n[1] + want[2] * n[2]) > COS_HEAD_ON:
                    _tilt(use)
                room = 0.0
                for c in range(3):
                    room += 0.5 * use[c] * (x[i, k, c] - x[j, k, c])
                room -= 0.5 * (d + MARGIN_M)
                _push(row_a[i], row_c[i], n_rows[i], k, use, 1.0, room, reach[i, k])
                _push(row_a[j], row_c[j], n_rows[j], k, use, -1.0, room, reach[j, k])


@njit(cache=True, error_model="numpy")
def plan_violation(x, references, targets, to_target, between, outer, worst):
    """Writes the deepest violation (N,), m, of the distance constraints by plans x (N, D+1, 13); 0 if none.

    Arguments as in `build_rows`; all stages 0..D count, without margin.
    """
    n_chasers = x.shape[0]
    worst[:] = 0.0
    for k in range(x.shape[1]):
        for i in range(n_chasers):
            s = t = 0.0
            for c in range(3):
                s += (x[i, k, c] - targets[k, c]) ** 2
                t += (x[i, k, c] - references[i, k, c]) ** 2
            worst[i] = max(worst[i], to_target[i] - np.sqrt(s), np.sqrt(t) - outer)
            for j in range(i + 1, n_chasers):
                s = 0.0
                for c in range(3):
                    s += (x[i, k, c] - x[j, k, c]) ** 2
                depth = between[i, j] - np.sqrt(s)
                worst[i] = max(worst[i], depth)
                worst[j] = max(worst[j], depth)
