/* Images: the median of 5x5 pixels, the threshold at a neighbourhood's mean, means over areas, and the white discs.
 *
 * Plain C99 without any Python. All numbers are whole but in means over areas, which add in one order; so nothing depends
 * on the processor.
 */
#ifndef TOUCHCELL_IMAGE_KERNELS_H
#define TOUCHCELL_IMAGE_KERNELS_H

#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if defined(__x86_64__) && defined(__GNUC__)
#include <immintrin.h>
#define INTEL 1
#else
#define INTEL 0
#endif

/* Two versions of a function where the processor is asked at load time which one it can run. */
#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
#define WIDE_VECTORS __attribute__((target_clones("avx2", "default")))
#else
#define WIDE_VECTORS
#endif

static inline ptrdiff_t clamp(ptrdiff_t i, ptrdiff_t end) { return i < 0 ? 0 : i >= end ? end - 1 : i; }

static inline int lowest_bit(uint64_t bits)
{
#if defined(__GNUC__)
    return __builtin_ctzll(bits);
#else
    int at = 0;
    for (; !(bits & 1); bits >>= 1)
        at++;
    return at;
#endif
}

#define ORDER(a, b)                       \
    do {                                  \
        uint8_t least = (a) < (b) ? a : b; \
        b = (a) < (b) ? b : a;             \
        a = least;                        \
    } while (0)

/* The shortest network that sorts five. */
#define SORT_5(a, b, c, d, e) \
    do {                      \
        ORDER(a, d);          \
        ORDER(b, e);          \
        ORDER(a, c);          \
        ORDER(b, d);          \
        ORDER(a, b);          \
        ORDER(c, e);          \
        ORDER(b, c);          \
        ORDER(d, e);          \
        ORDER(c, d);          \
    } while (0)

/* Each column of five rows by itself, into rows of `to` that lie `stride` apart. */
WIDE_VECTORS static void sort_columns(const uint8_t *const rows[5], ptrdiff_t width, uint8_t *restrict to,
                                      ptrdiff_t stride)
{
    const uint8_t *r0 = rows[0], *r1 = rows[1], *r2 = rows[2], *r3 = rows[3], *r4 = rows[4];
    for (ptrdiff_t x = 0; x < width; x++) {
        uint8_t a = r0[x], b = r1[x], c = r2[x], d = r3[x], e = r4[x];
        SORT_5(a, b, c, d, e);
        to[x] = a;
        to[x + stride] = b;
        to[x + 2 * stride] = c;
        to[x + 3 * stride] = d;
        to[x + 4 * stride] = e;
    }
}

/* Medians of the 5x5 values whose columns are sorted.
 *
 * With the rows sorted too, 13 of the 25 can still be the median, along the rising diagonal. The last 18 exchanges leave
 * it in the middle: found by a search, and checked for all 6^5 columns of zeros and ones, which proves it for all numbers
 * (the zero-one principle, Knuth vol. 3, 5.3.4).
 */
WIDE_VECTORS static void median_of_columns(const uint8_t *restrict sorted, ptrdiff_t stride, ptrdiff_t width,
                                           uint8_t *restrict to)
{
    const uint8_t *s0 = sorted, *s1 = s0 + stride, *s2 = s1 + stride, *s3 = s2 + stride, *s4 = s3 + stride;
    for (ptrdiff_t x = 0; x < width; x++) {
        uint8_t a0 = s0[x], a1 = s0[x + 1], a2 = s0[x + 2], a3 = s0[x + 3], a4 = s0[x + 4];
        uint8_t b0 = s1[x], b1 = s1[x + 1], b2 = s1[x + 2], b3 = s1[x + 3], b4 = s1[x + 4];
        uint8_t c0 = s2[x], c1 = s2[x + 1], c2 = s2[x + 2], c3 = s2[x + 3], c4 = s2[x + 4];
        uint8_t d0 = s3[x], d1 = s3[x + 1], d2 = s3[x + 2], d3 = s3[x + 3], d4 = s3[x + 4];
        uint8_t e0 = s4[x], e1 = s4[x + 1], e2 = s4[x + 2], e3 = s4[x + 3], e4 = s4[x + 4];
        SORT_5(a0, a1, a2, a3, a4);
        SORT_5(b0, b1, b2, b3, b4);
        SORT_5(c0, c1, c2, c3, c4);
        SORT_5(d0, d1, d2, d3, d4);
        SORT_5(e0, e1, e2, e3, e4);
        ORDER(a3, d1);
        ORDER(b3, d0);
        ORDER(b2, d1);
        ORDER(c3, e0);
        ORDER(b4, d1);
        ORDER(b4, c2);
        ORDER(d0, e1);
        ORDER(b4, d0);
        ORDER(d0, d2);
        ORDER(c2, d0);
        ORDER(c2, c3);
        ORDER(c3, d0);
        ORDER(b2, c2);
        ORDER(a4, c3);
        ORDER(a4, c2);
        ORDER(c1, c2);
        ORDER(c2, c3);
        ORDER(b4, c2);
        to[x] = c2;
    }
}

/* Rows of a grey image, or their medians of 5x5, which are made one after the other and kept for `kept` rows. What lies
 * beyond a border repeats it. */
typedef struct {
    const uint8_t *image;
    ptrdiff_t row_bytes, height, width;
    uint8_t *medians, *sorted;
    ptrdiff_t whole, kept, made;
} Rows;

static int open_rows(Rows *rows, const uint8_t *image, ptrdiff_t row_bytes, ptrdiff_t height, ptrdiff_t width,
                     int with_median, ptrdiff_t kept)
{
    /* Whole vectors: what lies behind the last pixel is computed too, and not looked at. */
    ptrdiff_t whole = (width + 31) / 32 * 32;
    *rows = (Rows){.image = image, .row_bytes = row_bytes, .height = height, .width = width, .whole = whole, .kept = kept};
    if (!with_median)
        return 1;
    rows->medians = calloc((size_t)(kept * whole + 5 * (whole + 4)), 1);
    rows->sorted = rows->medians + kept * whole;
    return rows->medians != NULL;
}

static void close_rows(Rows *rows) { free(rows->medians); }

static void make_median_row(Rows *rows)
{
    const uint8_t *five[5];
    ptrdiff_t y = rows->made++, stride = rows->whole + 4;
    for (ptrdiff_t i = 0; i < 5; i++)
        five[i] = rows->image + clamp(y + i - 2, rows->height) * rows->row_bytes;
    sort_columns(five, rows->width, rows->sorted + 2, stride);
    for (uint8_t *row = rows->sorted; row < rows->sorted + 5 * stride; row += stride) {
        row[0] = row[1] = row[2];
        row[rows->width + 2] = row[rows->width + 3] = row[rows->width + 1];
    }
    median_of_columns(rows->sorted, stride, rows->whole, rows->medians + y % rows->kept * rows->whole);
}

/* Row y, or the one at the border; not further back than `kept`. */
static const uint8_t *row_at(Rows *rows, ptrdiff_t y)
{
    y = clamp(y, rows->height);
    if (!rows->medians)
        return rows->image + y * rows->row_bytes;
    while (rows->made <= y)
        make_median_row(rows);
    return rows->medians + y % rows->kept * rows->whole;
}

/* 0: out of memory. */
static int median_5(const uint8_t *image, ptrdiff_t row_bytes, ptrdiff_t height, ptrdiff_t width, uint8_t *to)
{
    Rows rows;
    if (!open_rows(&rows, image, row_bytes, height, width, 1, 1))
        return 0;
    for (ptrdiff_t y = 0; y < height; y++)
        memcpy(to + y * width, row_at(&rows, y), (size_t)width);
    close_rows(&rows);
    return 1;
}

/* Column sums that take one row in and give one up. */
WIDE_VECTORS static void roll_columns(uint16_t *restrict sums, const uint8_t *in, const uint8_t *out, ptrdiff_t width)
{
    for (ptrdiff_t x = 0; x < width; x++)
        sums[x] = (uint16_t)(sums[x] + in[x] - out[x]);
}

/* What a neighbourhood's sum is compared with: white where sum + half < area * (pixel + offset). */
typedef struct {
    int32_t area, half, offset;
} Comparison;

/* White where a pixel exceeds the rounded mean of its neighbourhood less the offset, in whole numbers throughout.
 * `sum` is that of the first pixel's neighbourhood, to whose left `from` pixels are done already; each next one loses
 * columns[x] and takes in columns[x + block]. */
static void above_mean(const uint8_t *pixels, const uint16_t *columns, ptrdiff_t block, int32_t sum, Comparison with,
                       ptrdiff_t from, ptrdiff_t width, uint8_t *restrict to)
{
    for (ptrdiff_t x = from; x < width; x++) {
        to[x] = sum + with.half < with.area * ((int32_t)pixels[x] + with.offset) ? 255 : 0;
        sum += (int32_t)columns[x + block] - columns[x];
    }
}

#if INTEL
/* The first whole 32 of `width` pixels, as `above_mean`; `sum` becomes that of the next neighbourhood. How many. */
__attribute__((target("avx2"))) static ptrdiff_t above_mean_by_32(const uint8_t *pixels, const uint16_t *columns,
                                                                 ptrdiff_t block, int32_t *sum, Comparison with,
                                                                 ptrdiff_t width, uint8_t *restrict to)
{
    const __m256i area = _mm256_set1_epi32(with.area), half = _mm256_set1_epi32(with.half);
    const __m256i offset = _mm256_set1_epi32(with.offset), last = _mm256_set1_epi32(7), fourth = _mm256_set1_epi32(3);
    const __m256i upper = _mm256_setr_epi32(0, 0, 0, 0, -1, -1, -1, -1), order = _mm256_setr_epi32(0, 4, 1, 5, 2, 6, 3, 7);
    __m256i before = _mm256_set1_epi32(*sum);
    ptrdiff_t x = 0;
    for (; x + 32 <= width; x += 32) {
        __m256i white[4];
        for (int k = 0; k < 4; k++) {
            ptrdiff_t at = x + 8 * k;
            __m256i out = _mm256_cvtepu16_epi32(_mm_loadu_si128((const __m128i *)(columns + at)));
            __m256i in = _mm256_cvtepu16_epi32(_mm_loadu_si128((const __m128i *)(columns + at + block)));
            __m256i change = _mm256_sub_epi32(in, out);
            /* What the sums have changed by behind each pixel: within four, then the first four's on the last. */
            __m256i changed = _mm256_add_epi32(change, _mm256_slli_si256(change, 4));
            changed = _mm256_add_epi32(changed, _mm256_slli_si256(changed, 8));
            changed = _mm256_add_epi32(changed, _mm256_and_si256(_mm256_permutevar8x32_epi32(changed, fourth), upper));
            __m256i sums = _mm256_add_epi32(before, _mm256_sub_epi32(changed, change));
            before = _mm256_add_epi32(before, _mm256_permutevar8x32_epi32(changed, last));
            __m256i pixel = _mm256_cvtepu8_epi32(_mm_loadl_epi64((const __m128i *)(pixels + at)));
            __m256i most = _mm256_mullo_epi32(_mm256_add_epi32(pixel, offset), area);
            white[k] = _mm256_cmpgt_epi32(most, _mm256_add_epi32(sums, half));
        }
        __m256i packed = _mm256_packs_epi16(_mm256_packs_epi32(white[0], white[1]), _mm256_packs_epi32(white[2], white[3]));
        _mm256_storeu_si256((__m256i *)(to + x), _mm256_permutevar8x32_epi32(packed, order));
    }
    *sum = _mm256_cvtsi256_si32(before);
    return x;
}
#endif

/* Adaptive threshold of an image or of its medians; the border is repeated outwards. 0: out of memory.
 *
 * The same as OpenCV's adaptiveThreshold with ADAPTIVE_THRESH_MEAN_C and THRESH_BINARY, which rounds the mean to 8 bits
 * before it compares. A block of an odd side has no mean half way between two numbers, so there is one way to round.
 */
static int threshold(const uint8_t *image, ptrdiff_t row_bytes, ptrdiff_t height, ptrdiff_t width, int with_median,
                     ptrdiff_t block, int32_t offset, uint8_t *to)
{
    Rows rows;
    ptrdiff_t half = block / 2, padded = width + block - 1;
    /* One more column than the neighbourhoods reach: the last pixel's sum is rolled on, too. */
    uint16_t *columns = calloc((size_t)padded + 1, sizeof *columns);
    Comparison with = {.area = (int32_t)(block * block), .half = ((int32_t)(block * block) - 1) / 2, .offset = offset};
    int done = columns && open_rows(&rows, image, row_bytes, height, width, with_median, block + 1);
#if INTEL
    int wide = __builtin_cpu_supports("avx2");
#endif
    if (done) {
        uint16_t *middle = columns + half;
        for (ptrdiff_t y = -half - 1; y < half; y++) {
            const uint8_t *row = row_at(&rows, y);
            for (ptrdiff_t x = 0; x < width; x++)
                middle[x] = (uint16_t)(middle[x] + row[x]);
        }
        for (ptrdiff_t y = 0; y < height; y++) {
            const uint8_t *in = row_at(&rows, y + half), *pixels = row_at(&rows, y);
            roll_columns(middle, in, row_at(&rows, y - half - 1), width);
            for (ptrdiff_t x = 0; x < half; x++) {
                columns[x] = middle[0];
                middle[width + x] = middle[width - 1];
            }
            int32_t sum = 0;
            for (ptrdiff_t x = 0; x < block; x++)
                sum += columns[x];
            ptrdiff_t from = 0;
#if INTEL
            if (wide)
                from = above_mean_by_32(pixels, columns, block, &sum, with, width, to + y * width);
#endif
            above_mean(pixels, columns, block, sum, with, from, width, to + y * width);
        }
        close_rows(&rows);
    }
    free(columns);
    return done;
}

/* Means of squares of `factor` pixels, a power of two up to 64, rounded to the nearest and to even where two are as near:
 * what OpenCV's resize with INTER_AREA gives for these factors but 2. `to` is (height / factor, width / factor).
 * 0: out of memory. */
WIDE_VECTORS static int shrink(const uint8_t *image, ptrdiff_t row_bytes, ptrdiff_t height, ptrdiff_t width, ptrdiff_t factor,
                  uint8_t *to)
{
    ptrdiff_t rows = height / factor, columns = width / factor;
    uint32_t area = (uint32_t)(factor * factor);
    int bits = lowest_bit(area);
    uint16_t *sums = malloc((size_t)width * sizeof *sums);
    if (!sums)
        return 0;
    for (ptrdiff_t y = 0; y < rows; y++) {
        memset(sums, 0, (size_t)width * sizeof *sums);
        for (ptrdiff_t i = 0; i < factor; i++) {
            const uint8_t *row = image + (y * factor + i) * row_bytes;
            for (ptrdiff_t x = 0; x < width; x++)
                sums[x] = (uint16_t)(sums[x] + row[x]);
        }
        for (ptrdiff_t x = 0; x < columns; x++) {
            uint32_t sum = 0;
            for (ptrdiff_t i = 0; i < factor; i++)
                sum += sums[x * factor + i];
            uint32_t mean = sum >> bits, rest = sum - mean * area;
            to[y * columns + x] = (uint8_t)(mean + (2 * rest + mean % 2 > area));
        }
    }
    free(sums);
    return 1;
}

/* The pixels that a new pixel covers along one side, and the share of each in its mean; how many. `scale` pixels become
 * one. What covers less than a thousandth of a pixel counts for nothing, as in OpenCV. */
static int covered(ptrdiff_t at, double scale, ptrdiff_t size, ptrdiff_t *first, float *shares)
{
    double begin = (double)at * scale, end = begin + scale;
    double length = scale < (double)size - begin ? scale : (double)size - begin;
    ptrdiff_t from = (ptrdiff_t)begin, to = (ptrdiff_t)end;
    int count = 0;
    from += (double)from < begin;
    to = to < size - 1 ? to : size - 1;
    from = from < to ? from : to;
    *first = from;
    if ((double)from - begin > 1e-3) {
        --*first;
        shares[count++] = (float)(((double)from - begin) / length);
    }
    for (ptrdiff_t i = from; i < to; i++)
        shares[count++] = (float)(1.0 / length);
    if (end - (double)to > 1e-3) {
        double rest = end - (double)to < 1.0 ? end - (double)to : 1.0;
        shares[count++] = (float)((rest < length ? rest : length) / length);
    }
    return count;
}

/* Weighted sums of `most` numbers each, from `first` on; the first shares of all sums lie before the second ones. */
static void gather(const float *restrict row, const int32_t *restrict first, const float *restrict shares,
                   ptrdiff_t most, ptrdiff_t columns, float *restrict to)
{
    for (ptrdiff_t x = 0; x < columns; x++)
        to[x] = row[first[x]] * shares[x];
    for (ptrdiff_t i = 1; i < most; i++) {
        const float *from = row + i, *share = shares + i * columns;
        for (ptrdiff_t x = 0; x < columns; x++)
            to[x] += from[first[x]] * share[x];
    }
}

WIDE_VECTORS static void add_row(const float *restrict row, float share, ptrdiff_t columns, float *restrict sums)
{
    for (ptrdiff_t x = 0; x < columns; x++)
        sums[x] += share * row[x];
}

WIDE_VECTORS static void to_floats(const uint8_t *restrict row, ptrdiff_t width, float *restrict to)
{
    for (ptrdiff_t x = 0; x < width; x++)
        to[x] = row[x];
}

/* To the nearest number of 8 bits and to even where two are as near: the last bit of this float is worth one. */
WIDE_VECTORS static void to_bytes(const float *restrict sums, ptrdiff_t columns, uint8_t *restrict to)
{
    for (ptrdiff_t x = 0; x < columns; x++) {
        float shifted = sums[x] + 12582912.0f;
        int32_t bits;
        memcpy(&bits, &shifted, sizeof bits);
        bits -= 0x4b400000;
        to[x] = (uint8_t)(bits < 255 ? bits : 255);
    }
}

/* Means over the area of each new pixel, by rows first, in single precision and in the order of OpenCV's resize with
 * INTER_AREA, whose results are the same to the bit unless both sides shrink by a whole factor. `to` is (rows, columns),
 * neither more than the image has. 0: out of memory. */
static int area_means(const uint8_t *image, ptrdiff_t row_bytes, ptrdiff_t height, ptrdiff_t width, ptrdiff_t rows,
                      ptrdiff_t columns, uint8_t *to)
{
    double across = 1.0 / ((double)columns / (double)width), down = 1.0 / ((double)rows / (double)height);
    ptrdiff_t room = (ptrdiff_t)(across > down ? across : down) + 3, most = 0, made = -1;
    int32_t *first = malloc((size_t)columns * sizeof *first);
    float *floats = calloc((size_t)((room + 2) * columns + 2 * room + width), sizeof *floats);
    if (!first || !floats) {
        free(first);
        free(floats);
        return 0;
    }
    float *shares = floats, *one = shares + room * columns, *means = one + room, *sums = means + columns;
    float *row = sums + columns;
    for (ptrdiff_t x = 0; x < columns; x++) {
        ptrdiff_t from;
        int count = covered(x, across, width, &from, one);
        for (int i = 0; i < count; i++)
            shares[i * columns + x] = one[i];
        first[x] = (int32_t)from;
        most = count > most ? count : most;
    }
    for (ptrdiff_t y = 0; y < rows; y++) {
        ptrdiff_t from;
        int count = covered(y, down, height, &from, one);
        memset(sums, 0, (size_t)columns * sizeof *sums);
        for (int i = 0; i < count; i++) {
            if (from + i != made) {
                made = from + i;
                to_floats(image + made * row_bytes, width, row);
                gather(row, first, shares, most, columns, means);
            }
            add_row(means, one[i], columns, sums);
        }
        to_bytes(sums, columns, to + y * columns);
    }
    free(first);
    free(floats);
    return 1;
}

/* A run of white pixels in one row, its end exclusive, and the component that it belongs to. */
typedef struct {
    int32_t begin, end, component;
} Run;

/* What touches, also by a corner. `parent` leads to the component that it was joined with. */
typedef struct {
    int64_t sum_u, sum_v;
    int32_t parent, area, left, right, top, bottom;
} Component;

typedef struct {
    int32_t smallest_px, largest_px, longest_side_px;
} DiscSize;

static int32_t root_of(Component *components, int32_t i)
{
    while (components[i].parent != i)
        i = components[i].parent = components[components[i].parent].parent;
    return i;
}

/* The one that was found first keeps its number. */
static int32_t join(Component *components, int32_t a, int32_t b)
{
    a = root_of(components, a);
    b = root_of(components, b);
    if (a == b)
        return a;
    int32_t first = a < b ? a : b, other = a < b ? b : a;
    Component *to = &components[first], *from = &components[other];
    to->sum_u += from->sum_u;
    to->sum_v += from->sum_v;
    to->area += from->area;
    to->left = from->left < to->left ? from->left : to->left;
    to->right = from->right > to->right ? from->right : to->right;
    to->top = from->top < to->top ? from->top : to->top;
    to->bottom = from->bottom > to->bottom ? from->bottom : to->bottom;
    from->parent = first;
    return first;
}

/* One bit for each of 64 pixels, the first the lowest: whether it is white. */
static inline uint64_t white_bits(const uint8_t *pixels)
{
    uint64_t white = 0;
#if INTEL
    for (int i = 0; i < 64; i += 16) {
        __m128i sixteen = _mm_loadu_si128((const __m128i *)(pixels + i));
        uint64_t black = (uint64_t)_mm_movemask_epi8(_mm_cmpeq_epi8(sixteen, _mm_setzero_si128()));
        white |= (black ^ 0xffff) << i;
    }
#else
    for (int i = 0; i < 64; i += 8) {
        uint64_t eight = 0, low = 0x7f7f7f7f7f7f7f7fu;
        for (int j = 0; j < 8; j++)
            eight |= (uint64_t)pixels[i + j] << (8 * j);
        /* The highest bit of each byte, then all of them side by side. */
        eight = (((eight & low) + low) | eight) >> 7 & 0x0101010101010101u;
        white |= (eight * 0x0102040810204080u >> 56) << i;
    }
#endif
    return white;
}

/* Runs of one row. Where white begins or ends is read from 64 pixels at once, which are mostly black. */
static int32_t runs_of(const uint8_t *row, int32_t width, Run *runs)
{
    int32_t edges = 0;
    uint64_t last = 0;
    for (int32_t x = 0; x < width; x += 64) {
        uint8_t rest[64] = {0};
        const uint8_t *pixels = row + x;
        if (width - x < 64)
            pixels = memcpy(rest, row + x, (size_t)(width - x));
        uint64_t white = white_bits(pixels);
        for (uint64_t edge = white ^ (white << 1 | last); edge; edge &= edge - 1, edges++) {
            int32_t at = x + lowest_bit(edge);
            if (edges % 2)
                runs[edges / 2].end = at;
            else
                runs[edges / 2].begin = at;
        }
        last = white >> 63;
    }
    if (edges % 2)
        runs[edges++ / 2].end = width;
    return edges / 2;
}

/* Connected white components, 8 neighbours, in the order of their first pixels. -1: out of memory. */
static int32_t find_components(const uint8_t *image, ptrdiff_t row_bytes, int32_t height, int32_t width,
                               Component **found)
{
    size_t room = 1024;
    int32_t count = 0, above_count = 0;
    Component *components = malloc(room * sizeof *components);
    Run *above = malloc(((size_t)width + 1) * sizeof *above), *here = above ? above + width / 2 + 1 : NULL;
    Run *rows = above;
    *found = NULL;
    if (!components || !rows)
        goto failed;
    for (int32_t y = 0; y < height; y++) {
        int32_t here_count = runs_of(image + y * row_bytes, width, here);
        if ((size_t)(count + here_count) > room) {
            room = 2 * room + (size_t)here_count;
            Component *larger = realloc(components, room * sizeof *components);
            if (!larger)
                goto failed;
            components = larger;
        }
        for (int32_t i = 0, j = 0; i < here_count; i++) {
            Run *run = &here[i];
            int32_t length = run->end - run->begin;
            run->component = -1;
            while (j < above_count && above[j].end < run->begin)
                j++;
            for (int32_t k = j; k < above_count && above[k].begin <= run->end; k++)
                run->component = run->component < 0 ? root_of(components, above[k].component)
                                                    : join(components, run->component, above[k].component);
            if (run->component < 0) {
                run->component = count;
                components[count++] = (Component){.parent = run->component,
                                                  .left = run->begin,
                                                  .right = run->end,
                                                  .top = y,
                                                  .bottom = y + 1};
            }
            Component *component = &components[run->component];
            component->area += length;
            component->sum_u += (int64_t)length * (run->begin + run->end - 1) / 2;
            component->sum_v += (int64_t)length * y;
            component->left = run->begin < component->left ? run->begin : component->left;
            component->right = run->end > component->right ? run->end : component->right;
            component->bottom = y + 1;
        }
        Run *swapped = above;
        above = here;
        here = swapped;
        above_count = here_count;
    }
    free(rows);
    *found = components;
    return count;
failed:
    free(components);
    free(rows);
    return -1;
}

/* Moves the components that are discs to the front; their number. */
static int32_t keep_discs(Component *components, int32_t count, DiscSize size)
{
    int32_t kept = 0;
    for (int32_t i = 0; i < count; i++) {
        Component *each = &components[i];
        if (each->parent == i && each->area >= size.smallest_px && each->area <= size.largest_px &&
            each->right - each->left <= size.longest_side_px && each->bottom - each->top <= size.longest_side_px)
            components[kept++] = *each;
    }
    return kept;
}

enum { LANES = 8 };

/* Sums over the pixels of LANES columns and some rows: light, and light times its distances across and down. */
WIDE_VECTORS static void add_lights(const float *restrict row, ptrdiff_t stride, ptrdiff_t rows, float from_u, float from_v,
                              float inverse, float *restrict sums)
{
    float column[LANES] = {0}, down[LANES] = {0}, less[LANES];
    for (int i = 0; i < LANES; i++)
        less[i] = (from_u + (float)i) * (from_u + (float)i) * inverse;
    for (ptrdiff_t y = 0; y < rows; y++, row += stride) {
        float dv = from_v + (float)y, full = 1.0f - dv * dv * inverse;
#pragma GCC unroll 1
        for (int i = 0; i < LANES; i++) {
            float share = full - less[i], light = (share > 0.0f ? share : 0.0f) * row[i];
            column[i] += light;
            down[i] += light * dv;
        }
    }
    for (int i = 0; i < LANES; i++) {
        sums[0] += column[i];
        sums[1] += column[i] * (from_u + (float)i);
        sums[2] += down[i];
    }
}

/* Moves each place of an image to the centroid of the brightness around it, again and again until it stays.
 *
 * Mean shift (Comaniciu & Meer 2002): a pixel counts by 1 - (distance / radius)^2, and not at all beyond the radius.
 * `levels` becomes the weighted mean of the grey levels at the last place. Outside of the image everything is black.
 * 0: out of memory. */
static int mean_shift(const uint8_t *image, ptrdiff_t row_bytes, ptrdiff_t height, ptrdiff_t width,
                                   double radius, int turns, ptrdiff_t count, double *places, double *levels)
{
    ptrdiff_t reach = (ptrdiff_t)radius + 1, rows = 2 * reach + 1, blocks = (rows + LANES - 1) / LANES;
    ptrdiff_t border = 2 * reach + LANES, stride = width + 2 * border;
    float *dark = calloc((size_t)((height + 2 * border) * stride), sizeof *dark);
    if (!dark)
        return 0;
    for (ptrdiff_t y = 0; y < height; y++)
        to_floats(image + y * row_bytes, width, dark + (y + border) * stride + border);
    const double settled = 0.05, around = 0.5 * 3.14159265358979323846 * radius * radius;
    const float inverse = (float)(1.0 / (radius * radius));
    for (ptrdiff_t i = 0; i < count; i++) {
        double *place = places + 2 * i;
        levels[i] = 0.0;
        for (int turn = 0; turn < turns; turn++) {
            /* Far outside nothing is seen, and what is no number stays where it is. */
            if (!(place[0] >= -radius && place[1] >= -radius && place[0] <= (double)width + radius &&
                  place[1] <= (double)height + radius))
                break;
            ptrdiff_t middle_u = (ptrdiff_t)(place[0] + (double)border + 0.5), first_u = middle_u - reach;
            ptrdiff_t middle_v = (ptrdiff_t)(place[1] + (double)border + 0.5), first_v = middle_v - reach;
            float from_u = (float)((double)(first_u - border) - place[0]);
            float from_v = (float)((double)(first_v - border) - place[1]);
            const float *row = dark + first_v * stride + first_u;
            float sums[3] = {0};
            for (ptrdiff_t block = 0; block < blocks; block++)
                add_lights(row + block * LANES, stride, rows, from_u + (float)(block * LANES), from_v, inverse, sums);
            double sum = sums[0];
            levels[i] = sum / around;
            if (sum <= 0.0)
                break;
            double step_u = sums[1] / sum, step_v = sums[2] / sum;
            place[0] += step_u;
            place[1] += step_v;
            if (step_u * step_u + step_v * step_v < settled * settled)
                break;
        }
    }
    free(dark);
    return 1;
}

/* Of all grey levels. */
WIDE_VECTORS static double sum_of(const uint8_t *image, ptrdiff_t row_bytes, ptrdiff_t height, ptrdiff_t width)
{
    uint64_t sum = 0;
    for (ptrdiff_t y = 0; y < height; y++) {
        const uint8_t *row = image + y * row_bytes;
        uint32_t in_row = 0;
        for (ptrdiff_t x = 0; x < width; x++)
            in_row += row[x];
        sum += in_row;
    }
    return (double)sum;
}

WIDE_VECTORS static uint32_t row_apart(const uint8_t *restrict one, const uint8_t *restrict other, ptrdiff_t width)
{
    uint32_t sum = 0;
    for (ptrdiff_t x = 0; x < width; x++)
        sum += (uint32_t)(one[x] > other[x] ? one[x] - other[x] : other[x] - one[x]);
    return sum;
}

/* Mean absolute difference of two images in each of blocks x blocks parts. */
static void block_changes(const uint8_t *one, ptrdiff_t one_row, const uint8_t *other, ptrdiff_t other_row,
                          ptrdiff_t height, ptrdiff_t width, ptrdiff_t blocks, double *means)
{
    for (ptrdiff_t i = 0; i < blocks; i++) {
        ptrdiff_t top = i * height / blocks, bottom = (i + 1) * height / blocks;
        for (ptrdiff_t j = 0; j < blocks; j++) {
            ptrdiff_t left = j * width / blocks, right = (j + 1) * width / blocks;
            uint64_t sum = 0;
            for (ptrdiff_t y = top; y < bottom; y++)
                sum += row_apart(one + y * one_row + left, other + y * other_row + left, right - left);
            means[i * blocks + j] = (double)sum / (double)((bottom - top) * (right - left));
        }
    }
}

/* One row of a 3x3 convolution: `rows` are three padded rows of width + 2. */
static inline void convolve_row(const float *const rows[3], const float *weight, float bias, ptrdiff_t width,
                                float *restrict to)
{
    const float *r0 = rows[0], *r1 = rows[1], *r2 = rows[2];
    float a = weight[0], b = weight[1], c = weight[2], d = weight[3], e = weight[4], f = weight[5];
    float g = weight[6], h = weight[7], i = weight[8];
    for (ptrdiff_t x = 0; x < width; x++)
        to[x] = bias + (a * r0[x] + b * r0[x + 1] + c * r0[x + 2]) + (d * r1[x] + e * r1[x + 1] + f * r1[x + 2]) +
                (g * r2[x] + h * r2[x + 1] + i * r2[x + 2]);
}

/* The larger of two rows, then of each two neighbours, and of zero. */
WIDE_VECTORS static void pool_rows(const float *restrict one, const float *restrict other, ptrdiff_t columns,
                                   float *restrict to)
{
    for (ptrdiff_t x = 0; x < columns; x++) {
        float left = one[2 * x] > other[2 * x] ? one[2 * x] : other[2 * x];
        float right = one[2 * x + 1] > other[2 * x + 1] ? one[2 * x + 1] : other[2 * x + 1];
        float larger = left > right ? left : right;
        to[x] = larger > 0.0f ? larger : 0.0f;
    }
}

WIDE_VECTORS static void convolve_two_rows(const float *const rows[4], const float *weight, float bias, ptrdiff_t width,
                                           float *restrict one, float *restrict other)
{
    convolve_row(rows, weight, bias, width, one);
    convolve_row(rows + 1, weight, bias, width, other);
}

/* First block of a network: 3x3 convolution of one channel, padded by zeros, 2x2 maximum and ReLU, of which nothing but
 * the result is stored. `to` is (channels, height / 2, width / 2). 0: out of memory. */
static int first_block(const uint8_t *image, ptrdiff_t row_bytes, ptrdiff_t height, ptrdiff_t width, const float *weight,
                       const float *bias, ptrdiff_t channels, float *to)
{
    ptrdiff_t padded = width + 2, rows = height / 2, columns = width / 2;
    float *room = calloc((size_t)(4 * padded + 2 * width), sizeof *room);
    if (!room)
        return 0;
    float *one = room + 4 * padded, *other = one + width;
    for (ptrdiff_t y = 0; y < rows; y++) {
        const float *four[4];
        for (ptrdiff_t i = 0; i < 4; i++) {
            ptrdiff_t row = 2 * y - 1 + i, slot = (row + 4) % 4;
            float *values = room + slot * padded;
            four[i] = values;
            if (i < 2 && y > 0)
                continue;
            if (row < 0 || row >= height)
                memset(values, 0, (size_t)padded * sizeof *values);
            else
                to_floats(image + row * row_bytes, width, values + 1);
        }
        for (ptrdiff_t c = 0; c < channels; c++) {
            convolve_two_rows(four, weight + 9 * c, bias[c], width, one, other);
            pool_rows(one, other, columns, to + (c * rows + y) * columns);
        }
    }
    free(room);
    return 1;
}

#endif
