/* SPDX-License-Identifier: Apache-2.0 */
/* Rotations: quaternions scalar first, body to world; matrices (3, 3) by rows. J. Sola, "Quaternion
 * kinematics", 2017. */
#include "layout.h"

static void multiply_quaternions(const double *a, const double *b, double *out) {
    const double w = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3];
    const double x = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2];
    const double y = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1];
    const double z = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0];
    out[0] = w, out[1] = x, out[2] = y, out[3] = z;
}

/* out = conj(a) (x) b: the attitude b relative to a. */
static void relative_quaternion(const double *a, const double *b, double *out) {
    const double inverse[4] = {a[0], -a[1], -a[2], -a[3]};
    multiply_quaternions(inverse, b, out);
}

static void normalize_quaternion(double *q) {
    const double length = sqrt_of((q[0] * q[0] + q[1] * q[1]) + (q[2] * q[2] + q[3] * q[3]));
    for (int i = 0; i < 4; i++) q[i] /= length;
}

static double length3(const double *v) { return sqrt_of(dot3(v, v)); }

/* Unit quaternion of a rotation vector (Sola eq. 101). */
static void exponential_map(const double *phi, double *q) {
    const double angle = length3(phi);
    double sine, cosine;
    sine_cosine(0.5 * angle, &sine, &cosine);
    const double s = angle < 1e-4 ? 0.5 - angle * angle / 48.0 : sine / angle;
    q[0] = cosine;
    for (int i = 0; i < 3; i++) q[1 + i] = s * phi[i];
}

/* Angle whose tangent is n / w, both not negative: halved three times, then the series of the arc
 * tangent. */
static double arc_tangent(double n, double w) {
    double t = n / (w + sqrt_of(w * w + n * n));
    for (int i = 0; i < 2; i++) t = t / (1.0 + sqrt_of(1.0 + t * t));
    const double square = t * t;
    double sum = 0.0;
    for (int k = 19; k >= 1; k -= 2) sum = 1.0 / (double)k - square * sum;
    return 8.0 * t * sum;
}

/* Shortest rotation vector of a unit quaternion (Sola eq. 105). */
static void logarithmic_map(const double *q, double *phi) {
    const double sign = q[0] < 0.0 ? -1.0 : 1.0, w = sign * q[0], n = length3(q + 1);
    const double s = sign * (n < 1e-9 ? 2.0 / w : 2.0 * arc_tangent(n, w) / n);
    for (int i = 0; i < 3; i++) phi[i] = s * q[1 + i];
}

static void matrix_of(const double *q, double *m) {
    const double w = q[0], x = q[1], y = q[2], z = q[3];
    m[0] = 1.0 - 2.0 * (y * y + z * z), m[1] = 2.0 * (x * y - w * z), m[2] = 2.0 * (x * z + w * y);
    m[3] = 2.0 * (x * y + w * z), m[4] = 1.0 - 2.0 * (x * x + z * z), m[5] = 2.0 * (y * z - w * x);
    m[6] = 2.0 * (x * z - w * y), m[7] = 2.0 * (y * z + w * x), m[8] = 1.0 - 2.0 * (x * x + y * y);
}

/* The matrix whose product with w is v x w. */
static void skew(const double *v, double *m) {
    m[0] = m[4] = m[8] = 0.0;
    m[1] = -v[2], m[2] = v[1], m[3] = v[2], m[5] = -v[0], m[6] = -v[1], m[7] = v[0];
}

static void multiply_matrices(const double *a, const double *b, double *out) {
    double product[9];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            product[3 * i + j] =
                a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
    copy(product, out, 9);
}

static void transpose_matrix(const double *a, double *out) {
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) out[3 * j + i] = a[3 * i + j];
}

/* Right Jacobian of SO(3) (Sola eq. 183); a series where the closed form loses digits. */
static void right_jacobian(const double *phi, double *m) {
    const double x = phi[0], y = phi[1], z = phi[2], a2 = dot3(phi, phi);
    double b = 0.5 - a2 * (1.0 / 24.0 - a2 * (1.0 / 720.0 - a2 / 40320.0));
    double c = 1.0 / 6.0 - a2 * (1.0 / 120.0 - a2 * (1.0 / 5040.0 - a2 / 362880.0));
    if (a2 > 0.01) {
        const double a = sqrt_of(a2);
        double sine, cosine;
        sine_cosine(a, &sine, &cosine);
        b = (1.0 - cosine) / a2, c = (a - sine) / (a2 * a);
    }
    const double d = 1.0 - c * a2;
    m[0] = d + c * x * x, m[1] = c * x * y + b * z, m[2] = c * x * z - b * y;
    m[3] = c * x * y - b * z, m[4] = d + c * y * y, m[5] = c * y * z + b * x;
    m[6] = c * x * z + b * y, m[7] = c * y * z - b * x, m[8] = d + c * z * z;
}

/* Put s * m (3, 3) at column `column` of a row of 3 x `width`. */
static void put(double *rows, int64_t width, int64_t column, double s, const double *m) {
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) rows[width * i + column + j] = s * m[3 * i + j];
}

static void put_identity(double *rows, int64_t width, int64_t column) {
    for (int i = 0; i < 3; i++) rows[width * i + column + i] = 1.0;
}
