/* SPDX-License-Identifier: Apache-2.0 */
/* Rasterizer of triangle meshes: z-buffer with eight samples per pixel, shading once per pixel and
 * triangle, shadow maps.
 *
 * Both triangles at an edge evaluate the same edge function with opposite signs, so no sample
 * between them is missed. Surfaces are closed: triangles that face away are not drawn, and only
 * those that face away from the sun cast shadows, which keeps lit surfaces free of shadows of their
 * own.
 */

typedef float f8 __attribute__((vector_size(32), aligned(4), may_alias));
typedef int32_t i8x __attribute__((vector_size(32), aligned(4), may_alias));

/* Rows that are drawn together, so that their samples stay in a cache: 0.6 MB at 1280 pixels. */
#define BAND 8
#define SAMPLES 8 /* per pixel: as many floats as a vector register holds */
#define GROUP 32 /* consecutive triangles, which are mostly near each other, are skipped together */
#define PLANES 6 /* 1 / z; normal, u, v over z */
#define SUN_FAR (-1e30f) /* depth of an empty shadow map, towards the sun: behind everything */

/* Hides that a value is stored where it was loaded: compilers would use a masked store, which is
 * slow on many processors. */
#define HIDE_ADDRESS(pointer) __asm__("" : "+r"(pointer))

/* Pixels from the centre of a pixel to its samples, in sixteenths: each row and each column of a
 * grid has at most one. */
static const float SAMPLE_X[8] = {1, -1, 5, -3, -5, -7, 3, 7},
                   SAMPLE_Y[8] = {-3, 3, 1, -5, 5, -1, 7, -7};

/* Diffuse and specular reflectance, exponent, texture (0 none, 1 insulation, 2 cells). */
typedef struct {
    double diffuse, specular, shininess, texture;
} Surface;

/* Illumination in IRF: direction to the sun, shares of sun and ambient light, lamp (grey level at 1
 * m), white level; direction of the map's columns and rows. */
typedef struct {
    double sun[3], sun_share, ambient, lamp, white, across[3], along[3];
} Illumination;

/* A shadow map: the coordinate towards the sun of the nearest surface, of a rectangle in the plane
 * across the sun. */
typedef struct {
    int64_t width, height, offset, padding;
    double low[2], texel_m, used;
} ShadowMap;

typedef struct {
    double m[9], at[3];
} BodyPose;

typedef struct {
    float edge[3][3];         /* pixels inside the edge: a x + b y + c */
    float plane[PLANES][3];   /* values that are linear in the image */
    float near_w, far_w, normal[3], footprint;
    int32_t x0, x1, y0, y1, body, surface;
} Triangle;

static inline f8 all8(float s) { return (f8){s, s, s, s, s, s, s, s}; }
static inline f8 select8(i8x mask, f8 a, f8 b) { return (f8)((mask & (i8x)a) | (~mask & (i8x)b)); }
static inline f8 max8(f8 a, f8 b) { return select8(a > b, a, b); }
static inline f8 min8(f8 a, f8 b) { return select8(a < b, a, b); }
#if defined(__clang__)
static inline f8 sqrt8(f8 a) { return __builtin_elementwise_sqrt(a); }
#else
static inline f8 sqrt8(f8 a) {
    for (int i = 0; i < 8; i++) a[i] = __builtin_sqrtf(a[i]);
    return a;
}
#endif
#if defined(__clang__)
static inline int any8(i8x m) { return __builtin_reduce_or(m) != 0; }
#else /* GCC, for the sanitizers */
static inline int any8(i8x m) {
    int32_t s = 0;
    for (int i = 0; i < 8; i++) s |= m[i];
    return s != 0;
}
#endif
/* Largest whole numbers not above numbers between -1e9 and 1e9. */
static inline f8 floor8(f8 a) {
    f8 truncated = __builtin_convertvector(__builtin_convertvector(a, i8x), f8);
    return truncated - select8(truncated > a, all8(1.0f), all8(0.0f));
}

/* Edge from p to q as distance in pixels, positive to the left of it in axes x right, y down turned
 * by the sign of the area. The end points are ordered first, so that the other triangle at the edge
 * computes the opposite of every value. */
static void edge_function(const double *p, const double *q, float *out) {
    int swap = p[0] > q[0] || (p[0] == q[0] && p[1] > q[1]);
    const double *a = swap ? q : p, *b = swap ? p : q;
    double dx = b[0] - a[0], dy = b[1] - a[1], length = sqrt_of(dx * dx + dy * dy);
    if (!(length > 0.0)) {
        out[0] = out[1] = out[2] = 0.0f;
        return;
    }
    double sign = swap ? -1.0 : 1.0, nx = -dy / length, ny = dx / length;
    out[0] = (float)(sign * nx), out[1] = (float)(sign * ny),
    out[2] = (float)(sign * -(nx * a[0] + ny * a[1]));
}

/* Plane through three values at three points of the image. */
static void plane_of(double p[3][2], double area, double v0, double v1, double v2, float *out) {
    double a = ((v1 - v0) * (p[2][1] - p[0][1]) - (v2 - v0) * (p[1][1] - p[0][1])) / area;
    double b = ((v2 - v0) * (p[1][0] - p[0][0]) - (v1 - v0) * (p[2][0] - p[0][0])) / area;
    out[0] = (float)a, out[1] = (float)b, out[2] = (float)(v0 - a * p[0][0] - b * p[0][1]);
}

/* The whole part of a number between two whole numbers; the lower one for NaN. */
static int clamped(double a, double low, double high) {
    return (int)(a >= low ? (a > high ? high : a) : low);
}

/* Set up one triangle of vertices (3, 8): position, normal, u, v, in IRF. Return 0 if it covers
 * nothing. */
static int set_up(const Frustum *f, const double *vertices[3], int64_t width, int64_t height,
                  Triangle *t) {
    double p[3][2], w[3];
    for (int i = 0; i < 3; i++) {
        const double *v = vertices[i];
        w[i] = 1.0 / v[2];
        p[i][0] = v[0] * w[i] * f->fx + f->cx - f->origin[0];
        p[i][1] = v[1] * w[i] * f->fy + f->cy - f->origin[1];
    }
    double area =
        (p[1][0] - p[0][0]) * (p[2][1] - p[0][1]) - (p[2][0] - p[0][0]) * (p[1][1] - p[0][1]);
    if (!(abs_of(area) > 1e-9)) return 0;
    /* Front faces are clockwise in IRF seen along +z with y down: their area is negative here and
     * edges point inwards. */
    for (int i = 0; i < 3; i++) {
        const double *a = p[i], *b = p[(i + 1) % 3];
        edge_function(area > 0.0 ? a : b, area > 0.0 ? b : a, t->edge[i]);
    }
    plane_of(p, area, w[0], w[1], w[2], t->plane[0]);
    for (int k = 1; k < PLANES; k++) {
        int from = 2 + k;
        plane_of(p, area, vertices[0][from] * w[0], vertices[1][from] * w[1],
                 vertices[2][from] * w[2], t->plane[k]);
    }
    t->near_w = (float)max_of(w[0], max_of(w[1], w[2]));
    t->far_w = (float)min_of(w[0], min_of(w[1], w[2]));
    double low[2], high[2];
    for (int k = 0; k < 2; k++) {
        low[k] = min_of(p[0][k], min_of(p[1][k], p[2][k]));
        high[k] = max_of(p[0][k], max_of(p[1][k], p[2][k]));
    }
    t->x0 = clamped(__builtin_floor(low[0]), 0.0, (double)width),
    t->x1 = clamped(__builtin_ceil(high[0]) + 1.0, 0.0, (double)width);
    t->y0 = clamped(__builtin_floor(low[1]), 0.0, (double)height),
    t->y1 = clamped(__builtin_ceil(high[1]) + 1.0, 0.0, (double)height);
    return t->x0 < t->x1 && t->y0 < t->y1;
}

/* Clip a polygon of vertices (n, 8) at a plane; return the number of vertices left (at most 9). */
static int clip_vertices(double polygon[][8], int n, const double *plane) {
    double out[10][8];
    int kept = 0;
    for (int i = 0; i < n; i++) {
        const double *a = polygon[(i + n - 1) % n], *b = polygon[i];
        double da = dot3(a, plane) + plane[3], db = dot3(b, plane) + plane[3];
        if ((da < 0.0) != (db < 0.0) && kept < 9) {
            for (int k = 0; k < 8; k++) out[kept][k] = a[k] + (b[k] - a[k]) * (da / (da - db));
            kept++;
        }
        if (db >= 0.0 && kept < 9) copy(b, out[kept++], 8);
    }
    for (int i = 0; i < kept; i++) copy(out[i], polygon[i], 8);
    return kept;
}

/* Rasterize a triangle given in the map's texels (x, y) and metres towards the sun. */
static void cast_shadow(const ShadowMap *map, double p[3][3], float *depth) {
    double area =
        (p[1][0] - p[0][0]) * (p[2][1] - p[0][1]) - (p[2][0] - p[0][0]) * (p[1][1] - p[0][1]);
    if (!(abs_of(area) > 1e-9)) return;
    double at[3][2];
    float edge[3][3], plane[3];
    for (int i = 0; i < 3; i++) copy(p[i], at[i], 2);
    for (int i = 0; i < 3; i++) {
        const double *a = at[i], *b = at[(i + 1) % 3];
        edge_function(area > 0.0 ? a : b, area > 0.0 ? b : a, edge[i]);
    }
    plane_of(at, area, p[0][2], p[1][2], p[2][2], plane);
    float nearest = (float)max_of(p[0][2], max_of(p[1][2], p[2][2])),
          farthest = (float)min_of(p[0][2], min_of(p[1][2], p[2][2]));
    int y0 = clamped(__builtin_floor(min_of(at[0][1], min_of(at[1][1], at[2][1]))), 0.0,
                     (double)map->height);
    int y1 = clamped(__builtin_ceil(max_of(at[0][1], max_of(at[1][1], at[2][1]))) + 1.0, 0.0,
                     (double)map->height);
    int x0 = clamped(__builtin_floor(min_of(at[0][0], min_of(at[1][0], at[2][0]))), 0.0,
                     (double)map->width);
    int x1 = clamped(__builtin_ceil(max_of(at[0][0], max_of(at[1][0], at[2][0]))) + 1.0, 0.0,
                     (double)map->width);
    const f8 steps = {0, 1, 2, 3, 4, 5, 6, 7};
    for (int y = y0; y < y1; y++) {
        float *row = depth + map->offset + (int64_t)y * map->width;
        /* Columns between the edges, with a margin for rounding. */
        float left = (float)x0, right = (float)x1;
        for (int e = 0; e < 3; e++) {
            float c = edge[e][1] * (float)y + edge[e][2], a = edge[e][0];
            if (a > 1e-3f && -c / a - 1.0f > left) left = -c / a - 1.0f;
            if (a < -1e-3f && -c / a + 2.0f < right) right = -c / a + 2.0f;
        }
        if (!(left < right)) continue;
        int first = (int)left & ~7, last = (int)right;
        for (int x = first; x < last; x += 8) {
            f8 column = all8((float)x) + steps;
            i8x in = (i8x)(column >= 0.0f);
            for (int e = 0; e < 3; e++)
                in &= (edge[e][0] * column + (edge[e][1] * (float)y + edge[e][2])) >= 0.0f;
            if (!any8(in)) continue;
            f8 d = plane[0] * column + (plane[1] * (float)y + plane[2]);
            d = min8(max8(d, all8(farthest)), all8(nearest));
            f8 *cell = (f8 *)(row + x); /* rows are multiples of eight long */
            d = max8(select8(in, d, all8(SUN_FAR)), *cell);
            HIDE_ADDRESS(cell);
            *cell = d;
        }
    }
}

/* Share (0 to 1) of sunlight at points given by map coordinates in texels and metres towards the
 * sun: the four texels around each, weighted bilinearly (W. T. Reeves, D. H. Salesin, R. L. Cook,
 * 1987). */
static f8 sunlit(const ShadowMap *map, const float *depth, f8 x, f8 y, f8 towards) {
    i8x inside =
        (x >= 0.0f) & (y >= 0.0f) & (x < (float)(map->width - 1)) & (y < (float)(map->height - 1));
    x = select8(inside, x, all8(0.0f)), y = select8(inside, y, all8(0.0f));
    i8x column = __builtin_convertvector(x, i8x), row = __builtin_convertvector(y, i8x);
    float cells[4][8];
    int64_t down =
        map->height > 1 ? map->width : 0; /* a map has at least two rows where a point is inside */
    for (int i = 0; i < 8; i++) {
        const float *cell = depth + map->offset + (int64_t)row[i] * map->width + column[i];
        cells[0][i] = cell[0], cells[1][i] = cell[1], cells[2][i] = cell[down],
        cells[3][i] = cell[down + 1];
    }
    f8 u = x - __builtin_convertvector(column, f8), v = y - __builtin_convertvector(row, f8),
       lit[4];
    for (int k = 0; k < 4; k++)
        lit[k] = select8(*(const f8 *)cells[k] > towards, all8(0.0f), all8(1.0f));
    f8 share = (1.0f - v) * (lit[0] + u * (lit[1] - lit[0])) + v * (lit[2] + u * (lit[3] - lit[2]));
    return select8(inside, share, all8(1.0f));
}

typedef struct {
    const Surface *surfaces;
    const ShadowMap *maps;
    const float *depth, *wrinkles;
    int64_t wrinkle_size;
    const Triangle *triangles;
    /* Of the lens: focal lengths and centre, pixels of the canvas; of the light, as in
     * Illumination. */
    float fx, fy, cx, cy, sun[3], across[3], along[3], sun_share, ambient, lamp, white;
} Shading;

/* Texels of the map of wrinkles per metre of foil: wrinkles are some 12 mm wide. */
#define WRINKLE_PER_M 640.0f
/* Pitch of solar cells, m. Smaller: more lines that the known mesh of a target does not have. */
#define CELL_M 0.04f
/* Gap between two solar cells, m. Wider: stronger lines. */
#define GAP_M 0.0016f

/* Length of [a - h, a + h] that is within GAP_M / 2 of a multiple of CELL_M, over its length. */
static f8 gap_share(f8 a, f8 h) {
    f8 low = (a - h + 0.5f * GAP_M) / CELL_M, high = (a + h + 0.5f * GAP_M) / CELL_M,
       duty = all8(GAP_M / CELL_M);
    f8 below = floor8(low), above = floor8(high);
    f8 total = (above - below) * duty + min8(high - above, duty) - min8(low - below, duty);
    return min8(max8(total / (high - low), all8(0.0f)), all8(1.0f));
}

/* Change diffuse reflectance and normal ``n`` by the textures ``kind`` at (u, v). ``h``: half a
 * pixel on the surface, m; ``flat``: normal of the triangle. */
static void apply_textures(const Shading *s, i8x kind, f8 u, f8 v, f8 h, const f8 *flat,
                           f8 *diffuse, f8 *n) {
    /* Bounded, so that the conversions are defined; of a number and NaN, the number. */
    u = min8(max8(u, all8(-1e3f)), all8(1e3f)), v = min8(max8(v, all8(-1e3f)), all8(1e3f));
    h = min8(max8(h, all8(1e-6f)), all8(10.0f));
    if (any8(kind == 2)) {
        f8 a = gap_share(u, h), b = gap_share(v, h);
        *diffuse = select8(kind == 2, *diffuse + (a + b - a * b) * (0.45f - *diffuse), *diffuse);
    }
    if (!any8(kind == 1)) return;
    /* Wrinkles are some 12 mm wide; they average out where a pixel is larger. */
    f8 scale = 0.006f / max8(h, all8(0.006f)), size = all8((float)s->wrinkle_size);
    f8 x = u * WRINKLE_PER_M / size, y = v * WRINKLE_PER_M / size, bend_x, bend_y, tone;
    i8x last = (i8x){0} + (int32_t)(s->wrinkle_size - 1);
    i8x c = __builtin_convertvector((x - floor8(x)) * size, i8x),
        r = __builtin_convertvector((y - floor8(y)) * size, i8x);
    c = ((c > last) & last) | (~(c > last) & c),
    r = ((r > last) & last) | (~(r > last) & r); /* a fraction may round to 1 */
    for (int i = 0; i < 8; i++) {
        const float *cell = s->wrinkles + 3 * ((int64_t)r[i] * s->wrinkle_size + c[i]);
        bend_x[i] = cell[0], bend_y[i] = cell[1], tone[i] = cell[2];
    }
    scale = select8(kind == 1, scale, all8(0.0f));
    bend_x *= scale, bend_y *= scale;
    *diffuse *= 1.0f + scale * tone;
    /* Along any two directions in the surface: wrinkles have none. */
    n[0] += flat[2] * bend_x;
    n[1] += flat[2] * bend_y;
    n[2] -= flat[0] * bend_x + flat[1] * bend_y;
}

/* Grey levels of eight fragments: pixels (x, y) of triangles ``which``. */
static f8 shade(const Shading *s, const int32_t *which, f8 x, f8 y) {
    f8 value[PLANES], diffuse, specular, normal[3], footprint;
    i8x shiny = {0}, kind = {0};
    int uniform = 1;
    for (int i = 1; i < 8; i++) uniform &= which[i] == which[0];
    if (uniform) {
        const Triangle *t = s->triangles + which[0];
        for (int k = 0; k < PLANES; k++)
            value[k] = t->plane[k][0] * x + (t->plane[k][1] * y + t->plane[k][2]);
        value[0] = min8(max8(value[0], all8(t->far_w)), all8(t->near_w));
        for (int k = 0; k < 3; k++) normal[k] = all8(t->normal[k]);
        diffuse = all8((float)s->surfaces[t->surface].diffuse),
        specular = all8((float)s->surfaces[t->surface].specular);
        footprint = all8(t->footprint);
        shiny += clamped(s->surfaces[t->surface].shininess, 0.0, 1023.0),
            kind += clamped(s->surfaces[t->surface].texture, 0.0, 2.0);
    } else {
        float lane[PLANES + 6][8], px[8], py[8];
        int32_t exponent[8], texture[8];
        for (int i = 0; i < 8; i++) px[i] = x[i], py[i] = y[i];
        for (int i = 0; i < 8; i++) {
            const Triangle *t = s->triangles + which[i];
            const Surface *surface = s->surfaces + t->surface;
            for (int k = 0; k < PLANES; k++)
                lane[k][i] = t->plane[k][0] * px[i] + (t->plane[k][1] * py[i] + t->plane[k][2]);
            lane[0][i] = lane[0][i] < t->far_w ? t->far_w
                                               : (lane[0][i] > t->near_w ? t->near_w : lane[0][i]);
            for (int k = 0; k < 3; k++) lane[PLANES + k][i] = t->normal[k];
            lane[PLANES + 3][i] = (float)surface->diffuse,
                          lane[PLANES + 4][i] = (float)surface->specular;
            lane[PLANES + 5][i] = t->footprint;
            exponent[i] = clamped(surface->shininess, 0.0, 1023.0),
            texture[i] = clamped(surface->texture, 0.0, 2.0);
        }
        for (int k = 0; k < PLANES; k++) value[k] = *(const f8 *)lane[k];
        for (int k = 0; k < 3; k++) normal[k] = *(const f8 *)lane[PLANES + k];
        diffuse = *(const f8 *)lane[PLANES + 3], specular = *(const f8 *)lane[PLANES + 4],
        footprint = *(const f8 *)lane[PLANES + 5];
        shiny = *(const i8x *)exponent, kind = *(const i8x *)texture;
    }
    f8 z = 1.0f / value[0], n[3], at[3];
    at[0] = (x - s->cx) * (z / s->fx);
    at[1] = (y - s->cy) * (z / s->fy);
    at[2] = z;
    for (int k = 0; k < 3; k++) n[k] = value[1 + k] * z;
    if (any8(kind))
        apply_textures(s, kind, value[4] * z, value[5] * z, footprint * z, normal, &diffuse, n);
    f8 inverse = 1.0f / max8(sqrt8(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]), all8(1e-12f));
    f8 square = at[0] * at[0] + at[1] * at[1] + at[2] * at[2], away = -1.0f / sqrt8(square);
    f8 cosine = all8(0.0f), facing = all8(0.0f), to_lamp = all8(0.0f), view_sun = all8(0.0f),
       towards = all8(0.0f);
    for (int k = 0; k < 3; k++) {
        n[k] *= inverse;
        cosine += n[k] * s->sun[k];
        facing += normal[k] * s->sun[k];
        to_lamp += n[k] * at[k];
        towards += at[k] * s->sun[k];
    }
    to_lamp *= away, view_sun = towards * away;
    f8 level = s->white * s->ambient * diffuse;
    i8x lit = (cosine > 0.0f) & (facing > 0.0f);
    if (s->sun_share > 0.0f && any8(lit)) {
        f8 sun = all8(s->sun_share * s->white), map_x = all8(0.0f), map_y = all8(0.0f);
        for (int k = 0; k < 3; k++) map_x += at[k] * s->across[k], map_y += at[k] * s->along[k];
        const Triangle *t = s->triangles + which[0];
        int one = 1;
        for (int i = 1; i < 8; i++) one &= s->triangles[which[i]].body == t->body;
        for (int i = 0; i < (one ? 1 : 8); i++) {
            const ShadowMap *map = s->maps + s->triangles[which[i]].body;
            float texels = 1.0f / (float)map->texel_m;
            f8 share = sunlit(map, s->depth, (map_x - (float)map->low[0]) * texels,
                              (map_y - (float)map->low[1]) * texels, towards + 2e-4f);
            if (one) sun *= share;
            else sun[i] *= share[i];
        }
        sun = select8(lit, sun, all8(0.0f));
        f8 reflected = diffuse * cosine;
        if (any8(specular > 0.0f)) {
            /* Blinn's half vector h = view + sun: n'h over its length, which is sqrt(2 + 2
             * view'sun). */
            f8 gloss = max8(to_lamp + cosine, all8(0.0f)) /
                       sqrt8(max8(2.0f + 2.0f * view_sun, all8(1e-6f))),
               power = all8(1.0f);
            gloss = min8(gloss, all8(1.0f));
            for (i8x left = shiny; any8(left > 0); left = left >> 1) {
                power = select8((left & 1) == 1, power * gloss, power);
                gloss = gloss * gloss;
            }
            reflected += specular * power;
        }
        level += sun * reflected;
    }
    if (s->lamp > 0.0f)
        level += s->lamp * diffuse * max8(to_lamp, all8(0.0f)) / max8(square, all8(1e-6f));
    return level;
}

/* Fragments of pixels with several surfaces, which wait to be shaded eight at a time. Each pixel
 * keeps its sum, and the number of its fragments to come, in the depths of its first two
 * samples. */
typedef struct {
    int32_t which[8], pixel[8];
    float x[8], y[8], weight[8];
    int count;
} Pending;

static void shade_pending(const Shading *s, Pending *p, float *depth, uint8_t *out) {
    for (int k = p->count; k < 8; k++)
        p->which[k] = p->which[0], p->x[k] = p->x[0], p->y[k] = p->y[0];
    f8 level = min8(max8(shade(s, p->which, *(const f8 *)p->x, *(const f8 *)p->y), all8(0.0f)),
                    all8(255.0f));
    for (int k = 0; k < p->count; k++) {
        float *sum = depth + (int64_t)p->pixel[k] * SAMPLES;
        sum[0] += p->weight[k] * level[k];
        sum[1] -= 1.0f;
        if (sum[1] == 0.0f) out[p->pixel[k]] = (uint8_t)(sum[0] + 0.5f);
    }
    p->count = 0;
}

/* Add the fragments of a pixel of several surfaces, each at the middle of its samples. */
static void add_fragments(const Shading *s, const int32_t *o, int64_t x, int64_t y, Pending *p,
                          float *depth, uint8_t *out) {
    int32_t which[8];
    float count[8] = {0}, mx[8] = {0}, my[8] = {0}, empty = 0.0f, *sum = depth + x * SAMPLES;
    int n = 0;
    for (int k = 0; k < SAMPLES; k++) {
        int j = 0;
        if (o[k] < 0) {
            empty += 1.0f;
            continue;
        }
        while (j < n && which[j] != o[k]) j++;
        if (j == n) which[n++] = o[k];
        count[j] += 1.0f, mx[j] += SAMPLE_X[k], my[j] += SAMPLE_Y[k];
    }
    sum[0] = empty * (float)out[x] / (float)SAMPLES;
    sum[1] = (float)n;
    for (int j = 0; j < n; j++) {
        int k = p->count++;
        p->which[k] = which[j], p->pixel[k] = (int32_t)x, p->weight[k] = count[j] / (float)SAMPLES;
        p->x[k] = (float)x + mx[j] / (16.0f * count[j]),
        p->y[k] = (float)y + my[j] / (16.0f * count[j]);
        if (p->count == 8) shade_pending(s, p, depth, out);
    }
}

/* Sum the samples of a band of rows onto the canvas. ``owner``: triangle of every sample, -1 for
 * none; overwrites ``depth``. */
static void resolve(const Shading *s, const int32_t *owner, float *depth, int64_t y0, int64_t rows,
                    int64_t width, int64_t x0, int64_t x1, uint8_t *canvas) {
    for (int64_t r = 0; r < rows; r++) {
        uint8_t *out = canvas + (y0 + r) * width;
        Pending pending = {.count = 0};
        for (int64_t x = x0; x < x1;) {
            /* Up to eight pixels that one triangle covers wholly. */
            const int32_t *o = owner + (r * width + x) * SAMPLES, first = o[0];
            int n = 0;
            for (; n < 8 && x + n < x1; n++)
                if (any8(*(const i8x *)(o + n * SAMPLES) != first)) break;
            if (!n) {
                add_fragments(s, o, x, y0 + r, &pending, depth + r * width * SAMPLES, out);
                x++;
            } else {
                if (first >= 0) {
                    const int32_t which[8] = {first, first, first, first,
                                              first, first, first, first};
                    const f8 steps = {0, 1, 2, 3, 4, 5, 6, 7};
                    f8 level = shade(s, which, all8((float)x) + steps, all8((float)(y0 + r)));
                    level = min8(max8(level, all8(0.0f)), all8(255.0f)) + 0.5f;
                    i8x whole = __builtin_convertvector(level, i8x);
                    for (int k = 0; k < n; k++) out[x + k] = (uint8_t)whole[k];
                }
                x += n;
            }
        }
        if (pending.count) shade_pending(s, &pending, depth + r * width * SAMPLES, out);
    }
}

/* Rasterize pixels x0 to x1 of a row whose first sample is at ``depth`` and ``owner``. ``edges``:
 * values of the three edge functions of the row's samples at x = 0; ``row_w``: of 1 / z. Without
 * ``tested``, all samples are known to be inside the edges. */
static inline __attribute__((always_inline)) void cover_pixels(const Triangle *t, int32_t number,
                                                               int64_t x0, int64_t x1,
                                                               const f8 *edges, f8 row_w, f8 sx,
                                                               int tested, float *depth,
                                                               int32_t *owner) {
    for (int64_t x = x0; x < x1; x++) {
        f8 column = (float)x + sx;
        f8 w = t->plane[0][0] * column + row_w;
        w = min8(max8(w, all8(t->far_w)), all8(t->near_w));
        f8 *d = (f8 *)(depth + x * SAMPLES);
        i8x *o = (i8x *)(owner + x * SAMPLES);
        i8x in = w > *d;
        if (tested) {
            in &= (t->edge[0][0] * column + edges[0]) >= 0.0f;
            in &= (t->edge[1][0] * column + edges[1]) >= 0.0f;
            in &= (t->edge[2][0] * column + edges[2]) >= 0.0f;
        }
        if (!any8(in)) continue;
        *d = max8(select8(in, w, all8(0.0f)), *d);
        i8x kept = ~in & *o;
        HIDE_ADDRESS(o);
        *o = (in & number) | kept;
    }
}

/* Rasterize a triangle into a band of rows from ``band`` on. */
static void cover(const Triangle *t, int32_t number, int64_t band, int64_t rows, int64_t width,
                  float *depth, int32_t *owner) {
    f8 sx, sy;
    for (int k = 0; k < 8; k++) sx[k] = SAMPLE_X[k] / 16.0f, sy[k] = SAMPLE_Y[k] / 16.0f;
    int64_t y0 = t->y0 > band ? t->y0 : band, y1 = t->y1 < band + rows ? t->y1 : band + rows;
    for (int64_t y = y0; y < y1; y++) {
        float left = (float)t->x0, right = (float)t->x1, from = left, to = right;
        f8 edges[3];
        for (int e = 0; e < 3; e++) {
            float a = t->edge[e][0], b = t->edge[e][1], c = b * (float)y + t->edge[e][2];
            edges[e] = b * ((float)y + sy) + t->edge[e][2];
            /* A pixel has samples inside only if its centre is less than a pixel outside. */
            if (a > 1e-3f && (-c - 1.0f) / a > left) left = (-c - 1.0f) / a;
            if (a < -1e-3f && (-c - 1.0f) / a + 1.0f < right) right = (-c - 1.0f) / a + 1.0f;
            /* All samples are inside if the centre is a pixel inside; ``from`` and ``to``: such
             * pixels. */
            if (a > 1e-3f) from = (1.0f - c) / a + 1.0f > from ? (1.0f - c) / a + 1.0f : from;
            else if (a < -1e-3f) to = (1.0f - c) / a < to ? (1.0f - c) / a : to;
            else if (c < 1.5f + 2e-3f * (float)width) to = -1.0f;
        }
        if (!(left < right)) continue;
        f8 row_w = t->plane[0][1] * ((float)y + sy) + t->plane[0][2];
        float *d = depth + (y - band) * width * SAMPLES;
        int32_t *o = owner + (y - band) * width * SAMPLES;
        int64_t first = (int64_t)left, last = (int64_t)right < t->x1 ? (int64_t)right + 1 : t->x1;
        if (last > t->x1) last = t->x1;
        int64_t inner = last, outer = last;
        if (from < to) {
            inner = (int64_t)from > first ? (int64_t)from : first;
            outer = (int64_t)to < last ? (int64_t)to : last;
            if (inner > outer) inner = outer = last;
        }
        cover_pixels(t, number, first, inner, edges, row_w, sx, 1, d, o);
        cover_pixels(t, number, inner, outer, edges, row_w, sx, 0, d, o);
        cover_pixels(t, number, outer, last, edges, row_w, sx, 1, d, o);
    }
}

/* Transform a triangle's corners to IRF: vertices (3, 8) of position, normal, u, v. */
static void place_triangle(const BodyPose *body, const double *corners, const double *normals,
                           const double *uv, double v[][8]) {
    for (int i = 0; i < 3; i++) {
        multiply3(body->m, corners + 3 * i, v[i]);
        for (int k = 0; k < 3; k++) v[i][k] += body->at[k];
        multiply3(body->m, normals + 3 * i, v[i] + 3);
        v[i][6] = uv[2 * i], v[i][7] = uv[2 * i + 1];
    }
}

static void flat_normal(double v[][8], double *normal) {
    double a[3], b[3];
    subtract3(v[1], v[0], a);
    subtract3(v[2], v[0], b);
    cross3(a, b, normal);
    normalize3(normal);
}

/* Set up the triangles of a body that face the camera; return their number, at most six for each of
 * the mesh. */
static int64_t set_up_body(const Frustum *f, const BodyPose *pose, int32_t body, int64_t first,
                           int64_t end, const double *corners, const double *normals,
                           const double *uv, const int64_t *surface, int64_t width, int64_t height,
                           Triangle *out) {
    int64_t count = 0;
    for (int64_t i = first; i < end; i++) {
        double v[10][8], normal[3];
        int n = 3, cut[5] = {0};
        place_triangle(pose, corners + 9 * i, normals + 9 * i, uv + 6 * i, v);
        flat_normal(v, normal);
        if (!(dot3(normal, v[0]) < 0.0)) continue;
        for (int k = 0; k < 3; k++)
            for (int p = 0; p < 5; p++)
                cut[p] += !(dot3(v[k], f->planes[p]) + f->planes[p][3] >= 0.0);
        int outside = 0;
        for (int p = 0; p < 5; p++) outside |= cut[p] == 3;
        if (outside) continue;
        for (int p = 0; p < 5 && n >= 3; p++)
            if (cut[p]) n = clip_vertices(v, n, f->planes[p]);
        double distance = sqrt_of(dot3(v[0], v[0])),
               facing = -dot3(normal, v[0]) / max_of(distance, 1e-9);
        for (int k = 2; k < n && k < 8; k++) {
            const double *vertices[3] = {v[0], v[k - 1], v[k]};
            Triangle *t = out + count;
            if (!set_up(f, vertices, width, height, t)) continue;
            for (int j = 0; j < 3; j++) t->normal[j] = (float)normal[j];
            /* Half a pixel on the surface at 1 m, geometric mean of its two directions. */
            t->footprint = (float)(0.5 / (f->fx * sqrt_of(max_of(facing, 0.05))));
            t->body = body, t->surface = (int32_t)surface[i];
            count++;
        }
    }
    return count;
}

/* Cast the shadows of all bodies onto the map of one. */
static void fill_map(const ShadowMap *map, const Illumination *light, int64_t bodies,
                     const BodyPose *poses, const int64_t *first, const double *corners,
                     float *depth) {
    for (int64_t k = 0; k < map->width * map->height; k++) depth[map->offset + k] = SUN_FAR;
    for (int64_t b = 0; b < bodies; b++) {
        double rows[9], turned[9], from[3];
        copy(light->across, rows, 3), copy(light->along, rows + 3, 3),
            copy(light->sun, rows + 6, 3);
        product9(rows, poses[b].m, turned);
        multiply3(rows, poses[b].at, from);
        for (int64_t i = first[b]; i < first[b + 1]; i++) {
            double p[3][3];
            for (int k = 0; k < 3; k++) {
                multiply3(turned, corners + 9 * i + 3 * k, p[k]);
                for (int j = 0; j < 2; j++)
                    p[k][j] = (p[k][j] + from[j] - map->low[j]) / map->texel_m;
                p[k][2] += from[2];
            }
            double area = (p[1][0] - p[0][0]) * (p[2][1] - p[0][1]) -
                          (p[2][0] - p[0][0]) * (p[1][1] - p[0][1]);
            /* Counter-clockwise as seen from the sun (across, along, sun right-handed): faces the
             * sun. */
            if (!(area < 0.0)) continue;
            cast_shadow(map, p, depth);
        }
    }
}

/* Draw bodies onto ``canvas`` (height, width). ``camera`` (7): position and attitude IRF to WRF;
 * ``poses`` (bodies, 7): body to WRF; ``first`` (bodies + 1): ranges of the triangles, whose
 * ``corners`` and ``normals`` (m, 3, 3) are in body axes;
 * ``uv`` (m, 3, 2): texture coordinates, m; ``surface`` (m): their rows of ``surfaces``.
 * ``wrinkles`` (n, n, 3): slopes and relative reflectance of the insulation. ``maps`` (bodies) lie
 * in ``depth``, whose rows are multiples of eight long. Working memory: ``placed`` (bodies),
 * ``triangles`` (6 m), ``spans`` (6 m + groups + bands, 2), ``samples`` (BAND * width * 16). A body
 * at NaN is not drawn. */
EXPORT void NAME(draw_meshes)(const Frustum *f, int64_t width, int64_t height, const double *camera,
                              int64_t bodies, const double *poses, const int64_t *first,
                              const double *corners, const double *normals, const double *uv,
                              const int64_t *surface, const Surface *surfaces,
                              const Illumination *light, const float *wrinkles,
                              int64_t wrinkle_size, const ShadowMap *maps, float *depth,
                              BodyPose *placed, Triangle *triangles, int32_t *spans, float *samples,
                              uint8_t *canvas) {
    double inverse[4] = {camera[3], -camera[4], -camera[5], -camera[6]}, to_irf[9];
    matrix_of(inverse, to_irf);
    int64_t count = 0;
    for (int64_t b = 0; b < bodies; b++) {
        double turn[9], from[3];
        matrix_of(poses + 7 * b + 3, turn);
        product9(to_irf, turn, placed[b].m);
        subtract3(poses + 7 * b, camera, from);
        multiply3(to_irf, from, placed[b].at);
        count += set_up_body(f, placed + b, (int32_t)b, first[b], first[b + 1], corners, normals,
                             uv, surface, width, height, triangles + count);
    }
    if (light->sun_share > 0.0)
        for (int64_t b = 0; b < bodies; b++)
            if (maps[b].used > 0.0)
                fill_map(maps + b, light, bodies, placed, first, corners, depth);
    int32_t *groups = spans + 2 * count, *columns = groups + 2 * (count / GROUP + 1);
    int64_t bands = (height + BAND - 1) / BAND;
    for (int64_t b = 0; b < bands; b++) columns[2 * b] = (int32_t)width, columns[2 * b + 1] = 0;
    for (int64_t i = 0; i < count; i++) {
        const Triangle *t = triangles + i;
        int32_t *group = groups + 2 * (i / GROUP);
        spans[2 * i] = t->y0, spans[2 * i + 1] = t->y1;
        if (i % GROUP == 0 || t->y0 < group[0]) group[0] = t->y0;
        if (i % GROUP == 0 || t->y1 > group[1]) group[1] = t->y1;
        for (int32_t b = t->y0 / BAND; b <= (t->y1 - 1) / BAND; b++) {
            if (t->x0 < columns[2 * b]) columns[2 * b] = t->x0;
            if (t->x1 > columns[2 * b + 1]) columns[2 * b + 1] = t->x1;
        }
    }
    Shading s = {.surfaces = surfaces,
                 .maps = maps,
                 .depth = depth,
                 .wrinkles = wrinkles,
                 .wrinkle_size = wrinkle_size,
                 .triangles = triangles,
                 .fx = (float)f->fx,
                 .fy = (float)f->fy,
                 .cx = (float)(f->cx - f->origin[0]),
                 .cy = (float)(f->cy - f->origin[1]),
                 .sun_share = (float)light->sun_share,
                 .ambient = (float)light->ambient,
                 .lamp = (float)light->lamp,
                 .white = (float)light->white};
    for (int k = 0; k < 3; k++)
        s.sun[k] = (float)light->sun[k], s.across[k] = (float)light->across[k],
        s.along[k] = (float)light->along[k];
    int32_t *owner = (int32_t *)(samples + BAND * width * SAMPLES);
    for (int64_t y = 0; y < height; y += BAND) {
        int64_t rows = height - y < BAND ? height - y : BAND, x0 = columns[2 * (y / BAND)],
                x1 = columns[2 * (y / BAND) + 1];
        if (x0 >= x1) continue;
        for (int64_t r = 0; r < rows; r++)
            for (int64_t k = (r * width + x0) * SAMPLES; k < (r * width + x1) * SAMPLES; k++)
                samples[k] = 0.0f, owner[k] = -1;
        for (int64_t g = 0; g < count; g += GROUP) {
            if (groups[2 * (g / GROUP)] >= y + rows || groups[2 * (g / GROUP) + 1] <= y) continue;
            for (int64_t i = g; i < g + GROUP && i < count; i++)
                if (spans[2 * i] < y + rows && spans[2 * i + 1] > y)
                    cover(triangles + i, (int32_t)i, y, rows, width, samples, owner);
        }
        resolve(&s, owner, samples, y, rows, width, x0, x1, canvas);
    }
}
