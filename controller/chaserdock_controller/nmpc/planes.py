"""Distance constraints as half-spaces about a rollout, so that the chasers' problems separate.

A chaser-target constraint becomes the plane tangent to the keep-out ball; a chaser-chaser constraint a
separating plane at the midpoint, half the distance to each side; the outer bound a plane tangent to the
ball about the reference; an approach corridor the plane tangent to its cone where the chaser is nearest. A row of
stage k reads a' dp_k >= c with dp_k the change of the rolled position.
"""

from __future__ import annotations

import numpy as np

from chaserdock_controller.nmpc.compiled import kernel, part

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


@part
def _normalize(v):
    norm = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    if norm < 1e-9:
        return 0.0
    for i in range(3):
        v[i] /= norm
    return norm


@part
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@part
def _between(a, b, out):
    """out (3) = a - b, of which the first three."""
    for i in range(3):
        out[i] = a[i] - b[i]


@part
def _tilt(n, t):
    """Turns the unit normal ``n`` sideways by TILT. Odd in n: both chasers of a pair tilt the same plane.

    The side is n x e, e the axis that n has least of. t (3) is scratch.
    """
    least = 0
    for i in range(1, 3):
        if abs(n[i]) < abs(n[least]):
            least = i
    j, k = (least + 1) % 3, (least + 2) % 3
    t[least] = 0.0
    t[j] = n[k]
    t[k] = -n[j]
    _normalize(t)
    for i in range(3):
        n[i] += TILT * t[i]
    _normalize(n)


@part
def _push(stage, row_a, row_c, n_rows, i, k, n, sign, room, reach):
    """Adds the row sign n' dp_k >= -room of chaser i unless no admissible input can use up the room."""
    if room <= reach[i, k]:
        m = n_rows[i]
        for c in range(3):
            row_a[i, m, c] = sign * n[c]
        row_c[i, m] = -room
        stage[i, m] = k
        n_rows[i] = m + 1


@part
def _begin(here, there, ref, ref_there, last):
    """The side at stage 0: where the one is from the other, else where it is to be."""
    _between(here, there, last)
    if _normalize(last) == 0.0:
        _between(ref, ref_there, last)
        if _normalize(last) == 0.0:
            last[0] = 1.0


@part
def _side(n, want, d, held, last):
    """n becomes the normal at a stage; last is that of the stage before, and is updated.

    Returns (held, gap, cosine of the heading, length of ``want``): the way ``want`` is normalized. ``held``: the
    rollout goes through, and keeps the normal of the side that it came from.
    """
    gap = _normalize(n)
    ahead = _dot(n, last)
    if held or gap < INSIDE * d or ahead < 0.0:
        held = True
        gap *= ahead
        for c in range(3):
            n[c] = last[c]
    for c in range(3):
        last[c] = n[c]
    length = _normalize(want)
    return held, gap, -_dot(want, n), length


@part
def corridor_room(r, corridor, n):
    """Distance from the surface of the corridor's cone, m, positive inside; n (3) gets the normal inwards.

    r (3): position from the target; corridor (5): axis (unit), half angle, distance of the apex from the target.
    """
    s, c = np.sin(corridor[3]), np.cos(corridor[3])
    along = _dot(r, corridor)
    for i in range(3):
        n[i] = along * corridor[i] - r[i]
    aside = _normalize(n)
    if aside == 0.0:
        c, s = 0.0, 1.0
    for i in range(3):
        n[i] = s * corridor[i] + c * n[i]
    return s * (along - corridor[4]) - c * aside


@kernel
def build_rows(
    x, references, targets, to_target, between, outer, corridors, reach, stage, row_a, row_c, n_rows
):
    """Writes rows for all chasers.

    x (N, D+1, 13) rollouts; references (N, D+1, 7); targets (D+1, 3); to_target (N, D+1), between (N, N), outer: m;
    corridors (N, D+1, 5) as in `NmpcInput`; reach (N, D+1): how far admissible inputs can move a chaser from its
    rollout, m. Out: stage (N, M), row_a (N, M, 3), row_c (N, M), n_rows (N,); M at least D (N + 2). None at stage 0.
    """
    n_chasers, nodes = x.shape[0], x.shape[1]
    n_rows[:] = 0
    n = np.empty(3)
    last = np.empty(3)
    want = np.empty(3)
    for i in range(n_chasers):
        for k in range(1, nodes):
            _between(references[i, k], x[i, k], n)
            gap = _normalize(n)
            _push(stage, row_a, row_c, n_rows, i, k, n, 1.0, outer - gap, reach)
            if _dot(corridors[i, k], corridors[i, k]) > 0.0:
                _between(x[i, k], targets[k], want)
                room = corridor_room(want, corridors[i, k], n)
                _push(stage, row_a, row_c, n_rows, i, k, n, 1.0, room, reach)
        _begin(x[i, 0], targets[0], references[i, 0], targets[0], last)
        held = False
        for k in range(1, nodes):
            d = to_target[i, k]
            if d > 0.0:
                _between(references[i, k], targets[k], want)
                away = _dot(want, want)
                _between(x[i, k], targets[k], n)
                _between(references[i, k], x[i, k], want)
                held, gap, heading, length = _side(n, want, d, held, last)
                if heading > COS_HEAD_ON and length > gap and away >= d * d:
                    _tilt(n, want)
                _between(x[i, k], targets[k], want)
                _push(stage, row_a, row_c, n_rows, i, k, n, 1.0, _dot(n, want) - d - MARGIN_M, reach)
        for j in range(i + 1, n_chasers):
            d = between[i, j]
            if d > 0.0:
                _begin(x[i, 0], x[j, 0], references[i, 0], references[j, 0], last)
                held = False
                for k in range(1, nodes):
                    _between(x[i, k], x[j, k], n)
                    _between(references[i, k], references[j, k], want)
                    held, _, heading, length = _side(n, want, d, held, last)
                    if heading > COS_HEAD_ON and length >= d:
                        _tilt(n, want)
                    _between(x[i, k], x[j, k], want)
                    room = 0.5 * (_dot(n, want) - d - MARGIN_M)
                    _push(stage, row_a, row_c, n_rows, i, k, n, 1.0, room, reach)
                    _push(stage, row_a, row_c, n_rows, j, k, n, -1.0, room, reach)


@kernel
def plan_violation(x, references, targets, to_target, between, outer, corridors, worst):
    """Writes the deepest violation (N,), m, of the distance constraints by plans x (N, D+1, 13); 0 if none.

    Arguments as in `build_rows`; all stages 0..D count, without margin.
    """
    n_chasers = x.shape[0]
    worst[:] = 0.0
    r = np.empty(3)
    n = np.empty(3)
    for k in range(x.shape[1]):
        for i in range(n_chasers):
            _between(x[i, k], references[i, k], r)
            worst[i] = max(worst[i], _normalize(r) - outer)
            _between(x[i, k], targets[k], r)
            if _dot(corridors[i, k], corridors[i, k]) > 0.0:
                worst[i] = max(worst[i], -corridor_room(r, corridors[i, k], n))
            worst[i] = max(worst[i], to_target[i, k] - _normalize(r))
            for j in range(i + 1, n_chasers):
                _between(x[i, k], x[j, k], r)
                depth = between[i, j] - _normalize(r)
                worst[i] = max(worst[i], depth)
                worst[j] = max(worst[j], depth)
