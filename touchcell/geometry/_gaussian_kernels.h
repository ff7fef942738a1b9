/* Kernels of touchcell/geometry/gaussian.py: the steps of touchcell/geometry/_plain_gaussian.py, which says what they are for.
 *
 * Covariances are row-major 6x6, [v, w]. A function that can refuse returns 0 when it does.
 */
#ifndef TOUCHCELL_GAUSSIAN_KERNELS_H
#define TOUCHCELL_GAUSSIAN_KERNELS_H

#include <float.h>

#include "_se3_kernels.h"

#define SMALLEST_PIVOT (32.0 * DBL_EPSILON)
#define SMALLEST_VARIANCE 1e-60
#define ASYMMETRY 1e-6
#define ROUNDING (8.0 * DBL_EPSILON)

/* Lower factor L with S = L L'; the entries above its diagonal are not touched. */
static int cholesky(const double *S, double *L)
{
    for (int j = 0; j < 6; j++) {
        if (!(S[7 * j] >= SMALLEST_VARIANCE && S[7 * j] <= LARGEST))
            return 0;
        for (int i = j; i < 6; i++) {
            double rest = S[6 * i + j];
            for (int k = 0; k < j; k++)
                rest -= L[6 * i + k] * L[6 * j + k];
            if (i > j)
                L[6 * i + j] = rest / L[7 * j];
            else if (rest > SMALLEST_PIVOT * S[7 * j])
                L[7 * j] = sqrt(rest);
            else
                return 0;
        }
    }
    return 1;
}

/* The mean of S and its transpose, if they differ by rounding only and are finite. */
static int symmetric(const double *S, double *out)
{
    if (!all_bounded(S, 36))
        return 0;
    for (int i = 0; i < 6; i++)
        for (int j = 0; j <= i; j++) {
            double above = S[6 * j + i], below = S[6 * i + j];
            if (!(fabs(below - above) <= ASYMMETRY * sqrt(fabs(S[7 * i]) * fabs(S[7 * j]))))
                return 0;
            out[6 * i + j] = out[6 * j + i] = 0.5 * (below + above);
        }
    return 1;
}

static int semidefinite(const double *Q, double *out)
{
    double raised[36], L[36];
    if (!symmetric(Q, out))
        return 0;
    memcpy(raised, out, sizeof raised);
    for (int i = 0; i < 6; i++) {
        raised[7 * i] += 1e-9 * out[7 * i];
        if (out[7 * i] == 0.0) {
            for (int j = 0; j < 6; j++)
                if (out[6 * i + j] != 0.0)
                    return 0;
            raised[7 * i] = 1.0;
        }
    }
    return cholesky(raised, L);
}

/* U T and Ad(U) S Ad(U)' + Q. Q may be NULL. */
static int predict_kernel(
    const double *U, const double *T, const double *S, const double *Q, double *T_out, double *S_out)
{
    double Ad[36], moved[36], noise[36] = {0.0};
    if (Q && !semidefinite(Q, noise))
        return 0;
    compose_kernel(U, T, T_out);
    adjoint_kernel(U, Ad);
    for (int i = 0; i < 6; i++)
        for (int j = 0; j < 6; j++) {
            double sum = 0.0;
            for (int k = 0; k < 6; k++)
                sum += Ad[6 * i + k] * S[6 * k + j];
            moved[6 * i + j] = sum;
        }
    for (int i = 0; i < 6; i++)
        for (int j = 0; j <= i; j++) {
            double sum = 0.0;
            for (int k = 0; k < 6; k++)
                sum += moved[6 * i + k] * Ad[6 * j + k];
            S_out[6 * i + j] = S_out[6 * j + i] = sum + noise[6 * i + j];
        }
    return 1;
}

/* Six rows of [C^-1 G | C^-1 e], for the residual e = log(T inverse) and G = J_l^-1(e). */
static void whitened(const double *T, const double *inverse, const double *C, double rows[6][7])
{
    double step[16], e[6], G[36];
    compose_kernel(T, inverse, step);
    log_kernel(step, e);
    left_jacobian_inverse_kernel(e, G);
    for (int i = 0; i < 6; i++) {
        memcpy(rows[i], G + 6 * i, 6 * sizeof(double));
        rows[i][6] = e[i];
        for (int k = 0; k < i; k++)
            for (int j = 0; j < 7; j++)
                rows[i][j] -= C[6 * i + k] * rows[k][j];
        for (int j = 0; j < 7; j++)
            rows[i][j] /= C[7 * i];
    }
}

/* Householder QR in place: R in the upper triangle, Q' times the last column in the last column. */
static void triangularise(double a[12][7])
{
    for (int k = 0; k < 6; k++) {
        double square = 0.0;
        for (int i = k; i < 12; i++)
            square += a[i][k] * a[i][k];
        double norm = sqrt(square), pivot = a[k][k];
        double diagonal = pivot > 0.0 ? -norm : norm;
        double scale = 1.0 / (square + norm * fabs(pivot));
        a[k][k] = pivot - diagonal;
        for (int j = k + 1; j < 7; j++) {
            double dot = 0.0;
            for (int i = k; i < 12; i++)
                dot += a[i][k] * a[i][j];
            for (int i = k; i < 12; i++)
                a[i][j] -= scale * dot * a[i][k];
        }
        a[k][k] = diagonal;
    }
}

/* R^-1 R^-T, the covariance that belongs to the triangle. */
static void covariance_of(double a[12][7], double *S)
{
    double inverse[6][6] = {{0.0}};
    for (int j = 0; j < 6; j++) {
        inverse[j][j] = 1.0 / a[j][j];
        for (int i = j - 1; i >= 0; i--) {
            double sum = 0.0;
            for (int k = i + 1; k <= j; k++)
                sum += a[i][k] * inverse[k][j];
            inverse[i][j] = -sum / a[i][i];
        }
    }
    for (int i = 0; i < 6; i++)
        for (int j = 0; j <= i; j++) {
            double sum = 0.0;
            for (int k = i; k < 6; k++)
                sum += inverse[i][k] * inverse[j][k];
            S[6 * i + j] = S[6 * j + i] = sum;
        }
}

/* Largest component of the two translations. */
static double reach(const double *T1, const double *T2)
{
    double largest = 0.0;
    for (int i = 0; i < 3; i++)
        largest = fmax(largest, fmax(fabs(T1[4 * i + 3]), fabs(T2[4 * i + 3])));
    return largest;
}

/* Square of the step that the rounding of poses with such translations looks like, in standard deviations. */
static double rounding_squared(double a[12][7], double metres)
{
    double sum = 0.0;
    for (int i = 0; i < 6; i++)
        for (int j = i; j < 6; j++) {
            double entry = j < 3 ? a[i][j] * metres : a[i][j];
            sum += entry * entry;
        }
    return ROUNDING * ROUNDING * sum;
}

/* Gauss-Newton; 0 if the step is not below the tolerance after max_iterations updates. */
static int fuse_kernel(
    const double *T1, const double *S1, const double *T2, const double *S2, double tolerance, int max_iterations,
    double *T, double *S, int *iterations, double *nis)
{
    double C1[36], C2[36], inverse1[16], inverse2[16], stack[12][7];
    if (!cholesky(S1, C1) || !cholesky(S2, C2))
        return 0;
    inverse_kernel(T1, inverse1);
    inverse_kernel(T2, inverse2);
    memcpy(T, T1, 16 * sizeof(double));
    double metres = reach(T1, T2);
    for (*iterations = 0;; ++*iterations) {
        whitened(T, inverse1, C1, stack);
        whitened(T, inverse2, C2, stack + 6);
        triangularise(stack);
        double length = 0.0;
        for (int i = 0; i < 6; i++)
            length += stack[i][6] * stack[i][6];
        if (*iterations == 0) {
            /* What no step can explain: e' (G P1 G' + P2)^-1 e, without forming the sum. */
            *nis = 0.0;
            for (int i = 6; i < 12; i++)
                *nis += stack[i][6] * stack[i][6];
        }
        if (length < fmax(tolerance * tolerance, rounding_squared(stack, metres))) {
            covariance_of(stack, S);
            return 1;
        }
        if (*iterations >= max_iterations)
            return 0;
        double x[6], motion[16], moved[16];
        for (int i = 5; i >= 0; i--) {
            double sum = -stack[i][6];
            for (int k = i + 1; k < 6; k++)
                sum -= stack[i][k] * x[k];
            x[i] = sum / stack[i][i];
        }
        exp_kernel(x, motion);
        compose_kernel(motion, T, moved);
        memcpy(T, moved, sizeof moved);
    }
}

#endif
