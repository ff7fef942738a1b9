/* Which disc is nearest to each marker, and the least squares fit that moves the markers onto their discs.
 *
 * Plain C99 without any Python. float64 throughout; sums run in one order on every processor.
 */
#ifndef TOUCHCELL_MATCHING_KERNELS_H
#define TOUCHCELL_MATCHING_KERNELS_H

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "_image_kernels.h"

/* Points in buckets of a square grid; about one each where they are spread evenly. */
typedef struct {
    const double *points;
    double low[2], cell;
    ptrdiff_t columns, rows;
    int32_t *first, *members;
} Buckets;

/* Comparisons rather than floor, fmin and fmax, which are calls on processors of any age. */
static inline ptrdiff_t bucket_along(double place, double low, double cell, ptrdiff_t end)
{
    double at = (place - low) / cell;
    return at < 0.0 ? 0 : at >= (double)end ? end - 1 : (ptrdiff_t)at;
}

static inline double lesser(double a, double b) { return a < b ? a : b; }
static inline double greater(double a, double b) { return a > b ? a : b; }

static void free_buckets(Buckets *buckets) { free(buckets->first); }

/* One point or more. 0: out of memory. */
static int fill_buckets(Buckets *buckets, const double *points, ptrdiff_t count)
{
    double high[2];
    buckets->points = points;
    for (int axis = 0; axis < 2; axis++) {
        buckets->low[axis] = high[axis] = points[axis];
        for (ptrdiff_t i = 1; i < count; i++) {
            buckets->low[axis] = lesser(buckets->low[axis], points[2 * i + axis]);
            high[axis] = greater(high[axis], points[2 * i + axis]);
        }
    }
    double width = high[0] - buckets->low[0], height = high[1] - buckets->low[1];
    double longer = greater(greater(width, height), 1e-9);
    ptrdiff_t side = (ptrdiff_t)ceil(sqrt((double)count));
    buckets->cell = longer / (double)side;
    buckets->columns = bucket_along(high[0], buckets->low[0], buckets->cell, side) + 1;
    buckets->rows = bucket_along(high[1], buckets->low[1], buckets->cell, side) + 1;
    ptrdiff_t cells = buckets->columns * buckets->rows;
    buckets->first = calloc((size_t)(cells + 1 + count), sizeof *buckets->first);
    if (!buckets->first)
        return 0;
    buckets->members = buckets->first + cells + 1;
    for (int pass = 0; pass < 2; pass++) {
        for (ptrdiff_t i = count - 1; i >= 0; i--) {
            ptrdiff_t u = bucket_along(points[2 * i], buckets->low[0], buckets->cell, buckets->columns);
            ptrdiff_t v = bucket_along(points[2 * i + 1], buckets->low[1], buckets->cell, buckets->rows);
            int32_t *bucket = &buckets->first[v * buckets->columns + u];
            if (pass == 0)
                ++*bucket;
            else
                buckets->members[--*bucket] = (int32_t)i;
        }
        for (ptrdiff_t i = 1; pass == 0 && i <= cells; i++)
            buckets->first[i] += buckets->first[i - 1];
    }
    return 1;
}

/* The nearest point, the first of those that are equally near, and the square of its distance.
 *
 * Looks at squares of buckets that grow around the place, until what lies outside cannot be nearer. A place outside the
 * grid begins at its border, from which no point is further than from the place itself.
 */
static int32_t nearest_point(const Buckets *buckets, const double *place, double *square)
{
    ptrdiff_t u = bucket_along(place[0], buckets->low[0], buckets->cell, buckets->columns);
    ptrdiff_t v = bucket_along(place[1], buckets->low[1], buckets->cell, buckets->rows);
    double du0 = place[0] - (buckets->low[0] + (double)u * buckets->cell);
    double dv0 = place[1] - (buckets->low[1] + (double)v * buckets->cell);
    double border = lesser(lesser(du0, buckets->cell - du0), lesser(dv0, buckets->cell - dv0));
    int32_t best = -1;
    *square = INFINITY;
    for (ptrdiff_t ring = 0;; ring++) {
        ptrdiff_t left = u - ring, right = u + ring, top = v - ring, bottom = v + ring;
        for (ptrdiff_t row = top < 0 ? 0 : top; row <= bottom && row < buckets->rows; row++) {
            ptrdiff_t step = row == top || row == bottom || ring == 0 ? 1 : 2 * ring;
            for (ptrdiff_t column = left; column <= right; column += step) {
                if (column < 0 || column >= buckets->columns)
                    continue;
                const int32_t *bucket = &buckets->first[row * buckets->columns + column];
                for (int32_t k = bucket[0]; k < bucket[1]; k++) {
                    int32_t i = buckets->members[k];
                    double du = buckets->points[2 * i] - place[0], dv = buckets->points[2 * i + 1] - place[1];
                    double apart = du * du + dv * dv;
                    if (apart < *square || (apart == *square && i < best)) {
                        *square = apart;
                        best = i;
                    }
                }
            }
        }
        double clear = (double)ring * buckets->cell + greater(border, 0.0);
        int all = left <= 0 && top <= 0 && right >= buckets->columns - 1 && bottom >= buckets->rows - 1;
        if (all || *square < clear * clear)
            return best;
    }
}

/* Whether each place is, of all that have the same partner, the nearest to it; the first of those equally near.
 * `owner` is room for as many as there are points. */
static void find_owners(const int64_t *partner, const double *square, ptrdiff_t places, int32_t *owner,
                        ptrdiff_t points, uint8_t *owns)
{
    for (ptrdiff_t i = 0; i < points; i++)
        owner[i] = -1;
    for (ptrdiff_t i = 0; i < places; i++) {
        int32_t *holder = &owner[partner[i]];
        if (*holder < 0 || square[i] < square[*holder])
            *holder = (int32_t)i;
    }
    for (ptrdiff_t i = 0; i < places; i++)
        owns[i] = owner[partner[i]] == i;
}

/* The ways in which the markers move together.
 *
 * `basis` has a row for each coordinate of each marker (u, v, u, v, ...) and a column for each way; `stride` is their
 * number rounded up to whole tiles, the columns behind the last are zero.
 */
typedef struct {
    const double *basis;
    ptrdiff_t markers, modes, stride;
} Modes;

enum { TILE_ROWS = 4, TILE_COLUMNS = 8 };

/* One tile of the weighted moments of the basis, kept in registers over all markers. */
WIDE_VECTORS static void moments_of_tile(const Modes *modes, const double *weight, ptrdiff_t i0, ptrdiff_t j0,
                                         double *moments)
{
    double sum[TILE_ROWS][TILE_COLUMNS] = {{0.0}};
    ptrdiff_t stride = modes->stride;
    for (ptrdiff_t marker = 0; marker < modes->markers; marker++) {
        double w = weight[marker];
        if (w == 0.0)
            continue;
        const double *row = modes->basis + 2 * marker * stride;
        for (int axis = 0; axis < 2; axis++, row += stride)
            for (int i = 0; i < TILE_ROWS; i++) {
                double weighted = w * row[i0 + i];
                for (int j = 0; j < TILE_COLUMNS; j++)
                    sum[i][j] += weighted * row[j0 + j];
            }
    }
    for (int i = 0; i < TILE_ROWS; i++)
        for (int j = 0; j < TILE_COLUMNS; j++)
            moments[(i0 + i) * stride + j0 + j] = sum[i][j];
}

/* to += rows' * factors, over the coordinates of all markers. */
WIDE_VECTORS static void add_toward(const Modes *modes, const double *weight, const double *off, double *restrict to)
{
    const double *row = modes->basis;
    for (ptrdiff_t i = 0; i < 2 * modes->markers; i++, row += modes->stride) {
        double factor = weight[i / 2] * off[i];
        for (ptrdiff_t j = 0; factor != 0.0 && j < modes->stride; j++)
            to[j] += factor * row[j];
    }
}

/* places += basis * coefficients; the largest of the shifts along u or v. */
WIDE_VECTORS static double shift_places(const Modes *modes, const double *coefficients, double *places)
{
    double largest = 0.0;
    const double *row = modes->basis;
    for (ptrdiff_t i = 0; i < 2 * modes->markers; i++, row += modes->stride) {
        /* Four sums side by side, since one would wait for itself. */
        double sum[4] = {0.0};
        for (ptrdiff_t j = 0; j < modes->stride; j += 4)
            for (int k = 0; k < 4; k++)
                sum[k] += row[j + k] * coefficients[j + k];
        double shift = (sum[0] + sum[1]) + (sum[2] + sum[3]);
        places[i] += shift;
        largest = greater(fabs(shift), largest);
    }
    return largest;
}

/* Solves A x = b in place, A symmetric and positive definite with its lower triangle given. 0: it is not. */
static int solve_symmetric(double *A, ptrdiff_t stride, double *b, ptrdiff_t n)
{
    for (ptrdiff_t j = 0; j < n; j++) {
        double *row = A + j * stride, pivot = row[j];
        for (ptrdiff_t i = 0; i < j; i++)
            pivot -= row[i] * row[i];
        if (!(pivot > 0.0) || !isfinite(pivot))
            return 0;
        row[j] = pivot = sqrt(pivot);
        for (ptrdiff_t below = j + 1; below < n; below++) {
            double *other = A + below * stride, sum = other[j];
            for (ptrdiff_t i = 0; i < j; i++)
                sum -= other[i] * row[i];
            other[j] = sum / pivot;
        }
    }
    for (ptrdiff_t j = 0; j < n; j++) {
        for (ptrdiff_t i = 0; i < j; i++)
            b[j] -= A[j * stride + i] * b[i];
        b[j] /= A[j * stride + j];
    }
    for (ptrdiff_t j = n - 1; j >= 0; j--) {
        for (ptrdiff_t i = j + 1; i < n; i++)
            b[j] -= A[i * stride + j] * b[i];
        b[j] /= A[j * stride + j];
    }
    return 1;
}

/* The change of the coefficients that brings markers, by their weights, towards points `off` away from them, and not far
 * from the start: (B' W B + R) change = B' W off + R from_start. Room: `moments` stride * stride, `change` stride.
 * 0: the moments are not positive definite. */
static int fit_change(const Modes *modes, const double *weight, const double *off, const double *from_start,
                      const double *ridge, double *moments, double *change)
{
    for (ptrdiff_t i = 0; i < modes->stride; i += TILE_ROWS)
        for (ptrdiff_t j = 0; j < i + TILE_ROWS; j += TILE_COLUMNS)
            moments_of_tile(modes, weight, i, j, moments);
    memset(change, 0, (size_t)modes->stride * sizeof *change);
    add_toward(modes, weight, off, change);
    for (ptrdiff_t i = 0; i < modes->modes; i++) {
        moments[i * (modes->stride + 1)] += ridge[i];
        change[i] += ridge[i] * from_start[i];
    }
    return solve_symmetric(moments, modes->stride, change, modes->modes);
}

static int ascending(const void *a, const void *b)
{
    double left = *(const double *)a, right = *(const double *)b;
    return (left > right) - (left < right);
}

/* Of one number or more, which it sorts. */
static double median_of(double *values, ptrdiff_t count)
{
    qsort(values, (size_t)count, sizeof *values, ascending);
    return 0.5 * (values[(count - 1) / 2] + values[count / 2]);
}

/* When pairing and fitting by turns ends. */
typedef struct {
    double reach_px, least_reach_px, settled_px;
    int turns;
} Settling;

/* Pairs markers with points and fits the coefficients by turns until nothing moves. 0: out of memory.
 *
 * `base` holds the markers with all coefficients zero. A point far from where its marker should be may be a neighbour's,
 * and counts less. Too few pairs, or a fit without a solution, leave the coefficients as they are.
 */
static int settle(const Modes *modes, const double *base, const double *start, const double *ridge,
                  const Buckets *points, ptrdiff_t count, Settling settling, double *coefficients)
{
    ptrdiff_t m = modes->markers, k = modes->modes, stride = modes->stride;
    double *room = calloc((size_t)(7 * m + stride * stride + 3 * stride), sizeof *room);
    int64_t *partner = malloc((size_t)m * sizeof *partner);
    int32_t *owner = malloc((size_t)count * sizeof *owner);
    uint8_t *owns = malloc((size_t)m);
    int done = room && partner && owner && owns;
    if (done) {
        double *places = room, *off = places + 2 * m, *square = off + 2 * m, *weight = square + m;
        double *paired_squares = weight + m, *moments = paired_squares + m, *change = moments + stride * stride;
        double *from_start = change + stride, *padded = from_start + stride;
        double reach = settling.reach_px;
        memcpy(places, base, 2 * (size_t)m * sizeof *places);
        memcpy(padded, coefficients, (size_t)k * sizeof *padded);
        shift_places(modes, padded, places);
        for (int turn = 0; turn < settling.turns; turn++) {
            ptrdiff_t paired = 0;
            double soft = 0.35 * reach;
            for (ptrdiff_t i = 0; i < m; i++)
                partner[i] = nearest_point(points, places + 2 * i, &square[i]);
            find_owners(partner, square, m, owner, count, owns);
            for (ptrdiff_t i = 0; i < m; i++) {
                int close = owns[i] && square[i] < reach * reach;
                weight[i] = close ? 1.0 / (1.0 + square[i] / (soft * soft)) : 0.0;
                for (int axis = 0; axis < 2; axis++)
                    off[2 * i + axis] = points->points[2 * partner[i] + axis] - places[2 * i + axis];
                if (close)
                    paired_squares[paired++] = square[i];
            }
            for (ptrdiff_t i = 0; i < k; i++)
                from_start[i] = start[i] - coefficients[i];
            if (paired < k || !fit_change(modes, weight, off, from_start, ridge, moments, change))
                break;
            for (ptrdiff_t i = 0; i < k; i++)
                coefficients[i] += change[i];
            memset(change + k, 0, (size_t)(stride - k) * sizeof *change);
            double largest = shift_places(modes, change, places);
            if (reach <= settling.least_reach_px && largest < settling.settled_px)
                break;
            double typical = sqrt(median_of(paired_squares, paired));
            reach = fmax(settling.least_reach_px, fmin(0.8 * reach, 4.0 * typical));
        }
    }
    free(room);
    free(partner);
    free(owner);
    free(owns);
    return done;
}

/* Adds each point's weight to the four cells of a grid around it, by how near it lies to their middles. */
static void add_density(const double *points, const double *weights, ptrdiff_t count, const double *low, double cell,
                        ptrdiff_t grid, double *density)
{
    for (ptrdiff_t i = 0; i < count; i++) {
        double u = (points[2 * i] - low[0]) / cell - 0.5, v = (points[2 * i + 1] - low[1]) / cell - 0.5;
        double left = floor(u), top = floor(v), right_part = u - left, lower_part = v - top;
        for (int down = 0; down < 2; down++)
            for (int right = 0; right < 2; right++) {
                double column = left + right, row = top + down;
                if (column < 0.0 || column >= (double)grid || row < 0.0 || row >= (double)grid)
                    continue;
                double share = (right ? right_part : 1.0 - right_part) * (down ? lower_part : 1.0 - lower_part);
                density[(ptrdiff_t)row * grid + (ptrdiff_t)column] += weights[i] * share;
            }
    }
}

/* Squared distances of rows of bytes from one more, up to 32768 of them. */
WIDE_VECTORS static void bytes_apart(const uint8_t *rows, ptrdiff_t count, const uint8_t *one, ptrdiff_t length,
                                     int32_t *apart)
{
    for (ptrdiff_t row = 0; row < count; row++, rows += length) {
        int32_t sum = 0;
        for (ptrdiff_t i = 0; i < length; i++) {
            int16_t off = (int16_t)(rows[i] - one[i]);
            sum += off * off;
        }
        apart[row] = sum;
    }
}

/* to = bias + x' weight, weight being (inputs, outputs): all outputs advance together, input by input. */
WIDE_VECTORS static void affine(const float *restrict weight, const float *restrict bias, const float *restrict x,
                                ptrdiff_t inputs, ptrdiff_t outputs, float *restrict to)
{
    memcpy(to, bias, (size_t)outputs * sizeof *to);
    ptrdiff_t i = 0;
    /* Eight rows at a time: the sums are loaded and stored an eighth as often. */
    for (; i + 8 <= inputs; i += 8) {
        const float *w0 = weight + i * outputs, *w1 = w0 + outputs, *w2 = w1 + outputs, *w3 = w2 + outputs;
        const float *w4 = w3 + outputs, *w5 = w4 + outputs, *w6 = w5 + outputs, *w7 = w6 + outputs;
        float a = x[i], b = x[i + 1], c = x[i + 2], d = x[i + 3];
        float e = x[i + 4], f = x[i + 5], g = x[i + 6], h = x[i + 7];
        for (ptrdiff_t j = 0; j < outputs; j++)
            to[j] += ((a * w0[j] + b * w1[j]) + (c * w2[j] + d * w3[j])) +
                     ((e * w4[j] + f * w5[j]) + (g * w6[j] + h * w7[j]));
    }
    for (; i < inputs; i++)
        for (ptrdiff_t j = 0; j < outputs; j++)
            to[j] += x[i] * weight[i * outputs + j];
}

/* The mean of each place's known neighbours' values (u, v), zero where none is known. Neighbours are numbers of places. */
static void means_of_neighbours(const double *values, const uint8_t *known, const int64_t *neighbours, ptrdiff_t places,
                                ptrdiff_t each, double *means)
{
    for (ptrdiff_t i = 0; i < places; i++, neighbours += each) {
        double u = 0.0, v = 0.0, count = 0.0;
        for (ptrdiff_t j = 0; j < each; j++) {
            int64_t other = neighbours[j];
            if (!known[other])
                continue;
            u += values[2 * other];
            v += values[2 * other + 1];
            count += 1.0;
        }
        means[2 * i] = u / fmax(count, 1.0);
        means[2 * i + 1] = v / fmax(count, 1.0);
    }
}

/* What an image check measures of markers at `off` (u, v) px from where they are expected: the size of the first modes in
 * their standard deviations, the roughness that no mode explains, px, and the products with the filters.
 * `rows` is (2 markers, modes + filters), `room` as many floats; `measured` is 2 + filters. */
static void measure_field(const double *off, const float *mean, ptrdiff_t numbers, const float *rows, const double *sd,
                          ptrdiff_t modes, ptrdiff_t filters, ptrdiff_t strongest, float *room, double *measured)
{
    float *products = room, *left = room + modes + filters;
    double whole = 0.0, explained = 0.0, size = 0.0;
    for (ptrdiff_t i = 0; i < modes + filters; i++)
        products[i] = 0.0f;
    for (ptrdiff_t i = 0; i < numbers; i++) {
        left[i] = (float)(off[i] - (double)mean[i]);
        whole += (double)left[i] * left[i];
    }
    affine(rows, products, left, numbers, modes + filters, left + numbers);
    products = left + numbers;
    for (ptrdiff_t i = 0; i < modes; i++) {
        double product = products[i];
        explained += product * product;
        if (i < strongest)
            size += product * product / (sd[i] * sd[i]);
    }
    measured[0] = sqrt(size / (double)(strongest < modes ? strongest : modes));
    measured[1] = sqrt(fmax(whole - explained, 0.0) / (double)(numbers / 2));
    for (ptrdiff_t i = 0; i < filters; i++)
        measured[2 + i] = products[modes + i];
}

#endif
