/* python.c - the core as the extension module `cangauge._core`.
 *
 * A model and settings come in as bytes in the layout of cangauge.h: estimation/core_layout.py names
 * their fields, and SIZES proves that both agree. The state is known to C alone.
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

/* ------------------------------------------------------------------ state */

/* A state as bytes: this, then `currents` of the delay line and the samples from the oldest to `count`
 * that `time_skew` keeps. Only a core of the same sources reads it. */
typedef struct {
    cg_state state;
    cg_time since_s;
    int64_t currents;
    int64_t oldest;
    int64_t first;
    int64_t waiting;
    int64_t count;
} saved_head;

static cg_current *current_of(const cg_line *line, int64_t index)
{
    return &line->at[(line->first + index) % line->size];
}

static PyObject *Core_state(Core *self, PyObject *stamp_shift_s)
{
    const double shift_s = PyFloat_AsDouble(stamp_shift_s);
    const cg_line *line = &self->estimator.line;
    cg_skew *skew = self->skew;
    saved_head head = {0};
    if (PyErr_Occurred()) {
        return NULL;
    }
    (void)cg_evaluate(&self->estimator);
    head.state = self->estimator.state;
    head.state.clock.shift_s += shift_s;
    head.since_s = line->since_s;
    head.currents = line->count;
    if (skew != NULL) {
        head.first = skew->first;
        head.waiting = skew->waiting;
        head.count = skew->count;
        head.oldest = (skew->first < skew->waiting) ? skew->first : skew->waiting;
    }
    const size_t currents = (size_t)head.currents * sizeof(cg_current);
    const size_t samples = (size_t)(head.count - head.oldest) * sizeof(cg_sample);
    PyObject *bytes =
        PyBytes_FromStringAndSize(NULL, (Py_ssize_t)(sizeof(head) + currents + samples));
    if (bytes == NULL) {
        return NULL;
    }
    char *at = PyBytes_AS_STRING(bytes);
    memcpy(at, &head, sizeof(head));
    at += sizeof(head);
    for (int64_t k = 0; k < head.currents; ++k, at += sizeof(cg_current)) {
        memcpy(at, current_of(line, k), sizeof(cg_current));
    }
    for (int64_t k = head.oldest; k < head.count; ++k, at += sizeof(cg_sample)) {
        memcpy(at, &skew->at[k % CG_WAITING], sizeof(cg_sample));
    }
    return bytes;
}

/* Whether the lengths in a state are within the memory here, and those of its bytes. */
static bool fits(const Core *self, const saved_head *head, Py_ssize_t length)
{
    const int64_t samples = head->count - head->oldest;
    const int64_t samples_at_most = (self->skew == NULL) ? 0 : CG_WAITING;
    const bool is_within = (head->currents >= 0) && (head->currents <= self->estimator.line.size) &&
                           (head->oldest >= 0) && (samples >= 0) && (samples <= samples_at_most) &&
                           (head->first >= head->oldest) && (head->first <= head->count) &&
                           (head->waiting >= head->oldest) && (head->waiting <= head->count);
    return is_within && (length == (Py_ssize_t)(sizeof(*head) +
                                                ((size_t)head->currents * sizeof(cg_current)) +
                                                ((size_t)samples * sizeof(cg_sample))));
}

static PyObject *Core_restore(Core *self, PyObject *args)
{
    const char *at;
    Py_ssize_t length;
    double age_s;
    saved_head head;
    if (!PyArg_ParseTuple(args, "y#d", &at, &length, &age_s)) {
        return NULL;
    }
    if (length >= (Py_ssize_t)sizeof(head)) {
        memcpy(&head, at, sizeof(head));
    }
    if ((length < (Py_ssize_t)sizeof(head)) || !fits(self, &head, length) ||
        !cg_restore(&self->estimator, &head.state, age_s)) {
        PyErr_SetString(PyExc_ValueError, "not a state of this core");
        return NULL;
    }
    cg_line *line = &self->estimator.line;
    at += sizeof(head);
    line->first = 0;
    line->count = (int32_t)head.currents;
    line->since_s = head.since_s;
    memcpy(line->at, at, (size_t)head.currents * sizeof(cg_current));
    at += (size_t)head.currents * sizeof(cg_current);
    if (self->skew != NULL) {
        self->skew->first = head.first;
        self->skew->waiting = head.waiting;
        self->skew->count = head.count;
        for (int64_t k = head.oldest; k < head.count; ++k, at += sizeof(cg_sample)) {
            memcpy(&self->skew->at[k % CG_WAITING], at, sizeof(cg_sample));
        }
    }
    Py_RETURN_NONE;
}

static PyObject *Core_take_over(Core *self, PyObject *other)
{
    if (!Py_IS_TYPE(other, Py_TYPE(self)) || (other == (PyObject *)self)) {
        PyErr_SetString(PyExc_TypeError, "another Core is needed");
        return NULL;
    }
    cg_estimator *to = &self->estimator;
    cg_estimator *from = &((Core *)other)->estimator;
    cg_line *line = &to->line;
    (void)cg_evaluate(from);
    to->state = from->state;
    to->state.is_refused = false;
    line->first = 0;
    line->count = (from->line.count < line->size) ? from->line.count : line->size;
    line->since_s = from->line.since_s;
    for (int32_t k = 0; k < line->count; ++k) {
        line->at[k] = *current_of(&from->line, (from->line.count - line->count) + k);
    }
    to->model = from->model;
    cg_set_table(to, &self->model);
    Py_RETURN_NONE;
}

static PyObject *Core_start_from(Core *self, PyObject *args)
{
    double soc_pct;
    double std_pct;
    double away_s;
    if (!PyArg_ParseTuple(args, "ddd", &soc_pct, &std_pct, &away_s)) {
        return NULL;
    }
    cg_start_from(&self->estimator, soc_pct, std_pct, away_s);
    Py_RETURN_NONE;
}

/* ------------------------------------------------------------------ what the reference computes from */

static PyObject *Core_row(Core *self, PyObject *Py_UNUSED(none))
{
    return PyLong_FromLongLong((long long)self->estimator.state.memory.tick);
}

static PyObject *Core_filled_s(Core *self, PyObject *Py_UNUSED(none))
{
    return PyFloat_FromDouble(cg_line_filled_s(&self->estimator.line));
}

static PyObject *Core_current_at(Core *self, PyObject *ago_s)
{
    const double given_s = PyFloat_AsDouble(ago_s);
    return PyErr_Occurred() ? NULL : PyFloat_FromDouble(cg_line_at(&self->estimator.line, given_s));
}

#define DOUBLES(array, number) (const char *)(array), (Py_ssize_t)((size_t)(number) * sizeof(double))

/* Likelier filter, counted charge and voltages at the latest sample; arrays as bytes. */
static PyObject *Core_view(Core *self, PyObject *Py_UNUSED(none))
{
    const cg_model *model = &self->model;
    const cg_state *state = &self->estimator.state;
    const cg_ekf *ekf = cg_likelier(&state->filter, model);
    const int32_t size = cg_states(model);
    double low_passed[CG_LOW_PASSES];
    for (int32_t k = 0; k < model->low_passes; ++k) {
        low_passed[k] = state->low_pass[k].value;
    }
    return Py_BuildValue(
        "{s:y#,s:y#,s:y#,s:y#,s:y#,s:y#,s:y#,s:y#,s:d,s:d,s:d}",
        "x", DOUBLES(ekf->x, size), "pairs", DOUBLES(ekf->p, size * (size + 1) / 2),
        "b", DOUBLES(ekf->b, 2), "b_P", DOUBLES(ekf->b_p, 4), "b_V", DOUBLES(ekf->b_v, size * 2),
        "load", DOUBLES(state->load, cg_loads(model)), "drives", DOUBLES(state->drive, model->effects),
        "low_passed", DOUBLES(low_passed, model->low_passes),
        "time_s", state->counter.time_s, "moved_pct", state->counter.moved_pct,
        "temperature_c", state->memory.temperature_c);
}

static PyMethodDef METHODS[] = {
    {"update", (PyCFunction)Core_update, METH_O, "Process one sample, a tuple of four numbers."},
    {"estimate", (PyCFunction)Core_estimate, METH_NOARGS, "Return the latest estimate."},
    {"run", (PyCFunction)Core_run, METH_O, "Step over columns: 4 in, 7 + 2 out."},
    {"uncounted_std_pct", (PyCFunction)Core_uncounted_std_pct, METH_O, "After a silence [%]."},
    {"state", (PyCFunction)Core_state, METH_O, "Return the state as bytes, with a shift of stamps."},
    {"restore", (PyCFunction)Core_restore, METH_VARARGS, "Continue from such bytes, of an age [s]."},
    {"take_over", (PyCFunction)Core_take_over, METH_O, "Continue from a core of another model."},
    {"start_from", (PyCFunction)Core_start_from, METH_VARARGS, "Start from a SoC, its deviation [%] and age [s]."},
    {"row", (PyCFunction)Core_row, METH_NOARGS, "Return the number of the latest row."},
    {"filled_s", (PyCFunction)Core_filled_s, METH_NOARGS, "Return the delay line's time [s]."},
    {"current_at", (PyCFunction)Core_current_at, METH_O, "Return the current some time ago [A]."},
    {"view", (PyCFunction)Core_view, METH_NOARGS, "Return what health and power need."},
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
    PyObject *sizes = Py_BuildValue("{s:n,s:n}", "model", sizeof(cg_model), "settings",
                                    sizeof(cg_settings));
    if ((module == NULL) || (sizes == NULL) ||
        (PyModule_AddObjectRef(module, "Core", (PyObject *)&CoreType) < 0) ||
        (PyModule_AddObjectRef(module, "SIZES", sizes) < 0) ||
        (PyModule_AddStringConstant(module, "SOURCES", CG_SOURCES) < 0)) {
        Py_CLEAR(module);
    }
    Py_XDECREF(sizes);
    return module;
}
