/* Python's door to the compiled kernels: takes buffers, checks them, runs a kernel, writes into buffers.
 *
 * What is not of the right type, shape or order in memory, not finite, or too large, raises ArrayError. The shapes are in
 * touchcell/perception/kernels.py, which is what other modules call.
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <stdarg.h>

#include "_image_kernels.h"
#include "_matching_kernels.h"

/* TRUSTED: numbers that kernels.py has checked once are not checked again at each call. */
enum { MOST_ARGUMENTS = 12, ANY = -1, TRUSTED = 1 << 30 };

static const double LARGEST = 1e9;
static const Py_ssize_t MOST = 1 << 24;

static PyObject *array_error;

/* The buffers of one call, given back together. */
typedef struct {
    const char *function;
    Py_buffer views[MOST_ARGUMENTS];
    int count;
} Call;

static PyObject *finish(Call *call, PyObject *result)
{
    while (call->count)
        PyBuffer_Release(&call->views[--call->count]);
    return result;
}

static void refuse(const Call *call, const char *argument, const char *reason)
{
    PyObject *error = PyObject_CallFunction(array_error, "sss", call->function, argument, reason);
    if (error)
        PyErr_SetObject(array_error, error);
    Py_XDECREF(error);
}

static int is_of(const Py_buffer *view, char type)
{
    const char *format = view->format ? view->format : "B";
    if (format[0] == '\0' || format[1] != '\0')
        return 0;
    return format[0] == type || (type == 'q' && format[0] == 'l' && view->itemsize == 8);
}

/* A buffer of a type and shape; ANY is any length. NULL with an exception. */
static Py_buffer *take(Call *call, const char *argument, PyObject *value, char type, int flags, int ndim, ...)
{
    Py_buffer *view = &call->views[call->count];
    if (PyObject_GetBuffer(value, view, (flags & ~TRUSTED) | PyBUF_FORMAT) < 0) {
        PyErr_Clear();
        refuse(call, argument, "is no array of the right order in memory");
        return NULL;
    }
    call->count++;
    if (!is_of(view, type)) {
        refuse(call, argument, "is of another type");
        return NULL;
    }
    int fits = view->ndim == ndim;
    va_list lengths;
    va_start(lengths, ndim);
    for (int i = 0; i < ndim && fits; i++) {
        Py_ssize_t length = va_arg(lengths, Py_ssize_t);
        fits = length == ANY ? view->shape[i] <= MOST : view->shape[i] == length;
    }
    va_end(lengths);
    if (!fits) {
        refuse(call, argument, "has another shape");
        return NULL;
    }
    if (type == 'd' && !(flags & (PyBUF_WRITABLE | TRUSTED))) {
        const double *numbers = view->buf;
        for (Py_ssize_t i = 0; i < view->len / 8; i++)
            if (!(fabs(numbers[i]) <= LARGEST)) {
                refuse(call, argument, "is not finite, or larger than 1e9");
                return NULL;
            }
    }
    return view;
}

static int takes(const Call *call, Py_ssize_t count, Py_ssize_t wanted)
{
    if (count == wanted)
        return 1;
    PyErr_Format(PyExc_TypeError, "%s takes %zd arguments", call->function, wanted);
    return 0;
}

/* A finite number between bounds. */
static int number(const Call *call, const char *argument, PyObject *value, double least, double most, double *to)
{
    *to = PyFloat_AsDouble(value);
    if (PyErr_Occurred())
        return 0;
    if (*to >= least && *to <= most)
        return 1;
    refuse(call, argument, "is out of range");
    return 0;
}

/* Rows of an image may lie apart, its pixels may not. */
static Py_buffer *take_image(Call *call, PyObject *value)
{
    Py_buffer *image = take(call, "image", value, 'B', PyBUF_STRIDES, 2, (Py_ssize_t)ANY, (Py_ssize_t)ANY);
    if (!image)
        return NULL;
    if (image->shape[0] < 1 || image->shape[1] < 1) {
        refuse(call, "image", "is empty");
        return NULL;
    }
    if (image->shape[1] > 1 && image->strides[1] != 1) {
        refuse(call, "image", "has pixels that do not lie side by side");
        return NULL;
    }
    return image;
}

static PyObject *ended(Call *call, int done)
{
    if (!done)
        return finish(call, PyErr_NoMemory());
    return finish(call, Py_NewRef(Py_None));
}

static PyObject *py_median_5(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Call call = {.function = "median_5"};
    Py_buffer *image, *to;
    if (!takes(&call, count, 2) || !(image = take_image(&call, arguments[0])) ||
        !(to = take(&call, "to", arguments[1], 'B', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 2, image->shape[0],
                    image->shape[1])))
        return finish(&call, NULL);
    int done;
    Py_BEGIN_ALLOW_THREADS;
    done = median_5(image->buf, image->strides[0], image->shape[0], image->shape[1], to->buf);
    Py_END_ALLOW_THREADS;
    return ended(&call, done);
}

static PyObject *py_threshold(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Call call = {.function = "threshold"};
    Py_buffer *image, *to;
    double with_median, block_px, offset;
    if (!takes(&call, count, 5) || !(image = take_image(&call, arguments[0])) ||
        !number(&call, "with_median", arguments[1], 0.0, 1.0, &with_median) ||
        !number(&call, "block_px", arguments[2], 3.0, 255.0, &block_px) ||
        !number(&call, "offset", arguments[3], -256.0, 256.0, &offset) ||
        !(to = take(&call, "to", arguments[4], 'B', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 2, image->shape[0],
                    image->shape[1])))
        return finish(&call, NULL);
    if ((int)block_px % 2 == 0) {
        refuse(&call, "block_px", "is even");
        return finish(&call, NULL);
    }
    int done;
    Py_BEGIN_ALLOW_THREADS;
    done = threshold(image->buf, image->strides[0], image->shape[0], image->shape[1], with_median != 0.0,
                     (ptrdiff_t)block_px, (int32_t)offset, to->buf);
    Py_END_ALLOW_THREADS;
    return ended(&call, done);
}

static PyObject *py_shrink(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Call call = {.function = "shrink"};
    Py_buffer *image, *to;
    double factor;
    if (!takes(&call, count, 3) || !(image = take_image(&call, arguments[0])) ||
        !number(&call, "factor", arguments[1], 1.0, 64.0, &factor) ||
        !(to = take(&call, "to", arguments[2], 'B', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 2,
                    image->shape[0] / (Py_ssize_t)factor, image->shape[1] / (Py_ssize_t)factor)))
        return finish(&call, NULL);
    if ((int)factor & ((int)factor - 1)) {
        refuse(&call, "factor", "is no power of two");
        return finish(&call, NULL);
    }
    return ended(&call, shrink(image->buf, image->strides[0], image->shape[0], image->shape[1], (ptrdiff_t)factor, to->buf));
}

static PyObject *py_area_means(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Call call = {.function = "area_means"};
    Py_buffer *image, *to;
    if (!takes(&call, count, 2) || !(image = take_image(&call, arguments[0])) ||
        !(to = take(&call, "to", arguments[1], 'B', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 2, (Py_ssize_t)ANY,
                    (Py_ssize_t)ANY)))
        return finish(&call, NULL);
    if (to->shape[0] < 1 || to->shape[1] < 1 || to->shape[0] > image->shape[0] || to->shape[1] > image->shape[1]) {
        refuse(&call, "to", "is empty or larger than the image");
        return finish(&call, NULL);
    }
    int done;
    Py_BEGIN_ALLOW_THREADS;
    done = area_means(image->buf, image->strides[0], image->shape[0], image->shape[1], to->shape[0], to->shape[1],
                      to->buf);
    Py_END_ALLOW_THREADS;
    return ended(&call, done);
}

static PyObject *py_discs(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Call call = {.function = "discs"};
    Py_buffer *image;
    double smallest, largest, longest;
    if (!takes(&call, count, 4) || !(image = take_image(&call, arguments[0])) ||
        !number(&call, "smallest_px", arguments[1], 0.0, INT32_MAX, &smallest) ||
        !number(&call, "largest_px", arguments[2], 0.0, INT32_MAX, &largest) ||
        !number(&call, "longest_side_px", arguments[3], 0.0, INT32_MAX, &longest))
        return finish(&call, NULL);
    if ((int64_t)image->shape[0] * image->shape[1] > INT32_MAX) {
        refuse(&call, "image", "is too large");
        return finish(&call, NULL);
    }
    Component *components;
    int32_t found;
    Py_BEGIN_ALLOW_THREADS;
    found = find_components(image->buf, image->strides[0], (int32_t)image->shape[0], (int32_t)image->shape[1],
                            &components);
    Py_END_ALLOW_THREADS;
    if (found < 0)
        return ended(&call, 0);
    found = keep_discs(components, found, (DiscSize){(int32_t)smallest, (int32_t)largest, (int32_t)longest});
    PyObject *result = PyByteArray_FromStringAndSize(NULL, (Py_ssize_t)found * 3 * (Py_ssize_t)sizeof(double));
    if (result) {
        double *to = (double *)PyByteArray_AS_STRING(result);
        for (int32_t i = 0; i < found; i++) {
            to[2 * i] = (double)components[i].sum_u / components[i].area;
            to[2 * i + 1] = (double)components[i].sum_v / components[i].area;
            to[2 * found + i] = components[i].area;
        }
    }
    free(components);
    return finish(&call, result);
}

static Py_buffer *take_points(Call *call, const char *argument, PyObject *value)
{
    Py_buffer *points = take(call, argument, value, 'd', PyBUF_C_CONTIGUOUS, 2, (Py_ssize_t)ANY, (Py_ssize_t)2);
    if (points && points->shape[0] < 1) {
        refuse(call, argument, "is empty");
        return NULL;
    }
    return points;
}

static PyObject *py_pair(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Call call = {.function = "pair"};
    Py_buffer *places, *points, *partner, *square, *owns;
    if (!takes(&call, count, 5) || !(places = take_points(&call, "places", arguments[0])) ||
        !(points = take_points(&call, "points", arguments[1])) ||
        !(partner = take(&call, "partner", arguments[2], 'q', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 1, places->shape[0])) ||
        !(square = take(&call, "square", arguments[3], 'd', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 1, places->shape[0])) ||
        !(owns = take(&call, "owns", arguments[4], '?', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 1, places->shape[0])))
        return finish(&call, NULL);
    Buckets buckets;
    int32_t *owner = malloc((size_t)points->shape[0] * sizeof *owner);
    int done = owner && fill_buckets(&buckets, points->buf, points->shape[0]);
    if (done) {
        const double *place = places->buf;
        for (Py_ssize_t i = 0; i < places->shape[0]; i++)
            ((int64_t *)partner->buf)[i] = nearest_point(&buckets, place + 2 * i, INFINITY, (double *)square->buf + i);
        find_owners(partner->buf, square->buf, places->shape[0], owner, points->shape[0], owns->buf);
        free_buckets(&buckets);
    }
    free(owner);
    return ended(&call, done);
}

static PyObject *py_mean_shift(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Call call = {.function = "mean_shift"};
    Py_buffer *image, *places, *levels;
    double radius, turns;
    if (!takes(&call, count, 5) || !(image = take_image(&call, arguments[0])) ||
        !number(&call, "radius_px", arguments[1], 0.5, 256.0, &radius) ||
        !number(&call, "turns", arguments[2], 1.0, 1000.0, &turns) ||
        !(places = take(&call, "places", arguments[3], 'd', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 2, (Py_ssize_t)ANY, (Py_ssize_t)2)) ||
        !(levels = take(&call, "levels", arguments[4], 'd', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 1, places->shape[0])))
        return finish(&call, NULL);
    int done = mean_shift(image->buf, image->strides[0], image->shape[0], image->shape[1], radius, (int)turns,
                          places->shape[0], places->buf, levels->buf);
    return ended(&call, done);
}

static PyObject *py_block_changes(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Call call = {.function = "block_changes"};
    Py_buffer *one, *other, *means;
    if (!takes(&call, count, 3) || !(one = take_image(&call, arguments[0])) || !(other = take_image(&call, arguments[1])) ||
        !(means = take(&call, "means", arguments[2], 'd', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 2, (Py_ssize_t)ANY, (Py_ssize_t)ANY)))
        return finish(&call, NULL);
    Py_ssize_t blocks = means->shape[0], height = one->shape[0], width = one->shape[1];
    if (other->shape[0] != height || other->shape[1] != width || means->shape[1] != blocks || blocks < 1 ||
        blocks > height || blocks > width) {
        refuse(&call, "means", "or an image has another shape");
        return finish(&call, NULL);
    }
    block_changes(one->buf, one->strides[0], other->buf, other->strides[0], height, width, blocks, means->buf);
    return ended(&call, 1);
}

static PyObject *py_first_block(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Call call = {.function = "first_block"};
    Py_buffer *image, *weight, *bias, *to;
    if (!takes(&call, count, 4) || !(image = take_image(&call, arguments[0])) ||
        !(bias = take(&call, "bias", arguments[2], 'f', PyBUF_C_CONTIGUOUS, 1, (Py_ssize_t)ANY)) ||
        !(weight = take(&call, "weight", arguments[1], 'f', PyBUF_C_CONTIGUOUS, 2, bias->shape[0], (Py_ssize_t)9)) ||
        !(to = take(&call, "to", arguments[3], 'f', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 3, bias->shape[0],
                    image->shape[0] / 2, image->shape[1] / 2)))
        return finish(&call, NULL);
    int done = first_block(image->buf, image->strides[0], image->shape[0], image->shape[1], weight->buf, bias->buf,
                           bias->shape[0], to->buf);
    return ended(&call, done);
}

static const float *in_rows_of(Call *call, const char *argument, PyObject *value, Py_ssize_t rows, Py_ssize_t columns)
{
    Py_buffer *view = take(call, argument, value, 'f', PyBUF_C_CONTIGUOUS, 2, rows, columns);
    return view ? view->buf : NULL;
}

/* Places of the markers that an image shows next to where a polynomial of six numbers and a field put them. */
static PyObject *py_follow(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    enum { TERMS = 84 };
    Call call = {.function = "follow"};
    Py_buffer *image, *terms, *rest, *field, *neighbours, *limits, *expected, *off, *around, *seen;
    const float *weight;
    if (!takes(&call, count, 11) || !(image = take_image(&call, arguments[0])) ||
        !(terms = take(&call, "terms", arguments[1], 'f', PyBUF_C_CONTIGUOUS, 1, (Py_ssize_t)TERMS)) ||
        !(field = take_points(&call, "field", arguments[4])) ||
        !(weight = in_rows_of(&call, "weight", arguments[2], (Py_ssize_t)TERMS, 2 * field->shape[0])) ||
        !(rest = take(&call, "rest", arguments[3], 'f', PyBUF_C_CONTIGUOUS, 1, 2 * field->shape[0])) ||
        !(neighbours = take(&call, "neighbours", arguments[5], 'q', PyBUF_C_CONTIGUOUS, 2, field->shape[0], (Py_ssize_t)ANY)) ||
        !(limits = take(&call, "limits", arguments[6], 'd', PyBUF_C_CONTIGUOUS, 1, (Py_ssize_t)6)) ||
        !(expected = take(&call, "expected", arguments[7], 'd', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 2, field->shape[0], (Py_ssize_t)2)) ||
        !(off = take(&call, "off", arguments[8], 'd', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 2, field->shape[0], (Py_ssize_t)2)) ||
        !(around = take(&call, "around", arguments[9], 'd', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 2, field->shape[0], (Py_ssize_t)2)) ||
        !(seen = take(&call, "seen", arguments[10], '?', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 1, field->shape[0])))
        return finish(&call, NULL);
    const double *limit = limits->buf;
    double px[2] = {limit[0], limit[1]}, radius = limit[2], level = limit[4], stray = limit[5];
    Py_ssize_t m = field->shape[0], each = neighbours->shape[1];
    const int64_t *other = neighbours->buf;
    int inside = px[0] > 0.0 && px[1] > 0.0 && radius >= 0.5 && radius <= 256.0 && limit[3] >= 1.0 && limit[3] <= 1000.0;
    for (Py_ssize_t i = 0; i < m * each && inside; i++)
        inside = other[i] >= 0 && other[i] < m;
    if (!inside) {
        refuse(&call, "limits", "or neighbours are out of range");
        return finish(&call, NULL);
    }
    float *moved = malloc((size_t)(2 * m) * sizeof *moved);
    double *levels = malloc((size_t)m * sizeof *levels);
    int done = moved && levels;
    double at_markers = 0.0, everywhere = 0.0;
    if (done) {
        double *place = off->buf, *mean = around->buf, *put = expected->buf;
        uint8_t *is_seen = seen->buf;
        affine(weight, rest->buf, terms->buf, TERMS, 2 * m, moved);
        for (Py_ssize_t i = 0; i < 2 * m; i++) {
            put[i] = moved[i];
            place[i] = (put[i] + ((const double *)field->buf)[i] + 0.5) / px[i % 2] - 0.5;
        }
        done = mean_shift(image->buf, image->strides[0], image->shape[0], image->shape[1], radius, (int)limit[3], m, place,
                          levels);
        for (Py_ssize_t i = 0; i < m; i++) {
            is_seen[i] = levels[i] >= level;
            at_markers += is_seen[i] ? levels[i] : 0.0;
            for (int axis = 0; axis < 2; axis++)
                place[2 * i + axis] = (place[2 * i + axis] + 0.5) * px[axis] - 0.5 - put[2 * i + axis];
        }
        means_of_neighbours(place, is_seen, other, m, each, mean);
        for (Py_ssize_t i = 0; i < m; i++) {
            double u = place[2 * i] - mean[2 * i], v = place[2 * i + 1] - mean[2 * i + 1];
            is_seen[i] = is_seen[i] && u * u + v * v < stray * stray;
        }
        everywhere = sum_of(image->buf, image->strides[0], image->shape[0], image->shape[1]);
    }
    free(moved);
    free(levels);
    return done ? finish(&call, PyFloat_FromDouble(at_markers / (everywhere > 1.0 ? everywhere : 1.0))) : ended(&call, 0);
}

static PyObject *py_measure_field(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Call call = {.function = "measure_field"};
    Py_buffer *off, *mean, *sd, *measured;
    const float *rows;
    double strongest;
    if (!takes(&call, count, 6) || !(off = take_points(&call, "off", arguments[0])) ||
        !(mean = take(&call, "mean", arguments[1], 'f', PyBUF_C_CONTIGUOUS, 1, 2 * off->shape[0])) ||
        !(sd = take(&call, "sd", arguments[3], 'd', PyBUF_C_CONTIGUOUS, 1, (Py_ssize_t)ANY)) ||
        !number(&call, "strongest", arguments[4], 1.0, 1e6, &strongest) ||
        !(measured = take(&call, "measured", arguments[5], 'd', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 1, (Py_ssize_t)ANY)))
        return finish(&call, NULL);
    Py_ssize_t modes = sd->shape[0], filters = measured->shape[0] - 2, numbers = 2 * off->shape[0];
    if (modes < 1 || filters < 0) {
        refuse(&call, "sd", "or measured is too short");
        return finish(&call, NULL);
    }
    if (!(rows = in_rows_of(&call, "rows", arguments[2], numbers, modes + filters)))
        return finish(&call, NULL);
    float *room = malloc((size_t)(2 * (modes + filters) + numbers) * sizeof *room);
    int done = room != NULL;
    if (done)
        measure_field(off->buf, mean->buf, numbers, rows, sd->buf, modes, filters, (ptrdiff_t)strongest, room, measured->buf);
    free(room);
    return ended(&call, done);
}

/* The basis as (2 markers, stride), of which the first columns are the modes, in double and in single precision. */
static int take_modes(Call *call, PyObject *value, PyObject *rough, Py_ssize_t modes, Modes *to)
{
    Py_buffer *basis = take(call, "basis", value, 'd', PyBUF_C_CONTIGUOUS | TRUSTED, 2, (Py_ssize_t)ANY, (Py_ssize_t)ANY);
    if (!basis)
        return 0;
    Py_ssize_t stride = basis->shape[1];
    if (basis->shape[0] < 2 || basis->shape[0] % 2 || stride < 1 || stride > 1024 || stride % TILE || modes < 1 ||
        modes > stride) {
        refuse(call, "basis", "has another shape");
        return 0;
    }
    const float *single = in_rows_of(call, "rough", rough, basis->shape[0], stride);
    if (!single)
        return 0;
    *to = (Modes){basis->buf, single, basis->shape[0] / 2, modes, stride};
    return 1;
}

static PyObject *py_grow(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Call call = {.function = "grow"};
    Modes modes;
    Py_buffer *base, *coefficients, *start, *ridge, *points, *neighbours, *change;
    Growth growth;
    double turns;
    if (!takes(&call, count, 12) ||
        !(ridge = take(&call, "ridge", arguments[5], 'd', PyBUF_C_CONTIGUOUS, 1, (Py_ssize_t)ANY)) ||
        !take_modes(&call, arguments[0], arguments[1], ridge->shape[0], &modes) ||
        !(base = take(&call, "base", arguments[2], 'd', PyBUF_C_CONTIGUOUS, 1, (Py_ssize_t)(2 * modes.markers))) ||
        !(coefficients = take(&call, "coefficients", arguments[3], 'd', PyBUF_C_CONTIGUOUS, 1, ridge->shape[0])) ||
        !(start = take(&call, "start", arguments[4], 'd', PyBUF_C_CONTIGUOUS, 1, ridge->shape[0])) ||
        !(points = take_points(&call, "points", arguments[6])) ||
        !(neighbours = take(&call, "neighbours", arguments[7], 'q', PyBUF_C_CONTIGUOUS, 2, (Py_ssize_t)modes.markers,
                            (Py_ssize_t)ANY)) ||
        !number(&call, "reach_px", arguments[8], 1e-9, LARGEST, &growth.reach_px) ||
        !number(&call, "onward", arguments[9], 0.0, 1000.0, &growth.onward) ||
        !number(&call, "turns", arguments[10], 0.0, 1000.0, &turns) ||
        !(change = take(&call, "change", arguments[11], 'd', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 1, ridge->shape[0])))
        return finish(&call, NULL);
    growth.turns = (int)turns;
    const int64_t *other = neighbours->buf;
    for (Py_ssize_t i = 0; i < modes.markers * neighbours->shape[1]; i++)
        if (other[i] < 0 || other[i] > modes.markers) {
            refuse(&call, "neighbours", "are out of range");
            return finish(&call, NULL);
        }
    Buckets buckets;
    int done = fill_buckets(&buckets, points->buf, points->shape[0]);
    if (done) {
        done = grow(&modes, base->buf, coefficients->buf, start->buf, ridge->buf, &buckets, points->shape[0], other,
                    neighbours->shape[1], growth, change->buf);
        free_buckets(&buckets);
    }
    if (done < 0) {
        refuse(&call, "ridge", "leaves moments that are not positive definite");
        return finish(&call, NULL);
    }
    return ended(&call, done);
}

static PyObject *py_settle(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Call call = {.function = "settle"};
    Modes modes;
    Py_buffer *base, *start, *ridge, *points, *coefficients;
    Settling settling;
    double turns;
    if (!takes(&call, count, 11) ||
        !(ridge = take(&call, "ridge", arguments[4], 'd', PyBUF_C_CONTIGUOUS, 1, (Py_ssize_t)ANY)) ||
        !take_modes(&call, arguments[0], arguments[1], ridge->shape[0], &modes) ||
        !(base = take(&call, "base", arguments[2], 'd', PyBUF_C_CONTIGUOUS, 1, (Py_ssize_t)(2 * modes.markers))) ||
        !(start = take(&call, "start", arguments[3], 'd', PyBUF_C_CONTIGUOUS, 1, ridge->shape[0])) ||
        !(points = take_points(&call, "points", arguments[5])) ||
        !number(&call, "reach_px", arguments[6], 1e-9, LARGEST, &settling.reach_px) ||
        !number(&call, "least_reach_px", arguments[7], 1e-9, LARGEST, &settling.least_reach_px) ||
        !number(&call, "settled_px", arguments[8], 0.0, LARGEST, &settling.settled_px) ||
        !number(&call, "turns", arguments[9], 0.0, 1000.0, &turns) ||
        !(coefficients = take(&call, "coefficients", arguments[10], 'd', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 1,
                              ridge->shape[0])))
        return finish(&call, NULL);
    settling.turns = (int)turns;
    Buckets buckets;
    int done = fill_buckets(&buckets, points->buf, points->shape[0]);
    if (done) {
        done = settle(&modes, base->buf, start->buf, ridge->buf, &buckets, points->shape[0], settling,
                      coefficients->buf);
        free_buckets(&buckets);
    }
    return ended(&call, done);
}

/* Of each `step` of the markers, as there are `squares`. */
static PyObject *py_squares_apart(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Call call = {.function = "squares_apart"};
    Modes modes;
    Py_buffer *base, *coefficients, *points, *squares;
    double step;
    if (!takes(&call, count, 7) ||
        !(coefficients = take(&call, "coefficients", arguments[3], 'd', PyBUF_C_CONTIGUOUS, 1, (Py_ssize_t)ANY)) ||
        !take_modes(&call, arguments[0], arguments[1], coefficients->shape[0], &modes) ||
        !(base = take(&call, "base", arguments[2], 'd', PyBUF_C_CONTIGUOUS, 1, (Py_ssize_t)(2 * modes.markers))) ||
        !(points = take_points(&call, "points", arguments[4])) ||
        !number(&call, "step", arguments[5], 1.0, 1000.0, &step) ||
        !(squares = take(&call, "squares", arguments[6], 'd', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 1,
                         (modes.markers - 1) / (Py_ssize_t)step + 1)))
        return finish(&call, NULL);
    Buckets buckets;
    int done = fill_buckets(&buckets, points->buf, points->shape[0]);
    if (done) {
        squares_apart(&modes, base->buf, coefficients->buf, (ptrdiff_t)step, &buckets, squares->buf);
        free_buckets(&buckets);
    }
    return ended(&call, done);
}

static PyObject *py_find_markers(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Call call = {.function = "find_markers"};
    Modes modes;
    Py_buffer *base, *coefficients, *points, *view, *positions, *seen;
    if (!takes(&call, count, 8) ||
        !(coefficients = take(&call, "coefficients", arguments[3], 'd', PyBUF_C_CONTIGUOUS, 1, (Py_ssize_t)ANY)) ||
        !take_modes(&call, arguments[0], arguments[1], coefficients->shape[0], &modes) ||
        !(base = take(&call, "base", arguments[2], 'd', PyBUF_C_CONTIGUOUS, 1, (Py_ssize_t)(2 * modes.markers))) ||
        !(points = take_points(&call, "points", arguments[4])) ||
        !(view = take(&call, "view", arguments[5], 'd', PyBUF_C_CONTIGUOUS, 1, (Py_ssize_t)5)) ||
        !(positions = take(&call, "positions", arguments[6], 'd', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 2,
                           (Py_ssize_t)modes.markers, (Py_ssize_t)2)) ||
        !(seen = take(&call, "seen", arguments[7], '?', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 1,
                      (Py_ssize_t)modes.markers)))
        return finish(&call, NULL);
    const double *limit = view->buf;
    Buckets buckets;
    Tally tally;
    int done = fill_buckets(&buckets, points->buf, points->shape[0]);
    if (done) {
        done = find_markers(&modes, base->buf, coefficients->buf, &buckets, points->shape[0],
                            (View){limit[0], limit[1], limit[2], limit[3], limit[4]}, positions->buf, seen->buf, &tally);
        free_buckets(&buckets);
    }
    if (!done)
        return ended(&call, 0);
    return finish(&call, Py_BuildValue("nnnd", (Py_ssize_t)tally.found, (Py_ssize_t)tally.among,
                                       (Py_ssize_t)tally.expected, tally.squares));
}

static PyObject *py_density(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Call call = {.function = "density"};
    Py_buffer *points, *weights, *low, *density;
    double cell_px;
    if (!takes(&call, count, 5) ||
        !(points = take(&call, "centres", arguments[0], 'd', PyBUF_C_CONTIGUOUS, 3, (Py_ssize_t)ANY, (Py_ssize_t)ANY,
                        (Py_ssize_t)2)) ||
        !(weights = take(&call, "weights", arguments[1], 'd', PyBUF_C_CONTIGUOUS, 2, points->shape[0],
                         points->shape[1])) ||
        !(low = take(&call, "low", arguments[2], 'd', PyBUF_C_CONTIGUOUS, 1, (Py_ssize_t)2)) ||
        !number(&call, "cell_px", arguments[3], 1e-6, LARGEST, &cell_px) ||
        !(density = take(&call, "density", arguments[4], 'd', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 3, points->shape[0],
                         (Py_ssize_t)ANY, (Py_ssize_t)ANY)))
        return finish(&call, NULL);
    Py_ssize_t grid = density->shape[1], each = points->shape[1];
    if (density->shape[2] != grid) {
        refuse(&call, "density", "is not square");
        return finish(&call, NULL);
    }
    for (Py_ssize_t i = 0; i < points->shape[0]; i++)
        add_density((const double *)points->buf + 2 * each * i, (const double *)weights->buf + each * i, each, low->buf,
                    cell_px, grid, (double *)density->buf + grid * grid * i);
    return ended(&call, 1);
}

static PyObject *py_affine(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Call call = {.function = "affine"};
    Py_buffer *weight, *bias, *x, *to;
    if (!takes(&call, count, 4) ||
        !(weight = take(&call, "weight", arguments[0], 'f', PyBUF_C_CONTIGUOUS, 2, (Py_ssize_t)ANY, (Py_ssize_t)ANY)) ||
        !(bias = take(&call, "bias", arguments[1], 'f', PyBUF_C_CONTIGUOUS, 1, weight->shape[1])) ||
        !(x = take(&call, "x", arguments[2], 'f', PyBUF_C_CONTIGUOUS, 1, weight->shape[0])) ||
        !(to = take(&call, "to", arguments[3], 'f', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 1, weight->shape[1])))
        return finish(&call, NULL);
    affine(weight->buf, bias->buf, x->buf, weight->shape[0], weight->shape[1], to->buf);
    return ended(&call, 1);
}

static PyObject *py_reads_halves(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    return PyBool_FromLong(reads_halves());
}

/* Layers of the same size, each with its own input. */
static PyObject *py_affine_of_halves(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Call call = {.function = "affine_of_halves"};
    Py_buffer *weight, *bias, *x, *to;
    if (!takes(&call, count, 4) ||
        !(bias = take(&call, "bias", arguments[1], 'f', PyBUF_C_CONTIGUOUS, 2, (Py_ssize_t)ANY, (Py_ssize_t)ANY)) ||
        !(x = take(&call, "x", arguments[2], 'f', PyBUF_C_CONTIGUOUS, 2, bias->shape[0], (Py_ssize_t)ANY)) ||
        !(weight = take(&call, "weight", arguments[0], 'e', PyBUF_C_CONTIGUOUS, 4, bias->shape[0],
                        (x->shape[1] + 7) / 8, bias->shape[1] / 8, (Py_ssize_t)64)) ||
        !(to = take(&call, "to", arguments[3], 'f', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 2, bias->shape[0],
                    bias->shape[1])))
        return finish(&call, NULL);
    Py_ssize_t layers = bias->shape[0], outputs = bias->shape[1], inputs = x->shape[1];
    if (outputs % 8 || !reads_halves()) {
        refuse(&call, "bias", "is no multiple of eight, or the processor does not read half precision");
        return finish(&call, NULL);
    }
    for (Py_ssize_t i = 0; i < layers; i++)
        affine_of_halves((const uint16_t *)weight->buf + i * (weight->len / 2 / layers), (const float *)bias->buf + i * outputs,
                         (const float *)x->buf + i * inputs, inputs, outputs, (float *)to->buf + i * outputs);
    return ended(&call, 1);
}

static PyObject *py_bytes_apart(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Call call = {.function = "bytes_apart"};
    Py_buffer *rows, *one, *apart;
    if (!takes(&call, count, 3) ||
        !(rows = take(&call, "rows", arguments[0], 'B', PyBUF_C_CONTIGUOUS, 2, (Py_ssize_t)ANY, (Py_ssize_t)ANY)) ||
        !(one = take(&call, "one", arguments[1], 'B', PyBUF_C_CONTIGUOUS, 1, rows->shape[1])) ||
        !(apart = take(&call, "apart", arguments[2], 'i', PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, 1, rows->shape[0])))
        return finish(&call, NULL);
    if (rows->shape[1] > 32768) {
        refuse(&call, "rows", "are longer than 32768");
        return finish(&call, NULL);
    }
    bytes_apart(rows->buf, rows->shape[0], one->buf, rows->shape[1], apart->buf);
    return ended(&call, 1);
}

#define FAST(name) {#name, (PyCFunction)(void (*)(void))py_##name, METH_FASTCALL, NULL}

static PyMethodDef METHODS[] = {FAST(median_5), FAST(threshold), FAST(shrink),  FAST(area_means),  FAST(discs),  FAST(pair), FAST(grow),
                                FAST(settle), FAST(squares_apart), FAST(find_markers), FAST(density),   FAST(bytes_apart), FAST(affine), FAST(reads_halves), FAST(affine_of_halves), FAST(mean_shift), FAST(follow), FAST(first_block), FAST(block_changes), FAST(measure_field), {NULL, NULL, 0, NULL}};

static struct PyModuleDef MODULE = {PyModuleDef_HEAD_INIT, "touchcell.perception._kernelsc",
                                    "Compiled kernels of touchcell.perception.kernels.", -1, METHODS};

PyMODINIT_FUNC PyInit__kernelsc(void)
{
    PyObject *errors = PyImport_ImportModule("touchcell.perception.errors");
    if (!errors)
        return NULL;
    array_error = PyObject_GetAttrString(errors, "ArrayError");
    Py_DECREF(errors);
    return array_error ? PyModule_Create(&MODULE) : NULL;
}
