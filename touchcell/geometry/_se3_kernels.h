/* SE(3) kernels on single elements: the formulas of touchcell/geometry/_plain.py, in its order of operations.
 *
 * Matrices are row-major: T is 4x4, J and Ad are 6x6, xi is [v, w]. Inputs and outputs must not overlap.
 * What A to G stand for, and why, is at the top of touchcell/geometry/_plain.py.
 */
#ifndef TOUCHCELL_SE3_KERNELS_H
#define TOUCHCELL_SE3_KERNELS_H

#include <math.h>
#include <string.h>

#define TERMS 9
#define PI 3.14159265358979323846

static const double SERIES_A[TERMS] = {
    1.0, -1.0 / 6.0, 1.0 / 120.0, -1.0 / 5040.0, 1.0 / 362880.0, -1.0 / 39916800.0, 1.0 / 6227020800.0,
    -1.0 / 1307674368000.0, 1.0 / 355687428096000.0};
static const double SERIES_B[TERMS] = {
    1.0 / 2.0, -1.0 / 24.0, 1.0 / 720.0, -1.0 / 40320.0, 1.0 / 3628800.0, -1.0 / 479001600.0, 1.0 / 87178291200.0,
    -1.0 / 20922789888000.0, 1.0 / 6402373705728000.0};
static const double SERIES_C[TERMS] = {
    1.0 / 6.0, -1.0 / 120.0, 1.0 / 5040.0, -1.0 / 362880.0, 1.0 / 39916800.0, -1.0 / 6227020800.0,
    1.0 / 1307674368000.0, -1.0 / 355687428096000.0, 1.0 / 121645100408832000.0};
static const double SERIES_E[TERMS] = {
    2.0 / 24.0, -4.0 / 720.0, 6.0 / 40320.0, -8.0 / 3628800.0, 10.0 / 479001600.0, -12.0 / 87178291200.0,
    14.0 / 20922789888000.0, -16.0 / 6402373705728000.0, 18.0 / 2432902008176640000.0};
static const double SERIES_F[TERMS] = {
    2.0 / 120.0, -4.0 / 5040.0, 6.0 / 362880.0, -8.0 / 39916800.0, 10.0 / 6227020800.0, -12.0 / 1307674368000.0,
    14.0 / 355687428096000.0, -16.0 / 121645100408832000.0, 18.0 / 51090942171709440000.0};
static const double SERIES_D[TERMS + 1] = {
    1.0 / 12.0, 1.0 / 720.0, 1.0 / 30240.0, 1.0 / 1209600.0, 1.0 / 47900160.0, 691.0 / 1307674368000.0,
    1.0 / 74724249600.0, 3617.0 / 10670622842880000.0, 43867.0 / 5109094217170944000.0,
    174611.0 / 802857662698291200000.0};

static inline double polynomial(const double *coefficients, int terms, double s)
{
    double total = coefficients[terms - 1];
    for (int k = terms - 2; k >= 0; k--)
        total = total * s + coefficients[k];
    return total;
}

/* G = 2 dD/ds. */
static inline double polynomial_g(double s)
{
    double total = 2.0 * TERMS * SERIES_D[TERMS];
    for (int k = TERMS - 1; k >= 1; k--)
        total = total * s + 2.0 * k * SERIES_D[k];
    return total;
}

static inline void closed_abc(double s, double *A, double *B, double *C)
{
    double theta = sqrt(s), sine = sin(0.5 * theta), cosine = cos(0.5 * theta);
    *A = 2.0 * sine * cosine / theta;
    *B = 2.0 * sine * sine / s;
    *C = (1.0 - *A) / s;
}

static void exp_kernel(const double *xi, double *T)
{
    double x = xi[0], y = xi[1], z = xi[2], a = xi[3], b = xi[4], c = xi[5];
    double s = a * a + b * b + c * c, A, B, C;
    if (s < 1.0) {
        A = polynomial(SERIES_A, TERMS, s);
        B = polynomial(SERIES_B, TERMS, s);
        C = polynomial(SERIES_C, TERMS, s);
    } else {
        closed_abc(s, &A, &B, &C);
    }
    double p0 = b * z - c * y, p1 = c * x - a * z, p2 = a * y - b * x;
    double q0 = b * p2 - c * p1, q1 = c * p0 - a * p2, q2 = a * p1 - b * p0;
    double Bab = B * a * b, Bac = B * a * c, Bbc = B * b * c;
    double Aa = A * a, Ab = A * b, Ac = A * c;
    T[0] = 1.0 - B * (b * b + c * c), T[1] = Bab - Ac, T[2] = Bac + Ab, T[3] = x + B * p0 + C * q0;
    T[4] = Bab + Ac, T[5] = 1.0 - B * (a * a + c * c), T[6] = Bbc - Aa, T[7] = y + B * p1 + C * q1;
    T[8] = Bac - Ab, T[9] = Bbc + Aa, T[10] = 1.0 - B * (a * a + b * b), T[11] = z + B * p2 + C * q2;
    T[12] = 0.0, T[13] = 0.0, T[14] = 0.0, T[15] = 1.0;
}

/* Unnormalised quaternion (w >= 0, x, y, z), from the row of 4 q q' with the largest diagonal. */
static inline void quaternion(const double *T, double *q)
{
    double r00 = T[0], r01 = T[1], r02 = T[2], r10 = T[4], r11 = T[5], r12 = T[6], r20 = T[8], r21 = T[9], r22 = T[10];
    double trace = r00 + r11 + r22;
    if (trace > 0.0)
        q[0] = 1.0 + trace, q[1] = r21 - r12, q[2] = r02 - r20, q[3] = r10 - r01;
    else if (r00 >= r11 && r00 >= r22)
        q[0] = r21 - r12, q[1] = 1.0 + r00 - r11 - r22, q[2] = r01 + r10, q[3] = r02 + r20;
    else if (r11 >= r22)
        q[0] = r02 - r20, q[1] = r01 + r10, q[2] = 1.0 + r11 - r22 - r00, q[3] = r12 + r21;
    else
        q[0] = r10 - r01, q[1] = r02 + r20, q[2] = r12 + r21, q[3] = 1.0 + r22 - r00 - r11;
    if (q[0] < 0.0)
        for (int i = 0; i < 4; i++)
            q[i] = -q[i];
}

static void log_kernel(const double *T, double *xi)
{
    double q[4];
    quaternion(T, q);
    double n2 = q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
    /* Below this the squares underflow; the angle is then 2 |q| / qw to the last bit, and the cotangent is not used. */
    double scale = 2.0 / q[0], cot = 0.0;
    if (!(n2 < 1e-290)) {
        double n = sqrt(n2);
        scale = 2.0 * atan2(n, q[0]) / n;
        cot = q[0] / n;
    }
    double x = T[3], y = T[7], z = T[11], a = scale * q[1], b = scale * q[2], c = scale * q[3];
    double s = a * a + b * b + c * c;
    double D = s < 1.0 ? polynomial(SERIES_D, TERMS + 1, s) : (1.0 - 0.5 * sqrt(s) * cot) / s;
    double p0 = b * z - c * y, p1 = c * x - a * z, p2 = a * y - b * x;
    xi[0] = x - 0.5 * p0 + D * (b * p2 - c * p1);
    xi[1] = y - 0.5 * p1 + D * (c * p0 - a * p2);
    xi[2] = z - 0.5 * p2 + D * (a * p1 - b * p0);
    xi[3] = a, xi[4] = b, xi[5] = c;
}

static void compose_kernel(const double *left, const double *right, double *T)
{
    for (int i = 0; i < 12; i += 4) {
        for (int j = 0; j < 4; j++)
            T[i + j] = left[i] * right[j] + left[i + 1] * right[4 + j] + left[i + 2] * right[8 + j];
        T[i + 3] += left[i + 3];
    }
    T[12] = 0.0, T[13] = 0.0, T[14] = 0.0, T[15] = 1.0;
}

static void inverse_kernel(const double *T, double *out)
{
    double x = T[3], y = T[7], z = T[11];
    for (int i = 0; i < 3; i++) {
        out[4 * i] = T[i], out[4 * i + 1] = T[4 + i], out[4 * i + 2] = T[8 + i];
        out[4 * i + 3] = -(T[i] * x + T[4 + i] * y + T[8 + i] * z);
    }
    out[12] = 0.0, out[13] = 0.0, out[14] = 0.0, out[15] = 1.0;
}

static void adjoint_kernel(const double *T, double *Ad)
{
    double x = T[3], y = T[7], z = T[11];
    for (int j = 0; j < 3; j++) {
        double r0 = T[j], r1 = T[4 + j], r2 = T[8 + j];
        Ad[j] = r0, Ad[6 + j] = r1, Ad[12 + j] = r2;
        Ad[3 + j] = y * r2 - z * r1, Ad[9 + j] = z * r0 - x * r2, Ad[15 + j] = x * r1 - y * r0;
        Ad[18 + j] = 0.0, Ad[24 + j] = 0.0, Ad[30 + j] = 0.0;
        Ad[21 + j] = r0, Ad[27 + j] = r1, Ad[33 + j] = r2;
    }
}

/* [[M, N], [0, M]] with M = I + f W + g W^2, N its derivative along v; df, dg are 2 df/ds, 2 dg/ds. */
static inline void dual(const double *xi, double f, double g, double df, double dg, double *J)
{
    double x = xi[0], y = xi[1], z = xi[2], a = xi[3], b = xi[4], c = xi[5];
    double fa = f * a, fb = f * b, fc = f * c;
    double gab = g * a * b, gac = g * a * c, gbc = g * b * c;
    double ax = a * x, by = b * y, cz = c * z, d = ax + by + cz;
    double h = d * df, k = d * dg;
    double n0 = f * x + h * a, n1 = f * y + h * b, n2 = f * z + h * c;
    double o01 = g * (a * y + b * x) + k * a * b;
    double o02 = g * (a * z + c * x) + k * a * c;
    double o12 = g * (b * z + c * y) + k * b * c;

    J[0] = 1.0 - g * (b * b + c * c), J[1] = gab - fc, J[2] = gac + fb;
    J[6] = gab + fc, J[7] = 1.0 - g * (a * a + c * c), J[8] = gbc - fa;
    J[12] = gac - fb, J[13] = gbc + fa, J[14] = 1.0 - g * (a * a + b * b);
    J[3] = -2.0 * g * (by + cz) - k * (b * b + c * c), J[4] = o01 - n2, J[5] = o02 + n1;
    J[9] = o01 + n2, J[10] = -2.0 * g * (ax + cz) - k * (a * a + c * c), J[11] = o12 - n0;
    J[15] = o02 - n1, J[16] = o12 + n0, J[17] = -2.0 * g * (ax + by) - k * (a * a + b * b);
    for (int i = 0; i < 18; i += 6) {
        J[18 + i] = 0.0, J[19 + i] = 0.0, J[20 + i] = 0.0;
        J[21 + i] = J[i], J[22 + i] = J[i + 1], J[23 + i] = J[i + 2];
    }
}

static void left_jacobian_kernel(const double *xi, double *J)
{
    double s = xi[3] * xi[3] + xi[4] * xi[4] + xi[5] * xi[5], A, B, C, E, F;
    if (s < 1.0) {
        B = polynomial(SERIES_B, TERMS, s);
        C = polynomial(SERIES_C, TERMS, s);
        E = polynomial(SERIES_E, TERMS, s);
        F = polynomial(SERIES_F, TERMS, s);
    } else {
        closed_abc(s, &A, &B, &C);
        E = (2.0 * B - A) / s;
        F = (3.0 * C - B) / s;
    }
    dual(xi, B, C, -E, -F, J);
}

static void left_jacobian_inverse_kernel(const double *xi, double *J)
{
    double s = xi[3] * xi[3] + xi[4] * xi[4] + xi[5] * xi[5], D, G;
    if (s < 1.0) {
        D = polynomial(SERIES_D, TERMS + 1, s);
        G = polynomial_g(s);
    } else {
        double half = 0.5 * sqrt(s), sine = sin(half), half_cot = half * cos(half) / sine;
        D = (1.0 - half_cot) / s;
        G = (half * half / (sine * sine) + half_cot - 2.0) / (s * s);
    }
    dual(xi, -0.5, D, 0.0, G, J);
}

/* The limits of touchcell/geometry/_check.py. */
#define ROTATION_TOLERANCE 1e-6
#define LARGEST 1e60

/* False for NaN and infinity too. */
static inline int all_bounded(const double *values, int count)
{
    int good = 1;
    for (int i = 0; i < count; i++)
        good &= fabs(values[i]) <= LARGEST;
    return good;
}

static int is_twist(const double *xi)
{
    return all_bounded(xi, 6);
}

static int is_pose(const double *T)
{
    const double tolerance = ROTATION_TOLERANCE;
    int good = fabs(T[3]) <= LARGEST && fabs(T[7]) <= LARGEST && fabs(T[11]) <= LARGEST;
    good &= fabs(T[0] * T[0] + T[4] * T[4] + T[8] * T[8] - 1.0) <= tolerance;
    good &= fabs(T[1] * T[1] + T[5] * T[5] + T[9] * T[9] - 1.0) <= tolerance;
    good &= fabs(T[2] * T[2] + T[6] * T[6] + T[10] * T[10] - 1.0) <= tolerance;
    good &= fabs(T[0] * T[1] + T[4] * T[5] + T[8] * T[9]) <= tolerance;
    good &= fabs(T[0] * T[2] + T[4] * T[6] + T[8] * T[10]) <= tolerance;
    good &= fabs(T[1] * T[2] + T[5] * T[6] + T[9] * T[10]) <= tolerance;
    good &= T[0] * (T[5] * T[10] - T[6] * T[9]) - T[1] * (T[4] * T[10] - T[6] * T[8]) +
                T[2] * (T[4] * T[9] - T[5] * T[8]) >= 0.0;
    good &= fabs(T[12]) <= tolerance && fabs(T[13]) <= tolerance && fabs(T[14]) <= tolerance;
    return good && fabs(T[15] - 1.0) <= tolerance;
}

static void from_euler_kernel(const double *pose, double *T)
{
    double a = pose[3] * (PI / 180.0), b = pose[4] * (PI / 180.0), c = pose[5] * (PI / 180.0);
    double sa = sin(a), ca = cos(a), sb = sin(b), cb = cos(b), sc = sin(c), cc = cos(c);
    double entries[16] = {
        cc * cb, cc * sb * sa - sc * ca, cc * sb * ca + sc * sa, pose[0] * 1e-3,
        sc * cb, sc * sb * sa + cc * ca, sc * sb * ca - cc * sa, pose[1] * 1e-3,
        -sb,     cb * sa,                cb * ca,                pose[2] * 1e-3,
        0.0,     0.0,                    0.0,                    1.0};
    memcpy(T, entries, sizeof entries);
}

static void to_euler_kernel(const double *T, double *pose)
{
    double gamma = atan2(T[4], T[0]), sine = sin(gamma), cosine = cos(gamma);
    double alpha = atan2(sine * T[2] - cosine * T[6], cosine * T[5] - sine * T[1]);
    double beta = atan2(-T[8], hypot(T[0], T[4]));
    double entries[6] = {T[3] * 1e3,           T[7] * 1e3,          T[11] * 1e3,
                         alpha * (180.0 / PI), beta * (180.0 / PI), gamma * (180.0 / PI)};
    for (int i = 0; i < 6; i++)
        pose[i] = entries[i] + 0.0; /* Turns -0.0 into 0.0. */
}

#endif
