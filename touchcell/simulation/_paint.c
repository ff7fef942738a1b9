/* What render.py does to every pixel of a simulated frame, in one pass instead of a call per disc and per operation. */
#define PY_SSIZE_T_CLEAN
#define NPY_NO_DEPRECATED_API NPY_2_0_API_VERSION
#include <Python.h>
#include <math.h>
#include <numpy/arrayobject.h>

/* Two versions of a function where the processor is asked at load time which one it can run. */
#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
#define WIDE_VECTORS __attribute__((target_clones("avx2", "default")))
#else
#define WIDE_VECTORS
#endif

static PyArrayObject *array_of(PyObject *value, int type, int rank)
{
    if (!PyArray_Check(value))
        return NULL;
    PyArrayObject *array = (PyArrayObject *)value;
    return PyArray_TYPE(array) == type && PyArray_NDIM(array) == rank && PyArray_ISCARRAY_RO(array) ? array : NULL;
}

/* Stamps into a picture, each pixel as bright as the brightest stamp on it. */
static PyObject *paint(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    PyArrayObject *image = count == 3 ? array_of(arguments[0], NPY_UBYTE, 2) : NULL;
    PyArrayObject *centres = count == 3 ? array_of(arguments[1], NPY_DOUBLE, 2) : NULL;
    PyArrayObject *stamps = count == 3 ? array_of(arguments[2], NPY_UBYTE, 4) : NULL;
    if (!image || !centres || !stamps || !PyArray_ISWRITEABLE(image) || PyArray_DIM(centres, 1) != 2 ||
        PyArray_DIM(stamps, 0) != PyArray_DIM(stamps, 1) || PyArray_DIM(stamps, 2) != PyArray_DIM(stamps, 3) ||
        PyArray_DIM(stamps, 0) < 1) {
        PyErr_SetString(PyExc_TypeError, "paint takes a picture (h, w), centres (n, 2) and stamps (p, p, s, s), p > 0");
        return NULL;
    }
    npy_intp height = PyArray_DIM(image, 0), width = PyArray_DIM(image, 1);
    npy_intp phases = PyArray_DIM(stamps, 0), size = PyArray_DIM(stamps, 2), reach = size / 2;
    unsigned char *pixels = PyArray_DATA(image);
    const unsigned char *first = PyArray_DATA(stamps);
    const double *centre = PyArray_DATA(centres);
    for (npy_intp i = 0; i < PyArray_DIM(centres, 0); i++) {
        npy_intp corner[2], phase[2];
        int seen = 1;
        for (int axis = 0; axis < 2; axis++) {
            double at = centre[2 * i + axis], whole = floor(at + 0.5);
            double extent = (double)(axis == 0 ? width : height);
            /* So written, what is not a number is not seen either. */
            seen = seen && whole + reach >= 0.0 && whole - reach < extent;
            if (!seen)
                break;
            corner[axis] = (npy_intp)whole - reach;
            phase[axis] = (npy_intp)((at - whole + 0.5) * (double)phases);
            if (phase[axis] >= phases)
                phase[axis] = phases - 1;
        }
        if (!seen)
            continue;
        const unsigned char *stamp = first + (phase[1] * phases + phase[0]) * size * size;
        npy_intp top = corner[1] < 0 ? -corner[1] : 0, left = corner[0] < 0 ? -corner[0] : 0;
        npy_intp bottom = corner[1] + size > height ? height - corner[1] : size;
        npy_intp right = corner[0] + size > width ? width - corner[0] : size;
        for (npy_intp v = top; v < bottom; v++) {
            unsigned char *row = pixels + (corner[1] + v) * width + corner[0];
            const unsigned char *mark = stamp + v * size;
            for (npy_intp u = left; u < right; u++)
                row[u] = mark[u] > row[u] ? mark[u] : row[u];
        }
    }
    Py_RETURN_NONE;
}

/* Of 16 bits throughout, so that a compiler can do many at once. */
static inline unsigned char lit(unsigned char cover, unsigned char contrast, unsigned char background, signed char grain)
{
    /* Rounded division of up to 255 * 255 by 255, without dividing. */
    unsigned short x = (unsigned short)(cover * contrast + 128);
    short value = (short)(((unsigned short)(x + (x >> 8)) >> 8) + background);
    value = value > 255 ? 255 : value;
    value = (short)(value + grain);
    value = value < 0 ? 0 : value;
    return (unsigned char)(value > 255 ? 255 : value);
}

WIDE_VECTORS static void lit_row(const unsigned char *restrict cover, const unsigned char *restrict contrast,
                                 const unsigned char *restrict background, const signed char *restrict grain,
                                 npy_intp width, unsigned char *restrict to)
{
    for (npy_intp u = 0; u < width; u++)
        to[u] = lit(cover[u], contrast[u], background[u], grain[u]);
}

/* background + contrast * cover / 255, rounded and clipped; then the window of the noise at (top, left), clipped again. */
static PyObject *expose(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    PyArrayObject *layers[3] = {NULL, NULL, NULL}, *noise = count == 6 ? array_of(arguments[3], NPY_BYTE, 2) : NULL;
    for (int i = 0; i < 3; i++)
        layers[i] = count == 6 ? array_of(arguments[i], NPY_UBYTE, 2) : NULL;
    if (!layers[0] || !layers[1] || !layers[2] || !noise || !PyArray_SAMESHAPE(layers[0], layers[1]) ||
        !PyArray_SAMESHAPE(layers[0], layers[2])) {
        PyErr_SetString(PyExc_TypeError, "expose takes cover, contrast and background of one shape, noise, top and left");
        return NULL;
    }
    long top = PyLong_AsLong(arguments[4]), left = PyLong_AsLong(arguments[5]);
    if (PyErr_Occurred())
        return NULL;
    npy_intp height = PyArray_DIM(layers[0], 0), width = PyArray_DIM(layers[0], 1), stride = PyArray_DIM(noise, 1);
    /* So written, no sum can overflow. */
    if (top < 0 || left < 0 || top > PyArray_DIM(noise, 0) - height || left > stride - width) {
        PyErr_SetString(PyExc_ValueError, "the window leaves the noise");
        return NULL;
    }
    PyObject *frame = PyArray_SimpleNew(2, PyArray_DIMS(layers[0]), NPY_UBYTE);
    if (!frame)
        return NULL;
    const unsigned char *cover = PyArray_DATA(layers[0]), *contrast = PyArray_DATA(layers[1]);
    const unsigned char *background = PyArray_DATA(layers[2]);
    const signed char *grain = (const signed char *)PyArray_DATA(noise) + top * stride + left;
    unsigned char *pixels = PyArray_DATA((PyArrayObject *)frame);
    for (npy_intp v = 0; v < height; v++) {
        npy_intp at = v * width;
        lit_row(cover + at, contrast + at, background + at, grain + v * stride, width, pixels + at);
    }
    return frame;
}

static PyMethodDef METHODS[] = {
    {"paint", (PyCFunction)(void (*)(void))paint, METH_FASTCALL, NULL},
    {"expose", (PyCFunction)(void (*)(void))expose, METH_FASTCALL, NULL},
    {NULL, NULL, 0, NULL}};

static struct PyModuleDef MODULE = {
    PyModuleDef_HEAD_INIT, "touchcell.simulation._paint", "Compiled kernels of touchcell.simulation.render.", -1, METHODS};

PyMODINIT_FUNC PyInit__paint(void)
{
    import_array();
    return PyModule_Create(&MODULE);
}
