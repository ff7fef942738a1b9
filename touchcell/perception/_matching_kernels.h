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
    return !(at >= 0.0) ? 0 : at >= (double)end ? end - 1 : (ptrdiff_t)at;
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

/* The best point so far, the first of those that are equally near, and the square of its distance. */
typedef struct {
    double square;
    int32_t point;
} Nearest;

static inline void look_into(const Buckets *buckets, ptrdiff_t column, ptrdiff_t row, const double *place, Nearest *best)
{
    const int32_t *bucket = &buckets->first[row * buckets->columns + column];
    for (int32_t k = bucket[0]; k < bucket[1]; k++) {
        int32_t i = buckets->members[k];
        double du = buckets->points[2 * i] - place[0], dv = buckets->points[2 * i + 1] - place[1];
        double apart = du * du + dv * dv;
        if (apart < best->square || (apart == best->square && i < best->point))
            *best = (Nearest){apart, i};
    }
}

/* Squares of buckets around the place that grow until one holds a point: how many rings they have. What is no number
 * finds none. */
static ptrdiff_t look_around(const Buckets *buckets, ptrdiff_t u, ptrdiff_t v, const double *place, Nearest *best)
{
    for (ptrdiff_t ring = 1;; ring++) {
        ptrdiff_t left = u - ring, right = u + ring, top = v - ring, bottom = v + ring;
        for (ptrdiff_t row = top < 0 ? 0 : top; row <= bottom && row < buckets->rows; row++) {
            ptrdiff_t step = row == top || row == bottom ? 1 : 2 * ring;
            for (ptrdiff_t column = left; column <= right; column += step)
                if (column >= 0 && column < buckets->columns)
                    look_into(buckets, column, row, place, best);
        }
        if (best->point >= 0 || ring > buckets->columns + buckets->rows)
            return ring;
    }
}

/* The nearest point that is nearer than a limit, or -1, and the square of its distance, or of the limit.
 *
 * Looks into the bucket of the place, around it if that is empty and the limit infinite, and then where else a nearer
 * point can lie. A place outside the grid begins at its border, from which no point is further than from the place itself.
 */
static int32_t nearest_point(const Buckets *buckets, const double *place, double limit_square, double *square)
{
    ptrdiff_t u = bucket_along(place[0], buckets->low[0], buckets->cell, buckets->columns);
    ptrdiff_t v = bucket_along(place[1], buckets->low[1], buckets->cell, buckets->rows);
    Nearest best = {limit_square, -1};
    ptrdiff_t seen = 0;
    look_into(buckets, u, v, place, &best);
    if (isinf(best.square))
        seen = look_around(buckets, u, v, place, &best);
    double reach = sqrt(best.square);
    ptrdiff_t left = bucket_along(place[0] - reach, buckets->low[0], buckets->cell, buckets->columns);
    ptrdiff_t right = bucket_along(place[0] + reach, buckets->low[0], buckets->cell, buckets->columns);
    ptrdiff_t top = bucket_along(place[1] - reach, buckets->low[1], buckets->cell, buckets->rows);
    ptrdiff_t bottom = bucket_along(place[1] + reach, buckets->low[1], buckets->cell, buckets->rows);
    for (ptrdiff_t row = top; row <= bottom; row++)
        for (ptrdiff_t column = left; column <= right; column++)
            if (row < v - seen || row > v + seen || column < u - seen || column > u + seen)
                look_into(buckets, column, row, place, &best);
    *square = best.square;
    return best.point;
}

/* Whether each place is, of all that have the same partner, the nearest to it; the first of those equally near.
 * `owner` is room for as many as there are points. */
static void find_owners(const int64_t *partner, const double *square, ptrdiff_t places, int32_t *owner,
                        ptrdiff_t points, uint8_t *owns)
{
    for (ptrdiff_t i = 0; i < points; i++)
        owner[i] = -1;
    for (ptrdiff_t i = 0; i < places; i++) {
        int32_t *holder = partner[i] < 0 ? NULL : &owner[partner[i]];
        if (holder && (*holder < 0 || square[i] < square[*holder]))
            *holder = (int32_t)i;
    }
    for (ptrdiff_t i = 0; i < places; i++)
        owns[i] = partner[i] >= 0 && owner[partner[i]] == i;
}

/* The ways in which the markers move together.
 *
 * `basis` has a row for each coordinate of each marker (u, v, u, v, ...) and a column for each way; `stride` is their
 * number rounded up to whole tiles, the columns behind the last are zero. `rough` is the same in single precision.
 */
typedef struct {
    const double *basis;
    const float *rough;
    ptrdiff_t markers, modes, stride;
} Modes;

enum { TILE = 8 };

WIDE_VECTORS static void weigh_rows(const Modes *modes, const double *weight, float *restrict weighted)
{
    const float *row = modes->rough;
    for (ptrdiff_t i = 0; i < 2 * modes->markers; i++, row += modes->stride, weighted += modes->stride) {
        float w = (float)weight[i / 2];
        for (ptrdiff_t j = 0; j < modes->stride; j++)
            weighted[j] = w * row[j];
    }
}

typedef float Lanes __attribute__((vector_size(4 * TILE), aligned(4)));

/* One tile of the weighted moments of the basis, kept in registers over all markers. Single precision is enough: moments
 * only scale the steps of a fit, and where it ends does not depend on them. */
WIDE_VECTORS static void moments_of_tile(const Modes *modes, const float *weighted, ptrdiff_t i0, ptrdiff_t j0,
                                         double *moments)
{
    Lanes a = {0.0f}, b = {0.0f}, c = {0.0f}, d = {0.0f}, e = {0.0f}, f = {0.0f}, g = {0.0f}, h = {0.0f};
    ptrdiff_t stride = modes->stride;
    const float *left = weighted + i0, *right = modes->rough + j0;
    for (ptrdiff_t row = 0; row < 2 * modes->markers; row++, left += stride, right += stride) {
        Lanes each = *(const Lanes *)right;
        a += left[0] * each, b += left[1] * each, c += left[2] * each, d += left[3] * each;
        e += left[4] * each, f += left[5] * each, g += left[6] * each, h += left[7] * each;
    }
    Lanes sums[TILE] = {a, b, c, d, e, f, g, h};
    for (int i = 0; i < TILE; i++)
        for (int j = 0; j < TILE; j++)
            moments[(i0 + i) * stride + j0 + j] = (double)sums[i][j];
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

/* Solves A x = b in place, A symmetric and positive definite with its upper triangle given. 0: it is not. */
WIDE_VECTORS static int solve_symmetric(double *A, ptrdiff_t stride, double *b, ptrdiff_t n)
{
    for (ptrdiff_t j = 0; j < n; j++) {
        double *restrict row = A + j * stride;
        if (!(row[j] > 0.0) || !isfinite(row[j]))
            return 0;
        double inverse = 1.0 / sqrt(row[j]);
        for (ptrdiff_t k = j; k < n; k++)
            row[k] *= inverse;
        b[j] /= row[j];
        for (ptrdiff_t i = j + 1; i < n; i++) {
            double *restrict below = A + i * stride, factor = row[i];
            b[i] -= factor * b[j];
            for (ptrdiff_t k = i; k < n; k++)
                below[k] -= factor * row[k];
        }
    }
    for (ptrdiff_t j = n - 1; j >= 0; j--) {
        const double *row = A + j * stride;
        for (ptrdiff_t i = j + 1; i < n; i++)
            b[j] -= row[i] * b[i];
        b[j] /= row[j];
    }
    return 1;
}

/* Doubles that `fit_change` needs as room. */
static ptrdiff_t room_of_fit(const Modes *modes) { return modes->stride * (modes->stride + modes->markers); }

/* The change of the coefficients that brings markers, by their weights, towards points `off` away from them, and not far
 * from the start: (B' W B + R) change = B' W off + R from_start. `change` has room for `stride` numbers.
 * 0: the moments are not positive definite. */
static int fit_change(const Modes *modes, const double *weight, const double *off, const double *from_start,
                      const double *ridge, double *room, double *change)
{
    double *moments = room;
    float *weighted = (float *)(moments + modes->stride * modes->stride);
    weigh_rows(modes, weight, weighted);
    for (ptrdiff_t i = 0; i < modes->stride; i += TILE)
        for (ptrdiff_t j = i; j < modes->stride; j += TILE)
            moments_of_tile(modes, weighted, i, j, moments);
    memset(change, 0, (size_t)modes->stride * sizeof *change);
    add_toward(modes, weight, off, change);
    for (ptrdiff_t i = 0; i < modes->modes; i++) {
        moments[i * (modes->stride + 1)] += ridge[i];
        change[i] += ridge[i] * from_start[i];
    }
    return solve_symmetric(moments, modes->stride, change, modes->modes);
}

/* Of one number or more, which it orders in part (Hoare's selection). */
static double median_of(double *values, ptrdiff_t count)
{
    ptrdiff_t middle = count / 2, first = 0, last = count - 1;
    while (first < last) {
        double pivot = values[middle];
        ptrdiff_t i = first, j = last;
        do {
            while (values[i] < pivot)
                i++;
            while (pivot < values[j])
                j--;
            if (i <= j) {
                double swapped = values[i];
                values[i++] = values[j];
                values[j--] = swapped;
            }
        } while (i <= j);
        if (j < middle)
            first = i;
        if (middle < i)
            last = j;
    }
    double lower = values[middle];
    if (count % 2 == 0) {
        lower = values[0];
        for (ptrdiff_t i = 1; i < middle; i++)
            lower = greater(values[i], lower);
    }
    return 0.5 * (lower + values[middle]);
}

/* places = base + basis * coefficients. 0: out of memory. */
static int place_markers(const Modes *modes, const double *base, const double *coefficients, double *places)
{
    double *padded = calloc((size_t)modes->stride, sizeof *padded);
    if (!padded)
        return 0;
    memcpy(padded, coefficients, (size_t)modes->modes * sizeof *padded);
    memcpy(places, base, 2 * (size_t)modes->markers * sizeof *places);
    shift_places(modes, padded, places);
    free(padded);
    return 1;
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
    double *room = calloc((size_t)(7 * m + room_of_fit(modes) + 2 * stride), sizeof *room);
    int64_t *partner = malloc((size_t)m * sizeof *partner);
    int32_t *owner = malloc((size_t)count * sizeof *owner);
    uint8_t *owns = malloc((size_t)m);
    double *places = room;
    int done = room && partner && owner && owns && place_markers(modes, base, coefficients, places);
    if (done) {
        double *off = places + 2 * m, *square = off + 2 * m, *weight = square + m, *paired_squares = weight + m;
        double *change = paired_squares + m, *from_start = change + stride, *fit_room = from_start + stride;
        double reach = settling.reach_px;
        for (int turn = 0; turn < settling.turns; turn++) {
            ptrdiff_t paired = 0;
            double soft = 0.35 * reach;
            for (ptrdiff_t i = 0; i < m; i++)
                partner[i] = nearest_point(points, places + 2 * i, reach * reach, &square[i]);
            find_owners(partner, square, m, owner, count, owns);
            for (ptrdiff_t i = 0; i < m; i++) {
                weight[i] = owns[i] ? 1.0 / (1.0 + square[i] / (soft * soft)) : 0.0;
                for (int axis = 0; owns[i] && axis < 2; axis++)
                    off[2 * i + axis] = points->points[2 * partner[i] + axis] - places[2 * i + axis];
                if (owns[i])
                    paired_squares[paired++] = square[i];
            }
            for (ptrdiff_t i = 0; i < k; i++)
                from_start[i] = start[i] - coefficients[i];
            if (paired < k || !fit_change(modes, weight, off, from_start, ridge, fit_room, change))
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

/* Squared distances from their nearest points of some markers, the first and then each `step`. */
static void squares_apart(const Modes *modes, const double *base, const double *coefficients, ptrdiff_t step,
                          const Buckets *points, double *squares)
{
    for (ptrdiff_t i = 0; i < modes->markers; i += step) {
        const double *row = modes->basis + 2 * i * modes->stride;
        double place[2];
        for (int axis = 0; axis < 2; axis++, row += modes->stride) {
            place[axis] = base[2 * i + axis];
            for (ptrdiff_t j = 0; j < modes->modes; j++)
                place[axis] += row[j] * coefficients[j];
        }
        nearest_point(points, place, INFINITY, squares++);
    }
}

/* What makes a point a marker's own, and a place one in view of the camera. */
typedef struct {
    double reach_px, spacing_px, margin_px, width_px, height_px;
} View;

/* Markers with a point of their own, points without a marker although one is near, markers that a camera should see, and
 * the sum of squares of the distances of the first from their points. */
typedef struct {
    ptrdiff_t found, among, expected;
    double squares;
} Tally;

/* Where the markers are: at their own points, or where the coefficients put them. 0: out of memory. */
static int find_markers(const Modes *modes, const double *base, const double *coefficients, const Buckets *points,
                        ptrdiff_t count, View view, double *positions, uint8_t *seen, Tally *tally)
{
    ptrdiff_t m = modes->markers;
    double *places = malloc(3 * (size_t)m * sizeof *places), *square = places ? places + 2 * m : NULL;
    int64_t *partner = malloc((size_t)m * sizeof *partner);
    int32_t *owner = malloc((size_t)count * sizeof *owner);
    uint8_t *alone = malloc((size_t)count);
    Buckets markers = {0};
    int done = places && partner && owner && alone && place_markers(modes, base, coefficients, places) &&
               fill_buckets(&markers, places, m);
    if (done) {
        *tally = (Tally){0};
        memset(alone, 1, (size_t)count);
        for (ptrdiff_t i = 0; i < m; i++)
            partner[i] = nearest_point(points, places + 2 * i, view.reach_px * view.reach_px, &square[i]);
        find_owners(partner, square, m, owner, count, seen);
        for (ptrdiff_t i = 0; i < m; i++) {
            double u = places[2 * i], v = places[2 * i + 1];
            tally->expected += seen[i] || (u >= view.margin_px && u <= view.width_px - 1.0 - view.margin_px &&
                                           v >= view.margin_px && v <= view.height_px - 1.0 - view.margin_px);
            tally->found += seen[i];
            tally->squares += seen[i] ? square[i] : 0.0;
            if (seen[i])
                alone[partner[i]] = 0;
            memcpy(positions + 2 * i, seen[i] ? points->points + 2 * partner[i] : places + 2 * i, 2 * sizeof *positions);
        }
        for (ptrdiff_t i = 0; i < count; i++) {
            double apart, limit = view.spacing_px * view.spacing_px;
            tally->among += alone[i] && nearest_point(&markers, points->points + 2 * i, limit, &apart) >= 0;
        }
    }
    free_buckets(&markers);
    free(places);
    free(partner);
    free(owner);
    free(alone);
    return done;
}

/* How a match grows from its correct part. */
typedef struct {
    double reach_px, onward;
    int turns;
} Growth;

/* The change of the coefficients after markers without a point were searched for where their neighbours are, a turn for
 * each ring. `neighbours` are numbers of markers, `each` for every one; that of the markers is none. A marker is searched
 * for `onward` times as far as its neighbours have moved on average. 0: out of memory; -1: as `fit_change`. */
static int grow(const Modes *modes, const double *base, const double *coefficients, const double *start,
                const double *ridge, const Buckets *points, ptrdiff_t count, const int64_t *neighbours, ptrdiff_t each,
                Growth growth, double *change)
{
    ptrdiff_t m = modes->markers, stride = modes->stride;
    double *room = calloc((size_t)(10 * m + 2 + room_of_fit(modes) + 2 * stride), sizeof *room);
    int64_t *partner = malloc((size_t)m * sizeof *partner);
    int32_t *owner = malloc((size_t)count * sizeof *owner);
    uint8_t *paired = calloc((size_t)m + 1, 1), *owns = malloc((size_t)m);
    double *places = room, *off = places + 2 * m, *corrected = off + 2 * m + 2, *square = corrected + 2 * m;
    double *weight = square + m, *from_start = weight + m, *found = from_start + stride, *fit_room = found + stride;
    int done = room && partner && owner && paired && owns && place_markers(modes, base, coefficients, places);
    ptrdiff_t before = -1;
    for (int turn = 0; done && turn <= growth.turns; turn++) {
        /* The first turn pairs what is near as it is. */
        double reach = turn == 0 ? growth.reach_px : 1.3 * growth.reach_px;
        for (ptrdiff_t i = 0; i < m; i++) {
            double near = 0.0, u = 0.0, v = 0.0;
            for (ptrdiff_t k = 0; k < each; k++) {
                int64_t other = neighbours[i * each + k];
                near += paired[other];
                u += off[2 * other];
                v += off[2 * other + 1];
            }
            double more = growth.onward / greater(near, 1.0);
            corrected[2 * i] = places[2 * i] + (paired[i] ? off[2 * i] : more * u);
            corrected[2 * i + 1] = places[2 * i + 1] + (paired[i] ? off[2 * i + 1] : more * v);
            weight[i] = near;
        }
        for (ptrdiff_t i = 0; i < m; i++)
            partner[i] = nearest_point(points, corrected + 2 * i, reach * reach, &square[i]);
        find_owners(partner, square, m, owner, count, owns);
        ptrdiff_t now = 0;
        for (ptrdiff_t i = 0; i < m; i++) {
            paired[i] = owns[i] && (turn == 0 || weight[i] >= 2.0);
            for (int axis = 0; axis < 2; axis++)
                off[2 * i + axis] = paired[i] ? points->points[2 * partner[i] + axis] - places[2 * i + axis] : 0.0;
            now += paired[i];
        }
        if (turn > 0 && now <= before)
            break;
        before = now;
    }
    if (done) {
        for (ptrdiff_t i = 0; i < m; i++)
            weight[i] = paired[i];
        for (ptrdiff_t i = 0; i < modes->modes; i++)
            from_start[i] = start[i] - coefficients[i];
        done = fit_change(modes, weight, off, from_start, ridge, fit_room, found) ? 1 : -1;
        memcpy(change, found, (size_t)modes->modes * sizeof *change);
    }
    free(room);
    free(partner);
    free(owner);
    free(paired);
    free(owns);
    return done;
}

/* Adds each point's weight to the four cells of a grid around it, by how near it lies to their middles. */
static void add_density(const double *points, const double *weights, ptrdiff_t count, const double *low, double cell,
                        ptrdiff_t grid, double *density)
{
    for (ptrdiff_t i = 0; i < count; i++) {
        double u = (points[2 * i] - low[0]) / cell - 0.5, v = (points[2 * i + 1] - low[1]) / cell - 0.5;
        if (!(u > -1.0 && v > -1.0 && u < (double)grid && v < (double)grid))
            continue;
        /* Rounded down: a call to floor takes longer than all the rest. */
        ptrdiff_t left = (ptrdiff_t)(u + 1.0) - 1, top = (ptrdiff_t)(v + 1.0) - 1;
        double right_part = u - (double)left, lower_part = v - (double)top;
        for (int down = 0; down < 2; down++)
            for (int right = 0; right < 2; right++) {
                ptrdiff_t column = left + right, row = top + down;
                if (column < 0 || column >= grid || row < 0 || row >= grid)
                    continue;
                double share = (right ? right_part : 1.0 - right_part) * (down ? lower_part : 1.0 - lower_part);
                density[row * grid + column] += weights[i] * share;
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

/* Half precision is read by this processor. */
static int reads_halves(void)
{
#if INTEL
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("f16c");
#else
    return 0;
#endif
}

#if INTEL
#define HALVES_AT(i) _mm256_mul_ps(x##i, _mm256_cvtph_ps(_mm_loadu_si128((const __m128i *)weight + (i))))

/* As `affine`, in the same order, of weights in half precision: the network's time is that of reading them.
 *
 * Tiles of eight inputs by eight outputs lie one after the other, those of the same inputs together; inputs beyond the
 * last weigh nothing. `outputs` is a multiple of eight. */
__attribute__((target("avx2,f16c"))) static void affine_of_halves(const uint16_t *weight, const float *bias,
                                                                  const float *x, ptrdiff_t inputs, ptrdiff_t outputs,
                                                                  float *restrict to)
{
    enum { AHEAD = 2048 };
    memcpy(to, bias, (size_t)outputs * sizeof *to);
    for (ptrdiff_t i = 0; i < inputs; i += 8) {
        float eight[8] = {0.0f};
        memcpy(eight, x + i, (size_t)(inputs - i < 8 ? inputs - i : 8) * sizeof *eight);
        __m256 x0 = _mm256_set1_ps(eight[0]), x1 = _mm256_set1_ps(eight[1]), x2 = _mm256_set1_ps(eight[2]);
        __m256 x3 = _mm256_set1_ps(eight[3]), x4 = _mm256_set1_ps(eight[4]), x5 = _mm256_set1_ps(eight[5]);
        __m256 x6 = _mm256_set1_ps(eight[6]), x7 = _mm256_set1_ps(eight[7]);
        for (ptrdiff_t j = 0; j < outputs; j += 8, weight += 64) {
            _mm_prefetch((const char *)(weight + AHEAD), _MM_HINT_T0);
            _mm_prefetch((const char *)(weight + AHEAD + 32), _MM_HINT_T0);
            __m256 first = _mm256_add_ps(_mm256_add_ps(HALVES_AT(0), HALVES_AT(1)), _mm256_add_ps(HALVES_AT(2), HALVES_AT(3)));
            __m256 last = _mm256_add_ps(_mm256_add_ps(HALVES_AT(4), HALVES_AT(5)), _mm256_add_ps(HALVES_AT(6), HALVES_AT(7)));
            _mm256_storeu_ps(to + j, _mm256_add_ps(_mm256_loadu_ps(to + j), _mm256_add_ps(first, last)));
        }
    }
}
#else
static void affine_of_halves(const uint16_t *weight, const float *bias, const float *x, ptrdiff_t inputs,
                             ptrdiff_t outputs, float *to)
{
    (void)weight, (void)bias, (void)x, (void)inputs, (void)outputs, (void)to;
}
#endif

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
