/* Python's door to the compiled kernels: takes numpy arrays, checks them, runs a kernel over the batch.
 *
 * An argument that is not at once a clean float64 array goes to geometry/_check.py, which converts it or raises
 * GeometryError; so both backends accept and refuse the same things, with the same words.
 */
#define PY_SSIZE_T_CLEAN
#define NPY_NO_DEPRECATED_API NPY_2_0_API_VERSION
#include <Python.h>
#include <numpy/arrayobject.h>

#include "_se3_kernels.h"

static PyObject *check_twist, *check_pose, *check_pose_pair;

typedef struct {
    const char *name, *argument;
    PyObject **check;
    int (*is_valid)(const double *);
    int rank_in;
    npy_intp core_in[2];
    void (*kernel)(const double *, double *);
    int rank_out;
    npy_intp core_out[2];
} Operation;

static const Operation EXP = {"exp", "xi", &check_twist, is_twist, 1, {6, 1}, exp_kernel, 2, {4, 4}};
static const Operation LOG = {"log", "T", &check_pose, is_pose, 2, {4, 4}, log_kernel, 1, {6, 1}};
static const Operation INVERSE = {"inverse", "T", &check_pose, is_pose, 2, {4, 4}, inverse_kernel, 2, {4, 4}};
static const Operation ADJOINT = {"adjoint", "T", &check_pose, is_pose, 2, {4, 4}, adjoint_kernel, 2, {6, 6}};
static const Operation LEFT_JACOBIAN = {
    "left_jacobian", "xi", &check_twist, is_twist, 1, {6, 1}, left_jacobian_kernel, 2, {6, 6}};
static const Operation LEFT_JACOBIAN_INVERSE = {
    "left_jacobian_inverse", "xi", &check_twist, is_twist, 1, {6, 1}, left_jacobian_inverse_kernel, 2, {6, 6}};

/* Whether the kernels can read it in place: float64, contiguous, (..., core). */
static int is_readable(PyObject *value, int rank, const npy_intp *core)
{
    if (!PyArray_CheckExact(value))
        return 0;
    PyArrayObject *array = (PyArrayObject *)value;
    int ndim = PyArray_NDIM(array);
    if (PyArray_TYPE(array) != NPY_DOUBLE || !PyArray_ISCARRAY_RO(array) || ndim < rank)
        return 0;
    for (int i = 0; i < rank; i++)
        if (PyArray_DIM(array, ndim - rank + i) != core[i])
            return 0;
    return 1;
}

static PyObject *new_array(PyArrayObject *like, int rank_in, int rank_out, const npy_intp *core_out)
{
    npy_intp shape[NPY_MAXDIMS];
    int leading = PyArray_NDIM(like) - rank_in;
    if (leading + rank_out > NPY_MAXDIMS) {
        PyErr_SetString(PyExc_ValueError, "too many dimensions");
        return NULL;
    }
    for (int i = 0; i < leading; i++)
        shape[i] = PyArray_DIM(like, i);
    for (int i = 0; i < rank_out; i++)
        shape[leading + i] = core_out[i];
    return PyArray_SimpleNew(leading + rank_out, shape, NPY_DOUBLE);
}

/* Run over the batch. NULL without an exception: an element is not valid. */
static PyObject *run(const Operation *operation, PyArrayObject *in, int trusted)
{
    npy_intp size_in = operation->core_in[0] * operation->core_in[1];
    npy_intp size_out = operation->core_out[0] * operation->core_out[1];
    npy_intp count = PyArray_SIZE(in) / size_in;
    PyObject *out = new_array(in, operation->rank_in, operation->rank_out, operation->core_out);
    if (!out)
        return NULL;
    const double *from = PyArray_DATA(in);
    double *to = PyArray_DATA((PyArrayObject *)out);
    int valid = 1;
    NPY_BEGIN_THREADS_DEF;
    NPY_BEGIN_THREADS_THRESHOLDED(count);
    for (npy_intp i = 0; i < count && valid; i++, from += size_in, to += size_out) {
        valid = trusted || operation->is_valid(from);
        if (valid)
            operation->kernel(from, to);
    }
    NPY_END_THREADS;
    if (!valid)
        Py_CLEAR(out);
    return out;
}

static PyObject *apply(const Operation *operation, PyObject *value)
{
    if (is_readable(value, operation->rank_in, operation->core_in)) {
        PyObject *out = run(operation, (PyArrayObject *)value, 0);
        if (out || PyErr_Occurred())
            return out;
    }
    PyObject *clean = PyObject_CallFunction(*operation->check, "ssO", operation->name, operation->argument, value);
    if (!clean)
        return NULL;
    PyObject *out = run(operation, (PyArrayObject *)clean, 1);
    Py_DECREF(clean);
    return out;
}

static PyObject *py_exp(PyObject *module, PyObject *xi) { return apply(&EXP, xi); }
static PyObject *py_log(PyObject *module, PyObject *T) { return apply(&LOG, T); }
static PyObject *py_inverse(PyObject *module, PyObject *T) { return apply(&INVERSE, T); }
static PyObject *py_adjoint(PyObject *module, PyObject *T) { return apply(&ADJOINT, T); }
static PyObject *py_left_jacobian(PyObject *module, PyObject *xi) { return apply(&LEFT_JACOBIAN, xi); }
static PyObject *py_left_jacobian_inverse(PyObject *module, PyObject *xi) { return apply(&LEFT_JACOBIAN_INVERSE, xi); }

/* One pose, or as many as the other side has. NULL without an exception: an element is no pose. */
static PyObject *run_compose(PyArrayObject *left, PyArrayObject *right, int trusted)
{
    static const npy_intp core[2] = {4, 4};
    npy_intp step_left = PyArray_NDIM(left) > 2 ? 16 : 0, step_right = PyArray_NDIM(right) > 2 ? 16 : 0;
    PyArrayObject *longer = step_left ? left : right;
    npy_intp count = PyArray_SIZE(longer) / 16;
    PyObject *out = new_array(longer, 2, 2, core);
    if (!out)
        return NULL;
    const double *a = PyArray_DATA(left), *b = PyArray_DATA(right);
    double *to = PyArray_DATA((PyArrayObject *)out);
    int valid = 1;
    NPY_BEGIN_THREADS_DEF;
    NPY_BEGIN_THREADS_THRESHOLDED(count);
    for (npy_intp i = 0; i < count && valid; i++, a += step_left, b += step_right, to += 16) {
        valid = trusted || (is_pose(a) && is_pose(b));
        if (valid)
            compose_kernel(a, b, to);
    }
    NPY_END_THREADS;
    if (!valid)
        Py_CLEAR(out);
    return out;
}

static PyObject *py_compose(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    static const npy_intp core[2] = {4, 4};
    if (count != 2) {
        PyErr_SetString(PyExc_TypeError, "compose takes two poses");
        return NULL;
    }
    if (is_readable(arguments[0], 2, core) && is_readable(arguments[1], 2, core)) {
        PyArrayObject *left = (PyArrayObject *)arguments[0], *right = (PyArrayObject *)arguments[1];
        if (PyArray_NDIM(left) == 2 || PyArray_NDIM(right) == 2 || PyArray_SAMESHAPE(left, right)) {
            PyObject *out = run_compose(left, right, 0);
            if (out || PyErr_Occurred())
                return out;
        }
    }
    PyObject *pair = PyObject_CallFunction(
        check_pose_pair, "ssOsO", "compose", "T_a_b", arguments[0], "T_b_c", arguments[1]);
    PyObject *left, *right, *out = NULL;
    if (pair && PyArg_ParseTuple(pair, "OO", &left, &right))
        out = run_compose((PyArrayObject *)left, (PyArrayObject *)right, 1);
    Py_XDECREF(pair);
    return out;
}

static PyMethodDef METHODS[] = {
    {"exp", py_exp, METH_O, NULL},
    {"log", py_log, METH_O, NULL},
    {"compose", (PyCFunction)(void (*)(void))py_compose, METH_FASTCALL, NULL},
    {"inverse", py_inverse, METH_O, NULL},
    {"adjoint", py_adjoint, METH_O, NULL},
    {"left_jacobian", py_left_jacobian, METH_O, NULL},
    {"left_jacobian_inverse", py_left_jacobian_inverse, METH_O, NULL},
    {NULL, NULL, 0, NULL}};

static struct PyModuleDef MODULE = {
    PyModuleDef_HEAD_INIT, "geometry._se3c", "Compiled kernels of geometry.se3 and geometry.gaussian.", -1, METHODS};

PyMODINIT_FUNC PyInit__se3c(void)
{
    import_array();
    PyObject *check = PyImport_ImportModule("geometry._check");
    if (!check)
        return NULL;
    check_twist = PyObject_GetAttrString(check, "twist");
    check_pose = PyObject_GetAttrString(check, "pose");
    check_pose_pair = PyObject_GetAttrString(check, "pose_pair");
    Py_DECREF(check);
    if (!check_twist || !check_pose || !check_pose_pair)
        return NULL;
    return PyModule_Create(&MODULE);
}
