/* python.c - the core as the extension module `cangauge._core`.
 *
 * Constants and states cross by name, as dicts of numbers and lists; see the tables of fields.
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <stddef.h>

#include "cangauge_internal.h"
#include "python_health.h"

#ifndef CG_SOURCES
#define CG_SOURCES "" /* digest of the sources that this was built from */
#endif

/* ------------------------------------------------------------------ structures by name */

typedef struct {
    const char *name;
    char kind; /* d: double, i: int32, u: uint32, l: int64, b: bool */
    size_t offset;
    Py_ssize_t count; /* 0: a number, else the length of a list */
    int32_t low, high; /* limits of an int32 */
} field;

/* Fields of the structure OF. */
#define REAL(member) {#member, 'd', offsetof(OF, member), 0, 0, 0}
#define LIST(member, count) {#member, 'd', offsetof(OF, member), count, 0, 0}
#define WITHIN(member, low, high) {#member, 'i', offsetof(OF, member), 0, low, high}
#define BITS(member) {#member, 'u', offsetof(OF, member), 0, 0, 0}
#define COUNT(member) {#member, 'l', offsetof(OF, member), 0, 0, 0}
#define FLAG(member) {#member, 'b', offsetof(OF, member), 0, 0, 0}
#define END {NULL, 0, 0, 0, 0, 0}

#define OF cg_model
static const field MODEL[] = {
    LIST(ocv_v, CG_OCV), REAL(epsilon), LIST(slope_beyond, 2), REAL(kt_v_per_k), REAL(t_ref_c),
    LIST(soc_range_pct, 2), LIST(temperature_range_c, 2), LIST(current_range_a, 2),
    WITHIN(delays, 1, CG_DELAYS), LIST(delay_s, CG_DELAYS), LIST(resistance_ohm, CG_DELAYS),
    REAL(rate_hz), REAL(capacity_ah), REAL(charge_efficiency), REAL(initial_offset_pct),
    REAL(steady_ohm), REAL(nominal_v), REAL(fast_std_v), REAL(slow_std_v), REAL(slow_time_s),
    REAL(lasting_std_v), REAL(lasting_time_s), REAL(lasting_soc_pct), REAL(mean_c),
    REAL(kt_std_v_per_k), REAL(resistance_std_per_k), WITHIN(knots, 0, CG_KNOTS),
    WITHIN(functions, 0, CG_FUNCTIONS), LIST(knot_pct, CG_KNOTS),
    LIST(function_v, CG_KNOTS * CG_FUNCTIONS), WITHIN(effects, 0, CG_EFFECTS), REAL(skew_s),
    WITHIN(memories, 0, CG_MEMORIES), LIST(memory_ohm, CG_MEMORIES),
    LIST(memory_tau_s, CG_MEMORIES), END,
};
#undef OF
#define OF cg_effect
static const field EFFECT[] = {
    WITHIN(kind, CG_NO_EFFECT, CG_WEAK_CELL), WITHIN(lags, 0, CG_LAGS), LIST(value, CG_VALUES),
    LIST(tau_s, CG_LAGS), END,
};
#undef OF
#define OF cg_settings
static const field SETTINGS[] = {
    WITHIN(method, CG_EKF, CG_COULOMB), REAL(initial_soc_pct), REAL(initial_soc_std_pct),
    REAL(valid_std_pct), REAL(gap_s), BITS(reasons), REAL(full_voltage_v), REAL(full_current_a),
    REAL(full_hold_s), REAL(full_soc_pct), REAL(full_soc_std_pct), REAL(rest_after_s),
    REAL(rest_soc_std_pct), END,
};
#undef OF
#define OF cg_clock
static const field CLOCK[] = {
    REAL(last_s), REAL(shift_s), COUNT(behind), REAL(behind_s), REAL(age_s), FLAG(is_restored), END,
};
#undef OF
#define OF cg_counter
static const field COUNTER[] = {
    REAL(time_s), REAL(current_a), REAL(mean_square_a2), REAL(mean_a), REAL(discharged_pct),
    REAL(moved_pct), REAL(counted_s), FLAG(is_restored), END,
};
#undef OF
#define OF cg_since
static const field SINCE[] = {
    REAL(seconds), REAL(away_s), REAL(discharged_pct), REAL(moved_pct), REAL(gap_var_pct2),
    REAL(unseen_var_pct2), END,
};
#undef OF
#define OF cg_ekf
static const field EKF[] = {
    LIST(x, CG_STATES), LIST(p, CG_LEARNED * CG_STATES), REAL(mean_innovation_v),
    REAL(mean_seconds), FLAG(was_outlier), END,
};
#undef OF
#define OF cg_filter
static const field FILTER[] = {
    WITHIN(hypotheses, 1, 2), WITHIN(verdict, CG_NO_TEST, CG_UNCLEAR), REAL(log_odds),
    REAL(prior_log_odds), REAL(wide_std_pct), REAL(outlier_s), REAL(stated_pct), FLAG(is_untested),
    END,
};
#undef OF
#define OF cg_memory
static const field MEMORY[] = {
    COUNT(samples), COUNT(resets), REAL(first_s), COUNT(tick), REAL(temperature_c),
    REAL(newton_pct), FLAG(newton_inside), REAL(newton_std_pct), REAL(coulomb_start_pct),
    REAL(coulomb_var_pct2), REAL(coulomb_counted_s), REAL(coulomb_moved_pct), REAL(gap_until_s),
    REAL(contradicted_until_s), REAL(mismatch_until_s), REAL(bias_pct), REAL(rest_since_s),
    REAL(level_s), REAL(level_residual_v), REAL(level_drop_v), END,
};
static const field REFERENCES[] = {
    REAL(full_since_s), FLAG(is_full), FLAG(is_rested), END,
};
#undef OF
#define OF cg_estimate
static const field LATEST[] = {
    REAL(time_s), REAL(soc_pct), REAL(soc_std_pct), REAL(soc_newton_pct), REAL(soc_coulomb_pct),
    REAL(voltage_model_v), REAL(residual_v), WITHIN(status, CG_INITIALISING, CG_INVALID),
    BITS(reasons), COUNT(samples), END,
};
#undef OF
#define OF cg_state
static const field STATE[] = {
    FLAG(is_pending), FLAG(is_filtering), FLAG(is_refused), FLAG(has_other_capacity),
    BITS(implausible), REAL(beside_soc_v), END,
};
#undef OF
#define OF cg_lag
static const field LAG[] = {
    REAL(time_s), REAL(input), REAL(value), FLAG(is_started), END,
};
#undef OF

#define OF health
static const field HEALTH[] = {
    REAL(seconds), REAL(away_s), REAL(discharged_pct), REAL(moved_pct), REAL(gap_var_pct2),
    FLAG(is_started), REAL(sum_v), REAL(sum_drop_v), REAL(window_s), COUNT(ticks),
    LIST(block, HEALTH_BLOCK), LIST(waiting, 2 * HEALTH_SCALES), LIST(sums, 4 * HEALTH_SCALES),
    REAL(soc_pct), REAL(gain), REAL(offset_a), REAL(pct_per_as), REAL(full_window_s),
    REAL(full_block_s), REAL(memory_s), END,
};
#undef OF

static PyObject *get_number(const char *at, char kind)
{
    switch (kind) {
    case 'd':
        return PyFloat_FromDouble(*(const double *)at);
    case 'i':
        return PyLong_FromLong(*(const int32_t *)at);
    case 'u':
        return PyLong_FromUnsignedLong(*(const uint32_t *)at);
    case 'l':
        return PyLong_FromLongLong(*(const int64_t *)at);
    default:
        return PyBool_FromLong(*(const bool *)at);
    }
}

static int set_number(char *at, const field *each, PyObject *value)
{
    if (each->kind == 'd') {
        *(double *)at = PyFloat_AsDouble(value);
        return PyErr_Occurred() ? -1 : 0;
    }
    const long long number = PyLong_AsLongLong(value);
    if (PyErr_Occurred()) {
        return -1;
    }
    if (each->kind == 'u') {
        *(uint32_t *)at = (uint32_t)number;
    } else if (each->kind == 'l') {
        *(int64_t *)at = number;
    } else if (each->kind == 'b') {
        *(bool *)at = number != 0;
    } else if ((number < each->low) || (number > each->high)) {
        PyErr_Format(PyExc_ValueError, "%s: %lld is not within %d ... %d", each->name, number,
                     (int)each->low, (int)each->high);
        return -1;
    } else {
        *(int32_t *)at = (int32_t)number;
    }
    return 0;
}

static PyObject *get_fields(const void *structure, const field *fields)
{
    PyObject *found = PyDict_New();
    for (const field *each = fields; (found != NULL) && (each->name != NULL); ++each) {
        const char *at = (const char *)structure + each->offset;
        PyObject *value = NULL;
        if (each->count == 0) {
            value = get_number(at, each->kind);
        } else {
            value = PyList_New(each->count); /* of doubles */
            for (Py_ssize_t k = 0; (value != NULL) && (k < each->count); ++k) {
                PyList_SET_ITEM(value, k, PyFloat_FromDouble(((const double *)at)[k]));
            }
        }
        if ((value == NULL) || (PyDict_SetItemString(found, each->name, value) != 0)) {
            Py_CLEAR(found);
        }
        Py_XDECREF(value);
    }
    return found;
}

static int set_list(double *at, const field *each, PyObject *value)
{
    PyObject *items = PySequence_Fast(value, "a list of numbers is needed");
    if (items == NULL) {
        return -1;
    }
    const Py_ssize_t count = PySequence_Fast_GET_SIZE(items);
    int failed = 0;
    if (count > each->count) {
        PyErr_Format(PyExc_ValueError, "%s: at most %zd numbers", each->name, each->count);
        failed = -1;
    }
    for (Py_ssize_t k = 0; (failed == 0) && (k < count); ++k) {
        failed = set_number((char *)&at[k], each, PySequence_Fast_GET_ITEM(items, k));
    }
    Py_DECREF(items);
    return failed;
}

/* Set every field of a structure from a dict. */
static int set_fields(void *structure, const field *fields, PyObject *values)
{
    for (const field *each = fields; each->name != NULL; ++each) {
        char *at = (char *)structure + each->offset;
        PyObject *value = PyDict_Check(values) ? PyDict_GetItemString(values, each->name) : NULL;
        if (value == NULL) {
            PyErr_Format(PyExc_KeyError, "%s", each->name);
            return -1;
        }
        const int failed = (each->count == 0) ? set_number(at, each, value)
                                              : set_list((double *)at, each, value);
        if (failed != 0) {
            return -1;
        }
    }
    return 0;
}

static PyObject *none_unless_error(void) { return PyErr_Occurred() ? NULL : Py_NewRef(Py_None); }

/* Numbers of a list or tuple. */
static double real_at(PyObject *numbers, Py_ssize_t k)
{
    return PyFloat_AsDouble(PySequence_Fast_GET_ITEM(numbers, k));
}

static cg_sample sample_at(PyObject *numbers, Py_ssize_t k)
{
    return (cg_sample){real_at(numbers, k), real_at(numbers, k + 1), real_at(numbers, k + 2),
                       real_at(numbers, k + 3)};
}

/* ------------------------------------------------------------------ the type Core */

typedef struct {
    PyObject_HEAD
    cg_estimator estimator;
    cg_model model;
    cg_skew *skew;
    cg_current *storage;
    health health;
    PyObject *hook; /* object with count, tick and correct */
    PyTypeObject *estimate; /* a tuple of ten */
    PyObject *statuses; /* tuple */
    PyObject *reasons; /* by their bits */
} Core;

static bool hooked(Core *self, PyObject *answer)
{
    bool is_other = self->estimator.state.has_other_capacity;
    if (answer != NULL) {
        is_other = PyObject_IsTrue(answer) == 1;
        Py_DECREF(answer);
    }
    return is_other;
}

static PyObject *charge_of(const cg_since *since)
{
    return Py_BuildValue("ddddd", since->seconds, since->away_s, since->discharged_pct,
                         since->moved_pct, since->gap_var_pct2);
}

static bool hook_count(void *context, const cg_since *since)
{
    Core *self = context;
    return !PyErr_Occurred() &&
           hooked(self, PyObject_CallMethod(self->hook, "count", "N", charge_of(since)));
}

static bool hook_tick(void *context, const cg_tick *tick)
{
    Core *self = context;
    if (PyErr_Occurred()) {
        return false;
    }
    if (health_takes(&self->health, tick)) {
        health_take(&self->health, &self->estimator, tick);
        return self->estimator.state.has_other_capacity;
    }
    PyObject *charge = charge_of(&tick->since);
    if (!tick->has_voltage) {
        return hooked(self, PyObject_CallMethod(self->hook, "tick", "Nd", charge, tick->seconds));
    }
    return hooked(self,
                  PyObject_CallMethod(self->hook, "tick", "NddddddNN", charge, tick->seconds,
                                      tick->voltage_v, tick->without_ocv_v, tick->drop_v,
                                      tick->soc_newton_pct, tick->soc_counted_pct,
                                      PyBool_FromLong(tick->is_filled),
                                      PyBool_FromLong(tick->is_inside)));
}

static bool hook_correct(void *context, cg_real soc_pct, cg_real std_pct)
{
    Core *self = context;
    return !PyErr_Occurred() &&
           hooked(self, PyObject_CallMethod(self->hook, "correct", "dd", soc_pct, std_pct));
}

static int set_effects(Core *self, PyObject *effects)
{
    const Py_ssize_t count = PyList_Check(effects) ? PyList_GET_SIZE(effects) : -1;
    if (count != self->model.effects) {
        PyErr_SetString(PyExc_ValueError, "effects: not a list of as many dicts");
        return -1;
    }
    for (Py_ssize_t k = 0; k < count; ++k) {
        if (set_fields(&self->model.effect[k], EFFECT, PyList_GET_ITEM(effects, k)) != 0) {
            return -1;
        }
    }
    return 0;
}

static int begin(Core *self, PyObject *args, PyObject *kwargs)
{
    static char *names[] = {"model", "effects", "settings", "hook", "line_size", "line_block",
                            "spacing_s", "estimate", "statuses", "reasons", NULL};
    const cg_model *own = &self->model;
    PyObject *model, *effects, *settings_of, *hook, *estimate, *statuses, *reasons;
    int size, block;
    double spacing_s;
    cg_settings settings;
    if (!PyArg_ParseTupleAndKeywords(args, kwargs, "OOOOiidO!O!O", names, &model, &effects,
                                     &settings_of, &hook, &size, &block, &spacing_s, &PyType_Type,
                                     &estimate, &PyTuple_Type, &statuses, &reasons) ||
        (set_fields(&self->model, MODEL, model) != 0) || (set_effects(self, effects) != 0) ||
        (set_fields(&settings, SETTINGS, settings_of) != 0)) {
        return -1;
    }
    if (!PyType_IsSubtype((PyTypeObject *)estimate, &PyTuple_Type)) {
        PyErr_SetString(PyExc_TypeError, "estimate: not a type of tuples");
        return -1;
    }
    if ((size < 1) || (block < 0) || (block >= size)) {
        PyErr_SetString(PyExc_ValueError, "line_block: not within 0 ... line_size - 1");
        return -1;
    }
    if ((own->functions > 0) && (own->knots < 2)) {
        PyErr_SetString(PyExc_ValueError, "knots: functions need two or more");
        return -1;
    }
    const bool has_skew = cg_skew_of(own) < own->effects;
    self->storage = PyMem_New(cg_current, (size_t)size);
    self->skew = has_skew ? PyMem_New(cg_skew, 1) : NULL;
    if ((self->storage == NULL) || (has_skew && (self->skew == NULL))) {
        PyErr_NoMemory();
        return -1;
    }
    const cg_line line = {self->storage, size, 0, 0, block, spacing_s, 0.0};
    cg_init(&self->estimator, own, &settings, &line, self->skew);
    self->estimator.hook = (cg_hook){self, hook_count, hook_tick, hook_correct};
    self->hook = Py_NewRef(hook);
    self->estimate = (PyTypeObject *)Py_NewRef(estimate);
    self->statuses = Py_NewRef(statuses);
    self->reasons = Py_NewRef(reasons);
    return 0;
}

/* No `__init__`: an object that exists is ready. */
static PyObject *Core_new(PyTypeObject *type, PyObject *args, PyObject *kwargs)
{
    PyObject *self = type->tp_alloc(type, 0);
    if ((self != NULL) && (begin((Core *)self, args, kwargs) != 0)) {
        Py_CLEAR(self);
    }
    return self;
}

static int Core_traverse(Core *self, visitproc visit, void *arg)
{
    Py_VISIT(self->hook);
    Py_VISIT(self->estimate);
    Py_VISIT(self->statuses);
    Py_VISIT(self->reasons);
    return 0;
}

static int Core_clear(Core *self)
{
    Py_CLEAR(self->hook);
    Py_CLEAR(self->estimate);
    Py_CLEAR(self->statuses);
    Py_CLEAR(self->reasons);
    return 0;
}

static void Core_dealloc(Core *self)
{
    PyObject_GC_UnTrack(self);
    (void)Core_clear(self);
    PyMem_Free(self->storage);
    PyMem_Free(self->skew);
    Py_TYPE(self)->tp_free((PyObject *)self);
}

/* ------------------------------------------------------------------ samples and estimates */

static PyObject *Core_update(Core *self, PyObject *sample)
{
    if (!PyTuple_Check(sample) || (PyTuple_GET_SIZE(sample) != 4)) {
        PyErr_SetString(PyExc_TypeError, "a sample is a tuple of four numbers");
        return NULL;
    }
    const cg_sample now = sample_at(sample, 0);
    if (!PyErr_Occurred()) {
        (void)cg_update(&self->estimator, &now);
    }
    return none_unless_error();
}

static PyObject *Core_estimate(Core *self, PyObject *Py_UNUSED(none))
{
    const cg_estimate now = cg_evaluate(&self->estimator);
    const double number[7] = {
        now.time_s,          now.soc_pct,         now.soc_std_pct, now.soc_newton_pct,
        now.soc_coulomb_pct, now.voltage_model_v, now.residual_v,
    };
    PyObject *bits = PyLong_FromUnsignedLong(now.reasons);
    PyObject *item[10] = {NULL};
    for (int k = 0; k < 7; ++k) {
        item[k] = PyFloat_FromDouble(number[k]);
    }
    item[7] = PySequence_GetItem(self->statuses, now.status);
    item[8] = (bits == NULL) ? NULL : PyObject_GetItem(self->reasons, bits);
    item[9] = PyLong_FromLongLong(now.samples);
    Py_XDECREF(bits);
    PyObject *plain = PyErr_Occurred() ? NULL : PyTuple_New(10);
    for (int k = 0; k < 10; ++k) {
        if (plain != NULL) {
            PyTuple_SET_ITEM(plain, k, item[k]);
        } else {
            Py_XDECREF(item[k]);
        }
    }
    /* As tuple.__new__ does: `tp_alloc` leaves out what a later Python caches in a tuple. */
    PyObject *args = (plain == NULL) ? NULL : PyTuple_Pack(1, plain);
    PyObject *found = (args == NULL) ? NULL : PyTuple_Type.tp_new(self->estimate, args, NULL);
    Py_XDECREF(args);
    Py_XDECREF(plain);
    return found;
}

#define COLUMNS_IN 4
#define COLUMNS_OUT 9

/* Step over whole columns: (4 columns of doubles in), (7 of doubles and 2 of int64 out). */
static PyObject *Core_run(Core *self, PyObject *args)
{
    Py_buffer column[COLUMNS_IN + COLUMNS_OUT];
    int taken = 0;
    Py_ssize_t rows = -1;
    PyObject *given = NULL;
    if (!PyArg_ParseTuple(args, "O!", &PyTuple_Type, &given)) {
        return NULL;
    }
    if (PyTuple_GET_SIZE(given) != COLUMNS_IN + COLUMNS_OUT) {
        PyErr_SetString(PyExc_TypeError, "4 columns in and 9 out are needed");
        return NULL;
    }
    for (int k = 0; k < COLUMNS_IN + COLUMNS_OUT; ++k) {
        const int flags = PyBUF_C_CONTIGUOUS | ((k >= COLUMNS_IN) ? PyBUF_WRITABLE : 0);
        if (PyObject_GetBuffer(PyTuple_GET_ITEM(given, k), &column[k], flags) != 0) {
            break;
        }
        taken += 1;
        const Py_ssize_t length = column[k].len / 8;
        if ((column[k].itemsize != 8) || ((rows >= 0) && (length != rows))) {
            PyErr_SetString(PyExc_ValueError, "columns of 8-byte numbers of one length are needed");
            break;
        }
        rows = length;
    }
    for (Py_ssize_t k = 0; !PyErr_Occurred() && (k < rows); ++k) {
        const cg_sample now = {
            ((const double *)column[0].buf)[k], ((const double *)column[1].buf)[k],
            ((const double *)column[2].buf)[k], ((const double *)column[3].buf)[k],
        };
        (void)cg_update(&self->estimator, &now);
        const cg_estimate found = cg_evaluate(&self->estimator);
        const double number[7] = {
            found.time_s,          found.soc_pct,         found.soc_std_pct, found.soc_newton_pct,
            found.soc_coulomb_pct, found.voltage_model_v, found.residual_v,
        };
        for (int j = 0; j < 7; ++j) {
            ((double *)column[COLUMNS_IN + j].buf)[k] = number[j];
        }
        ((int64_t *)column[COLUMNS_IN + 7].buf)[k] = found.status;
        ((int64_t *)column[COLUMNS_IN + 8].buf)[k] = found.reasons;
        if (((k & 0xfff) == 0xfff) && (PyErr_CheckSignals() != 0)) {
            break;
        }
    }
    for (int k = 0; k < taken; ++k) {
        PyBuffer_Release(&column[k]);
    }
    return none_unless_error();
}

static PyObject *Core_pseudo_ocv_at(Core *self, PyObject *soc)
{
    const double soc_pct = PyFloat_AsDouble(soc);
    double slope;
    if (PyErr_Occurred()) {
        return NULL;
    }
    const double volts = cg_pseudo_ocv(&self->estimator, soc_pct, &slope);
    return Py_BuildValue("dd", volts, slope);
}

static PyObject *Core_offset_a(Core *self, PyObject *Py_UNUSED(none))
{
    return PyFloat_FromDouble(cg_offset_a(&self->estimator));
}

static PyObject *Core_uncounted_std_pct(Core *self, PyObject *seconds)
{
    const double given = PyFloat_AsDouble(seconds);
    return PyErr_Occurred() ? NULL
                            : PyFloat_FromDouble(cg_uncounted_std_pct(&self->estimator, given));
}

static PyObject *Core_is_refused(Core *self, void *Py_UNUSED(closure))
{
    return PyBool_FromLong(self->estimator.state.is_refused);
}

/* ------------------------------------------------------------------ delay line */

static PyObject *Core_current_at(Core *self, PyObject *ago)
{
    const double ago_s = PyFloat_AsDouble(ago);
    if (PyErr_Occurred()) {
        return NULL;
    }
    if (self->estimator.line.count == 0) {
        PyErr_SetString(PyExc_IndexError, "the delay line is empty");
        return NULL;
    }
    return PyFloat_FromDouble(cg_line_at(&self->estimator.line, ago_s));
}

static PyObject *Core_filled_s(Core *self, PyObject *Py_UNUSED(none))
{
    return PyFloat_FromDouble(cg_line_filled_s(&self->estimator.line));
}

static PyObject *Core_line(Core *self, PyObject *Py_UNUSED(none))
{
    const cg_line *line = &self->estimator.line;
    PyObject *times = PyList_New(line->count);
    PyObject *currents = PyList_New(line->count);
    for (int32_t k = 0; (times != NULL) && (currents != NULL) && (k < line->count); ++k) {
        const cg_current *at = &line->at[(line->first + k) % line->size];
        PyList_SET_ITEM(times, k, PyFloat_FromDouble(at->time_s));
        PyList_SET_ITEM(currents, k, PyFloat_FromDouble(at->current_a));
    }
    if ((times == NULL) || (currents == NULL)) {
        Py_XDECREF(times);
        Py_XDECREF(currents);
        return NULL;
    }
    return Py_BuildValue("NNd", times, currents, line->since_s);
}

static PyObject *Core_fill_line(Core *self, PyObject *args)
{
    cg_line *line = &self->estimator.line;
    PyObject *times, *currents;
    double since_s;
    if (!PyArg_ParseTuple(args, "O!O!d", &PyList_Type, &times, &PyList_Type, &currents, &since_s)) {
        return NULL;
    }
    const Py_ssize_t given = PyList_GET_SIZE(times);
    if (PyList_GET_SIZE(currents) != given) {
        PyErr_SetString(PyExc_ValueError, "not as many currents as times");
        return NULL;
    }
    /* The latest, where a longer delay line left more. */
    const Py_ssize_t kept = (given < line->size) ? given : line->size;
    line->first = 0;
    line->count = (int32_t)kept;
    line->since_s = since_s;
    for (Py_ssize_t k = 0; k < kept; ++k) {
        const Py_ssize_t from = given - kept + k;
        line->at[k] = (cg_current){real_at(times, from), real_at(currents, from)};
    }
    self->estimator.without_ocv_v = NAN;
    return none_unless_error();
}

/* ------------------------------------------------------------------ state by name */

typedef struct {
    const char *name;
    const field *fields;
    size_t offset;
} part;

static const part PARTS[] = {
    {"clock", CLOCK, offsetof(cg_state, clock)},
    {"counter", COUNTER, offsetof(cg_state, counter)},
    {"since", SINCE, offsetof(cg_state, since)},
    {"filter", FILTER, offsetof(cg_state, filter)},
    {"first", EKF, offsetof(cg_state, filter.ekf[0])},
    {"second", EKF, offsetof(cg_state, filter.ekf[1])},
    {"memory", MEMORY, offsetof(cg_state, memory)},
    {"references", REFERENCES, offsetof(cg_state, memory)},
    {"latest", LATEST, offsetof(cg_state, latest)},
    {"state", STATE, 0},
    {NULL, NULL, 0},
};

static const part *part_named(const char *name)
{
    for (const part *each = PARTS; each->name != NULL; ++each) {
        if (strcmp(each->name, name) == 0) {
            return each;
        }
    }
    PyErr_SetString(PyExc_KeyError, name);
    return NULL;
}

static PyObject *Core_get(Core *self, PyObject *args)
{
    const char *name;
    if (!PyArg_ParseTuple(args, "s", &name)) {
        return NULL;
    }
    const part *found = part_named(name);
    return (found == NULL)
               ? NULL
               : get_fields((char *)&self->estimator.state + found->offset, found->fields);
}

static PyObject *Core_set(Core *self, PyObject *args)
{
    const char *name;
    PyObject *values;
    if (!PyArg_ParseTuple(args, "sO", &name, &values)) {
        return NULL;
    }
    const part *found = part_named(name);
    if (found != NULL) {
        (void)set_fields((char *)&self->estimator.state + found->offset, found->fields, values);
    }
    return none_unless_error();
}

static PyObject *Core_get_health(Core *self, PyObject *Py_UNUSED(none))
{
    return get_fields(&self->health, HEALTH);
}

static PyObject *Core_set_health(Core *self, PyObject *values)
{
    (void)set_fields(&self->health, HEALTH, values);
    return none_unless_error();
}

static cg_effect_state *effect_numbered(Core *self, int effect)
{
    if ((effect < 0) || (effect >= self->model.effects)) {
        PyErr_SetString(PyExc_IndexError, "no such effect");
        return NULL;
    }
    return &self->estimator.state.effect[effect];
}

static PyObject *Core_get_lags(Core *self, PyObject *number)
{
    const long effect = PyLong_AsLong(number);
    cg_effect_state *state = PyErr_Occurred() ? NULL : effect_numbered(self, (int)effect);
    PyObject *lags = (state == NULL) ? NULL : PyList_New(CG_LAGS);
    for (int k = 0; (lags != NULL) && (k < CG_LAGS); ++k) {
        PyList_SET_ITEM(lags, k, get_fields(&state->lag[k], LAG));
    }
    return lags;
}

static PyObject *Core_set_lags(Core *self, PyObject *args)
{
    int effect;
    double volts;
    PyObject *lags;
    if (!PyArg_ParseTuple(args, "idO!", &effect, &volts, &PyList_Type, &lags)) {
        return NULL;
    }
    cg_effect_state *state = effect_numbered(self, effect);
    if (state == NULL) {
        return NULL;
    }
    state->volts = volts;
    for (Py_ssize_t k = 0; (k < CG_LAGS) && (k < PyList_GET_SIZE(lags)); ++k) {
        if (set_fields(&state->lag[k], LAG, PyList_GET_ITEM(lags, k)) != 0) {
            return NULL;
        }
    }
    Py_RETURN_NONE;
}

/* State of time_skew: the number of samples held back, the samples, times and currents. */
static PyObject *Core_get_skew(Core *self, PyObject *Py_UNUSED(none))
{
    const cg_skew *skew = self->skew;
    PyObject *numbers = PyList_New(0);
    if ((numbers == NULL) || (skew == NULL)) {
        return numbers;
    }
    const Py_ssize_t waiting = skew->waiting_count;
    const Py_ssize_t total = 1 + 4 * waiting + 2 * (Py_ssize_t)skew->count;
    Py_SETREF(numbers, PyList_New(total));
    if (numbers == NULL) {
        return NULL;
    }
    PyList_SET_ITEM(numbers, 0, PyFloat_FromDouble((double)waiting));
    for (int32_t k = 0; k < skew->waiting_count; ++k) {
        const cg_sample *each = &skew->waiting[(skew->waiting_first + k) % CG_WAITING];
        const double number[4] = {each->time_s, each->current_a, each->voltage_v,
                                  each->temperature_c};
        for (int j = 0; j < 4; ++j) {
            PyList_SET_ITEM(numbers, 1 + 4 * k + j, PyFloat_FromDouble(number[j]));
        }
    }
    for (int32_t k = 0; k < skew->count; ++k) {
        const cg_current *at = &skew->at[(skew->first + k) % CG_WAITING];
        PyList_SET_ITEM(numbers, 1 + 4 * waiting + k, PyFloat_FromDouble(at->time_s));
        PyList_SET_ITEM(numbers, 1 + 4 * waiting + skew->count + k,
                        PyFloat_FromDouble(at->current_a));
    }
    return numbers;
}

static PyObject *Core_set_skew(Core *self, PyObject *args)
{
    cg_skew *skew = self->skew;
    PyObject *waiting, *times, *currents;
    if (!PyArg_ParseTuple(args, "O!O!O!", &PyList_Type, &waiting, &PyList_Type, &times,
                          &PyList_Type, &currents)) {
        return NULL;
    }
    if ((skew == NULL) || (PyList_GET_SIZE(waiting) > 4 * CG_WAITING) ||
        (PyList_GET_SIZE(times) > CG_WAITING) || (PyList_GET_SIZE(waiting) % 4 != 0) ||
        (PyList_GET_SIZE(times) != PyList_GET_SIZE(currents))) {
        PyErr_SetString(PyExc_ValueError, "more samples held back than there is memory for");
        return NULL;
    }
    skew->waiting_first = skew->first = 0;
    skew->waiting_count = (int32_t)(PyList_GET_SIZE(waiting) / 4);
    skew->count = (int32_t)PyList_GET_SIZE(times);
    for (int32_t k = 0; k < skew->waiting_count; ++k) {
        skew->waiting[k] = sample_at(waiting, 4 * (Py_ssize_t)k);
    }
    for (int32_t k = 0; k < skew->count; ++k) {
        skew->at[k] = (cg_current){real_at(times, k), real_at(currents, k)};
    }
    return none_unless_error();
}

/* ------------------------------------------------------------------ module */

static PyMethodDef METHODS[] = {
    {"update", (PyCFunction)Core_update, METH_O, "Process one sample, a tuple of four numbers."},
    {"estimate", (PyCFunction)Core_estimate, METH_NOARGS, "Return the latest estimate."},
    {"run", (PyCFunction)Core_run, METH_VARARGS, "Step over columns: 4 in, 7 + 2 out."},
    {"pseudo_ocv_at", (PyCFunction)Core_pseudo_ocv_at, METH_O, "Return voltage and slope."},
    {"offset_a", (PyCFunction)Core_offset_a, METH_NOARGS, "Return the current's offset [A]."},
    {"uncounted_std_pct", (PyCFunction)Core_uncounted_std_pct, METH_O, "After a silence [%]."},
    {"current_at", (PyCFunction)Core_current_at, METH_O, "Return an earlier current [A]."},
    {"filled_s", (PyCFunction)Core_filled_s, METH_NOARGS, "Return the gap-free stretch [s]."},
    {"line", (PyCFunction)Core_line, METH_NOARGS, "Return times, currents and start."},
    {"fill_line", (PyCFunction)Core_fill_line, METH_VARARGS, "Set times, currents and start."},
    {"get", (PyCFunction)Core_get, METH_VARARGS, "Return a part of the state."},
    {"set", (PyCFunction)Core_set, METH_VARARGS, "Set a part of the state."},
    {"get_health", (PyCFunction)Core_get_health, METH_NOARGS, "Return the sums of the health."},
    {"set_health", (PyCFunction)Core_set_health, METH_O, "Set the sums of the health."},
    {"get_lags", (PyCFunction)Core_get_lags, METH_O, "Return the lags of an effect."},
    {"set_lags", (PyCFunction)Core_set_lags, METH_VARARGS, "Set voltage and lags of an effect."},
    {"get_skew", (PyCFunction)Core_get_skew, METH_NOARGS, "Return what time_skew holds back."},
    {"set_skew", (PyCFunction)Core_set_skew, METH_VARARGS, "Set what time_skew holds back."},
    {NULL, NULL, 0, NULL},
};

static PyGetSetDef GETSET[] = {
    {"is_refused", (getter)Core_is_refused, NULL, "Whether the latest sample was refused.", NULL},
    {NULL, NULL, NULL, NULL, NULL},
};

static PyTypeObject CoreType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "cangauge._core.Core",
    .tp_doc = "Estimator in C.",
    .tp_basicsize = sizeof(Core),
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .tp_new = Core_new,
    .tp_dealloc = (destructor)Core_dealloc,
    .tp_traverse = (traverseproc)Core_traverse,
    .tp_clear = (inquiry)Core_clear,
    .tp_methods = METHODS,
    .tp_getset = GETSET,
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
    if ((module == NULL) || (PyModule_AddObjectRef(module, "Core", (PyObject *)&CoreType) < 0) ||
        (PyModule_AddIntConstant(module, "FUNCTIONS", CG_FUNCTIONS) < 0) ||
        (PyModule_AddIntConstant(module, "STATES", CG_STATES) < 0) ||
        (PyModule_AddStringConstant(module, "SOURCES", CG_SOURCES) < 0)) {
        Py_XDECREF(module);
        return NULL;
    }
    return module;
}
