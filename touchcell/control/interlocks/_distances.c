/* Distances of capsules from each other and from boxes: the formulas of collision.py, which says where they are from.
 *
 * What is not finite comes out as NaN, as in the plain ones.
 */
#define PY_SSIZE_T_CLEAN
#define NPY_NO_DEPRECATED_API NPY_2_0_API_VERSION
#include <Python.h>
#include <math.h>
#include <numpy/arrayobject.h>

#define TINY 1e-30
#define KNOTS 8

typedef struct {
    const double *data;
    npy_intp count;
} Doubles;

typedef struct {
    const npy_intp *data;
    npy_intp count;
} Indices;

static double clamped(double x, double low, double high) { return x < low ? low : x > high ? high : x; }

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static double between_segments(const double *a0, const double *a1, const double *b0, const double *b1)
{
    double u[3], v[3], w[3], gap[3];
    for (int i = 0; i < 3; i++) {
        u[i] = a1[i] - a0[i];
        v[i] = b1[i] - b0[i];
        w[i] = a0[i] - b0[i];
    }
    double uu = dot(u, u), uv = dot(u, v), uw = dot(u, w), vv = dot(v, v), vw = dot(v, w);
    double slant = uu * vv - uv * uv;
    /* Along parallel lines all points are equally near. */
    double s = slant > 1e-12 * uu * vv ? clamped((uv * vw - vv * uw) / fmax(slant, TINY), 0.0, 1.0) : 0.0;
    double t = clamped((uv * s + vw) / fmax(vv, TINY), 0.0, 1.0);
    s = clamped((uv * t - uw) / fmax(uu, TINY), 0.0, 1.0);
    for (int i = 0; i < 3; i++)
        gap[i] = w[i] + s * u[i] - t * v[i];
    return sqrt(dot(gap, gap));
}

/* From the box of half sides `half` around the origin to p + share * d; the vector goes to `off`. */
static void outside(const double *p, const double *d, double share, const double *half, double *off)
{
    for (int i = 0; i < 3; i++) {
        double at = p[i] + share * d[i];
        off[i] = at - clamped(at, -half[i], half[i]);
    }
}

static double from_box(const double *a0, const double *a1, const double *T, const double *half)
{
    double p[3], d[3], off[3], knots[KNOTS] = {0.0}, slopes[KNOTS];
    for (int j = 0; j < 3; j++) {
        p[j] = d[j] = 0.0;
        for (int i = 0; i < 3; i++) {
            p[j] += T[4 * i + j] * (a0[i] - T[4 * i + 3]);
            d[j] += T[4 * i + j] * (a1[i] - a0[i]);
        }
        double safe = fabs(d[j]) > TINY ? d[j] : 1.0;
        knots[1 + j] = clamped((half[j] - p[j]) / safe, 0.0, 1.0);
        knots[4 + j] = clamped((-half[j] - p[j]) / safe, 0.0, 1.0);
    }
    knots[KNOTS - 1] = 1.0;
    for (int i = 1; i < KNOTS; i++) {
        double knot = knots[i];
        int k = i;
        for (; k > 0 && knots[k - 1] > knot; k--)
            knots[k] = knots[k - 1];
        knots[k] = knot;
    }
    int rising = -1;
    for (int k = 0; k < KNOTS; k++) {
        outside(p, d, knots[k], half, off);
        slopes[k] = dot(off, d);
        if (rising < 0 && slopes[k] >= 0.0)
            rising = k;
    }
    double best = knots[0];
    if (slopes[KNOTS - 1] < 0.0) {
        best = 1.0;
    } else if (rising > 0) {
        double low = slopes[rising - 1], change = slopes[rising] - low;
        double share = change > 0.0 ? clamped(-low / change, 0.0, 1.0) : 0.0;
        best = knots[rising - 1] + share * (knots[rising] - knots[rising - 1]);
    }
    outside(p, d, best, half, off);
    return sqrt(dot(off, off));
}

/* The array, if it is contiguous and of the type; NULL with an exception if not. */
static PyArrayObject *readable(PyObject *value, int type)
{
    PyArrayObject *array = (PyArrayObject *)value;
    if (PyArray_CheckExact(value) && PyArray_TYPE(array) == type && PyArray_ISCARRAY_RO(array))
        return array;
    PyErr_Format(PyExc_TypeError, "not a contiguous array of %s", type == NPY_DOUBLE ? "float64" : "indices");
    return NULL;
}

static int doubles(PyObject *value, void *to)
{
    PyArrayObject *array = readable(value, NPY_DOUBLE);
    if (array)
        *(Doubles *)to = (Doubles){PyArray_DATA(array), PyArray_SIZE(array)};
    return array != NULL;
}

static int indices(PyObject *value, void *to)
{
    PyArrayObject *array = readable(value, NPY_INTP);
    if (array)
        *(Indices *)to = (Indices){PyArray_DATA(array), PyArray_SIZE(array)};
    return array != NULL;
}

static int below(Indices list, npy_intp limit)
{
    for (npy_intp k = 0; k < list.count; k++)
        if (list.data[k] < 0 || list.data[k] >= limit)
            return 0;
    return 1;
}

/* Ends of capsules in the world: (2, n, 3) from frames (f, 4, 4), the frame of each end (2, n), and it there (2, n, 3). */
static void place(Doubles T, Indices frames, Doubles ends, double *placed)
{
    for (npy_intp k = 0; k < frames.count; k++) {
        const double *pose = T.data + 16 * frames.data[k], *end = ends.data + 3 * k;
        for (int i = 0; i < 3; i++)
            placed[3 * k + i] = dot(pose + 4 * i, end) + pose[4 * i + 3];
    }
}

/* clearances(T, frames, ends, of_arms, of_boxes, radii, T_box, half): what Clearances.distances returns. */
static PyObject *clearances(PyObject *module, PyObject *arguments)
{
    Doubles T, ends, radii, boxes, half;
    Indices frames, of_arms, of_boxes;
    if (!PyArg_ParseTuple(arguments, "O&O&O&O&O&O&O&O&", doubles, &T, indices, &frames, doubles, &ends, indices,
                          &of_arms, indices, &of_boxes, doubles, &radii, doubles, &boxes, doubles, &half))
        return NULL;
    npy_intp capsules = frames.count / 2, arm_pairs = of_arms.count / 2, box_pairs = of_boxes.count / 2;
    if (ends.count != 6 * capsules || radii.count != arm_pairs + box_pairs || boxes.count != 16 * box_pairs ||
        half.count != 3 * box_pairs || T.count % 16 || !below(frames, T.count / 16) || !below(of_arms, capsules) ||
        !below((Indices){of_boxes.data, box_pairs}, capsules)) {
        PyErr_SetString(PyExc_IndexError, "frames, capsules and pairs do not belong together");
        return NULL;
    }
    npy_intp pairs = radii.count;
    PyObject *out = PyArray_SimpleNew(1, &pairs, NPY_DOUBLE);
    double *placed = PyMem_Malloc((6 * capsules + 1) * sizeof(double));
    if (!out || !placed) {
        Py_XDECREF(out);
        PyMem_Free(placed);
        return PyErr_NoMemory();
    }
    double *apart = PyArray_DATA((PyArrayObject *)out);
    const double *tail = placed, *head = placed + 3 * capsules;
    place(T, frames, ends, placed);
    for (npy_intp k = 0; k < arm_pairs; k++) {
        npy_intp i = 3 * of_arms.data[k], j = 3 * of_arms.data[arm_pairs + k];
        *apart++ = between_segments(tail + i, head + i, tail + j, head + j) - *radii.data++;
    }
    for (npy_intp k = 0; k < box_pairs; k++) {
        npy_intp i = 3 * of_boxes.data[k];
        *apart++ = from_box(tail + i, head + i, boxes.data + 16 * k, half.data + 3 * k) - *radii.data++;
    }
    PyMem_Free(placed);
    return out;
}

static PyMethodDef METHODS[] = {{"clearances", clearances, METH_VARARGS, NULL}, {NULL, NULL, 0, NULL}};

static struct PyModuleDef MODULE = {
    PyModuleDef_HEAD_INIT, "touchcell.control.interlocks._distances", "Compiled distances of collision.py.", -1, METHODS};

PyMODINIT_FUNC PyInit__distances(void)
{
    import_array();
    return PyModule_Create(&MODULE);
}
