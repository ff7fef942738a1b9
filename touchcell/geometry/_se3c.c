/* Python's door to the compiled kernels: takes numpy arrays, checks them, runs a kernel over the batch.
 *
 * An argument that is not at once a clean float64 array goes to touchcell/geometry/_check.py, which converts it or raises
 * GeometryError; so both backends accept and refuse the same things, with the same words.
 */
#define PY_SSIZE_T_CLEAN
#define NPY_NO_DEPRECATED_API NPY_2_0_API_VERSION
#include <Python.h>
#include <numpy/arrayobject.h>

#include "_gaussian_kernels.h"
#include "_se3_kernels.h"

static const npy_intp POSE[2] = {4, 4}, COVARIANCE[2] = {6, 6};

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
static const Operation FROM_EULER = {
    "from_euler_mm_deg", "pose", &check_twist, is_twist, 1, {6, 1}, from_euler_kernel, 2, {4, 4}};
static const Operation TO_EULER = {
    "to_euler_mm_deg", "T", &check_pose, is_pose, 2, {4, 4}, to_euler_kernel, 1, {6, 1}};
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
static PyObject *py_from_euler(PyObject *module, PyObject *pose) { return apply(&FROM_EULER, pose); }
static PyObject *py_to_euler(PyObject *module, PyObject *T) { return apply(&TO_EULER, T); }
static PyObject *py_adjoint(PyObject *module, PyObject *T) { return apply(&ADJOINT, T); }
static PyObject *py_left_jacobian(PyObject *module, PyObject *xi) { return apply(&LEFT_JACOBIAN, xi); }
static PyObject *py_left_jacobian_inverse(PyObject *module, PyObject *xi) { return apply(&LEFT_JACOBIAN_INVERSE, xi); }

/* One pose, or as many as the other side has. NULL without an exception: an element is no pose. */
static PyObject *run_compose(PyArrayObject *left, PyArrayObject *right, int trusted)
{
    npy_intp step_left = PyArray_NDIM(left) > 2 ? 16 : 0, step_right = PyArray_NDIM(right) > 2 ? 16 : 0;
    PyArrayObject *longer = step_left ? left : right;
    npy_intp count = PyArray_SIZE(longer) / 16;
    PyObject *out = new_array(longer, 2, 2, POSE);
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
    if (count != 2) {
        PyErr_SetString(PyExc_TypeError, "compose takes two poses");
        return NULL;
    }
    if (is_readable(arguments[0], 2, POSE) && is_readable(arguments[1], 2, POSE)) {
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

static const double *readable_matrix(PyObject *value, const npy_intp *core)
{
    if (!is_readable(value, 2, core) || PyArray_NDIM((PyArrayObject *)value) != 2)
        return NULL;
    return PyArray_DATA((PyArrayObject *)value);
}

/* A mean and a covariance to return together. */
typedef struct {
    PyObject *mean, *covariance;
    double *T, *S;
} Pair;

static int new_pair(Pair *pair)
{
    pair->mean = PyArray_SimpleNew(2, POSE, NPY_DOUBLE);
    pair->covariance = PyArray_SimpleNew(2, COVARIANCE, NPY_DOUBLE);
    if (!pair->mean || !pair->covariance) {
        Py_XDECREF(pair->mean);
        Py_XDECREF(pair->covariance);
        return 0;
    }
    pair->T = PyArray_DATA((PyArrayObject *)pair->mean);
    pair->S = PyArray_DATA((PyArrayObject *)pair->covariance);
    return 1;
}

static PyObject *refuse(Pair *pair)
{
    Py_DECREF(pair->mean);
    Py_DECREF(pair->covariance);
    Py_RETURN_NONE;
}

static PyObject *py_admit(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    if (count != 2) {
        PyErr_SetString(PyExc_TypeError, "admit takes a mean and a covariance");
        return NULL;
    }
    const double *T = readable_matrix(arguments[0], POSE), *S = readable_matrix(arguments[1], COVARIANCE);
    double factor[36];
    Pair pair;
    if (!T || !S || !is_pose(T))
        Py_RETURN_NONE;
    if (!new_pair(&pair))
        return NULL;
    if (!symmetric(S, pair.S) || !cholesky(pair.S, factor))
        return refuse(&pair);
    memcpy(pair.T, T, 16 * sizeof(double));
    PyArray_CLEARFLAGS((PyArrayObject *)pair.mean, NPY_ARRAY_WRITEABLE);
    PyArray_CLEARFLAGS((PyArrayObject *)pair.covariance, NPY_ARRAY_WRITEABLE);
    return Py_BuildValue("NN", pair.mean, pair.covariance);
}

static PyObject *py_predict(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    if (count != 4) {
        PyErr_SetString(PyExc_TypeError, "predict takes U, T, S and Q");
        return NULL;
    }
    const double *U = readable_matrix(arguments[0], POSE), *T = readable_matrix(arguments[1], POSE);
    const double *S = readable_matrix(arguments[2], COVARIANCE), *Q = readable_matrix(arguments[3], COVARIANCE);
    Pair pair;
    if (!U || !T || !S || !(Q || arguments[3] == Py_None) || !is_pose(U))
        Py_RETURN_NONE;
    if (!new_pair(&pair))
        return NULL;
    if (!predict_kernel(U, T, S, Q, pair.T, pair.S))
        return refuse(&pair);
    return Py_BuildValue("NN", pair.mean, pair.covariance);
}

static PyObject *py_fuse(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    if (count != 6) {
        PyErr_SetString(PyExc_TypeError, "fuse takes T1, S1, T2, S2, tolerance and max_iterations");
        return NULL;
    }
    const double *T1 = readable_matrix(arguments[0], POSE), *S1 = readable_matrix(arguments[1], COVARIANCE);
    const double *T2 = readable_matrix(arguments[2], POSE), *S2 = readable_matrix(arguments[3], COVARIANCE);
    double tolerance = PyFloat_AsDouble(arguments[4]), nis;
    long max_iterations = PyLong_AsLong(arguments[5]);
    int iterations;
    Pair pair;
    if (PyErr_Occurred())
        return NULL;
    if (!T1 || !S1 || !T2 || !S2)
        Py_RETURN_NONE;
    if (!new_pair(&pair))
        return NULL;
    if (!fuse_kernel(T1, S1, T2, S2, tolerance, (int)max_iterations, pair.T, pair.S, &iterations, &nis))
        return refuse(&pair);
    return Py_BuildValue("NNid", pair.mean, pair.covariance, iterations, nis);
}

static PyMethodDef METHODS[] = {
    {"exp", py_exp, METH_O, NULL},
    {"log", py_log, METH_O, NULL},
    {"compose", (PyCFunction)(void (*)(void))py_compose, METH_FASTCALL, NULL},
    {"inverse", py_inverse, METH_O, NULL},
    {"adjoint", py_adjoint, METH_O, NULL},
    {"from_euler_mm_deg", py_from_euler, METH_O, NULL},
    {"to_euler_mm_deg", py_to_euler, METH_O, NULL},
    {"left_jacobian", py_left_jacobian, METH_O, NULL},
    {"left_jacobian_inverse", py_left_jacobian_inverse, METH_O, NULL},
    {"admit", (PyCFunction)(void (*)(void))py_admit, METH_FASTCALL, NULL},
    {"predict", (PyCFunction)(void (*)(void))py_predict, METH_FASTCALL, NULL},
    {"fuse", (PyCFunction)(void (*)(void))py_fuse, METH_FASTCALL, NULL},
    {NULL, NULL, 0, NULL}};

static struct PyModuleDef MODULE = {
    PyModuleDef_HEAD_INIT, "touchcell.geometry._se3c", "Compiled kernels of touchcell.geometry.se3 and touchcell.geometry.gaussian.", -1, METHODS};

PyMODINIT_FUNC PyInit__se3c(void)
{
    import_array();
    PyObject *check = PyImport_ImportModule("touchcell.geometry._check");
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
