/* cangauge.c - clock, counting, and the step from sample to estimate.
 *
 * Follows the Python modules estimation.counting, estimation.state and estimation.estimator; their
 * docstrings state equations and sources, and units and reasons of the constants below.
 */
#include "cangauge_internal.h"

/* counting */
#define BRIDGE_S 60.0
#define USE_S 120.0
#define DRAIN_PCT_PER_HOUR 0.05
#define DRAIN_AT_MOST_PCT 5.0
#define FASTEST_PCT_PER_HOUR 150.0
#define OFFSET_STD_PER_AH 0.025
#define CAPACITY_STD 0.05
#define MEAN_SQUARE_MEMORY_S 300.0
#define HELD_S 5.0

/* clock */
#define LATEST_S 1e11
#define SHORTEST_STEP_S 1e-7
#define SET_BACK_S 1.0
#define SET_BACK_SAMPLES 5
#define EARLY_S 5.0
#define SHORTEST_INTERRUPTION_S 1e-3
#define LONGEST_INTERRUPTION_S (30.0 * 86400.0)
#define UNKNOWN_INTERRUPTION_S 86400.0

/* step */
#define REST_CURRENT_C_RATE 0.02
#define REST_S 600.0
#define CONTRADICTED_S 300.0
#define MISMATCH_S 600.0
#define CURRENT_AT_MOST_A 5000.0
#define STEP_C_RATE 0.05
#define STEPS_MEMORY 10.0
#define STEPS_AT_LEAST 6.0
#define STEPS_CORRELATION 0.9

/* Reasons that the standard deviation contains. */
#define NOTES                                                                                      \
    (CG_TEMPERATURE_MISSING | CG_VOLTAGE_OUTSIDE_MODEL | CG_SOC_OUTSIDE_MODEL |                    \
     CG_TEMPERATURE_OUTSIDE_MODEL | CG_CURRENT_OUTSIDE_MODEL)

/* ------------------------------------------------------------------ clock */

cg_time cg_time_of_s(double time_s)
{
#if CG_HAS_FLOATS
    return (fabs(time_s) <= LATEST_S) ? (cg_time)llrint(time_s * CG_TICKS_PER_S) : CG_NO_TIME;
#else
    return time_s;
#endif
}

double cg_s_of_time(cg_time time_s)
{
#if CG_HAS_FLOATS
    return cg_is_time(time_s) ? ((double)time_s / CG_TICKS_PER_S) : (double)NAN;
#else
    return time_s;
#endif
}

static bool is_set_back(cg_clock *clock, cg_time stamp_s, cg_time step_s)
{
    if (step_s > -cg_span(R(SET_BACK_S))) {
        return false;
    }
    if (cg_is_time(clock->behind_s) && ((stamp_s - clock->behind_s) < cg_span(R(SHORTEST_STEP_S)))) {
        clock->behind = 0;
    }
    if ((clock->behind + 1) >= SET_BACK_SAMPLES) {
        return true;
    }
    clock->behind += 1;
    clock->behind_s = stamp_s;
    return false;
}

/* A stamp's time, later than the last. False: refuse the sample. */
static bool clock_time(cg_clock *clock, cg_time stamp_s, cg_time *time_s)
{
    const cg_time latest_s = (cg_time)LATEST_S * CG_SECOND;
    const cg_time shortest_s = cg_span(R(SHORTEST_STEP_S));
    if (!((-latest_s <= stamp_s) && (stamp_s <= latest_s))) {
        return false;
    }
    const bool was_restored = clock->is_restored;
    if (!cg_is_time(clock->last_s)) {
        clock->last_s = stamp_s;
        clock->is_restored = false;
        *time_s = stamp_s;
        return true;
    }
    cg_time shift_s = clock->shift_s;
    const cg_time step_s = stamp_s + shift_s - clock->last_s;
    const cg_real age_s = clock->age_s;
    const bool is_unknown = isnan(age_s) != 0;
    clock->is_restored = false;
    const cg_real passed_s =
        is_unknown ? R(UNKNOWN_INTERRUPTION_S) : cg_max(R(SHORTEST_INTERRUPTION_S), age_s);
    const cg_real least_s = cg_max(R(SHORTEST_STEP_S), passed_s - R(EARLY_S));
    if (was_restored && !(step_s >= cg_span(least_s))) {
        shift_s += cg_span(passed_s) - step_s;
    } else if (step_s < shortest_s) {
        if (!is_set_back(clock, stamp_s, step_s)) {
            return false;
        }
        shift_s += stamp_s - clock->behind_s - step_s;
    } else if (step_s > cg_span(R(LONGEST_INTERRUPTION_S))) {
        shift_s += cg_span(R(LONGEST_INTERRUPTION_S)) - step_s;
    }
    *time_s = stamp_s + shift_s;
    if ((*time_s - clock->last_s) < shortest_s) {
        return false;
    }
    clock->shift_s = shift_s;
    clock->behind = 0;
    clock->behind_s = CG_NO_TIME;
    clock->last_s = *time_s;
    return true;
}

/* ------------------------------------------------------------------ counting */

typedef struct {
    cg_real seconds;
    cg_real away_s;
    cg_real parked_std_pct;
} charge_step;

/* Self-discharge and consumers of a parked car. */
static cg_real drain_pct_of(cg_real seconds)
{
    return cg_min(R(DRAIN_PCT_PER_HOUR) * seconds / R(3600.0), R(DRAIN_AT_MOST_PCT));
}

static cg_real parked_std_pct(cg_real seconds, cg_real rms_pct_per_s)
{
    const cg_real drain_pct = drain_pct_of(seconds);
    const cg_real use_pct =
        cg_min(rms_pct_per_s * cg_min(seconds, R(USE_S)), cg_sqrt(R(CG_UNKNOWN_VAR_PCT2)));
    return cg_sqrt(cg_square(drain_pct) + cg_square(use_pct));
}

static charge_step count(cg_estimator *self, cg_time time_s, cg_real current_a)
{
    const cg_model *model = self->model;
    cg_counter *counter = &self->state.counter;
    const cg_real gap_s = self->settings.gap_s;
    const cg_time last_s = counter->time_s;
    const cg_real last_a = counter->current_a;
    charge_step step = {R(0.0), R(0.0), R(0.0)};
    counter->time_s = time_s;
    counter->current_a = current_a;
    if (!cg_is_time(last_s)) {
        counter->mean_square_a2 = current_a * current_a;
        return step;
    }
    const cg_real seconds = cg_seconds(time_s - last_s);
    step.seconds = seconds;
    const cg_real across_a = R(0.5) * (current_a + last_a);
    const cg_real kept = cg_exp(-seconds / R(MEAN_SQUARE_MEMORY_S));
    const cg_real square_a2 = counter->mean_square_a2;
    counter->mean_square_a2 = (kept * square_a2) + ((R(1.0) - kept) * (current_a * current_a));
    const cg_real per_as = cg_pct_per_as(model);
    if (seconds > cg_max(R(BRIDGE_S), gap_s)) {
        const cg_real rms_a = cg_sqrt(cg_max(square_a2, last_a * last_a));
        step.away_s = seconds;
        step.parked_std_pct = parked_std_pct(seconds, rms_a * per_as);
        return step;
    }
    counter->counted_s = cg_plus(counter->counted_s, seconds);
    const cg_real out_pct = across_a * seconds * per_as;
    counter->discharged_pct = cg_plus(counter->discharged_pct, out_pct);
    counter->moved_pct = cg_plus(counter->moved_pct, cg_fabs(out_pct));
    const cg_real turned_a = cg_expm1(-seconds / R(HELD_S)) * (current_a - last_a);
    counter->turned_a2 = R(0.5) * cg_square(turned_a);
    cg_real var_pct2 = counter->turned_a2 * cg_square(seconds * per_as);
    if (seconds > gap_s) {
        const cg_real ends_a2 = R(0.5) * ((current_a * current_a) + (last_a * last_a));
        const cg_real gap_pct = cg_sqrt(cg_max(square_a2, ends_a2)) * seconds * per_as;
        var_pct2 += cg_square(gap_pct);
    }
    counter->gap_var_pct2 = cg_plus(counter->gap_var_pct2, var_pct2);
    return step;
}

cg_real cg_uncounted_std_pct(const cg_estimator *self, cg_real seconds)
{
    const cg_counter *counter = &self->state.counter;
    if (!cg_is_time(counter->time_s)) {
        return R(0.0);
    }
    const cg_real rms_a = cg_sqrt(cg_max(counter->mean_square_a2, cg_square(counter->current_a)));
    return cg_min(rms_a * seconds * cg_pct_per_as(self->model), cg_sqrt(R(CG_UNKNOWN_VAR_PCT2)));
}

/* Deviation of the SoC if the car was charged or driven in an interval. */
static cg_real moved_std_pct(cg_real seconds)
{
    return cg_min(R(FASTEST_PCT_PER_HOUR) * seconds / R(3600.0), cg_sqrt(R(CG_UNKNOWN_VAR_PCT2)));
}

/* ------------------------------------------------------------------ SoC of each method */

static cg_real coulomb_pct(const cg_state *state)
{
    return cg_minus(state->memory.coulomb_start_pct, state->counter.discharged_pct);
}

static cg_real coulomb_std_pct(const cg_state *state)
{
    const cg_memory *memory = &state->memory;
    const cg_counter *counter = &state->counter;
    const cg_real seconds = cg_minus(counter->counted_s, memory->coulomb_counted_s);
    const cg_real moved_pct = cg_minus(counter->moved_pct, memory->coulomb_moved_pct);
    const cg_real gap_pct2 = cg_minus(counter->gap_var_pct2, memory->coulomb_gap_var_pct2);
    const cg_real offset_pct = R(OFFSET_STD_PER_AH) * seconds * R(100.0) / R(3600.0);
    const cg_real capacity_pct = R(CAPACITY_STD) * moved_pct;
    return cg_sqrt(memory->coulomb_var_pct2 + gap_pct2 + cg_square(offset_pct) +
                   cg_square(capacity_pct));
}

/* Charge and time since the filter's state. */
static void since_filter(const cg_state *state, cg_passed *passed)
{
    const cg_memory *memory = &state->memory;
    const cg_counter *counter = &state->counter;
    passed->seconds = cg_minus(counter->counted_s, memory->filter_counted_s);
    passed->discharged_pct = cg_minus(counter->discharged_pct, memory->filter_discharged_pct);
    passed->variance_pct2 = cg_minus(counter->gap_var_pct2, memory->filter_gap_var_pct2);
    passed->away_s = R(0.0);
}

static cg_real filter_soc(const cg_estimator *self, cg_real *std_pct)
{
    const cg_state *state = &self->state;
    cg_passed passed;
    since_filter(state, &passed);
    return cg_clip_soc(cg_filter_soc(&state->filter, self->model, &passed, std_pct));
}

/* SoC of the chosen method, and its standard deviation; NAN until known. */
static cg_real soc_now(const cg_estimator *self, cg_real *std_pct)
{
    const cg_memory *memory = &self->state.memory;
    const int32_t method = self->settings.method;
    if (method == (int32_t)CG_NEWTON) {
        *std_pct = memory->newton_std_pct;
        return memory->newton_pct;
    }
    if (!memory->is_known) {
        *std_pct = CG_NAN;
        return CG_NAN;
    }
    if (method == (int32_t)CG_COULOMB) {
        *std_pct = coulomb_std_pct(&self->state);
        return cg_clip_soc(coulomb_pct(&self->state));
    }
    return filter_soc(self, std_pct);
}

static void start_count(cg_state *state, cg_real soc_pct, cg_real std_pct)
{
    state->memory.coulomb_start_pct = cg_plus(state->counter.discharged_pct, soc_pct);
    state->memory.coulomb_var_pct2 = cg_square(std_pct);
    state->memory.coulomb_counted_s = state->counter.counted_s;
    state->memory.coulomb_moved_pct = state->counter.moved_pct;
    state->memory.coulomb_gap_var_pct2 = state->counter.gap_var_pct2;
}

/* Start filter and count. */
static void start(cg_estimator *self, cg_real soc_pct, cg_real std_pct, bool is_doubtful)
{
    cg_filter_start(&self->state.filter, self->model, soc_pct, std_pct, is_doubtful);
    self->state.memory.is_known = true;
    start_count(&self->state, soc_pct, std_pct);
}

/* After an unobserved interval the car is parked still, or was charged or driven. */
static void be_away(cg_estimator *self, cg_real away_s, cg_real parked_pct)
{
    const cg_real moved_pct = moved_std_pct(away_s);
    cg_filter_doubt(&self->state.filter, self->model, R(CG_WRONG_PRIOR), moved_pct, away_s,
                    parked_pct);
    self->state.memory.coulomb_var_pct2 += R(CG_WRONG_PRIOR) * cg_square(moved_pct);
}

/* ------------------------------------------------------------------ step */

static void set_filter_time(cg_state *state, cg_sum counted_s, cg_sum discharged_pct)
{
    state->memory.filter_counted_s = counted_s;
    state->memory.filter_discharged_pct = discharged_pct;
    state->memory.filter_gap_var_pct2 = state->counter.gap_var_pct2;
}

/* Predict the filter to a count. */
static void propagate(cg_estimator *self, const cg_sum *counted_s, const cg_sum *discharged_pct)
{
    const cg_memory *memory = &self->state.memory;
    cg_passed passed;
    since_filter(&self->state, &passed);
    passed.seconds = cg_minus(*counted_s, memory->filter_counted_s);
    passed.discharged_pct = cg_minus(*discharged_pct, memory->filter_discharged_pct);
    cg_filter_predict(&self->state.filter, self->model, &passed);
    set_filter_time(&self->state, *counted_s, *discharged_pct);
}

/* The open block then lies in part before the filter's state. */
static void propagate_to_now(cg_estimator *self)
{
    propagate(self, &self->state.counter.counted_s, &self->state.counter.discharged_pct);
    self->state.block.is_broken = true;
}

/* Test the innovations of the last minutes, and what the filter has learned. */
static void test_model(cg_estimator *self, cg_time time_s)
{
    const cg_model *model = self->model;
    cg_memory *memory = &self->state.memory;
    const cg_ekf *likelier = cg_likelier(&self->state.filter, model);
    cg_real total = R(0.0);
    cg_real newer = likelier->innovation2;
    if (memory->innovations < model->tested_blocks) {
        memory->innovations += 1;
    }
    for (int32_t k = 0; k < memory->innovations; ++k) { /* the newest is the first */
        const cg_real here = memory->innovation2[k];
        memory->innovation2[k] = newer;
        total += newer;
        newer = here;
    }
    const bool is_lasting = total > model->innovations_at_most;
    if (is_lasting || (cg_strain(likelier, model) > model->strain_at_most)) {
        memory->mismatch_until_s = time_s + cg_span(R(MISMATCH_S));
    }
    if (is_lasting) {
        memory->innovations = 0;
        cg_filter_doubt(&self->state.filter, model, R(CG_WRONG_PRIOR), R(CG_WRONG_STD_PCT),
                        R(0.0), R(0.0));
    }
}

static void average(const cg_sum *sums, cg_real rows, int32_t number, cg_real *means)
{
    for (int32_t k = 0; k < number; ++k) {
        means[k] = cg_value(sums[k]) / rows;
    }
}

/* Correct the filter by the open block, and test its innovation. */
static void close_block(cg_estimator *self, cg_time time_s)
{
    const cg_model *model = self->model;
    cg_memory *memory = &self->state.memory;
    cg_filter *filter = &self->state.filter;
    const cg_block *block = &self->state.block;
    const cg_real rows = (cg_real)block->rows;
    cg_real scalars[4];
    cg_real load[CG_LOADS];
    cg_real drive[CG_EFFECTS];
    cg_means means;
    if (block->is_broken || (block->rows == 0)) {
        memory->is_unseen = memory->is_unseen || (block->rows == 0);
        propagate_to_now(self); /* so that sigma grows by what the biases make of the charge */
        return;
    }
    memory->is_unseen = false;
    means.counted_s = cg_mean(block->sums[0], rows);
    means.discharged_pct = cg_mean(block->sums[1], rows);
    average(&block->sums[2], rows, 4, scalars);
    means.voltage_v = scalars[0];
    means.temperature_c = scalars[1];
    means.drop_v = scalars[2];
    means.unseen_v2 = scalars[3];
    average(&block->sums[6], rows, cg_loads(model), load);
    average(block->drive, rows, model->effects, drive);
    means.load = load;
    means.drive = drive;
    propagate(self, &means.counted_s, &means.discharged_pct);
    const bool was_rejected = cg_filter_is_rejected(filter, model);
    cg_filter_update(filter, model, &means);
    const bool is_lost = !cg_filter_is_valid(filter, model);
    if (is_lost) {
        cg_filter_start(filter, model, CG_NAN, R(0.0), false);
    }
    if (is_lost || (cg_filter_is_rejected(filter, model) && !was_rejected)) {
        memory->contradicted_until_s = time_s + cg_span(R(CONTRADICTED_S));
    }
    memory->is_known = true;
    test_model(self, time_s);
    if (isnan(coulomb_pct(&self->state))) {
        cg_real std_pct;
        const cg_real soc_pct = filter_soc(self, &std_pct);
        start_count(&self->state, soc_pct, std_pct);
    }
}

/* Fuse a SoC that is known otherwise into count and filter. */
static void correct(cg_estimator *self, cg_real soc_pct, cg_real std_pct)
{
    cg_state *state = &self->state;
    propagate_to_now(self);
    cg_filter_correct(&state->filter, self->model, soc_pct, std_pct);
    state->memory.is_known = true;
    if (isnan(coulomb_pct(state))) {
        start_count(state, soc_pct, std_pct);
        return;
    }
    const cg_real counted_pct = cg_clip_soc(coulomb_pct(state));
    const cg_real var_pct2 = cg_square(coulomb_std_pct(state));
    const cg_real gain = var_pct2 / (var_pct2 + cg_square(std_pct));
    start_count(state, counted_pct + (gain * (soc_pct - counted_pct)),
                cg_sqrt((R(1.0) - gain) * var_pct2));
}

/* Keep since when a condition has held. */
static void note_since(cg_time *start_s, bool holds, cg_time now_s)
{
    if (!holds) {
        *start_s = CG_NO_TIME;
    } else if (!cg_is_time(*start_s)) {
        *start_s = now_s;
    } else { /* as before */
    }
}

/* Whether a condition has held for a time, as of now. */
static bool becomes(bool *is_true, cg_time start_s, cg_time now_s, cg_real after_s)
{
    const bool was_true = *is_true;
    *is_true = cg_is_time(start_s) && (cg_seconds(now_s - start_s) >= after_s);
    return *is_true && !was_true;
}

static void use_references(cg_estimator *self, const cg_sample *sample)
{
    const cg_settings *rule = &self->settings;
    cg_memory *memory = &self->state.memory;
    const cg_real newton_pct = memory->newton_pct;
    bool becomes_full = false;
    bool becomes_rested = false;
    if (!isnan(rule->full_voltage_v) && !isnan(sample->voltage_v)) {
        note_since(&memory->full_since_s,
                   (sample->voltage_v >= rule->full_voltage_v) &&
                       (cg_fabs(sample->current_a) <= rule->full_current_a),
                   sample->time_s);
        becomes_full =
            becomes(&memory->is_full, memory->full_since_s, sample->time_s, rule->full_hold_s);
    }
    if (!isnan(rule->rest_after_s) && !isnan(newton_pct)) {
        becomes_rested =
            becomes(&memory->is_rested, memory->rest_since_s, sample->time_s, rule->rest_after_s);
    }
    if (becomes_full) {
        correct(self, rule->full_soc_pct, rule->full_soc_std_pct);
    }
    if (becomes_rested) {
        correct(self, newton_pct, rule->rest_soc_std_pct);
    }
}

/* Standard deviation of the SoC by inverse of one row's voltage. */
static cg_real inverse_std_pct(const cg_estimator *self, cg_real soc_pct, cg_real temperature_c)
{
    const cg_model *model = self->model;
    cg_real of_load[CG_FUNCTIONS];
    cg_real row[CG_FUNCTIONS];
    cg_real slope;
    (void)cg_pseudo_ocv(self, soc_pct, &slope);
    slope = cg_max(slope, R(CG_LEAST_SLOPE));
    cg_functions_of_load(model, self->state.load, of_load);
    cg_functions_row(model, soc_pct, of_load, row);
    const cg_real variance =
        cg_dot(row, row, model->functions) +
        (cg_square(cg_cold(model, temperature_c)) *
         (cg_square(model->level_std_v) + cg_square(model->slow_std_v) +
          cg_square(model->residual_std_v)));
    const cg_real std_pct = cg_sqrt(variance) / slope;
    return cg_min(cg_sqrt(cg_square(std_pct) + cg_square(model->soc_std_pct)),
                  cg_sqrt(R(CG_UNKNOWN_VAR_PCT2)));
}

/* Voltage by earlier currents, which a slow log shows in part. */
static cg_real unseen_v_per_a(const cg_model *model)
{
    cg_real total = R(0.0);
    for (int32_t k = 2; k <= cg_currents(model); ++k) {
        total += model->load[k];
    }
    return total;
}

static bool is_outside(cg_real value, const cg_real *range)
{
    return (value < range[0]) || (value > range[1]);
}

/* Correlate the steps of voltage and current: of a battery they are opposite. */
static void watch_sign(const cg_model *model, cg_memory *memory, const cg_sample *sample)
{
    const cg_real keep = R(1.0 - (1.0 / STEPS_MEMORY));
    const cg_real step_v = sample->voltage_v - memory->row_v;
    const cg_real step_a = sample->current_a - memory->row_a;
    memory->row_v = sample->voltage_v;
    memory->row_a = sample->current_a;
    if (isnan(step_v) || (cg_fabs(step_a) < (R(STEP_C_RATE) * model->capacity_ah))) {
        return;
    }
    memory->steps = (keep * memory->steps) + R(1.0);
    memory->steps_v2 = (keep * memory->steps_v2) + (step_v * step_v);
    memory->steps_a2 = (keep * memory->steps_a2) + (step_a * step_a);
    memory->steps_va = (keep * memory->steps_va) + (step_v * step_a);
    if (memory->steps_va < R(0.0)) {
        memory->is_sign_wrong = false;
    } else if ((memory->steps >= R(STEPS_AT_LEAST)) &&
               (memory->steps_va >
                (R(STEPS_CORRELATION) * cg_sqrt(memory->steps_v2 * memory->steps_a2)))) {
        memory->is_sign_wrong = true;
    } else { /* as before */
    }
}

/* Compare a current beyond the fit's with the voltage, which is that of one nearer to the fit's if
 * it is false. */
static void confirm_current(cg_estimator *self, const cg_sample *sample, cg_real unseen_v2)
{
    cg_state *state = &self->state;
    const cg_model *model = self->model;
    const bool is_above = sample->current_a > model->current_range_a[1];
    if (!is_above && !(sample->current_a < model->current_range_a[0])) {
        return;
    }
    cg_passed passed;
    since_filter(state, &passed);
    const cg_means row = {
        .voltage_v = sample->voltage_v,
        .temperature_c = state->memory.temperature_c,
        .unseen_v2 = unseen_v2,
        .load = state->load,
        .drive = state->drive,
    };
    const cg_real left = cg_filter_residual(&state->filter, model, &passed, &row);
    if ((is_above ? left : -left) > model->residual_at_most) {
        state->memory.contradicted_until_s = sample->time_s + cg_span(R(CONTRADICTED_S));
    }
}

static void add(cg_sum *sums, const cg_real *values, int32_t number)
{
    for (int32_t k = 0; k < number; ++k) {
        sums[k] = cg_plus(sums[k], values[k]);
    }
}

/* Compare a row's voltage with the model, and add it to the open block. */
static void use_row(cg_estimator *self, const cg_sample *sample)
{
    cg_state *state = &self->state;
    cg_memory *memory = &state->memory;
    const cg_model *model = self->model;
    cg_real std_pct;
    cg_real slope;
    const cg_real guess_pct = isnan(memory->newton_pct) ? R(50.0) : memory->newton_pct;
    memory->newton_pct = CG_NAN;
    memory->newton_std_pct = CG_NAN;
    memory->newton_inside = true;
    if (!isnan(sample->voltage_v)) {
        const cg_real temperature_c =
            isnan(memory->temperature_c) ? model->usual_c : memory->temperature_c;
        cg_sum *sums = state->block.sums;
        memory->newton_pct = cg_newton(self, sample->voltage_v - state->load_v, guess_pct,
                                       &memory->newton_inside);
        if (self->settings.method == (int32_t)CG_NEWTON) { /* no other method asks for it */
            memory->newton_std_pct = inverse_std_pct(self, memory->newton_pct, temperature_c);
        }
        const cg_real scalars[4] = {
            sample->voltage_v, memory->temperature_c, state->drop_v,
            cg_square(unseen_v_per_a(model)) * state->counter.turned_a2,
        };
        sums[0] = cg_plus_sum(sums[0], state->counter.counted_s);
        sums[1] = cg_plus_sum(sums[1], state->counter.discharged_pct);
        add(&sums[2], scalars, 4);
        add(&sums[6], state->load, cg_loads(model));
        add(state->block.drive, state->drive, model->effects);
        state->block.rows += 1;
        confirm_current(self, sample, scalars[3]);
        watch_sign(model, memory, sample);
    }
    const cg_real soc_pct = soc_now(self, &std_pct);
    memory->voltage_model_v = CG_NAN;
    if (!isnan(soc_pct)) {
        memory->voltage_model_v = cg_pseudo_ocv(self, soc_pct, &slope) + state->load_v;
    }
    memory->residual_v = sample->voltage_v - memory->voltage_model_v;
    use_references(self, sample);
}

/* Follow gaps, unobserved intervals and rests. */
static void follow(cg_estimator *self, const cg_sample *sample, const charge_step *charge,
                   bool is_gap)
{
    const cg_model *model = self->model;
    cg_memory *memory = &self->state.memory;
    if (is_gap) {
        self->state.block.is_broken = true;
        memory->row_v = CG_NAN;
        memory->gap_until_s = sample->time_s + cg_span(model->delay_s[model->delays - 1]);
    }
    if (charge->away_s != R(0.0)) {
        propagate_to_now(self);
        be_away(self, charge->away_s, charge->parked_std_pct);
    }
    note_since(&memory->rest_since_s,
               cg_fabs(sample->current_a) <= (R(REST_CURRENT_C_RATE) * model->capacity_ah),
               sample->time_s);
    if (charge->seconds > R(REST_S)) {
        memory->rest_since_s = sample->time_s - cg_span(charge->seconds);
    }
}

static void process(cg_estimator *self, const cg_sample *sample)
{
    const cg_model *model = self->model;
    cg_memory *memory = &self->state.memory;
    cg_block *block = &self->state.block;
    const cg_time since_s = sample->time_s - memory->first_s;
    const int64_t number = cg_periods(since_s, model->block_s, R(1e-9));
    if (number > block->number) {
        close_block(self, sample->time_s);
        *block = (cg_block){0};
        block->number = number;
    }
    if ((self->state.implausible != 0U) && isnan(sample->voltage_v)) {
        block->is_broken = true; /* an open contactor; other rows may be of a voltage that falls */
    }
    cg_real counted_a = sample->current_a;
    if (counted_a < R(0.0)) {
        counted_a = model->charge_efficiency * counted_a;
    }
    const charge_step charge = count(self, sample->time_s, counted_a);
    if (!isnan(sample->temperature_c) || (charge.away_s != R(0.0))) {
        memory->temperature_c = sample->temperature_c;
    }
    const bool is_gap = charge.seconds > self->settings.gap_s;
    cg_advance(self, sample, memory->temperature_c, is_gap);
    follow(self, sample, &charge, is_gap);
    const int64_t tick = cg_periods(since_s, R(1.0) / model->rate_hz, R(1e-6));
    if (tick > memory->tick) {
        memory->tick = tick;
        use_row(self, sample);
    }
}

/* Replace an implausible voltage or temperature by NAN. */
static uint32_t drop_implausible(cg_sample *sample, cg_real nominal_v)
{
    static const cg_real temperature_within_c[2] = {R(-60.0), R(120.0)};
    const cg_real voltage_within_v[2] = {R(0.5) * nominal_v, R(1.5) * nominal_v};
    uint32_t reason = 0U;
    if (is_outside(sample->voltage_v, voltage_within_v)) {
        sample->voltage_v = CG_NAN;
        reason = CG_IMPLAUSIBLE_INPUT;
    }
    if (is_outside(sample->temperature_c, temperature_within_c)) {
        sample->temperature_c = CG_NAN;
        reason = CG_IMPLAUSIBLE_INPUT;
    }
    return reason;
}

bool cg_update(cg_estimator *self, const cg_sample *sample)
{
    const cg_model *model = self->model;
    cg_state *state = &self->state;
    const cg_time stamp_s = sample->time_s;
    cg_sample now = *sample;
    const int32_t skew = cg_skew_of(model);
    state->is_refused = !((cg_fabs(sample->current_a) <= R(CURRENT_AT_MOST_A)) &&
                          clock_time(&state->clock, stamp_s, &now.time_s));
    if (state->is_refused) {
        return false;
    }
    if (skew < model->effects) {
        (void)cg_evaluate(self); /* this sample may be held back, which keeps the last estimate */
    }
    state->implausible = drop_implausible(&now, model->nominal_v);
    if (state->memory.samples == 0) {
        state->memory.first_s = now.time_s;
    }
    state->memory.samples += 1;
    const cg_time newest_s = now.time_s;
    bool is_ready = true;
    cg_correct(self, &now, 0, skew);
    if (skew < model->effects) {
        cg_skew_push(self->skew, &now);
        is_ready = cg_skew_pop(self->skew, model->skew_s, newest_s, &now);
    }
    if (!is_ready) {
        state->latest.time_s = stamp_s;
        state->latest.samples = state->memory.samples;
    }
    while (is_ready) { /* at most the samples that were held back */
        cg_correct(self, &now, skew + 1, model->effects);
        process(self, &now);
        state->pending = now;
        state->pending_stamp_s = stamp_s;
        state->is_pending = true;
        is_ready = (skew < model->effects) &&
                   cg_skew_pop(self->skew, model->skew_s, newest_s, &now);
    }
    return true;
}

/* ------------------------------------------------------------------ estimate */

static uint32_t reason_if(bool is_set, uint32_t reason)
{
    return is_set ? reason : 0U;
}

static uint32_t reasons_now(const cg_estimator *self, const cg_sample *sample, cg_real soc_pct,
                            cg_real std_pct)
{
    const cg_model *model = self->model;
    const cg_memory *memory = &self->state.memory;
    const cg_time longest_s = cg_span(model->delay_s[model->delays - 1]);
    const cg_time time_s = sample->time_s;
    uint32_t reasons = self->settings.reasons | self->state.implausible;
    reasons |= reason_if(isnan(soc_pct) != 0, CG_NO_INITIAL_SOC);
    reasons |= reason_if(std_pct > self->settings.valid_std_pct, CG_SOC_UNCERTAIN);
    reasons |= reason_if(cg_line_filled_s(&self->line) < longest_s, CG_DELAY_LINE_FILLING);
    reasons |= reason_if(time_s < memory->gap_until_s, CG_CURRENT_GAP);
    reasons |= reason_if((isnan(sample->voltage_v) != 0) || memory->is_unseen, CG_VOLTAGE_MISSING);
    reasons |= reason_if(isnan(sample->temperature_c) != 0, CG_TEMPERATURE_MISSING);
    reasons |= reason_if(!memory->newton_inside, CG_VOLTAGE_OUTSIDE_MODEL);
    reasons |= reason_if(time_s < memory->contradicted_until_s, CG_INNOVATION_LARGE);
    reasons |= reason_if(time_s < memory->mismatch_until_s, CG_MODEL_MISMATCH);
    reasons |= reason_if(memory->is_sign_wrong, CG_SIGN_SUSPECT);
    reasons |= reason_if(is_outside(soc_pct, model->soc_range_pct), CG_SOC_OUTSIDE_MODEL);
    reasons |= reason_if(is_outside(sample->temperature_c, model->temperature_range_c),
                         CG_TEMPERATURE_OUTSIDE_MODEL);
    reasons |= reason_if(is_outside(sample->current_a, model->current_range_a),
                         CG_CURRENT_OUTSIDE_MODEL);
    return reasons;
}

static int32_t status_of(uint32_t reasons)
{
    if ((reasons & ~NOTES) == 0U) {
        return (int32_t)CG_VALID;
    }
    if ((reasons & CG_NO_INITIAL_SOC) != 0U) {
        return (int32_t)CG_INITIALISING;
    }
    if ((reasons & (CG_INPUT_STALE | CG_CURRENT_MISSING | CG_MODEL_MISMATCH | CG_SIGN_SUSPECT)) != 0U) {
        return (int32_t)CG_INVALID;
    }
    return (int32_t)CG_DEGRADED;
}

cg_estimate cg_evaluate(cg_estimator *self)
{
    cg_state *state = &self->state;
    cg_estimate *latest = &state->latest;
    if (state->is_pending) {
        cg_real std_pct;
        const cg_real soc_pct = soc_now(self, &std_pct);
        state->is_pending = false;
        latest->time_s = state->pending_stamp_s;
        latest->soc_pct = soc_pct;
        latest->soc_std_pct = std_pct;
        latest->soc_newton_pct = state->memory.newton_pct;
        latest->soc_coulomb_pct = cg_clip_soc(coulomb_pct(state));
        latest->voltage_model_v = state->memory.voltage_model_v;
        latest->residual_v = state->memory.residual_v;
        latest->reasons = reasons_now(self, &state->pending, soc_pct, std_pct);
        latest->samples = state->memory.samples;
    }
    cg_estimate estimate = *latest;
    if (state->is_refused) {
        estimate.reasons |= CG_IMPLAUSIBLE_INPUT;
    }
    estimate.status = status_of(estimate.reasons);
    return estimate;
}

/* ------------------------------------------------------------------ begin and continue */

cg_settings cg_default_settings(void)
{
    cg_settings settings = {0};
    settings.method = (int32_t)CG_EKF;
    settings.initial_soc_pct = CG_NAN;
    settings.initial_soc_std_pct = R(1.0);
    settings.valid_std_pct = R(5.0);
    settings.gap_s = R(2.0);
    settings.full_voltage_v = CG_NAN;
    settings.rest_after_s = CG_NAN;
    return settings;
}

static void forget(cg_state *state)
{
    const cg_real nan = CG_NAN;
    *state = (cg_state){0};
    state->clock.last_s = CG_NO_TIME;
    state->clock.behind_s = CG_NO_TIME;
    state->counter.time_s = CG_NO_TIME;
    state->memory.first_s = CG_NO_TIME;
    state->memory.tick = -1;
    state->memory.temperature_c = nan;
    state->memory.row_v = nan;
    state->memory.newton_pct = nan;
    state->memory.newton_inside = true;
    state->memory.newton_std_pct = nan;
    state->memory.voltage_model_v = nan;
    state->memory.residual_v = nan;
    state->memory.coulomb_start_pct = cg_sum_of(CG_NAN);
    state->memory.coulomb_var_pct2 = nan;
    state->memory.gap_until_s = CG_NO_TIME;
    state->memory.contradicted_until_s = CG_NO_TIME;
    state->memory.mismatch_until_s = CG_NO_TIME;
    state->memory.rest_since_s = CG_NO_TIME;
    state->memory.full_since_s = CG_NO_TIME;
    state->latest = (cg_estimate){CG_NO_TIME, nan, nan, nan, nan, nan, nan,
                                  (int32_t)CG_INITIALISING, CG_NO_INITIAL_SOC, 0};
}

static void empty(cg_skew *skew)
{
    if (skew != NULL) {
        skew->first = 0;
        skew->waiting = 0;
        skew->count = 0;
    }
}

void cg_init(cg_estimator *self, const cg_model *model, const cg_settings *settings,
             const cg_line *line, cg_skew *skew)
{
    const cg_real given_pct = settings->initial_soc_pct;
    cg_state *state = &self->state;
    self->model = model;
    self->settings = *settings;
    self->line = *line;
    self->line.first = 0;
    self->line.count = 0;
    self->skew = skew;
    empty(skew);
    forget(state);
    cg_filter_start(&state->filter, model, CG_NAN, R(0.0), false);
    if (!isnan(given_pct)) {
        start(self, cg_clip_soc(given_pct + model->initial_offset_pct),
              settings->initial_soc_std_pct, true);
    }
}

void cg_start_from(cg_estimator *self, cg_real soc_pct, cg_real std_pct, cg_real away_s)
{
    start(self, soc_pct, std_pct, false);
    if (away_s > R(0.0)) {
        be_away(self, away_s, drain_pct_of(away_s));
    }
}

void cg_set_table(cg_estimator *self, const cg_model *model)
{
    const cg_estimate latest = cg_evaluate(self);
    const cg_model *before = self->model;
    cg_state *state = &self->state;
    cg_memory *memory = &state->memory;
    cg_lag low_pass[CG_LOW_PASSES];
    cg_real soc_pct = latest.soc_pct;
    cg_real std_pct = latest.soc_std_pct;
    if (isnan(soc_pct)) { /* the inverse has none without a voltage; counting has */
        soc_pct = latest.soc_coulomb_pct;
        std_pct = cg_sqrt(R(CG_UNKNOWN_VAR_PCT2));
    }
    for (int32_t j = 0; j < model->low_passes; ++j) {
        low_pass[j] = (cg_lag){0};
        for (int32_t k = 0; k < before->low_passes; ++k) {
            if (before->low_pass_s[k] == model->low_pass_s[j]) {
                low_pass[j] = state->low_pass[k];
            }
        }
    }
    for (int32_t j = 0; j < model->low_passes; ++j) {
        state->low_pass[j] = low_pass[j];
    }
    for (int32_t k = 0; k < CG_EFFECTS; ++k) {
        state->effect[k] = (cg_effect_state){0};
        state->drive[k] = R(0.0);
    }
    if (model->delay_s[model->delays - 1] > before->delay_s[before->delays - 1]) {
        cg_line_lengthen(&self->line);
    }
    empty(self->skew);
    self->model = model;
    set_filter_time(state, state->counter.counted_s, state->counter.discharged_pct);
    state->block.is_broken = true;
    memory->mismatch_until_s = CG_NO_TIME;
    memory->innovations = 0;
    memory->is_known = !isnan(soc_pct);
    cg_filter_take_over(&state->filter, model, before, soc_pct, std_pct);
    if (memory->is_known) {
        start_count(state, soc_pct, std_pct);
    }
}

static bool is_plausible(const cg_state *state, const cg_model *model)
{
    const cg_memory *memory = &state->memory;
    return (memory->samples >= 0) && (memory->innovations >= 0) &&
           (memory->innovations <= model->tested_blocks) &&
           isfinite(cg_value(state->counter.discharged_pct)) &&
           isfinite(cg_value(state->counter.counted_s)) &&
           cg_filter_is_plausible(&state->filter, model);
}

bool cg_restore(cg_estimator *self, const cg_state *state, cg_real age_s)
{
    if (!is_plausible(state, self->model)) {
        return false;
    }
    self->state = *state;
    self->state.is_pending = false; /* its delay line is gone */
    self->state.is_refused = false;
    self->state.clock.age_s = age_s;
    self->state.clock.is_restored = true;
    self->line.count = 0;
    return true;
}
