/* Nearest point of a triangle mesh in microseconds: a hierarchy of boxes over the triangles, then a refinement on the
 * smooth surface that corner normals describe (docs/explanation/shapes.md). Memory is owned by the Tree object. */
#define PY_SSIZE_T_CLEAN
#define NPY_NO_DEPRECATED_API NPY_2_0_API_VERSION
#include <Python.h>
#include <float.h>
#include <math.h>
#include <numpy/arrayobject.h>

#define LEAF 4
#define DEPTH 64

typedef struct {
    double low[3], high[3];
    int left, right; /* children; for a leaf left is -1 */
    int first, count;
} Node;

typedef struct {
    PyObject_HEAD
    npy_intp vertex_count, face_count;
    double *vertices;      /* (n, 3) */
    int *faces;            /* (m, 3) */
    double *normals;       /* (m, 3, 3) of corners, unit */
    double *bends;         /* (m, 3, 6) of corners: shape operator xx yy zz xy xz yz, 1/m */
    int *neighbours;       /* (m, 3) across the edge from corner i to i + 1; -1 for a crease or a border */
    double *edge_normals;  /* (m, 3, 3) sum of both faces' normals */
    double *point_normals; /* (n, 3) weighted by angle */
    Node *nodes;
    int *order;
} Tree;

typedef struct {
    double squared;
    int face, feature; /* 0 inside, 1..3 edge, 4..6 corner */
    double at[3], weight[3];
} Hit;

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static void cross(const double *a, const double *b, double *c)
{
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

static int build(Tree *tree, const double *centres, int *used, int first, int count)
{
    int own = (*used)++;
    Node *node = &tree->nodes[own];
    double low[3] = {DBL_MAX, DBL_MAX, DBL_MAX}, high[3] = {-DBL_MAX, -DBL_MAX, -DBL_MAX};
    double least[3] = {DBL_MAX, DBL_MAX, DBL_MAX}, most[3] = {-DBL_MAX, -DBL_MAX, -DBL_MAX};
    for (int i = first; i < first + count; i++) {
        int face = tree->order[i];
        for (int axis = 0; axis < 3; axis++) {
            for (int corner = 0; corner < 3; corner++) {
                double x = tree->vertices[3 * tree->faces[3 * face + corner] + axis];
                low[axis] = fmin(low[axis], x);
                high[axis] = fmax(high[axis], x);
            }
            least[axis] = fmin(least[axis], centres[3 * face + axis]);
            most[axis] = fmax(most[axis], centres[3 * face + axis]);
        }
    }
    for (int axis = 0; axis < 3; axis++) {
        node->low[axis] = low[axis];
        node->high[axis] = high[axis];
    }
    node->first = first;
    node->count = count;
    node->left = node->right = -1;
    if (count <= LEAF)
        return own;
    int axis = 0;
    for (int each = 1; each < 3; each++)
        if (most[each] - least[each] > most[axis] - least[axis])
            axis = each;
    /* Quickselect to the median, so that the depth is log2 of the count whatever the mesh. */
    int lo = first, hi = first + count - 1, middle = first + count / 2, *order = tree->order;
    while (lo < hi) {
        double pivot = centres[3 * order[(lo + hi) / 2] + axis];
        int i = lo, j = hi;
        while (i <= j) {
            while (centres[3 * order[i] + axis] < pivot)
                i++;
            while (centres[3 * order[j] + axis] > pivot)
                j--;
            if (i <= j) {
                int held = order[i];
                order[i++] = order[j];
                order[j--] = held;
            }
        }
        if (middle <= j)
            hi = j;
        else if (middle >= i)
            lo = i;
        else
            break;
    }
    int left = build(tree, centres, used, first, middle - first);
    int right = build(tree, centres, used, middle, first + count - middle);
    tree->nodes[own].left = left;
    tree->nodes[own].right = right;
    return own;
}

/* Nearest point of a triangle by its Voronoi regions (Ericson, Real-Time Collision Detection, 5.1.5). */
static void nearest_on_face(const Tree *tree, int face, const double *p, Hit *best)
{
    const double *a = &tree->vertices[3 * tree->faces[3 * face]];
    const double *b = &tree->vertices[3 * tree->faces[3 * face + 1]];
    const double *c = &tree->vertices[3 * tree->faces[3 * face + 2]];
    double ab[3], ac[3], ap[3], bp[3], cp[3], v, w;
    int feature;
    for (int i = 0; i < 3; i++) {
        ab[i] = b[i] - a[i];
        ac[i] = c[i] - a[i];
        ap[i] = p[i] - a[i];
        bp[i] = p[i] - b[i];
        cp[i] = p[i] - c[i];
    }
    double d1 = dot(ab, ap), d2 = dot(ac, ap), d3 = dot(ab, bp), d4 = dot(ac, bp), d5 = dot(ab, cp), d6 = dot(ac, cp);
    double va = d3 * d6 - d5 * d4, vb = d5 * d2 - d1 * d6, vc = d1 * d4 - d3 * d2;
    if (d1 <= 0.0 && d2 <= 0.0)
        v = 0.0, w = 0.0, feature = 4;
    else if (d3 >= 0.0 && d4 <= d3)
        v = 1.0, w = 0.0, feature = 5;
    else if (vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0)
        v = d1 / (d1 - d3), w = 0.0, feature = 1;
    else if (d6 >= 0.0 && d5 <= d6)
        v = 0.0, w = 1.0, feature = 6;
    else if (vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0)
        v = 0.0, w = d2 / (d2 - d6), feature = 3;
    else if (va <= 0.0 && d4 - d3 >= 0.0 && d5 - d6 >= 0.0)
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6)), v = 1.0 - w, feature = 2;
    else
        v = vb / (va + vb + vc), w = vc / (va + vb + vc), feature = 0;
    double at[3], squared = 0.0;
    for (int i = 0; i < 3; i++) {
        at[i] = a[i] + v * ab[i] + w * ac[i];
        squared += (p[i] - at[i]) * (p[i] - at[i]);
    }
    if (squared < best->squared) {
        best->squared = squared;
        best->face = face;
        best->feature = feature;
        best->weight[0] = 1.0 - v - w;
        best->weight[1] = v;
        best->weight[2] = w;
        for (int i = 0; i < 3; i++)
            best->at[i] = at[i];
    }
}

static double to_box(const Node *node, const double *p)
{
    double squared = 0.0;
    for (int i = 0; i < 3; i++) {
        double below = node->low[i] - p[i], above = p[i] - node->high[i];
        double off = below > above ? below : above;
        squared += off > 0.0 ? off * off : 0.0;
    }
    return squared;
}

static Hit search(const Tree *tree, const double *p)
{
    Hit best = {.squared = DBL_MAX, .face = 0};
    int stack[2 * DEPTH], top = 0;
    double far[2 * DEPTH];
    stack[0] = 0;
    far[top++] = to_box(&tree->nodes[0], p);
    while (top) {
        top--;
        if (far[top] >= best.squared)
            continue;
        const Node *node = &tree->nodes[stack[top]];
        if (node->left < 0) {
            for (int i = node->first; i < node->first + node->count; i++)
                nearest_on_face(tree, tree->order[i], p, &best);
            continue;
        }
        double left = to_box(&tree->nodes[node->left], p), right = to_box(&tree->nodes[node->right], p);
        int nearer = left <= right ? node->left : node->right, other = left <= right ? node->right : node->left;
        stack[top] = other;
        far[top++] = left <= right ? right : left;
        stack[top] = nearer;
        far[top++] = left <= right ? left : right;
    }
    return best;
}

/* Signed distance to the facets; the sign by the pseudonormal of the nearest feature (Baerentzen and Aanaes 2005). */
static double facet_distance(const Tree *tree, const double *p, const Hit *hit, double *face_normal)
{
    const int *corner = &tree->faces[3 * hit->face];
    const double *a = &tree->vertices[3 * corner[0]], *b = &tree->vertices[3 * corner[1]],
                 *c = &tree->vertices[3 * corner[2]];
    double ab[3], ac[3], off[3];
    for (int i = 0; i < 3; i++) {
        ab[i] = b[i] - a[i];
        ac[i] = c[i] - a[i];
        off[i] = p[i] - hit->at[i];
    }
    cross(ab, ac, face_normal);
    double length = sqrt(dot(face_normal, face_normal));
    for (int i = 0; i < 3; i++)
        face_normal[i] /= length > 0.0 ? length : 1.0;
    const double *outward = face_normal;
    if (hit->feature >= 4)
        outward = &tree->point_normals[3 * corner[hit->feature - 4]];
    else if (hit->feature >= 1)
        outward = &tree->edge_normals[9 * hit->face + 3 * (hit->feature - 1)];
    double distance = sqrt(hit->squared);
    return dot(off, outward) < 0.0 ? -distance : distance;
}

/* Where the ray along the interpolated normal passes through p: Newton's method in barycentric coordinates, from
 * triangle to triangle. Returns whether it converged; weights and distance are those of the last triangle. */
static int refine(const Tree *tree, const double *p, int *face, double *weight, double *distance, int *stopped)
{
    *stopped = 0;
    for (int hop = 0; hop < 12; hop++) {
        const int *corner = &tree->faces[3 * *face];
        const double *a = &tree->vertices[3 * corner[0]], *b = &tree->vertices[3 * corner[1]],
                     *c = &tree->vertices[3 * corner[2]];
        const double *n = &tree->normals[9 * *face];
        double v = weight[1], w = weight[2], d = *distance;
        for (int step = 0; step < 12; step++) {
            double normal[3], miss[3], first[3], second[3], pair[3];
            for (int i = 0; i < 3; i++) {
                double turn_v = n[3 + i] - n[i], turn_w = n[6 + i] - n[i];
                normal[i] = n[i] + v * turn_v + w * turn_w;
                miss[i] = p[i] - (a[i] + v * (b[i] - a[i]) + w * (c[i] - a[i])) - d * normal[i];
                first[i] = b[i] - a[i] + d * turn_v;
                second[i] = c[i] - a[i] + d * turn_w;
            }
            cross(first, second, pair);
            double volume = dot(pair, normal), part[3];
            if (fabs(volume) < 1e-30)
                return 0;
            cross(second, normal, part);
            double dv = dot(part, miss) / volume;
            cross(normal, first, part);
            double dw = dot(part, miss) / volume;
            double dd = dot(pair, miss) / volume;
            v += dv;
            w += dw;
            d += dd;
            if (!(fabs(v) < 50.0 && fabs(w) < 50.0))
                return 0;
            if (fabs(dv) + fabs(dw) < 1e-9)
                break;
        }
        double u = 1.0 - v - w;
        *distance = d;
        weight[0] = u;
        weight[1] = v;
        weight[2] = w;
        if (u >= -1e-7 && v >= -1e-7 && w >= -1e-7)
            return 1;
        /* Opposite of corner 0 is edge 1 (from corner 1 to 2), and so on. */
        int edge = u <= v && u <= w ? 1 : v <= w ? 2 : 0;
        int next = tree->neighbours[3 * *face + edge];
        if (next < 0) {
            *stopped = 1;
            return 0;
        }
        double at[3];
        for (int i = 0; i < 3; i++)
            at[i] = u * a[i] + v * b[i] + w * c[i];
        Hit start = {.squared = DBL_MAX};
        nearest_on_face(tree, next, at, &start);
        *face = next;
        for (int i = 0; i < 3; i++)
            weight[i] = start.weight[i];
    }
    return 0;
}

/* Whether the way to p leaves a corner within 30 deg of its smooth normal, as it does but on creases. */
static int along_normal(const Tree *tree, const double *p, const Hit *hit, double away)
{
    const double *n = &tree->normals[9 * hit->face + 3 * (hit->feature - 4)];
    double along = 0.0;
    for (int i = 0; i < 3; i++)
        along += (p[i] - hit->at[i]) * n[i];
    return along / away > 0.866;
}

/* distance, normal, point, both curvatures (NaN on a crease). */
static void smooth(const Tree *tree, const double *p, double *out)
{
    Hit hit = search(tree, p);
    double flat[3], away = facet_distance(tree, p, &hit, flat);
    double weight[3] = {hit.weight[0], hit.weight[1], hit.weight[2]}, distance = away;
    int face = hit.face, stopped = 0;
    int found = refine(tree, p, &face, weight, &distance, &stopped);
    const int *corner = &tree->faces[3 * hit.face];
    double longest = 0.0;
    for (int i = 0; i < 3; i++) {
        const double *a = &tree->vertices[3 * corner[i]], *b = &tree->vertices[3 * corner[(i + 1) % 3]];
        double side[3] = {b[0] - a[0], b[1] - a[1], b[2] - a[2]};
        longest = fmax(longest, dot(side, side));
    }
    /* Another sheet of the surface, or beyond a centre of curvature: not what was searched for. */
    if (found && fabs(distance - away) > 0.25 * sqrt(longest))
        found = 0;
    if (!found) {
        face = hit.face;
        for (int i = 0; i < 3; i++)
            weight[i] = hit.weight[i];
        int on_crease = 0;
        if (hit.feature >= 1 && hit.feature <= 3)
            on_crease = tree->neighbours[3 * face + hit.feature - 1] < 0;
        else if (hit.feature >= 4)
            on_crease = stopped || !along_normal(tree, p, &hit, away);
        if (on_crease && hit.squared > 1e-18) {
            for (int i = 0; i < 3; i++) {
                out[1 + i] = (p[i] - hit.at[i]) / away;
                out[4 + i] = hit.at[i];
            }
            out[0] = away;
            out[7] = out[8] = NAN;
            return;
        }
    }
    const double *n = &tree->normals[9 * face];
    corner = &tree->faces[3 * face];
    double at[3] = {0.0, 0.0, 0.0}, normal[3] = {0.0, 0.0, 0.0}, lifted[3], bend[6] = {0};
    for (int i = 0; i < 3; i++) {
        for (int axis = 0; axis < 3; axis++) {
            at[axis] += weight[i] * tree->vertices[3 * corner[i] + axis];
            normal[axis] += weight[i] * n[3 * i + axis];
        }
        for (int term = 0; term < 6; term++)
            bend[term] += weight[i] * tree->bends[18 * face + 6 * i + term];
    }
    double length = sqrt(dot(normal, normal));
    for (int axis = 0; axis < 3; axis++) {
        normal[axis] = length > 1e-9 ? normal[axis] / length : flat[axis];
        lifted[axis] = at[axis];
    }
    /* Half of Phong tessellation: exact for quadratic surfaces (docs/explanation/shapes.md). */
    for (int i = 0; i < 3; i++) {
        double to[3], rise;
        for (int axis = 0; axis < 3; axis++)
            to[axis] = tree->vertices[3 * corner[i] + axis] - at[axis];
        rise = 0.5 * weight[i] * dot(to, &n[3 * i]);
        for (int axis = 0; axis < 3; axis++)
            lifted[axis] += rise * n[3 * i + axis];
    }
    double gap = 0.0;
    for (int axis = 0; axis < 3; axis++)
        gap += (p[axis] - lifted[axis]) * normal[axis];
    out[0] = gap;
    for (int axis = 0; axis < 3; axis++) {
        out[1 + axis] = normal[axis];
        out[4 + axis] = found ? p[axis] - gap * normal[axis] : lifted[axis];
    }
    /* The shape operator has a zero eigenvalue along the normal: the others from its trace and its minors. */
    double trace = bend[0] + bend[1] + bend[2];
    double minors = bend[0] * bend[1] + bend[0] * bend[2] + bend[1] * bend[2] - bend[3] * bend[3] - bend[4] * bend[4] -
                    bend[5] * bend[5];
    double root = sqrt(fmax(0.25 * trace * trace - minors, 0.0));
    out[7] = 0.5 * trace + root;
    out[8] = 0.5 * trace - root;
}

static PyObject *tree_nearest(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    double p[3], out[9];
    if (count != 3) {
        PyErr_SetString(PyExc_TypeError, "nearest takes x, y, z");
        return NULL;
    }
    for (int i = 0; i < 3; i++) {
        p[i] = PyFloat_AsDouble(arguments[i]);
        if (p[i] == -1.0 && PyErr_Occurred())
            return NULL;
        if (!isfinite(p[i])) {
            PyErr_SetString(PyExc_ValueError, "the point is not finite");
            return NULL;
        }
    }
    smooth((Tree *)self, p, out);
    return Py_BuildValue("(ddddddddd)", out[0], out[1], out[2], out[3], out[4], out[5], out[6], out[7], out[8]);
}

static PyArrayObject *array_of(PyObject *value, int type, int rank)
{
    if (!PyArray_Check(value))
        return NULL;
    PyArrayObject *array = (PyArrayObject *)value;
    return PyArray_TYPE(array) == type && PyArray_NDIM(array) == rank && PyArray_ISCARRAY_RO(array) ? array : NULL;
}

static PyObject *tree_distances(PyObject *self, PyObject *value)
{
    PyArrayObject *points = array_of(value, NPY_DOUBLE, 2);
    if (!points || PyArray_DIM(points, 1) != 3) {
        PyErr_SetString(PyExc_TypeError, "distances takes points (k, 3)");
        return NULL;
    }
    npy_intp size = PyArray_DIM(points, 0);
    PyObject *result = PyArray_SimpleNew(1, &size, NPY_DOUBLE);
    if (!result)
        return NULL;
    const double *p = PyArray_DATA(points);
    double *out = PyArray_DATA((PyArrayObject *)result), normal[3];
    for (npy_intp i = 0; i < size; i++) {
        if (!(isfinite(p[3 * i]) && isfinite(p[3 * i + 1]) && isfinite(p[3 * i + 2]))) {
            out[i] = NAN;
            continue;
        }
        Hit hit = search((Tree *)self, p + 3 * i);
        out[i] = facet_distance((Tree *)self, p + 3 * i, &hit, normal);
    }
    return result;
}

static void tree_free(PyObject *self)
{
    Tree *tree = (Tree *)self;
    PyTypeObject *type = Py_TYPE(self);
    PyMem_Free(tree->vertices);
    PyMem_Free(tree->faces);
    PyMem_Free(tree->normals);
    PyMem_Free(tree->bends);
    PyMem_Free(tree->neighbours);
    PyMem_Free(tree->edge_normals);
    PyMem_Free(tree->point_normals);
    PyMem_Free(tree->nodes);
    PyMem_Free(tree->order);
    type->tp_free(self);
    Py_DECREF(type);
}

static void *copied(PyArrayObject *array)
{
    void *memory = PyMem_Malloc((size_t)PyArray_NBYTES(array));
    if (memory)
        memcpy(memory, PyArray_DATA(array), (size_t)PyArray_NBYTES(array));
    else
        PyErr_NoMemory();
    return memory;
}

static PyObject *tree_new(PyTypeObject *type, PyObject *arguments, PyObject *keywords)
{
    PyObject *given[7];
    if (!PyArg_ParseTuple(arguments, "OOOOOOO", &given[0], &given[1], &given[2], &given[3], &given[4], &given[5],
                          &given[6]))
        return NULL;
    static const int types[7] = {NPY_DOUBLE, NPY_INT32, NPY_DOUBLE, NPY_DOUBLE, NPY_INT32, NPY_DOUBLE, NPY_DOUBLE};
    static const int ranks[7] = {2, 2, 3, 3, 2, 3, 2};
    PyArrayObject *arrays[7];
    for (int i = 0; i < 7; i++) {
        arrays[i] = array_of(given[i], types[i], ranks[i]);
        if (!arrays[i]) {
            PyErr_Format(PyExc_TypeError, "argument %d is no contiguous array of its type and rank", i + 1);
            return NULL;
        }
    }
    npy_intp n = PyArray_DIM(arrays[0], 0), m = PyArray_DIM(arrays[1], 0);
    static const int last[7] = {3, 3, 3, 6, 3, 3, 3};
    for (int i = 0; i < 7; i++) {
        npy_intp rows = i == 0 || i == 6 ? n : m;
        if (PyArray_DIM(arrays[i], 0) != rows || PyArray_DIM(arrays[i], ranks[i] - 1) != last[i] ||
            (ranks[i] == 3 && PyArray_DIM(arrays[i], 1) != 3)) {
            PyErr_Format(PyExc_ValueError, "argument %d has another shape", i + 1);
            return NULL;
        }
    }
    if (m < 1 || m > 50000000) {
        PyErr_SetString(PyExc_ValueError, "a mesh has one to 50 million faces");
        return NULL;
    }
    const int *faces = PyArray_DATA(arrays[1]), *neighbours = PyArray_DATA(arrays[4]);
    for (npy_intp i = 0; i < 3 * m; i++)
        if (faces[i] < 0 || faces[i] >= n || neighbours[i] >= m) {
            PyErr_SetString(PyExc_ValueError, "a face names a vertex or a neighbour that is not there");
            return NULL;
        }
    Tree *tree = (Tree *)type->tp_alloc(type, 0);
    if (!tree)
        return NULL;
    tree->vertex_count = n;
    tree->face_count = m;
    int complete = (tree->vertices = copied(arrays[0])) && (tree->faces = copied(arrays[1])) &&
                   (tree->normals = copied(arrays[2])) && (tree->bends = copied(arrays[3])) &&
                   (tree->neighbours = copied(arrays[4])) && (tree->edge_normals = copied(arrays[5])) &&
                   (tree->point_normals = copied(arrays[6]));
    double *centres = PyMem_Malloc(sizeof(double) * 3 * (size_t)m);
    tree->nodes = PyMem_Malloc(sizeof(Node) * 2 * (size_t)m);
    tree->order = PyMem_Malloc(sizeof(int) * (size_t)m);
    if (!complete || !centres || !tree->nodes || !tree->order) {
        PyMem_Free(centres);
        Py_DECREF(tree);
        return PyErr_NoMemory();
    }
    for (npy_intp face = 0; face < m; face++) {
        tree->order[face] = (int)face;
        for (int axis = 0; axis < 3; axis++) {
            double low = DBL_MAX, high = -DBL_MAX;
            for (int corner = 0; corner < 3; corner++) {
                double x = tree->vertices[3 * tree->faces[3 * face + corner] + axis];
                low = fmin(low, x);
                high = fmax(high, x);
            }
            centres[3 * face + axis] = 0.5 * (low + high);
        }
    }
    int used = 0;
    build(tree, centres, &used, 0, (int)m);
    PyMem_Free(centres);
    return (PyObject *)tree;
}

static PyMethodDef tree_methods[] = {
    {"nearest", (PyCFunction)(void (*)(void))tree_nearest, METH_FASTCALL,
     "nearest(x, y, z) -> distance, normal (3), point (3), both curvatures"},
    {"distances", tree_distances, METH_O, "distances(points) -> signed distances to the facets"},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot tree_slots[] = {
    {Py_tp_new, tree_new},
    {Py_tp_dealloc, tree_free},
    {Py_tp_methods, tree_methods},
    {0, NULL},
};

static PyType_Spec tree_spec = {
    .name = "touchcell.simulation.meshes._mesh.Tree",
    .basicsize = sizeof(Tree),
    .flags = Py_TPFLAGS_DEFAULT,
    .slots = tree_slots,
};

static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, .m_name = "_mesh", .m_size = -1};

PyMODINIT_FUNC PyInit__mesh(void)
{
    import_array();
    PyObject *made = PyModule_Create(&module);
    if (!made)
        return NULL;
    PyObject *type = PyType_FromSpec(&tree_spec);
    if (!type || PyModule_AddObject(made, "Tree", type) < 0) {
        Py_XDECREF(type);
        Py_DECREF(made);
        return NULL;
    }
    return made;
}
