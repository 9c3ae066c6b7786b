/* cangauge_model.c - delay line, voltage model and its effects.
 *
 * Follows the Python modules model.delay_line, model.first_order, model.voltage_model,
 * model.extended and model.effects; their docstrings state equations and sources.
 */
#include "cangauge_internal.h"

#define BRIDGE_S 60.0 /* over a longer step the current is unknown */
#define SLOPE_STEP_PCT 0.05
#define SLOPE_AT_LEAST 2e-5
#define STEPS_AT_MOST 80
#define COLDEST_C (-60.0)
#define HOTTEST_C 120.0
#define ZERO_C_IN_K 273.15
#define REFERENCE_C 25.0
#define STEEPNESS_AT_MOST 5.0
#define STALE_AT_MOST 64

#define ACTIVATION_K 3000.0
#define RESISTANCE_REFERENCE_C 20.0
#define UNKNOWN_STD_K 8.0

/* ------------------------------------------------------------------ delay line */

static cg_current *line_entry(const cg_line *line, int32_t index)
{
    int32_t place = line->first + index;
    if (place >= line->size) {
        place -= line->size;
    }
    return &line->at[place];
}

static void line_drop(cg_line *line, int32_t number)
{
    line->first = (line->first + number) % line->size;
    line->count -= number;
}

/* Number of entries at or before a time. */
static int32_t line_until(const cg_line *line, cg_real time_s)
{
    int32_t low = 0;
    int32_t high = line->count;
    while (low < high) {
        const int32_t middle = (low + high) / 2;
        if (time_s < line_entry(line, middle)->time_s) {
            high = middle;
        } else {
            low = middle + 1;
        }
    }
    return low;
}

/* Let the times count from the oldest entry. */
static void line_rebase(cg_line *line)
{
    const cg_real later_s = line_entry(line, 0)->time_s;
    for (int32_t k = 0; k < line->count; ++k) {
        line_entry(line, k)->time_s -= later_s;
    }
    line->base_s += cg_span(later_s);
}

void cg_line_push(cg_line *line, cg_real longest_s, bool is_gap, cg_time time_s,
                  cg_real current_a)
{
    if ((line->count == 0) || is_gap) {
        line->count = 0;
        line->since_s = time_s;
        line->base_s = cg_base_of(time_s);
    } else if (line_entry(line, 0)->time_s >= R(CG_REBASE_S)) {
        line_rebase(line);
    }
    const cg_real now_s = cg_seconds(time_s - line->base_s);
    if ((line->count > 1) &&
        ((now_s - line_entry(line, line->count - 2)->time_s) < line->spacing_s)) {
        line->count -= 1;
    } else if (line->count == line->size) {
        line_drop(line, 1); /* memory smaller than the spacing needs */
    }
    line->count += 1;
    cg_current *newest = line_entry(line, line->count - 1);
    newest->time_s = now_s;
    newest->current_a = current_a;
    const int32_t stale_at = line->block + 1;
    const cg_real oldest_s = now_s - longest_s;
    if ((line->count > stale_at) && (line_entry(line, stale_at)->time_s <= oldest_s)) {
        line_drop(line, line_until(line, oldest_s) - 1);
    }
}

/* After a while of another longest delay: what was dropped meanwhile is missing. */
void cg_line_lengthen(cg_line *line)
{
    if (line->count > 0) {
        const cg_time oldest_s = line->base_s + cg_span(line_entry(line, 0)->time_s);
        line->since_s = (oldest_s > line->since_s) ? oldest_s : line->since_s;
    }
}

cg_time cg_line_filled_s(const cg_line *line)
{
    if (line->count == 0) {
        return cg_span(R(0.0));
    }
    return cg_span(line_entry(line, line->count - 1)->time_s) + line->base_s - line->since_s;
}

/* Current between two samples. */
static cg_real between(cg_real before_a, cg_real after_a, cg_real part_s, cg_real step_s)
{
    return before_a + ((after_a - before_a) * part_s / step_s);
}

cg_real cg_line_at(const cg_line *line, cg_real ago_s)
{
    if (line->count == 0) {
        return R(0.0); /* as before the first sample */
    }
    const cg_real at_s = line_entry(line, line->count - 1)->time_s - ago_s;
    const int32_t right = line_until(line, at_s);
    if (right == 0) {
        return line_entry(line, 0)->current_a;
    }
    const cg_current *before = line_entry(line, right - 1);
    if (right == line->count) {
        return before->current_a;
    }
    const cg_current *after = line_entry(line, right);
    return between(before->current_a, after->current_a, at_s - before->time_s,
                   after->time_s - before->time_s);
}

/* ------------------------------------------------------------------ voltage model */

/* Of one SoC: the knot to the left, and weights of value and slope there and to the right. */
typedef struct {
    int32_t left;
    cg_real value[4];
    cg_real slope[4];
} cg_place;

static cg_place place_of(const cg_real *knots, int32_t count, cg_real soc_pct)
{
    const int32_t last = count - 1;
    if (soc_pct < knots[0]) {
        const cg_place below = {0, {R(1.0), soc_pct - knots[0]}, {R(0.0), R(1.0)}};
        return below;
    }
    if (soc_pct > knots[last]) {
        const cg_place above = {last - 1, {R(0.0), R(0.0), R(1.0), soc_pct - knots[last]},
                                {R(0.0), R(0.0), R(0.0), R(1.0)}};
        return above;
    }
    int32_t left = 0;
    int32_t right = last;
    while ((right - left) > 1) {
        const int32_t middle = (left + right) / 2;
        if (soc_pct < knots[middle]) {
            right = middle;
        } else {
            left = middle;
        }
    }
    const cg_real width = knots[left + 1] - knots[left];
    const cg_real f = (soc_pct - knots[left]) / width;
    const cg_real back = R(1.0) - f;
    const cg_real turn = R(6.0) * f * back / width;
    const cg_place inside = {
        left,
        {(R(1.0) + (R(2.0) * f)) * back * back, width * f * back * back,
         f * f * (R(3.0) - (R(2.0) * f)), -width * f * f * back},
        {-turn, back * (R(1.0) - (R(3.0) * f)), turn, f * ((R(3.0) * f) - R(2.0))},
    };
    return inside;
}

#ifndef CANGAUGE_CONFIG /* an exported model has a table of it */
static cg_real published_ocv(const cg_model *model, cg_real soc_pct, cg_real *slope)
{
    const cg_wide *k = model->ocv_v;
    const cg_real at = cg_clip(soc_pct, model->soc_range_pct[0], model->soc_range_pct[1]);
    const cg_wide gain = (1.0 - (2.0 * model->epsilon)) / 100.0;
    const cg_wide s = ((cg_wide)at * gain) + model->epsilon;
    const cg_wide r = 1.0 / s;
    const cg_wide powers = r * (k[1] + (r * (k[2] + (r * (k[3] + (r * k[4]))))));
    const cg_real volts =
        (cg_real)(k[0] + powers + (k[5] * s) + (k[6] * log(s)) + (k[7] * log1p(-s)));
    if (soc_pct == at) {
        cg_wide by_s = k[5] + (k[6] * r) - (k[7] / (1.0 - s));
        by_s -= r * r * (k[1] + (r * ((2.0 * k[2]) + (r * ((3.0 * k[3]) + (r * 4.0 * k[4]))))));
        *slope = (cg_real)(by_s * gain);
        return volts;
    }
    *slope = (soc_pct < at) ? model->slope_beyond[0] : model->slope_beyond[1];
    return volts + (*slope * (soc_pct - at));
}

#endif

/* The curve of the model, and its slope. */
static cg_real curve_v(const cg_model *model, cg_real soc_pct, cg_real *slope)
{
#ifndef CANGAUGE_CONFIG
    if (model->knots == 0) {
        return published_ocv(model, soc_pct, slope);
    }
#endif
    const cg_place at = place_of(model->knot_pct, model->knots, soc_pct);
    /* By the rise between the knots: floats lose less than by the weights of two high voltages. */
    const cg_real rise_v = model->knot_v[at.left + 1] - model->knot_v[at.left];
    const cg_real before = model->knot_slope[at.left];
    const cg_real after = model->knot_slope[at.left + 1];
    *slope = (at.slope[1] * before) + (at.slope[2] * rise_v) + (at.slope[3] * after);
    return model->knot_v[at.left] +
           ((at.value[1] * before) + (at.value[2] * rise_v) + (at.value[3] * after));
}

/* 1/T, of a temperature at which a law of it holds. */
static cg_real inverse_k(cg_real temperature_c)
{
    return R(1.0) / (cg_clip(temperature_c, R(COLDEST_C), R(HOTTEST_C)) + R(ZERO_C_IN_K));
}

/* Resistance relative to that at the reference temperature, by Arrhenius' law. */
static cg_real resistance_factor(cg_real temperature_c)
{
    const cg_real reference = R(1.0) / (R(RESISTANCE_REFERENCE_C) + R(ZERO_C_IN_K));
    return cg_exp(R(ACTIVATION_K) * (inverse_k(temperature_c) - reference));
}

/* Growth of the voltage errors in the cold, 1 or more. */
cg_real cg_cold(const cg_model *model, cg_real temperature_c)
{
    return cg_pow(cg_max(R(1.0), resistance_factor(temperature_c)), model->cold_exponent);
}

/* Change of the voltage by each principal function through the load columns. */
void cg_functions_of_load(const cg_model *model, const cg_real *load, cg_real *row)
{
    const int32_t loads = cg_loads(model);
    for (int32_t j = 0; j < model->functions; ++j) {
        cg_real total = R(0.0);
        for (int32_t k = 0; k < loads; ++k) {
            total += load[k] * model->function_load[k][j];
        }
        row[j] = total;
    }
}

/* The same with that through the curve. */
void cg_functions_row(const cg_model *model, cg_real soc_pct, const cg_real *of_load, cg_real *row)
{
    if (model->functions > 0) {
        const cg_place at = place_of(model->function_pct, model->function_knots, soc_pct);
        const cg_real *left_v = model->function_v[at.left];
        const cg_real *left_slope = model->function_slope[at.left];
        const cg_real *right_v = model->function_v[at.left + 1];
        const cg_real *right_slope = model->function_slope[at.left + 1];
        for (int32_t j = 0; j < model->functions; ++j) {
            row[j] = (at.value[0] * left_v[j]) + (at.value[1] * left_slope[j]) +
                     (at.value[2] * right_v[j]) + (at.value[3] * right_slope[j]) + of_load[j];
        }
    }
}

/* Load columns at a temperature that depend on it: the first, and the Arrhenius change. */
static void warm_columns(const cg_model *model, cg_real temperature_c, cg_real *load)
{
    const int32_t currents = cg_currents(model);
    const cg_real bounded =
        cg_clip(temperature_c, model->temperature_limits_c[0], model->temperature_limits_c[1]);
    load[0] = bounded - model->t_ref_c;
    if (model->has_arrhenius != 0) {
        const cg_real colder = (resistance_factor(bounded) / model->arrhenius_mean) - R(1.0);
        load[1 + currents] = colder * cg_dot(&load[1], model->arrhenius_ohm, currents);
    }
}

/* Standard deviation of the voltage by an unknown temperature, of a load row at the usual one. */
cg_real cg_unknown_temperature_v(const cg_model *model, const cg_real *load)
{
    const int32_t last = cg_loads(model) - 1;
    cg_real warmer[CG_LOADS];
    for (int32_t k = 0; k <= last; ++k) {
        warmer[k] = load[k];
    }
    warm_columns(model, model->usual_c + R(UNKNOWN_STD_K), warmer);
    const cg_real by_k = warmer[0] - load[0];
    const cg_real by_ohm = (model->has_arrhenius != 0) ? (warmer[last] - load[last]) : R(0.0);
    cg_real variance = cg_square((by_k * model->load[0]) + (by_ohm * model->load[last]));
    for (int32_t j = 0; j < model->functions; ++j) {
        variance += cg_square((by_k * model->function_load[0][j]) +
                              (by_ohm * model->function_load[last][j]));
    }
    return cg_sqrt(variance);
}

/* ------------------------------------------------------------------ effects */

/* First-order lag from its first input on. Over a step longer than `rest_s` the input counts as zero. */
static cg_real lag_step(cg_lag *lag, cg_real tau_s, cg_real rest_s, cg_time time_s, cg_real input)
{
    const cg_real seconds = cg_seconds(time_s - lag->time_s);
    const cg_real step = seconds / tau_s;
    const cg_real a = cg_exp(-step);
    lag->value *= a;
    if (seconds <= rest_s) {
        const cg_real b = (-cg_expm1(-step) / step) - a;
        lag->value += ((R(1.0) - a) * input) + (b * (lag->input - input));
    }
    lag->time_s = time_s;
    lag->input = input;
    return lag->value;
}

/* The same from a first output on. */
static cg_real lag_from(cg_lag *lag, cg_real first, cg_real tau_s, cg_real rest_s, cg_time time_s,
                        cg_real input)
{
    if (lag->is_started) {
        return lag_step(lag, tau_s, rest_s, time_s, input);
    }
    *lag = (cg_lag){time_s, input, first, true};
    return first;
}

/* Lag of a current: none has flowed before the first. */
static cg_real lag_from_rest(cg_lag *lag, cg_real tau_s, cg_time time_s, cg_real input)
{
    return lag_from(lag, R(0.0), tau_s, R(BRIDGE_S), time_s, input);
}

static cg_real arrhenius(cg_real temperature_c, cg_real activation_k)
{
    const cg_real reference = R(1.0) / (R(REFERENCE_C) + R(ZERO_C_IN_K));
    return cg_exp(activation_k * (inverse_k(temperature_c) - reference));
}

static cg_real scaled_drop(cg_real drop_v, cg_real current_a, cg_real delayed, cg_real ohm)
{
    return (delayed * drop_v) + ((R(1.0) - delayed) * (-ohm * current_a));
}

int32_t cg_skew_of(const cg_model *model)
{
    int32_t k = 0;
    while ((k < model->effects) && (model->effect[k].kind != (int32_t)CG_TIME_SKEW)) {
        ++k;
    }
    return k;
}

static void correct_core(const cg_effect *effect, cg_effect_state *state, cg_sample *sample)
{
    const cg_real rise_k = effect->value[0];
    const cg_real late = effect->value[1];
    const cg_real rate = sample->current_a / effect->value[2];
    const cg_real above = lag_from_rest(&state->lag[0], effect->tau_s[0], sample->time_s,
                                        cg_square(rate));
    const cg_real outside_c = sample->temperature_c;
    sample->temperature_c += rise_k * above;
    if ((late != R(0.0)) && !isnan(outside_c)) {
        const cg_real followed =
            lag_from(&state->lag[1], outside_c, effect->tau_s[1], R(INFINITY), sample->time_s,
                     outside_c);
        sample->temperature_c += late * (followed - outside_c);
    }
}

/* Apply the corrections of the effects from one to before another. */
void cg_correct(cg_estimator *self, cg_sample *sample, int32_t from, int32_t to)
{
    for (int32_t k = from; k < to; ++k) {
        const cg_effect *effect = &self->model->effect[k];
        cg_effect_state *state = &self->state.effect[k];
        switch (effect->kind) {
        case CG_CURRENT_SENSOR:
            sample->current_a = (sample->current_a - effect->value[0]) / effect->value[1];
            break;
        case CG_VOLTAGE_SENSOR:
            sample->voltage_v = (sample->voltage_v - effect->value[0]) / effect->value[1];
            break;
        case CG_TEMPERATURE_SENSOR:
            sample->temperature_c -= effect->value[0];
            break;
        case CG_TEMPERATURE_LAG:
            if (!isnan(sample->temperature_c)) {
                const cg_real measured_c = sample->temperature_c;
                const cg_real smooth = lag_from(&state->lag[0], measured_c, effect->tau_s[0],
                                                R(INFINITY), sample->time_s, measured_c);
                sample->temperature_c += effect->value[0] * (sample->temperature_c - smooth);
            }
            break;
        case CG_CORE_TEMPERATURE:
            correct_core(effect, state, sample);
            break;
        default: /* corrects nothing */
            break;
        }
    }
}

static cg_sample *skew_entry(cg_skew *skew, int64_t number)
{
    return &skew->at[number % CG_WAITING];
}

/* Keep a sample until its current is known. */
void cg_skew_push(cg_skew *skew, const cg_sample *sample)
{
    *skew_entry(skew, skew->count) = *sample;
    skew->count += 1;
    const int64_t oldest = skew->count - CG_WAITING;
    skew->first = (oldest > skew->first) ? oldest : skew->first;
    skew->waiting = (oldest > skew->waiting) ? oldest : skew->waiting;
}

/* Number of the first current after a time. */
static int64_t skew_after(cg_skew *skew, cg_time time_s)
{
    int64_t low = skew->first;
    int64_t high = skew->count;
    while (low < high) {
        const int64_t middle = (low + high) / 2;
        if (time_s < skew_entry(skew, middle)->time_s) {
            high = middle;
        } else {
            low = middle + 1;
        }
    }
    return low;
}

/* Take the oldest sample if its current is known, which it then has. */
bool cg_skew_pop(cg_skew *skew, cg_real skew_s, cg_time now_s, cg_sample *sample)
{
    const bool is_waiting = skew->waiting < skew->count;
    const cg_time upcoming_s = is_waiting ? skew_entry(skew, skew->waiting)->time_s : now_s;
    const cg_time at_s = upcoming_s + cg_span(skew_s);
    const int64_t right = skew_after(skew, at_s);
    if (!is_waiting || (at_s > now_s)) {
        const int64_t stale = right - 1 - skew->first;
        skew->first += (stale > STALE_AT_MOST) ? stale : 0;
        return false;
    }
    *sample = *skew_entry(skew, skew->waiting);
    skew->waiting += 1;
    const cg_sample *after = skew_entry(skew, right);
    if (right == skew->first) {
        sample->current_a = after->current_a;
        return true;
    }
    const cg_sample *before = skew_entry(skew, right - 1);
    sample->current_a = before->current_a;
    if (right < skew->count) {
        sample->current_a = between(before->current_a, after->current_a,
                                    cg_seconds(at_s - before->time_s),
                                    cg_seconds(after->time_s - before->time_s));
    }
    return true;
}

static void advance_hysteresis(const cg_effect *effect, cg_lag *lag, const cg_sample *sample)
{
    const cg_real seconds = cg_seconds(sample->time_s - lag->time_s);
    if (lag->is_started && (seconds <= R(BRIDGE_S))) {
        const cg_real mean = R(0.5) * (sample->current_a + lag->input);
        const cg_real decay = cg_fabs(mean) * seconds / effect->value[1];
        const cg_real toward = (signbit(mean) != 0) ? R(-1.0) : R(1.0);
        lag->value = (cg_exp(-decay) * lag->value) + (toward * cg_expm1(-decay));
    }
    lag->is_started = true;
    lag->time_s = sample->time_s;
    lag->input = sample->current_a;
}

static cg_real rc_volts(const cg_effect *effect, cg_lag *lag, const cg_sample *sample,
                        cg_real temperature_c)
{
    const cg_real activation_k = effect->value[0];
    const cg_real colder =
        (activation_k != R(0.0)) ? arrhenius(temperature_c, activation_k) : R(1.0);
    const cg_real smooth_a =
        lag_from_rest(lag, effect->tau_s[0], sample->time_s, sample->current_a);
    return -effect->value[3] * colder * smooth_a;
}

static cg_real charge_transfer_v(const cg_effect *effect, cg_real current_a, cg_real temperature_c)
{
    const cg_real *value = effect->value;
    const cg_real per_a = value[1] * arrhenius(temperature_c, value[3]);
    const cg_real slope = value[2] * cg_asinh(value[4] * per_a) / value[4];
    return -value[0] * (cg_asinh(current_a * per_a) - (slope * current_a));
}

/* Advance an effect to a corrected sample: its voltage, or what that over SoC is computed from. */
static cg_real advance_effect(const cg_effect *effect, cg_effect_state *state,
                           const cg_sample *sample, cg_real temperature_c, cg_real drop_v)
{
    const cg_real *value = effect->value;
    const cg_real current_a = sample->current_a;
    cg_lag *lag = &state->lag[0];
    cg_real drive = R(0.0);
    switch (effect->kind) {
    case CG_RESISTANCE_GROWTH:
        drive = value[0] * scaled_drop(drop_v, current_a, value[1], value[2]);
        break;
    case CG_RESISTANCE_TEMPERATURE:
        drive = value[0] * scaled_drop(drop_v, current_a, value[2], value[4]) *
                cg_expm1(value[1] * (inverse_k(temperature_c) - value[3]));
        break;
    case CG_RESISTANCE_SOC:
        drive = scaled_drop(drop_v, current_a, value[3], value[4]);
        break;
    case CG_RESISTANCE_ASYMMETRY:
        drive = -value[0] * cg_min(current_a, R(0.0));
        break;
    case CG_RESISTANCE_STEP:
        if (!lag->is_started) {
            lag->is_started = true;
            lag->time_s = sample->time_s;
        }
        drive = (cg_seconds(sample->time_s - lag->time_s) >= value[1])
                           ? (-value[0] * current_a)
                           : R(0.0);
        break;
    case CG_CHARGE_TRANSFER:
        drive = charge_transfer_v(effect, current_a, temperature_c);
        break;
    case CG_RC:
        drive = rc_volts(effect, lag, sample, temperature_c);
        break;
    case CG_HYSTERESIS:
        advance_hysteresis(effect, lag, sample);
        drive = value[0] * lag->value;
        break;
    case CG_ENTROPIC:
        drive = cg_clip(temperature_c, R(COLDEST_C), R(HOTTEST_C)) - value[3];
        break;
    case CG_WEAK_CELL:
        drive = value[0];
        break;
    default: /* adds no voltage */
        break;
    }
    return drive;
}

static bool depends_on_soc(const cg_effect *effect)
{
    const int32_t kind = effect->kind;
    return (kind == (int32_t)CG_RESISTANCE_SOC) || (kind == (int32_t)CG_ENTROPIC) ||
           (kind == (int32_t)CG_WEAK_CELL) ||
           ((kind == (int32_t)CG_RC) && (effect->value[1] != R(0.0)));
}

/* Load columns at the latest sample, their voltage, and its part over the resistances. */
static void advance_load(cg_estimator *self, const cg_sample *sample, cg_real temperature_c)
{
    const cg_model *model = self->model;
    cg_state *state = &self->state;
    cg_real *load = state->load;
    for (int32_t j = 0; j < model->delays; ++j) {
        load[1 + j] = cg_line_at(&self->line, model->delay_s[j]);
    }
    for (int32_t j = 0; j < model->low_passes; ++j) {
        load[1 + model->delays + j] = lag_from_rest(&state->low_pass[j], model->low_pass_s[j],
                                                    sample->time_s, sample->current_a);
    }
    warm_columns(model, temperature_c, load);
    state->load_v = cg_dot(load, model->load, cg_loads(model));
    state->drop_v = cg_dot(&load[1], &model->load[1], cg_loads(model) - 1);
}

/* Advance the voltage model to a corrected sample. */
void cg_advance(cg_estimator *self, const cg_sample *sample, cg_real temperature_c,
                bool is_gap)
{
    const cg_model *model = self->model;
    cg_state *state = &self->state;
    const cg_real known_c = (isfinite(temperature_c) != 0) ? temperature_c : model->usual_c;
    cg_line_push(&self->line, model->delay_s[model->delays - 1], is_gap, sample->time_s,
                 sample->current_a);
    advance_load(self, sample, known_c);
    for (int32_t k = 0; k < model->effects; ++k) {
        const cg_effect *effect = &model->effect[k];
        state->drive[k] =
            advance_effect(effect, &state->effect[k], sample, known_c, state->drop_v);
    }
}

/* Factor on the drive of an effect that depends on the SoC, at one. */
static cg_real over_soc(const cg_model *model, const cg_effect *effect, cg_real soc_pct)
{
    const cg_real *value = effect->value;
    const cg_real soc = cg_clip(soc_pct, R(0.0), R(100.0));
    cg_real slope;
    cg_real factor;
    switch (effect->kind) {
    case CG_RESISTANCE_SOC:
        factor = (value[0] * cg_exp(-soc / value[2])) +
                 (value[1] * cg_exp((soc - R(100.0)) / value[2]));
        break;
    case CG_ENTROPIC: {
        const cg_real x = (soc / R(50.0)) - R(1.0);
        factor = value[0] + (value[1] * x) + (value[2] * ((R(1.5) * x * x) - R(0.5)));
        break;
    }
    case CG_WEAK_CELL:
        factor = curve_v(model, R(100.0) - ((R(100.0) - soc_pct) * value[1]), &slope) -
                 curve_v(model, soc_pct, &slope);
        break;
    default: /* CG_RC along the slope */
        (void)curve_v(model, soc_pct, &slope);
        slope = cg_clip(slope / value[2], R(0.0), R(STEEPNESS_AT_MOST));
        factor = R(1.0) + (value[1] * (slope - R(1.0)));
        break;
    }
    return factor;
}

static cg_real over_soc_v(const cg_model *model, const cg_real *drive, cg_real soc_pct)
{
    cg_real volts = R(0.0);
    for (int32_t k = 0; k < model->effects; ++k) {
        if (depends_on_soc(&model->effect[k])) {
            volts += drive[k] * over_soc(model, &model->effect[k], soc_pct);
        }
    }
    return volts;
}

/* Curve and effects of given drives at a SoC, and the slope. */
cg_real cg_curve_at(const cg_model *model, const cg_real *drive, cg_real soc_pct, cg_real *slope)
{
    cg_real volts = curve_v(model, soc_pct, slope);
    bool is_over_soc = false;
    for (int32_t k = 0; k < model->effects; ++k) {
        if (depends_on_soc(&model->effect[k])) {
            is_over_soc = true;
        } else {
            volts += drive[k];
        }
    }
    if (is_over_soc) {
        volts += over_soc_v(model, drive, soc_pct);
        const cg_real above_v = over_soc_v(model, drive, soc_pct + R(SLOPE_STEP_PCT));
        const cg_real below_v = over_soc_v(model, drive, soc_pct - R(SLOPE_STEP_PCT));
        *slope += (above_v - below_v) / (R(2.0) * R(SLOPE_STEP_PCT));
        *slope = cg_max(*slope, R(SLOPE_AT_LEAST) * model->nominal_v);
    }
    return volts;
}

cg_real cg_pseudo_ocv(const cg_estimator *self, cg_real soc_pct, cg_real *slope)
{
    return cg_curve_at(self->model, self->state.drive, soc_pct, slope);
}

/* Newton's method inside a bracket: the SoC whose pseudo-OCV is a voltage. */
cg_real cg_newton(const cg_estimator *self, cg_real ocv_v, cg_real guess_pct, bool *inside)
{
    cg_real low = R(0.0);
    cg_real high = R(100.0);
    cg_real slope;
    const cg_real low_v = cg_pseudo_ocv(self, low, &slope);
    const cg_real high_v = cg_pseudo_ocv(self, high, &slope);
    if (ocv_v <= low_v) {
        *inside = (ocv_v == low_v);
        return low;
    }
    if (ocv_v >= high_v) {
        *inside = (ocv_v == high_v);
        return high;
    }
    *inside = true;
    cg_real soc = cg_clip(guess_pct, low, high);
    for (int32_t step = 0; step < STEPS_AT_MOST; ++step) {
        const cg_real error = cg_pseudo_ocv(self, soc, &slope) - ocv_v;
        if (error > R(0.0)) {
            high = soc;
        } else {
            low = soc;
        }
        const cg_real following = soc - (error / slope);
        if (cg_fabs(following - soc) < R(CG_CLOSE_PCT)) {
            return cg_clip_soc(following);
        }
        const bool is_between = (low < following) && (following < high);
        soc = is_between ? following : (R(0.5) * (low + high));
    }
    return soc;
}
