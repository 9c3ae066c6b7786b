/* python.c - the core as the extension module `cangauge._core`.
 *
 * Structures cross as bytes in the layout of cangauge.h; estimation/core_layout.py names the same
 * fields as data types of NumPy, and SIZES proves that both agree.
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include "cangauge_internal.h"

#ifndef CG_SOURCES
#define CG_SOURCES "" /* digest of the sources that this was built from */
#endif

#define COLUMNS_IN 4
#define NUMBERS_OUT 7
#define COLUMNS (COLUMNS_IN + NUMBERS_OUT + 2)

typedef struct {
    PyObject_HEAD
    cg_estimator estimator;
    cg_model model;
    cg_skew *skew;
    cg_current *storage;
    PyTypeObject *estimate; /* a tuple of ten */
    PyObject *statuses; /* tuple */
    PyObject *reasons; /* by their bits */
} Core;

static int begin(Core *self, PyObject *args)
{
    Py_buffer model, settings;
    PyObject *estimate, *statuses, *reasons;
    int size, block;
    double spacing_s;
    cg_settings of_user;
    if (!PyArg_ParseTuple(args, "y*y*iidO!O!O", &model, &settings, &size, &block, &spacing_s,
                          &PyType_Type, &estimate, &PyTuple_Type, &statuses, &reasons)) {
        return -1;
    }
    const bool fits = (model.len == (Py_ssize_t)sizeof(cg_model)) &&
                      (settings.len == (Py_ssize_t)sizeof(cg_settings)) && (size > 0) &&
                      PyType_IsSubtype((PyTypeObject *)estimate, &PyTuple_Type);
    if (fits) {
        memcpy(&self->model, model.buf, sizeof(cg_model));
        memcpy(&of_user, settings.buf, sizeof(cg_settings));
    }
    PyBuffer_Release(&model);
    PyBuffer_Release(&settings);
    if (!fits) {
        PyErr_SetString(PyExc_ValueError, "constants of another layout");
        return -1;
    }
    const bool has_skew = cg_skew_of(&self->model) < self->model.effects;
    self->storage = PyMem_New(cg_current, (size_t)size);
    self->skew = has_skew ? PyMem_New(cg_skew, 1) : NULL;
    if ((self->storage == NULL) || (has_skew && (self->skew == NULL))) {
        PyErr_NoMemory();
        return -1;
    }
    cg_line line = CG_LINE(self->storage, size, spacing_s);
    line.block = block;
    cg_init(&self->estimator, &self->model, &of_user, &line, self->skew);
    self->estimate = (PyTypeObject *)Py_NewRef(estimate);
    self->statuses = Py_NewRef(statuses);
    self->reasons = Py_NewRef(reasons);
    return 0;
}

/* No `__init__`: an object that exists is ready. */
static PyObject *Core_new(PyTypeObject *type, PyObject *args, PyObject *Py_UNUSED(kwargs))
{
    PyObject *self = type->tp_alloc(type, 0);
    if ((self != NULL) && (begin((Core *)self, args) != 0)) {
        Py_CLEAR(self);
    }
    return self;
}

static void Core_dealloc(Core *self)
{
    Py_XDECREF(self->estimate);
    Py_XDECREF(self->statuses);
    Py_XDECREF(self->reasons);
    PyMem_Free(self->storage);
    PyMem_Free(self->skew);
    Py_TYPE(self)->tp_free((PyObject *)self);
}

static PyObject *Core_update(Core *self, PyObject *sample)
{
    double number[COLUMNS_IN];
    if (!PyTuple_Check(sample) || (PyTuple_GET_SIZE(sample) != COLUMNS_IN)) {
        PyErr_SetString(PyExc_TypeError, "a sample is a tuple of four numbers");
        return NULL;
    }
    for (int k = 0; k < COLUMNS_IN; ++k) {
        number[k] = PyFloat_AsDouble(PyTuple_GET_ITEM(sample, k));
    }
    if (PyErr_Occurred()) {
        return NULL;
    }
    const cg_sample now = {number[0], number[1], number[2], number[3]};
    return PyBool_FromLong(cg_update(&self->estimator, &now));
}

static void numbers_of(const cg_estimate *estimate, double *number)
{
    const double found[NUMBERS_OUT] = {
        estimate->time_s,          estimate->soc_pct,         estimate->soc_std_pct,
        estimate->soc_newton_pct,  estimate->soc_coulomb_pct, estimate->voltage_model_v,
        estimate->residual_v,
    };
    memcpy(number, found, sizeof(found));
}

static PyObject *Core_estimate(Core *self, PyObject *Py_UNUSED(none))
{
    const cg_estimate now = cg_evaluate(&self->estimator);
    double number[NUMBERS_OUT];
    numbers_of(&now, number);
    PyObject *bits = PyLong_FromUnsignedLong(now.reasons);
    PyObject *reasons = (bits == NULL) ? NULL : PyObject_GetItem(self->reasons, bits);
    PyObject *status = PySequence_GetItem(self->statuses, now.status);
    Py_XDECREF(bits);
    PyObject *plain =
        PyErr_Occurred() ? NULL
                         : Py_BuildValue("dddddddOOL", number[0], number[1], number[2], number[3],
                                         number[4], number[5], number[6], status, reasons,
                                         (long long)now.samples);
    Py_XDECREF(status);
    Py_XDECREF(reasons);
    /* As tuple.__new__ does: `tp_alloc` leaves out what a later Python caches in a tuple. */
    PyObject *args = (plain == NULL) ? NULL : PyTuple_Pack(1, plain);
    PyObject *found = (args == NULL) ? NULL : PyTuple_Type.tp_new(self->estimate, args, NULL);
    Py_XDECREF(args);
    Py_XDECREF(plain);
    return found;
}

/* Step over whole columns: 4 of doubles in, 7 of doubles and 2 of int64 out. */
static PyObject *Core_run(Core *self, PyObject *columns)
{
    Py_buffer column[COLUMNS];
    int held = 0;
    Py_ssize_t rows = -1;
    if (!PyTuple_Check(columns) || (PyTuple_GET_SIZE(columns) != COLUMNS)) {
        PyErr_SetString(PyExc_TypeError, "4 columns in and 9 out are needed");
        return NULL;
    }
    while ((held < COLUMNS) && !PyErr_Occurred()) {
        const int flags = PyBUF_C_CONTIGUOUS | ((held >= COLUMNS_IN) ? PyBUF_WRITABLE : 0);
        if (PyObject_GetBuffer(PyTuple_GET_ITEM(columns, held), &column[held], flags) == 0) {
            const Py_ssize_t length = column[held].len / 8;
            if ((column[held].itemsize != 8) || ((rows >= 0) && (length != rows))) {
                PyErr_SetString(PyExc_ValueError, "columns of 8-byte numbers of one length");
            }
            rows = length;
            held += 1;
        }
    }
    for (Py_ssize_t k = 0; !PyErr_Occurred() && (k < rows); ++k) {
        double number[NUMBERS_OUT];
        const cg_sample now = {
            ((const double *)column[0].buf)[k], ((const double *)column[1].buf)[k],
            ((const double *)column[2].buf)[k], ((const double *)column[3].buf)[k],
        };
        const int64_t before = self->estimator.state.memory.tick;
        (void)cg_update(&self->estimator, &now);
        cg_estimate found = cg_evaluate(&self->estimator);
        if (self->estimator.state.memory.tick == before) { /* they are of an earlier row */
            found.voltage_model_v = (cg_real)NAN;
            found.residual_v = (cg_real)NAN;
        }
        numbers_of(&found, number);
        for (int j = 0; j < NUMBERS_OUT; ++j) {
            ((double *)column[COLUMNS_IN + j].buf)[k] = number[j];
        }
        ((int64_t *)column[COLUMNS_IN + NUMBERS_OUT].buf)[k] = found.status;
        ((int64_t *)column[COLUMNS_IN + NUMBERS_OUT + 1].buf)[k] = found.reasons;
        if ((k & 0xfff) == 0xfff) {
            (void)PyErr_CheckSignals();
        }
    }
    while (held > 0) {
        held -= 1;
        PyBuffer_Release(&column[held]);
    }
    return PyErr_Occurred() ? NULL : Py_NewRef(Py_None);
}

static PyObject *Core_uncounted_std_pct(Core *self, PyObject *seconds)
{
    const double given = PyFloat_AsDouble(seconds);
    return PyErr_Occurred() ? NULL
                            : PyFloat_FromDouble(cg_uncounted_std_pct(&self->estimator, given));
}

/* Memory of a part, which stays valid as long as the object. */
static PyObject *Core_memory(Core *self, PyObject *args)
{
    const char *name;
    if (!PyArg_ParseTuple(args, "s", &name)) {
        return NULL;
    }
    cg_line *line = &self->estimator.line;
    const struct {
        const char *name;
        void *at;
        size_t size;
    } part[] = {
        {"state", &self->estimator.state, sizeof(cg_state)},
        {"line", line, sizeof(cg_line)},
        {"currents", line->at, (size_t)line->size * sizeof(cg_current)},
        {"skew", self->skew, sizeof(cg_skew)},
    };
    for (size_t k = 0; k < sizeof(part) / sizeof(part[0]); ++k) {
        if ((strcmp(part[k].name, name) == 0) && (part[k].at != NULL)) {
            return PyMemoryView_FromMemory(part[k].at, (Py_ssize_t)part[k].size, PyBUF_WRITE);
        }
    }
    PyErr_SetString(PyExc_KeyError, name);
    return NULL;
}

static PyMethodDef METHODS[] = {
    {"update", (PyCFunction)Core_update, METH_O, "Process one sample, a tuple of four numbers."},
    {"estimate", (PyCFunction)Core_estimate, METH_NOARGS, "Return the latest estimate."},
    {"run", (PyCFunction)Core_run, METH_O, "Step over columns: 4 in, 7 + 2 out."},
    {"uncounted_std_pct", (PyCFunction)Core_uncounted_std_pct, METH_O, "After a silence [%]."},
    {"memory", (PyCFunction)Core_memory, METH_VARARGS, "Return the memory of a part."},
    {NULL, NULL, 0, NULL},
};

static PyTypeObject CoreType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "cangauge._core.Core",
    .tp_doc = "Estimator in C.",
    .tp_basicsize = sizeof(Core),
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_new = Core_new,
    .tp_dealloc = (destructor)Core_dealloc,
    .tp_methods = METHODS,
};

static struct PyModuleDef MODULE = {
    PyModuleDef_HEAD_INIT, "_core", "The estimator's core, compiled.", -1, NULL, NULL, NULL, NULL,
    NULL,
};

PyMODINIT_FUNC PyInit__core(void)
{
    if (PyType_Ready(&CoreType) < 0) {
        return NULL;
    }
    PyObject *module = PyModule_Create(&MODULE);
    PyObject *sizes = Py_BuildValue(
        "{s:n,s:n,s:n,s:n,s:n}", "model", sizeof(cg_model), "settings", sizeof(cg_settings),
        "state", sizeof(cg_state), "line", sizeof(cg_line), "skew", sizeof(cg_skew));
    if ((module == NULL) || (sizes == NULL) ||
        (PyModule_AddObjectRef(module, "Core", (PyObject *)&CoreType) < 0) ||
        (PyModule_AddObjectRef(module, "SIZES", sizes) < 0) ||
        (PyModule_AddStringConstant(module, "SOURCES", CG_SOURCES) < 0)) {
        Py_CLEAR(module);
    }
    Py_XDECREF(sizes);
    return module;
}
