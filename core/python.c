/* python.c - the core as the extension module `cangauge._core`.
 *
 * Constants of a model and settings come in by the names of their fields in cangauge.h, as arrays of
 * doubles (estimation/core_constants.py). The state is known to C alone.
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

/* ------------------------------------------------------------------ constants by name */

/* Place of a field: a number, or an array of rows of columns. */
typedef struct {
    const char *name;
    size_t offset;
    bool is_integer;
    Py_ssize_t rows;
    Py_ssize_t columns;
    size_t stride;
} field;

#define SIZE(of, name) sizeof(((of *)NULL)->name)
#define INTEGER(of, name) {#name, offsetof(of, name), true, 1, 1, 0}
#define REAL(of, name)                                                                             \
    {#name, offsetof(of, name), false, SIZE(of, name) / sizeof(double), 1, sizeof(double)}
#define TABLE(of, name)                                                                            \
    {#name, offsetof(of, name), false, SIZE(of, name) / SIZE(of, name[0]),                         \
     SIZE(of, name[0]) / sizeof(double), SIZE(of, name[0])}
#define OF_EFFECTS(name, is_integer, columns)                                                      \
    {"effect_" #name, offsetof(cg_model, effect[0].name), is_integer, CG_EFFECTS, columns,         \
     sizeof(cg_effect)}
#define END {NULL, 0, false, 0, 0, 0}

static const field MODEL_FIELDS[] = {
    REAL(cg_model, ocv_v), REAL(cg_model, epsilon), REAL(cg_model, slope_beyond),
    INTEGER(cg_model, knots), REAL(cg_model, knot_pct), REAL(cg_model, knot_v),
    REAL(cg_model, knot_slope), REAL(cg_model, t_ref_c), REAL(cg_model, temperature_limits_c),
    INTEGER(cg_model, delays), REAL(cg_model, delay_s), INTEGER(cg_model, low_passes),
    REAL(cg_model, low_pass_s), INTEGER(cg_model, has_arrhenius), REAL(cg_model, arrhenius_ohm),
    REAL(cg_model, arrhenius_mean), REAL(cg_model, usual_c), REAL(cg_model, load),
    REAL(cg_model, soc_range_pct), REAL(cg_model, temperature_range_c),
    REAL(cg_model, current_range_a), REAL(cg_model, rate_hz), REAL(cg_model, capacity_ah),
    REAL(cg_model, charge_efficiency), REAL(cg_model, initial_offset_pct),
    REAL(cg_model, nominal_v), REAL(cg_model, level_std_v), REAL(cg_model, slow_std_v),
    REAL(cg_model, slow_time_s), REAL(cg_model, fast_std_v), REAL(cg_model, soc_std_pct),
    REAL(cg_model, cold_exponent), REAL(cg_model, residual_std_v), REAL(cg_model, block_s),
    INTEGER(cg_model, tested_blocks), REAL(cg_model, innovations_at_most),
    REAL(cg_model, residual_at_most),
    REAL(cg_model, strain_at_most), INTEGER(cg_model, functions),
    INTEGER(cg_model, function_knots), REAL(cg_model, function_pct), TABLE(cg_model, function_v),
    TABLE(cg_model, function_slope), TABLE(cg_model, function_load), INTEGER(cg_model, effects),
    OF_EFFECTS(kind, true, 1), OF_EFFECTS(value, false, CG_VALUES),
    OF_EFFECTS(tau_s, false, CG_LAGS), REAL(cg_model, skew_s), END,
};

static const field SETTINGS_FIELDS[] = {
    INTEGER(cg_settings, method), REAL(cg_settings, initial_soc_pct),
    REAL(cg_settings, initial_soc_std_pct), REAL(cg_settings, valid_std_pct),
    REAL(cg_settings, gap_s), INTEGER(cg_settings, reasons), REAL(cg_settings, full_voltage_v),
    REAL(cg_settings, full_current_a), REAL(cg_settings, full_hold_s),
    REAL(cg_settings, full_soc_pct), REAL(cg_settings, full_soc_std_pct),
    REAL(cg_settings, rest_after_s), REAL(cg_settings, rest_soc_std_pct), END,
};

/* Fill one field from an array of doubles. False: it is none, or larger than the field. */
static bool fill(char *structure, const field *at, const Py_buffer *values)
{
    const Py_ssize_t rows = (values->ndim > 0) ? values->shape[0] : 1;
    const Py_ssize_t columns = (values->ndim > 1) ? values->shape[1] : 1;
    const double *value = values->buf;
    if ((values->itemsize != (Py_ssize_t)sizeof(double)) || (values->ndim > 2) ||
        (rows > at->rows) || (columns > at->columns)) {
        return false;
    }
    for (Py_ssize_t row = 0; row < rows; ++row) {
        char *to = structure + at->offset + ((size_t)row * at->stride);
        if (at->is_integer) {
            const int32_t number = (int32_t)*value++;
            memcpy(to, &number, sizeof(number));
        } else {
            memcpy(to, value, (size_t)columns * sizeof(double));
            value += columns;
        }
    }
    return true;
}

/* Fill a structure from arrays by name. False: an error is set. */
static bool fill_all(void *structure, const field *fields, PyObject *arrays)
{
    PyObject *name;
    PyObject *array;
    Py_ssize_t next = 0;
    while (!PyErr_Occurred() && PyDict_Next(arrays, &next, &name, &array)) {
        Py_buffer values;
        const field *at = fields;
        while ((at->name != NULL) && (PyUnicode_CompareWithASCIIString(name, at->name) != 0)) {
            ++at;
        }
        if (PyObject_GetBuffer(array, &values, PyBUF_FORMAT | PyBUF_C_CONTIGUOUS) == 0) {
            if ((at->name == NULL) || !fill(structure, at, &values)) {
                PyErr_Format(PyExc_ValueError, "the core has no place for %S", name);
            }
            PyBuffer_Release(&values);
        }
    }
    return PyErr_Occurred() == NULL;
}

static int begin(Core *self, PyObject *args)
{
    PyObject *model, *settings, *estimate, *statuses, *reasons;
    int size, block;
    double spacing_s;
    cg_settings of_user = {0};
    if (!PyArg_ParseTuple(args, "O!O!iidO!O!O", &PyDict_Type, &model, &PyDict_Type, &settings,
                          &size, &block, &spacing_s, &PyType_Type, &estimate, &PyTuple_Type,
                          &statuses, &reasons) ||
        !fill_all(&self->model, MODEL_FIELDS, model) ||
        !fill_all(&of_user, SETTINGS_FIELDS, settings)) {
        return -1;
    }
    if ((size <= 0) || !PyType_IsSubtype((PyTypeObject *)estimate, &PyTuple_Type)) {
        PyErr_SetString(PyExc_ValueError, "a delay line and a tuple's type are needed");
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
    double covariance[CG_STATES * CG_STATES];
    const double *pair = ekf->p;
    for (int32_t i = 0; i < size; ++i) {
        for (int32_t j = 0; j <= i; ++j) {
            covariance[(i * size) + j] = *pair;
            covariance[(j * size) + i] = *pair++;
        }
    }
    for (int32_t k = 0; k < model->low_passes; ++k) {
        low_passed[k] = state->low_pass[k].value;
    }
    return Py_BuildValue(
        "({s:y#,s:y#,s:y#,s:y#,s:y#},y#,y#,y#,d,d,d)",
        "x", DOUBLES(ekf->x, size), "P", DOUBLES(covariance, size * size), "b", DOUBLES(ekf->b, 2),
        "b_P", DOUBLES(ekf->b_p, 4), "b_V", DOUBLES(ekf->b_v, size * 2),
        DOUBLES(state->load, cg_loads(model)), DOUBLES(state->drive, model->effects),
        DOUBLES(low_passed, model->low_passes), state->counter.time_s, state->counter.moved_pct,
        state->memory.temperature_c);
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
    if ((module == NULL) ||
        (PyModule_AddObjectRef(module, "Core", (PyObject *)&CoreType) < 0) ||
        (PyModule_AddStringConstant(module, "SOURCES", CG_SOURCES) < 0)) {
        Py_CLEAR(module);
    }
    return module;
}
