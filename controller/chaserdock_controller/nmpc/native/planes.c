/* SPDX-License-Identifier: Apache-2.0 */
/* Terms that restrict motion, written as half-spaces about a rollout, so that the chasers'
 * problems separate.
 *
 * Keep-out: plane tangent to the ball about the target.
 * Outer bound: plane tangent to the ball about the reference.
 * Corridor: plane tangent to the cone where the chaser is nearest.
 * Separation: plane midway between two chasers, half the distance to each side. With shapes,
 *     this distance is at least what they need along the line between the centres.
 * Target's shape: for each cuboid the plane that separates it from the chaser's shape, normal to
 *     the line from its nearest point to the chaser's centre.
 * Passive coasts: half-spaces of position and velocity as given (nmpc/terms/coast.py).
 *
 * A row of stage k reads a' dr_k >= c, with dr_k the changes of the rolled position and
 * velocity. */
#include "base.h"

/* Additional margin of the plan, m. Linearization can lose 2 mm of a distance. */
#define MARGIN_M 5e-3
/* Cosine of 10 degrees. For a chaser that heads for the centre within this angle the passing
 * side is undetermined. With half and twice the angle a plan in 150 of one flight ends at its
 * iteration limit. */
#define COS_HEAD_ON 0.984807753012208
/* Tangent of the angle by which the normal is then tilted. Without it a symmetric approach goes
 * straight through. 0.1 and 0.4 pass obstacles as well. */
#define TILT 0.2
/* Closer than this share of the distance, the rollout counts as inside and the last normal is
 * kept: a crossing rollout must not get the normal of the far side. 0.4 and 0.95 keep the same
 * distances. */
#define INSIDE 0.8
/* Bound for `out_of_reach`: a tilted normal sees 1 / sqrt(1 + TILT^2) = 0.9806 of the gap. */
#define TILTED_SHARE 0.98
/* Largest shift, m, of the planes between chasers in favour of one that cannot keep its own
 * distances. A neighbour comes closer by at most this, a small part of the distance (0.35 m).
 * Half and twice change no flight without shapes. */
#define RELIEF_MAX_M 0.02

/* Rows of all chasers, with a capacity of `width` each. reach (N, D+1): distance, m, by which
 * admissible inputs can move a chaser from its rollout by each stage. */
typedef struct {
    int64_t width, nodes;
    const double *reach;
    int64_t *stage, *n_rows;
    double *a, *c;  /* (N, width, 6): of position and velocity; (N, width) */
    double *relief; /* (N,) working memory */
} Rows;
LAYOUT(Rows, width, nodes, reach, stage, n_rows, a, c, relief)

/* Tilt the unit normal n sideways by TILT. Odd in n, so that both chasers of a pair tilt the
 * same plane. The side is n x e, with e the axis of the smallest component of n. */
static void tilt(double *n) {
    int i = 0;
    for (int c = 1; c < 3; c++)
        if (abs_of(n[c]) < abs_of(n[i])) i = c;
    int j = (i + 1) % 3, k = (i + 2) % 3;
    double t[3];
    t[i] = 0.0;
    t[j] = n[k];
    t[k] = -n[j];
    normalize3(t);
    for (int c = 0; c < 3; c++) n[c] = madd(TILT, t[c], n[c]);
    normalize3(n);
}

/* Add the row sign n' dp_k >= -room of chaser i, unless no admissible input can reach it. */
static inline void push(const Rows *rows, int64_t i, int64_t k, const double *n, double sign,
                        double room) {
    if (!(room <= rows->reach[i * rows->nodes + k])) return;
    int64_t m = i * rows->width + rows->n_rows[i]++;
    for (int c = 0; c < 3; c++) {
        rows->a[6 * m + c] = sign * n[c];
        rows->a[6 * m + 3 + c] = 0.0;
    }
    rows->c[m] = -room;
    rows->stage[m] = k;
}

/* Set the normal at stage 0: the direction of the relative position, or else of the relative
 * reference. */
static void first_side(const double *here, const double *there, const double *ref,
                       const double *ref_there, double *last) {
    subtract3(here, there, last);
    if (normalize3(last) > 0.0) return;
    subtract3(ref, ref_there, last);
    if (normalize3(last) == 0.0) last[0] = 1.0;
}

/* Compute the normal n of a stage, and update that of the previous stage, `last`. `held`: the
 * rollout crosses the constraint and keeps the normal of its entry side. Normalizes the
 * displacement `want` and returns its length. */
static double side(double *n, double *want, double d, int *held, double *last, double *gap,
                   double *heading) {
    *gap = normalize3(n);
    double ahead = dot3(n, last);
    if (*held || *gap < INSIDE * d || ahead < 0.0) {
        *held = 1;
        *gap *= ahead;
        copy(last, n, 3);
    }
    copy(n, last, 3);
    double length = normalize3(want);
    *heading = -dot3(want, n);
    return length;
}

/* Return the distance, m, from the surface of the corridor's cone, positive inside; write the
 * inward normal to n (3). r (3): position from the target. corridor (5): axis (unit), half
 * angle, distance of the apex from the target. */
static double corridor_room(const double *r, const double *corridor, double *n) {
    double s, c, along = dot3(r, corridor);
    sine_cosine(corridor[3], &s, &c);
    for (int i = 0; i < 3; i++) n[i] = madd(along, corridor[i], -r[i]);
    double aside = normalize3(n);
    if (aside == 0.0) {
        c = 0.0;
        s = 1.0;
    }
    for (int i = 0; i < 3; i++) n[i] = madd(s, corridor[i], c * n[i]);
    return madd(s, along - corridor[4], -(c * aside));
}

/* Return how far, m, a chaser's shape extends from its centre along sign n; 0 without a shape.
 * n (3): WRF; q (4): body to WRF. */
static double reach_along(const Problem *problem, const double *q, double sign, const double *n) {
    double t[3], u[3], local[3], furthest = 0.0;
    if (!problem->n_shape) return 0.0;
    cross3(q + 1, n, t);
    cross3(q + 1, t, u);
    for (int c = 0; c < 3; c++) local[c] = sign * madd(2.0, u[c] - q[0] * t[c], n[c]);
    for (const double *box = problem->shape; box < problem->shape + 15 * problem->n_shape;
         box += 15) {
        double reach = dot3(box, local);
        for (int c = 0; c < 3; c++)
            reach = madd(abs_of(madd(box[9 + c], local[2],
                                     madd(box[6 + c], local[1], box[3 + c] * local[0]))),
                         box[12 + c], reach);
        furthest = box == problem->shape ? reach : max_of(furthest, reach);
    }
    return furthest;
}

/* Return the distance, m, that the centres of two chasers in states x and y (13) must keep
 * along n (3), a unit vector from the second to the first. */
static double centre_distance(const Problem *problem, int64_t i, int64_t j, const double *x,
                              const double *y, const double *n) {
    const double d = problem->between[i * problem->n + j],
                 apart = problem->apart[i * problem->n + j];
    if (!(apart > 0.0)) return d;
    return max_of(d, apart + reach_along(problem, x + 6, -1.0, n) +
                         reach_along(problem, y + 6, 1.0, n));
}

/* Return the largest `centre_distance` over all attitudes. */
static double largest_distance(const Problem *problem, int64_t i, int64_t j) {
    const double d = problem->between[i * problem->n + j],
                 apart = problem->apart[i * problem->n + j];
    double radius = 0.0;
    if (!(apart > 0.0)) return d;
    for (const double *box = problem->shape; box < problem->shape + 15 * problem->n_shape;
         box += 15)
        radius = max_of(radius, sqrt_of(dot3(box, box)) + sqrt_of(dot3(box + 12, box + 12)));
    return max_of(d, apart + 2.0 * radius);
}

/* Test whether two chasers stay so far apart over the whole rollout that inputs can reach no
 * row between them. */
static int out_of_reach(const Rows *rows, const double *x, const double *y, const double *reach_x,
                        const double *reach_y, double d) {
    double last[3], now[3];
    subtract3(x, y, last);
    for (int64_t k = 1; k < rows->nodes; k++) {
        subtract3(x + 13 * k, y + 13 * k, now);
        double needed = (d + MARGIN_M + 2.0 * max_of(reach_x[k], reach_y[k])) / TILTED_SHARE;
        if (dot3(now, now) <= needed * needed || dot3(now, last) <= 0.0) return 0;
        copy(now, last, 3);
    }
    return 1;
}

/* Add rows of the separating planes of two chasers. `relief`: shift of the planes away from i,
 * m. */
static void pair_rows(const Problem *problem, const Rows *rows, int64_t i, int64_t j,
                      const double *x, const double *y, double relief) {
    const int64_t nodes = rows->nodes;
    const double *here = problem->references + 7 * nodes * i,
                 *there = problem->references + 7 * nodes * j;
    if (out_of_reach(rows, x, y, rows->reach + i * nodes, rows->reach + j * nodes,
                     largest_distance(problem, i, j)))
        return;
    double last[3] = {0}, n[3], want[3], gap, heading;
    int held = 0;
    first_side(x, y, here, there, last);
    for (int64_t k = 1; k < nodes; k++) {
        subtract3(x + 13 * k, y + 13 * k, n);
        copy(n, want, 3);
        normalize3(want);
        double d = centre_distance(problem, i, j, x + 13 * k, y + 13 * k, want);
        subtract3(here + 7 * k, there + 7 * k, want);
        double length = side(n, want, d, &held, last, &gap, &heading);
        if (heading > COS_HEAD_ON && length >= d) tilt(n);
        d = centre_distance(problem, i, j, x + 13 * k, y + 13 * k, n);
        subtract3(x + 13 * k, y + 13 * k, want);
        double room = 0.5 * (dot3(n, want) - d - MARGIN_M);
        push(rows, i, k, n, 1.0, room + relief);
        push(rows, j, k, n, -1.0, room - relief);
    }
}

/* Return the signed distance, m, of a point (3) from a cuboid (15), and write its gradient to n
 * (3) (chaserdock_models.shape_distance). */
static double box_distance(const double *point, const double *box, double *n) {
    double r[3], local[3], off[3] = {0}, square = 0.0;
    subtract3(point, box, r);
    for (int i = 0; i < 3; i++) {
        local[i] = madd(box[9 + i], r[2], madd(box[6 + i], r[1], box[3 + i] * r[0]));
        if (abs_of(local[i]) > box[12 + i])
            off[i] = local[i] - (local[i] > 0.0 ? box[12 + i] : -box[12 + i]);
        square = madd(off[i], off[i], square);
    }
    double distance = sqrt_of(square);
    if (!(distance > 0.0)) {
        int face = 0;
        for (int i = 1; i < 3; i++)
            if (abs_of(local[i]) - box[12 + i] > abs_of(local[face]) - box[12 + face]) face = i;
        distance = abs_of(local[face]) - box[12 + face];
        for (int i = 0; i < 3; i++) off[i] = 0.0;
        off[face] = local[face] >= 0.0 ? 1.0 : -1.0;
    } else
        for (int i = 0; i < 3; i++) off[i] /= distance;
    multiply3(box + 3, off, n);
    return distance;
}

/* Return the signed distance, m, of a chaser's shape from a cuboid, along the gradient n (3) of
 * its centre's distance. x (13): the chaser's state. */
static double shape_gap(const Problem *problem, const double *x, const double *box, double *n) {
    double distance = box_distance(x, box, n);
    return distance - reach_along(problem, x + 6, -1.0, n);
}

/* Return the distance, m, of a point (3) from the plane with unit normal n (3) that touches a
 * cuboid (15) from outside. */
static double plane_distance(const double *point, const double *box, const double *n) {
    double r[3], support = 0.0;
    subtract3(point, box, r);
    for (int i = 0; i < 3; i++)
        support = madd(abs_of(madd(box[9 + i], n[2], madd(box[6 + i], n[1], box[3 + i] * n[0]))),
                       box[12 + i], support);
    return dot3(n, r) - support;
}

/* Add rows of the separating planes of one cuboid. A rollout that crosses it keeps the normal
 * of its entry side. */
static void box_rows(const Problem *problem, const Rows *rows, int64_t i, int64_t box,
                     const double *x) {
    const double clearance = problem->clearance[i];
    double last[3], n[3];
    int held = 0;
    box_distance(x, problem->boxes + 15 * box, last);
    for (int64_t k = 1; k < rows->nodes; k++) {
        const double *at = problem->boxes + 15 * (problem->n_boxes * k + box);
        double gap = box_distance(x + 13 * k, at, n);
        if (held || gap < INSIDE * (clearance + reach_along(problem, x + 13 * k + 6, -1.0, n)) ||
            dot3(n, last) < 0.0) {
            held = 1;
            copy(last, n, 3);
        }
        copy(n, last, 3);
        double needed = clearance + reach_along(problem, x + 13 * k + 6, -1.0, n);
        push(rows, i, k, n, 1.0, plane_distance(x + 13 * k, at, n) - needed - MARGIN_M);
    }
}

/* Add rows of the coasts of one chaser, unless no admissible input can reach them. */
static void coast_rows(const Problem *problem, const Rows *rows, int64_t i, const double *x) {
    for (int64_t k = 1; k < rows->nodes; k++)
        for (int64_t j = 0; j < problem->n_coasts; j++) {
            const double *row =
                problem->coasts + 7 * (problem->n_coasts * (rows->nodes * i + k) + j);
            double a = sqrt_of(dot3(row, row)), b = sqrt_of(dot3(row + 3, row + 3));
            double room = dot3(row, x + 13 * k) + dot3(row + 3, x + 13 * k + 3) - row[6];
            /* A constant force that moves a chaser by r in t changes its velocity by 2 r / t. */
            double reach =
                rows->reach[i * rows->nodes + k] * (a + 2.0 * b / (problem->step_s * (double)k));
            if ((a == 0.0 && b == 0.0) || !(room <= reach)) continue;
            int64_t m = i * rows->width + rows->n_rows[i]++;
            copy(row, rows->a + 6 * m, 6);
            rows->c[m] = -room;
            rows->stage[m] = k;
        }
}

/* Return how far, m, a chaser's rollout violates its present rows without their margin, at most
 * RELIEF_MAX_M. Its neighbours give way by that much. Otherwise its half of the gaps between
 * chasers could hold it inside a keep-out. */
static double violation(const Rows *rows, int64_t i) {
    double worst = 0.0;
    for (int64_t m = rows->width * i; m < rows->width * i + rows->n_rows[i]; m++)
        worst = max_of(worst, rows->c[m] - MARGIN_M);
    return min_of(worst, RELIEF_MAX_M);
}

/* Add rows of the outer bound and of the corridor. */
static void outer_and_corridor_rows(const Problem *problem, const Rows *rows, int64_t i,
                                    const double *x) {
    const int64_t nodes = rows->nodes;
    const double *reference = problem->references + 7 * nodes * i;
    const double *corridor = problem->corridors + 5 * nodes * i, *target = problem->targets;
    double n[3], from_target[3];
    for (int64_t k = 1; k < nodes; k++) {
        subtract3(reference + 7 * k, x + 13 * k, n);
        double gap = normalize3(n);
        push(rows, i, k, n, 1.0, problem->outer - gap);
        if (dot3(corridor + 5 * k, corridor + 5 * k) > 0.0) {
            subtract3(x + 13 * k, target + 3 * k, from_target);
            double room = corridor_room(from_target, corridor + 5 * k, n);
            push(rows, i, k, n, 1.0, room);
        }
    }
}

/* Add rows of the keep-out. */
static void keep_out_rows(const Problem *problem, const Rows *rows, int64_t i, const double *x) {
    const int64_t nodes = rows->nodes;
    const double *reference = problem->references + 7 * nodes * i;
    const double *distance = problem->to_target + nodes * i, *target = problem->targets;
    double last[3] = {0}, n[3], want[3], gap, heading;
    int held = 0;
    first_side(x, target, reference, target, last);
    for (int64_t k = 1; k < nodes; k++) {
        const double d = distance[k];
        if (!(d > 0.0)) continue;
        subtract3(reference + 7 * k, target + 3 * k, want);
        double away = dot3(want, want);
        subtract3(x + 13 * k, target + 3 * k, n);
        subtract3(reference + 7 * k, x + 13 * k, want);
        double length = side(n, want, d, &held, last, &gap, &heading);
        if (heading > COS_HEAD_ON && length > gap && away >= d * d) tilt(n);
        subtract3(x + 13 * k, target + 3 * k, want);
        push(rows, i, k, n, 1.0, dot3(n, want) - d - MARGIN_M);
    }
}

/* Write the rows of all terms about the rollouts x (N, D+1, 13): stage (N, M), a (N, M, 6), c
 * (N, M), n_rows (N,), with M at least D (N + 2 + n_boxes + n_coasts). Stage 0 has no rows; a
 * distance of NaN gives none. */
EXPORT void NAME(build_rows)(const Problem *problem, const double *x, const Rows *rows) {
    const int64_t n = problem->n, size = 13 * rows->nodes;
    for (int64_t i = 0; i < n; i++) {
        rows->n_rows[i] = 0;
        outer_and_corridor_rows(problem, rows, i, x + size * i);
        keep_out_rows(problem, rows, i, x + size * i);
        if (problem->clearance[i] > 0.0)
            for (int64_t b = 0; b < problem->n_boxes; b++)
                box_rows(problem, rows, i, b, x + size * i);
        rows->relief[i] = violation(rows, i);
        if (problem->n_coasts) coast_rows(problem, rows, i, x + size * i);
    }
    for (int64_t i = 0; i < n; i++)
        for (int64_t j = i + 1; j < n; j++)
            if (problem->between[i * n + j] > 0.0 || problem->apart[i * n + j] > 0.0)
                pair_rows(problem, rows, i, j, x + size * i, x + size * j,
                          rows->relief[i] - rows->relief[j]);
}

/* Write the deepest violation (N,), m, of the distance constraints by plans x (N, D+1, 13); 0
 * without any. All stages 0..D count, without margin. NaN if a position is. */
EXPORT void NAME(plan_violation)(const Problem *problem, const double *x, double *worst) {
    const int64_t nodes = problem->stages + 1;
    double r[3], n[3];
    zero(worst, problem->n);
    for (int64_t i = 0; i < problem->n; i++) {
        const double *at = x + 13 * nodes * i;
        for (int64_t k = 0; k < nodes; k++, at += 13) {
            const double *corridor = problem->corridors + 5 * (nodes * i + k);
            subtract3(at, problem->references + 7 * (nodes * i + k), r);
            worst[i] = max_or_nan(worst[i], sqrt_of(dot3(r, r)) - problem->outer);
            subtract3(at, problem->targets + 3 * k, r);
            if (dot3(corridor, corridor) > 0.0)
                worst[i] = max_or_nan(worst[i], -corridor_room(r, corridor, n));
            worst[i] =
                max_or_nan(worst[i], problem->to_target[nodes * i + k] - sqrt_of(dot3(r, r)));
            for (int64_t b = 0; b < problem->n_boxes && problem->clearance[i] > 0.0; b++) {
                double gap =
                    shape_gap(problem, at, problem->boxes + 15 * (problem->n_boxes * k + b), n);
                worst[i] = max_or_nan(worst[i], problem->clearance[i] - gap);
            }
            for (int64_t j = i + 1; j < problem->n; j++) {
                subtract3(at, x + 13 * (nodes * j + k), r);
                double square = dot3(r, r);
                copy(r, n, 3);
                normalize3(n);
                const double d = centre_distance(problem, i, j, at, x + 13 * (nodes * j + k), n);
                if (square >= d * d) continue;
                worst[i] = max_or_nan(worst[i], d - sqrt_of(square));
                worst[j] = max_or_nan(worst[j], d - sqrt_of(square));
            }
        }
    }
}
