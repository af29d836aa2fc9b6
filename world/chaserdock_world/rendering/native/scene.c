/* SPDX-License-Identifier: Apache-2.0 */
/* Scene geometry: visible faces of boxes, their painting order, and the placement of textures. */
#include "base.h"

#define OUTLINE_MOST 10 /* a rectangle that is cut by five planes has at most nine corners */

/* View frustum of a canvas (chaserdock_world.rendering.scene_geometry.Frustum): planes n x + d >= 0
 * of points in front and on the canvas, inward unit normals of its borders, the lens, the canvas'
 * first pixel. */
typedef struct {
    double planes[5][4], borders[4][3], fx, fy, cx, cy, origin[2], near_m;
} Frustum;
LAYOUT(Frustum, planes, borders, fx, fy, cx, cy, origin, near_m)

/* A box in its body's axes, metres. */
typedef struct {
    double body, position[3], rotation[9], half[3], radius;
} Shape;

/* A visible box: number of its shape, pose in IRF, and the pixels of the canvas that bound its
 * outline. */
typedef struct {
    double shape, centre[3], rotation[9], half[3], low[2], high[2];
} VisibleBox;

/* A visible face in IRF: index of its visible box and side of it, whether all of it is in front,
 * its clipped outline. */
typedef struct {
    double box, side, in_front, width, height, centre[3], right[3], up[3], normal[3], count,
        outline[OUTLINE_MOST][2];
} Face;

static void product9(const double *a, const double *b, double *out) {
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            out[3 * i + j] = (a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j]) + a[3 * i + 2] * b[6 + j];
}

static void matrix_of(const double *q, double *m) {
    double w = q[0], x = q[1], y = q[2], z = q[3];
    double rows[9] = {1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
                      2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
                      2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)};
    copy(rows, m, 9);
}

/* Clip ``polygon`` at one plane (I. E. Sutherland, G. W. Hodgman, 1974); return the number of
 * points left. */
static int clip(double polygon[][3], int n, const double *plane) {
    double out[OUTLINE_MOST][3];
    int kept = 0;
    for (int i = 0; i < n; i++) {
        const double *a = polygon[(i + n - 1) % n], *b = polygon[i];
        double da = dot3(a, plane) + plane[3], db = dot3(b, plane) + plane[3];
        if ((da < 0.0) != (db < 0.0) && kept < OUTLINE_MOST) {
            for (int k = 0; k < 3; k++) out[kept][k] = a[k] + (b[k] - a[k]) * (da / (da - db));
            kept++;
        }
        if (db >= 0.0 && kept < OUTLINE_MOST) copy(b, out[kept++], 3);
    }
    for (int i = 0; i < kept; i++) copy(out[i], polygon[i], 3);
    return kept;
}

/* Compute a face's outline on the canvas from its ``corners`` (4); return 0 if it is empty. */
static int outline_of(const Frustum *f, double corners[][3], Face *face) {
    double polygon[OUTLINE_MOST][3];
    int n = 4, cut[5] = {0};
    face->in_front = 1.0;
    for (int i = 0; i < 4; i++) {
        copy(corners[i], polygon[i], 3);
        if (!(corners[i][2] >= f->near_m)) face->in_front = 0.0;
        for (int p = 0; p < 5; p++)
            cut[p] += dot3(corners[i], f->planes[p]) + f->planes[p][3] < 0.0;
    }
    for (int p = 0; p < 5; p++)
        if (cut[p] == 4) return 0;
    for (int p = 0; p < 5 && n >= 3; p++)
        if (cut[p]) n = clip(polygon, n, f->planes[p]);
    if (n < 3) return 0;
    face->count = n;
    for (int i = 0; i < n; i++) {
        face->outline[i][0] = polygon[i][0] / polygon[i][2] * f->fx + f->cx - f->origin[0];
        face->outline[i][1] = polygon[i][1] / polygon[i][2] * f->fy + f->cy - f->origin[1];
    }
    return 1;
}

static int reaches(const Frustum *f, const double *centre, double radius) {
    for (int i = 0; i < 4; i++)
        if (dot3(centre, f->borders[i]) < -radius) return 0;
    return centre[2] + radius >= f->near_m;
}

/* Find the visible boxes and faces, in the order of boxes and sides; ``counts``: number of boxes
 * and of faces. ``camera`` (7): position and attitude IRF to WRF; ``poses`` (bodies, 7): of the
 * bodies, body to WRF; ``sides`` (6, 3, 3): right, up and normal of a box's sides as columns.
 * ``faces`` holds six faces per shape. A box at NaN is not visible. */
EXPORT void NAME(visible_faces)(const Frustum *f, const double *camera, const double *poses,
                                int64_t shapes, const Shape *shape, const double *sides,
                                VisibleBox *boxes, Face *faces, int64_t *counts) {
    double inverse[4] = {camera[3], -camera[4], -camera[5], -camera[6]}, to_irf[9];
    int64_t count = 0, visible = 0;
    matrix_of(inverse, to_irf);
    for (int64_t i = 0; i < shapes; i++) {
        const Shape *s = shape + i;
        const double *pose = poses + 7 * (int64_t)s->body;
        double turn[9], body[9], from[3], at[3], place[3];
        VisibleBox *box = boxes + visible;
        matrix_of(pose + 3, turn);
        product9(to_irf, turn, body);
        subtract3(pose, camera, from);
        multiply3(to_irf, from, at);
        multiply3(body, s->position, place);
        for (int k = 0; k < 3; k++) box->centre[k] = at[k] + place[k];
        if (!reaches(f, box->centre, s->radius)) continue;
        product9(body, s->rotation, box->rotation);
        copy(s->half, box->half, 3);
        box->shape = (double)i;
        int any = 0;
        for (int side = 0; side < 6; side++) {
            Face *face = faces + count;
            double axes[9], corners[4][3], size[2];
            product9(box->rotation, sides + 9 * side, axes);
            for (int k = 0; k < 3; k++) {
                face->right[k] = axes[3 * k], face->up[k] = axes[3 * k + 1],
                face->normal[k] = axes[3 * k + 2];
                face->centre[k] = box->centre[k] + s->half[side / 2] * face->normal[k];
            }
            if (!(dot3(face->normal, face->centre) < 0.0)) continue;
            /* Width and height, as in chaserdock_models.targets.face_extent. */
            size[0] = 2.0 * s->half[side < 2 ? 1 : 0], size[1] = 2.0 * s->half[side < 4 ? 2 : 1];
            for (int c = 0; c < 4; c++) {
                double u = (c == 1 || c == 2 ? 0.5 : -0.5) * size[0],
                       v = (c < 2 ? 0.5 : -0.5) * size[1];
                for (int k = 0; k < 3; k++)
                    corners[c][k] = face->centre[k] + (u * face->right[k] + v * face->up[k]);
            }
            if (!outline_of(f, corners, face)) continue;
            face->width = size[0], face->height = size[1];
            face->box = (double)visible, face->side = side;
            for (int k = 0; k < 2; k++) {
                if (!any) box->low[k] = box->high[k] = face->outline[0][k];
                for (int n = 0; n < (int)face->count; n++) {
                    box->low[k] = min_of(box->low[k], face->outline[n][k]);
                    box->high[k] = max_of(box->high[k], face->outline[n][k]);
                }
            }
            any = 1;
            count++;
        }
        visible += any;
    }
    counts[0] = visible;
    counts[1] = count;
}

/* Return 1 if box a can occlude b as seen from the origin, -1 if b can occlude a, 0 if neither can.
 *
 * Uses those of the 15 axes that can separate two boxes (S. Gottschalk, M. C. Lin, D. Manocha,
 * "OBBTree", 1996) that have a gap: a plane with the origin and a on one side and b on the other
 * proves that b cannot occlude a. For boxes that touch or overlap slightly, the axis of largest gap
 * decides. */
static int occludes(const VisibleBox *a, const VisibleBox *b) {
    double axes[15][3], end[15], start[15], gap[15], widest = -1e300;
    int n = 0;
    for (int i = 0; i < 3; i++)
        for (int k = 0; k < 3; k++)
            axes[i][k] = a->rotation[3 * k + i], axes[3 + i][k] = b->rotation[3 * k + i];
    n = 6;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            cross3(axes[i], axes[3 + j], axes[n]);
            double length = sqrt_of(dot3(axes[n], axes[n]));
            if (!(length > 1e-6)) continue;
            for (int k = 0; k < 3; k++) axes[n][k] /= length;
            n++;
        }
    for (int i = 0; i < n; i++) {
        double at_a = dot3(axes[i], a->centre), at_b = dot3(axes[i], b->centre), reach_a = 0.0,
               reach_b = 0.0;
        for (int j = 0; j < 3; j++) {
            reach_a += abs_of(dot3(axes[i], axes[j])) * a->half[j];
            reach_b += abs_of(dot3(axes[i], axes[3 + j])) * b->half[j];
        }
        double sign = at_a > at_b ? -1.0 : 1.0; /* orients every axis from a to b */
        end[i] = sign * at_a + reach_a;
        start[i] = sign * at_b - reach_b;
        gap[i] = start[i] - end[i];
        widest = max_of(widest, gap[i]);
    }
    /* The origin projects to 0 on every axis, and every plane between the end of a and the start of
     * b separates the boxes: one of them has the origin on b's side if a ends before 0, and one on
     * a's side if b starts after 0. */
    int a_may = 1, b_may = 1;
    for (int i = 0; i < n; i++) {
        if (!(widest > 0.0 ? gap[i] > 0.0 : gap[i] >= widest)) continue;
        if (end[i] <= 0.0) a_may = 0;
        if (start[i] >= 0.0) b_may = 0;
    }
    if (a_may && b_may) return dot3(a->centre, a->centre) < dot3(b->centre, b->centre) ? 1 : -1;
    return a_may ? 1 : (b_may ? -1 : 0);
}

static int apart(const VisibleBox *a, const VisibleBox *b) {
    for (int k = 0; k < 2; k++)
        if (a->low[k] > b->high[k] + 1.0 || b->low[k] > a->high[k] + 1.0) return 1;
    return 0;
}

/* Determine the painting order: every box after those that it occludes. Boxes that occlude one
 * another cyclically (long thin ones can) have no such order; the farthest is painted first. Boxes
 * at NaN come anywhere. ``occluded`` (n, n) is working memory. */
EXPORT void NAME(paint_order)(int64_t n, const VisibleBox *boxes, uint8_t *occluded,
                              int64_t *order) {
    for (int64_t i = 0; i < n * n; i++) occluded[i] = 0;
    for (int64_t i = 0; i < n; i++)
        for (int64_t j = i + 1; j < n; j++) {
            if (apart(boxes + i, boxes + j)) continue;
            int order_of_pair = occludes(boxes + i, boxes + j);
            if (order_of_pair > 0) occluded[i * n + j] = 1; /* i waits for j */
            else if (order_of_pair < 0) occluded[j * n + i] = 1;
        }
    /* Farthest first, stable. */
    for (int64_t i = 0; i < n; i++) {
        double distance = dot3(boxes[i].centre, boxes[i].centre);
        int64_t k = i;
        for (; k > 0 && dot3(boxes[order[k - 1]].centre, boxes[order[k - 1]].centre) < distance;
             k--)
            order[k] = order[k - 1];
        order[k] = i;
    }
    for (int64_t done = 0; done < n; done++) {
        int64_t next = done;
        for (int64_t k = done; k < n; k++) {
            int waits = 0;
            for (int64_t j = done; j < n; j++) waits |= occluded[order[k] * n + order[j]];
            if (!waits) {
                next = k;
                break;
            }
        }
        int64_t box = order[next];
        for (int64_t k = next; k > done; k--) order[k] = order[k - 1];
        order[done] = box;
    }
}

/* Place a face's texture on a patch of the canvas with ``samples`` per pixel from pixel ``x0``,
 * ``y0`` on; return 0 if the region is empty or the homography is not finite. Output: the region of
 * the patch (low x, y, high x, y), how often the texture's width and height are halved, so that a
 * texel is about a sample at the centre of the outline, and the homography (3, 3) from a sample of
 * the region to texels. ``patch``: width, height; ``finest``: columns and rows of the finest
 * texture, ``texel_m`` wide. */
EXPORT int64_t NAME(place_texture)(const Frustum *f, const Face *face, double samples, double x0,
                                   double y0, const int64_t *patch, const int64_t *finest,
                                   double texel_m, int64_t *region, int64_t *halved,
                                   double *matrix) {
    double lens[4], low[2], high[2], middle[2] = {0.0, 0.0}, origin[2] = {x0, y0};
    int count = (int)face->count;
    lens[0] = samples * f->fx, lens[1] = samples * f->fy;
    lens[2] = samples * f->cx + ((samples - 1.0) / 2.0 - samples * (f->origin[0] + x0));
    lens[3] = samples * f->cy + ((samples - 1.0) / 2.0 - samples * (f->origin[1] + y0));
    for (int k = 0; k < 2; k++) {
        for (int i = 0; i < count; i++) {
            double at = (face->outline[i][k] - origin[k]) * samples + (samples - 1.0) / 2.0;
            low[k] = i ? min_of(low[k], at) : at;
            high[k] = i ? max_of(high[k], at) : at;
            middle[k] += at;
        }
        middle[k] /= count;
        low[k] = max_of(__builtin_floor(low[k]) - 2.0, 0.0);
        high[k] = min_of(__builtin_ceil(high[k]) + 3.0, (double)patch[k]);
        if (!(high[k] > low[k])) return 0;
        region[k] = (int64_t)low[k];
        region[2 + k] = (int64_t)high[k];
    }
    /* Intersect the ray through the centre of the outline with the face's plane. */
    double ray[3] = {(middle[0] - lens[2]) / lens[0], (middle[1] - lens[3]) / lens[1], 1.0},
           normal[3], at[3];
    cross3(face->right, face->up, normal);
    double depth = dot3(normal, face->centre) / dot3(normal, ray);
    for (int k = 0; k < 3; k++) at[k] = ray[k] * depth;
    int64_t texels[2];
    for (int axis = 0; axis < 2; axis++) {
        /* Derivative of the sample's coordinates with respect to metres along the axis. */
        const double *along = axis ? face->up : face->right;
        double by[2];
        for (int k = 0; k < 2; k++) by[k] = lens[k] * (along[k] - at[k] / at[2] * along[2]) / at[2];
        double share = max_of(sqrt_of(by[0] * by[0] + by[1] * by[1]), 1.0) * texel_m;
        halved[axis] = 0;
        for (double limit = 0.7071067811865476; share < limit && halved[axis] < 30; limit *= 0.5)
            halved[axis]++;
        texels[axis] = finest[axis] >> halved[axis];
        if (texels[axis] < 2) texels[axis] = 2;
    }
    double columns = (double)texels[0], rows = (double)texels[1], m[9], det, largest = 0.0;
    for (int k = 0; k < 3; k++) {
        double u = face->right[k] * face->width / columns, v = face->up[k] * face->height / rows;
        m[k] = u;
        m[3 + k] = -v;
        m[6 + k] = (face->centre[k] + u * (0.5 - columns / 2.0)) + v * (rows / 2.0 - 0.5);
    }
    /* Columns of the matrix from texels to IRF, then to samples of the region. */
    for (int c = 0; c < 3; c++) {
        double *p = m + 3 * c;
        p[0] = lens[0] * p[0] + (lens[2] - low[0]) * p[2];
        p[1] = lens[1] * p[1] + (lens[3] - low[1]) * p[2];
    }
    double rows_of[9];
    cross3(m + 3, m + 6, rows_of);
    cross3(m + 6, m, rows_of + 3);
    cross3(m, m + 3, rows_of + 6);
    det = dot3(m, rows_of);
    if (!(abs_of(det) > 0.0)) return 0; /* singular, or not a number */
    for (int i = 0; i < 9; i++) {
        matrix[i] = rows_of[i] / det;
        largest = max_of(largest, abs_of(matrix[i]));
    }
    for (int i = 0; i < 9; i++) matrix[i] /= largest;
    return all_finite(matrix, 9);
}

/* Draw stars in ``directions`` (count, 3) of IRF, each one pixel of its level, on a canvas (height,
 * width), except those within 0.1 of the camera's plane or at NaN. ``lens``: fx, fy, cx, cy, the
 * canvas' first pixel. Return how many are drawn, with their columns and rows in ``at`` (count,
 * 2). */
EXPORT int64_t NAME(draw_stars)(const double *directions, const uint8_t *levels, int64_t count,
                                const double *lens, int64_t width, int64_t height, uint8_t *canvas,
                                int64_t *at) {
    int64_t drawn = 0;
    for (int64_t i = 0; i < count; i++) {
        const double *d = directions + 3 * i;
        if (!(d[2] > 0.1)) continue;
        double x = d[0] / d[2] * lens[0] + lens[2] - lens[4],
               y = d[1] / d[2] * lens[1] + lens[3] - lens[5];
        /* Adding and subtracting 1.5 * 2^52 rounds to the nearest integer, ties to even. */
        if (!(x > -1.0 && y > -1.0 && x < (double)width && y < (double)height)) continue;
        int64_t column = (int64_t)((x + 6755399441055744.0) - 6755399441055744.0);
        int64_t row = (int64_t)((y + 6755399441055744.0) - 6755399441055744.0);
        if (!(column >= 0 && column < width && row >= 0 && row < height)) continue;
        canvas[row * width + column] = levels[i];
        at[2 * drawn] = column;
        at[2 * drawn++ + 1] = row;
    }
    return drawn;
}
