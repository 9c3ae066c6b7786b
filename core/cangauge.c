/* cangauge.c - clock, counting, and the step from sample to estimate.
 *
 * Follows the Python modules estimation.counting and estimation.estimator operation by operation;
 * their docstrings state equations and sources.
 */
#include "cangauge_internal.h"

/* counting */
#define BRIDGE_S 60.0
#define USE_S 120.0
#define DRAIN_PCT_PER_HOUR 0.05
#define DRAIN_AT_MOST_PCT 5.0
#define AWAY_PCT_PER_HOUR 20.0
#define AWAY_AT_MOST_PCT 30.0
#define MEAN_SQUARE_MEMORY_S 300.0
#define HELD_S 5.0
#define MEAN_MEMORY_S 60.0

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
#define MISMATCH_SIGMAS 3.0
#define LEVEL_MEMORY_S 30.0
#define CURRENT_AT_MOST_A 5000.0
#define TEMPERATURE_MARGIN_K 5.0
#define SOC_MARGIN_PCT 1.0
#define OUTSIDE_MARGIN_K 1.0
#define CURRENT_MARGIN 1.1

/* ------------------------------------------------------------------ clock */

static bool is_set_back(cg_clock *clock, cg_time stamp_s, cg_time step_s)
{
    if (step_s > -SET_BACK_S) {
        return false;
    }
    if ((stamp_s - clock->behind_s) < SHORTEST_STEP_S) {
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
    if (!(fabs(stamp_s) <= LATEST_S)) {
        return false;
    }
    const bool was_restored = clock->is_restored;
    if (isnan(clock->last_s)) {
        clock->last_s = stamp_s;
        clock->is_restored = false;
        *time_s = stamp_s;
        return true;
    }
    cg_time shift_s = clock->shift_s;
    const cg_time step_s = stamp_s + shift_s - clock->last_s;
    const cg_time age_s = clock->age_s;
    const bool is_unknown = isnan(age_s) != 0;
    clock->is_restored = false;
    cg_time least_s = (is_unknown ? UNKNOWN_INTERRUPTION_S : age_s) - EARLY_S;
    least_s = (SHORTEST_STEP_S > least_s) ? SHORTEST_STEP_S : least_s;
    if (was_restored && !(step_s >= least_s)) {
        cg_time passed_s = UNKNOWN_INTERRUPTION_S;
        if (!is_unknown) {
            passed_s = (SHORTEST_INTERRUPTION_S > age_s) ? SHORTEST_INTERRUPTION_S : age_s;
        }
        shift_s += passed_s - step_s;
    } else if (step_s < SHORTEST_STEP_S) {
        if (!is_set_back(clock, stamp_s, step_s)) {
            return false;
        }
        shift_s += stamp_s - clock->behind_s - step_s;
    } else if (step_s > LONGEST_INTERRUPTION_S) {
        shift_s += LONGEST_INTERRUPTION_S - step_s;
    } else {
        /* the usual step */
    }
    *time_s = stamp_s + shift_s;
    if ((*time_s - clock->last_s) < SHORTEST_STEP_S) {
        return false;
    }
    clock->shift_s = shift_s;
    clock->behind = 0;
    clock->behind_s = (cg_time)NAN;
    clock->last_s = *time_s;
    return true;
}

/* ------------------------------------------------------------------ counting */

typedef struct {
    cg_real seconds;
    cg_real discharged_pct;
    cg_real gap_std_pct;
    cg_real away_s;
    cg_real parked_std_pct;
} charge_step;

static cg_real parked_std_pct(cg_real seconds, cg_real rms_pct_per_s)
{
    const cg_real drain_pct =
        cg_min(R(DRAIN_PCT_PER_HOUR) * seconds / R(3600.0), R(DRAIN_AT_MOST_PCT));
    const cg_real use_pct =
        cg_min(rms_pct_per_s * cg_min(seconds, R(USE_S)), R(CG_MOVED_STD_AT_MOST_PCT));
    return cg_sqrt(cg_square(drain_pct) + cg_square(use_pct));
}

static charge_step count(cg_estimator *self, cg_time time_s, cg_real current_a)
{
    const cg_model *model = self->model;
    cg_counter *counter = &self->state.counter;
    const cg_real gap_s = self->settings.gap_s;
    const cg_time last_s = counter->time_s;
    const cg_real last_a = counter->current_a;
    charge_step step = {R(0.0), R(0.0), R(0.0), R(0.0), R(0.0)};
    counter->time_s = time_s;
    counter->current_a = current_a;
    if (isnan(last_s)) {
        counter->mean_square_a2 = current_a * current_a;
        counter->mean_a = current_a;
        return step;
    }
    const cg_real seconds = (cg_real)(time_s - last_s);
    step.seconds = seconds;
    cg_real across_a = R(0.5) * (current_a + last_a);
    if (counter->is_restored && (seconds > gap_s)) {
        const cg_real held = R(HELD_S) / seconds * -cg_expm1(R(-0.5) * seconds / R(HELD_S));
        across_a = counter->mean_a + (held * (current_a + last_a - (R(2.0) * counter->mean_a)));
    }
    counter->is_restored = false;
    cg_real kept = cg_exp(-seconds / R(MEAN_MEMORY_S));
    counter->mean_a = (kept * counter->mean_a) + ((R(1.0) - kept) * current_a);
    kept = cg_exp(-seconds / R(MEAN_SQUARE_MEMORY_S));
    const cg_real square_a2 = counter->mean_square_a2;
    counter->mean_square_a2 = (kept * square_a2) + ((R(1.0) - kept) * (current_a * current_a));
    const cg_real per_as = cg_pct_per_as(model);
    if (seconds > cg_max(R(BRIDGE_S), gap_s)) {
        const cg_real rms_a = cg_sqrt(cg_max(square_a2, last_a * last_a));
        step.gap_std_pct = cg_min(R(AWAY_PCT_PER_HOUR) * seconds / R(3600.0), R(AWAY_AT_MOST_PCT));
        step.away_s = seconds;
        step.parked_std_pct = parked_std_pct(seconds, rms_a * per_as);
        return step;
    }
    counter->counted_s += (cg_sum)seconds;
    step.discharged_pct = across_a * seconds * per_as;
    counter->discharged_pct += (cg_sum)step.discharged_pct;
    counter->moved_pct += (cg_sum)cg_fabs(step.discharged_pct);
    if (seconds > gap_s) {
        const cg_real ends_a2 = R(0.5) * ((current_a * current_a) + (last_a * last_a));
        step.gap_std_pct = cg_sqrt(cg_max(square_a2, ends_a2)) * seconds * per_as;
    }
    return step;
}

cg_real cg_uncounted_std_pct(const cg_estimator *self, cg_real seconds)
{
    const cg_counter *counter = &self->state.counter;
    if (isnan(counter->time_s)) {
        return R(0.0);
    }
    const cg_real rms_a = cg_sqrt(cg_max(counter->mean_square_a2, cg_square(counter->current_a)));
    return cg_min(rms_a * seconds * cg_pct_per_as(self->model), R(CG_MOVED_STD_AT_MOST_PCT));
}

/* ------------------------------------------------------------------ SoC of each method */

static cg_sum coulomb_pct(const cg_state *state)
{
    return state->memory.coulomb_start_pct - state->counter.discharged_pct;
}

static cg_real coulomb_std_pct(const cg_estimator *self)
{
    const cg_memory *memory = &self->state.memory;
    const cg_counter *counter = &self->state.counter;
    const cg_model *model = self->model;
    const cg_real hours = (cg_real)(counter->counted_s - memory->coulomb_counted_s) / R(3600.0);
    const cg_real moved_pct = (cg_real)(counter->moved_pct - memory->coulomb_moved_pct);
    const cg_real offset_pct = R(CG_OFFSET_STD_PER_AH) * model->capacity_ah * R(3600.0) * hours *
                               cg_pct_per_as(model);
    const cg_real scale_pct = R(CG_CAPACITY_STD) * moved_pct;
    return cg_sqrt(memory->coulomb_var_pct2 + cg_square(offset_pct) + cg_square(scale_pct));
}

/* SoC of the chosen method, and its standard deviation; NAN until known. */
static cg_real soc_now(cg_estimator *self, cg_real *std_pct)
{
    const cg_memory *memory = &self->state.memory;
    const int32_t method = self->settings.method;
    if (method == (int32_t)CG_NEWTON) {
        *std_pct = memory->newton_std_pct;
        return memory->newton_pct;
    }
    if (isnan(memory->coulomb_start_pct)) {
        *std_pct = CG_NAN;
        return CG_NAN;
    }
    const cg_real counted_pct = cg_clip_soc((cg_real)coulomb_pct(&self->state));
    if (method == (int32_t)CG_COULOMB) {
        *std_pct = coulomb_std_pct(self);
        return counted_pct;
    }
    const cg_real soc_pct = cg_filter_soc(self, std_pct);
    if (self->state.counter.time_s < memory->mismatch_until_s) {
        *std_pct = cg_sqrt(cg_square(*std_pct) + cg_square(memory->bias_pct) +
                           cg_square(counted_pct - soc_pct));
    }
    return soc_pct;
}

static void start_count(cg_state *state, cg_sum soc_pct, cg_real var_pct2)
{
    state->memory.coulomb_start_pct = soc_pct + state->counter.discharged_pct;
    state->memory.coulomb_var_pct2 = var_pct2;
    state->memory.coulomb_counted_s = state->counter.counted_s;
    state->memory.coulomb_moved_pct = state->counter.moved_pct;
}

static void start(cg_estimator *self, cg_real soc_pct, cg_real std_pct)
{
    cg_state *state = &self->state;
    start_count(state, (cg_sum)soc_pct, cg_square(std_pct));
    if (self->settings.method == (int32_t)CG_EKF) {
        cg_filter_start(&state->filter, self->model, soc_pct, std_pct);
        state->is_filtering = true;
        state->since = (cg_since){0};
    }
}

/* ------------------------------------------------------------------ step */

/* Model's voltage less the pseudo-OCV at the latest sample. */
static cg_real without_ocv_v(cg_estimator *self)
{
    if (isnan(self->without_ocv_v)) {
        const cg_model *model = self->model;
        cg_real temperature_c = self->state.memory.temperature_c;
        if (isnan(temperature_c)) {
            temperature_c = model->t_ref_c;
        }
        for (int32_t j = 0; j < model->delays; ++j) {
            self->delayed_a[j] = cg_line_at(&self->line, (cg_time)model->delay_s[j]);
        }
        self->without_ocv_v = cg_offset_v(model, temperature_c, self->delayed_a);
    }
    return self->without_ocv_v;
}

/* Hand the voltage to the hook, and follow the levels of residual and predicted drop. */
static void after_voltage(cg_estimator *self, const cg_sample *sample, cg_tick *tick)
{
    const cg_model *model = self->model;
    cg_memory *memory = &self->state.memory;
    const cg_real cold = model->temperature_range_c[0] - R(TEMPERATURE_MARGIN_K);
    const cg_real hot = model->temperature_range_c[1] + R(TEMPERATURE_MARGIN_K);
    tick->has_voltage = true;
    tick->voltage_v = sample->voltage_v;
    tick->without_ocv_v = self->without_ocv_v;
    tick->drop_v = cg_dot(model->resistance_ohm, self->delayed_a, 0, model->delays);
    tick->soc_newton_pct = memory->newton_inside ? memory->newton_pct : CG_NAN;
    tick->soc_counted_pct = cg_clip_soc((cg_real)coulomb_pct(&self->state));
    tick->is_filled =
        cg_line_filled_s(&self->line) >= (cg_time)model->delay_s[model->delays - 1];
    tick->is_inside = (cold <= memory->temperature_c) && (memory->temperature_c <= hot);
    if (self->hook.tick != NULL) {
        self->state.has_other_capacity = self->hook.tick(self->hook.context, tick);
    }
    cg_real std_pct;
    cg_real slope;
    const cg_real soc_pct = soc_now(self, &std_pct);
    const cg_real ocv_v = cg_pseudo_ocv(self, soc_pct, &slope);
    const cg_real residual_v = tick->voltage_v - tick->without_ocv_v - ocv_v;
    cg_real weight = R(1.0);
    if ((sample->time_s - memory->level_s) < LEVEL_MEMORY_S) {
        weight = -cg_expm1((cg_real)(memory->level_s - sample->time_s) / R(LEVEL_MEMORY_S));
    }
    memory->level_residual_v += weight * (residual_v - memory->level_residual_v);
    memory->level_drop_v += weight * (tick->drop_v - memory->level_drop_v);
    memory->level_s = sample->time_s;
}

static void update_with_voltage(cg_estimator *self, const cg_sample *sample, cg_tick *tick,
                                const cg_since *since)
{
    const cg_model *model = self->model;
    cg_memory *memory = &self->state.memory;
    cg_measurement seen;
    cg_real functions_v[CG_STATES];
    cg_real slope;
    seen.voltage_v = sample->voltage_v;
    seen.without_ocv_v = without_ocv_v(self);
    const cg_real guess_pct = isnan(memory->newton_pct) ? R(50.0) : memory->newton_pct;
    memory->newton_pct =
        cg_newton(self, seen.voltage_v - seen.without_ocv_v, guess_pct, &memory->newton_inside);
    seen.soc_pct = memory->newton_pct;
    seen.std_v = cg_fast_std_v(self, memory->temperature_c, &seen.kt_std_v);
    cg_real mean_a = R(0.0);
    for (int32_t j = 0; j < model->delays; ++j) {
        mean_a += self->delayed_a[j];
    }
    mean_a = mean_a / (cg_real)model->delays;
    seen.resistance_std_v =
        cg_resistance_std(model, memory->temperature_c) * (mean_a * model->steady_ohm);
    (void)cg_pseudo_ocv(self, memory->newton_pct, &slope);
    cg_curve_functions(model, memory->newton_pct, functions_v);
    const cg_real part_v[5] = {
        seen.std_v,
        cg_sqrt(cg_square(model->slow_std_v) + cg_square(model->lasting_std_v)),
        cg_sqrt(cg_dot(functions_v, functions_v, 0, model->functions)),
        seen.kt_std_v,
        seen.resistance_std_v,
    };
    const cg_real error_v = cg_sqrt(cg_dot(part_v, part_v, 0, 5));
    memory->newton_std_pct = cg_min(error_v / slope, R(CG_UNKNOWN_SOC_STD_PCT));
    if (isnan(memory->coulomb_start_pct)) {
        start(self, memory->newton_pct, R(CG_UNKNOWN_SOC_STD_PCT));
        memory->coulomb_var_pct2 = cg_square(memory->newton_std_pct);
    }
    if (self->state.is_filtering) {
        if (cg_filter_update(self, &seen, since)) {
            memory->contradicted_until_s = sample->time_s + CONTRADICTED_S;
        }
        const cg_ekf *ekf = cg_likelier(&self->state.filter);
        const cg_real bias_v = ekf->x[CG_X_SLOW] + ekf->x[CG_X_LASTING];
        memory->bias_pct = cg_min(cg_fabs(bias_v) / slope, R(CG_UNKNOWN_SOC_STD_PCT));
        if ((cg_strain(ekf, model) > R(MISMATCH_SIGMAS)) || self->state.has_other_capacity) {
            memory->mismatch_until_s = sample->time_s + CONTRADICTED_S;
        }
    }
    after_voltage(self, sample, tick);
}

/* Fuse a SoC that is known otherwise into count and filter. */
static void fuse_reference(cg_estimator *self, cg_real soc_pct, cg_real std_pct, bool is_by_voltage)
{
    cg_state *state = &self->state;
    if (isnan(state->memory.coulomb_start_pct)) {
        start(self, soc_pct, std_pct);
        return;
    }
    if (!is_by_voltage && (self->hook.correct != NULL)) {
        state->has_other_capacity = self->hook.correct(self->hook.context, soc_pct, std_pct);
    }
    const cg_real counted_pct = cg_clip_soc((cg_real)coulomb_pct(state));
    const cg_real var_pct2 = cg_square(coulomb_std_pct(self));
    const cg_real gain = var_pct2 / (var_pct2 + cg_square(std_pct));
    start_count(state, (cg_sum)(counted_pct + (gain * (soc_pct - counted_pct))),
                (R(1.0) - gain) * var_pct2);
    if (state->is_filtering) {
        cg_filter_set_soc(&state->filter, self->model, soc_pct, std_pct);
    }
}

static bool becomes_full(cg_estimator *self, const cg_sample *sample)
{
    const cg_settings *rule = &self->settings;
    cg_memory *memory = &self->state.memory;
    if (!((sample->voltage_v >= rule->full_voltage_v) &&
          (cg_fabs(sample->current_a) <= rule->full_current_a))) {
        if (!isnan(sample->voltage_v)) {
            memory->full_since_s = (cg_time)NAN;
            memory->is_full = false;
        }
        return false;
    }
    if (isnan(memory->full_since_s)) {
        memory->full_since_s = sample->time_s;
    }
    const bool was_full = memory->is_full;
    memory->is_full = (sample->time_s - memory->full_since_s) >= (cg_time)rule->full_hold_s;
    return memory->is_full && !was_full;
}

static void use_references(cg_estimator *self, const cg_sample *sample, cg_time rest_s)
{
    const cg_settings *rule = &self->settings;
    cg_memory *memory = &self->state.memory;
    const bool is_full = !isnan(rule->full_voltage_v) && becomes_full(self, sample);
    const cg_real newton_pct = memory->newton_pct;
    bool becomes_rested = false;
    if (!isnan(rule->rest_after_s) && (isfinite(newton_pct) != 0)) {
        const bool was_rested = memory->is_rested;
        memory->is_rested = rest_s >= (cg_time)rule->rest_after_s;
        becomes_rested = memory->is_rested && !was_rested;
    }
    if (is_full) {
        fuse_reference(self, rule->full_soc_pct, rule->full_soc_std_pct, false);
    }
    if (becomes_rested) {
        fuse_reference(self, newton_pct, rule->rest_soc_std_pct, true);
    }
}

/* Restart a filter that is lost from the voltage, or from the count. */
static void restart_if_lost(cg_estimator *self, cg_time time_s)
{
    cg_state *state = &self->state;
    if (state->is_filtering && cg_filter_is_lost(&state->filter)) {
        cg_real soc_pct = state->memory.newton_pct;
        if (isnan(soc_pct)) {
            soc_pct = cg_clip_soc((cg_real)coulomb_pct(state));
        }
        if (isnan(soc_pct)) {
            soc_pct = R(50.0);
        }
        cg_filter_start(&state->filter, self->model, soc_pct, R(CG_UNKNOWN_SOC_STD_PCT));
        state->memory.contradicted_until_s = time_s + CONTRADICTED_S;
        state->memory.resets += 1;
    }
}

static void use_voltage(cg_estimator *self, const cg_sample *sample)
{
    cg_state *state = &self->state;
    cg_memory *memory = &state->memory;
    const cg_time rest_s = sample->time_s - memory->rest_since_s;
    const cg_since since = state->since;
    cg_tick tick = {0};
    state->since = (cg_since){0};
    if (state->is_filtering) {
        cg_filter_predict(&state->filter, self->model, &since);
        if (rest_s > REST_S) {
            cg_filter_shrink_bias(&state->filter, self->model);
        }
    }
    tick.since = since;
    tick.seconds = since.seconds;
    if ((since.away_s != R(0.0)) && (self->hook.count != NULL)) {
        state->has_other_capacity = self->hook.count(self->hook.context, &since);
        tick.since = (cg_since){0};
    }
    if (isnan(sample->voltage_v)) {
        memory->newton_pct = CG_NAN;
        memory->newton_inside = true;
        memory->newton_std_pct = CG_NAN;
        if (self->hook.tick != NULL) {
            state->has_other_capacity = self->hook.tick(self->hook.context, &tick);
        }
    } else {
        update_with_voltage(self, sample, &tick, &since);
    }
    use_references(self, sample, rest_s);
    restart_if_lost(self, sample->time_s);
}

/* Add a sample's charge to what the next voltage uses. */
static void add_charge(cg_estimator *self, const cg_sample *sample, const charge_step *charge)
{
    cg_memory *memory = &self->state.memory;
    cg_since *since = &self->state.since;
    since->seconds += charge->seconds;
    since->discharged_pct += charge->discharged_pct;
    since->moved_pct += cg_fabs(charge->discharged_pct);
    if (charge->away_s != R(0.0)) {
        since->away_s += charge->away_s;
        since->unseen_var_pct2 += cg_square(charge->parked_std_pct);
    } else {
        since->gap_var_pct2 += cg_square(charge->gap_std_pct);
    }
    if (charge->seconds > self->settings.gap_s) {
        const cg_model *model = self->model;
        memory->gap_until_s = sample->time_s + (cg_time)model->delay_s[model->delays - 1];
    }
    if ((charge->gap_std_pct != R(0.0)) && !isnan(memory->coulomb_var_pct2)) {
        memory->coulomb_var_pct2 += cg_square(charge->gap_std_pct);
    }
    if (cg_fabs(sample->current_a) > (R(REST_CURRENT_C_RATE) * self->model->capacity_ah)) {
        memory->rest_since_s = (cg_time)NAN;
    } else if (isnan(memory->rest_since_s)) {
        memory->rest_since_s = sample->time_s;
    } else {
        /* still at rest */
    }
    if (charge->seconds > R(REST_S)) {
        memory->rest_since_s = sample->time_s - (cg_time)charge->seconds;
    }
}

static void process(cg_estimator *self, const cg_sample *sample)
{
    const cg_model *model = self->model;
    cg_memory *memory = &self->state.memory;
    cg_real counted_a = sample->current_a;
    if ((model->effects > 0) && (counted_a < R(0.0))) {
        counted_a = model->charge_efficiency * counted_a;
    }
    const charge_step charge = count(self, sample->time_s, counted_a);
    cg_line_push(&self->line, model->delay_s[model->delays - 1], self->settings.gap_s,
                 sample->time_s, sample->current_a);
    self->without_ocv_v = CG_NAN;
    add_charge(self, sample, &charge);
    if (!isnan(sample->temperature_c)) {
        memory->temperature_c = sample->temperature_c;
    }
    if (model->effects > 0) {
        cg_advance(self, sample, memory->temperature_c);
    }
    const cg_time ticks = (sample->time_s - memory->first_s) * (cg_time)model->rate_hz;
    const int64_t tick = (int64_t)floor(ticks + 1e-6);
    if (tick > memory->tick) {
        memory->tick = tick;
        use_voltage(self, sample);
    }
}

/* Replace an implausible voltage or temperature by NAN. */
static uint32_t drop_implausible(cg_sample *sample, cg_real nominal_v)
{
    uint32_t reason = 0U;
    if (!isnan(sample->voltage_v) && !(((R(0.5) * nominal_v) <= sample->voltage_v) &&
                                       (sample->voltage_v <= (R(1.5) * nominal_v)))) {
        sample->voltage_v = CG_NAN;
        reason = CG_IMPLAUSIBLE_INPUT;
    }
    if (!isnan(sample->temperature_c) &&
        !((R(-60.0) <= sample->temperature_c) && (sample->temperature_c <= R(120.0)))) {
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
    state->is_refused = !((cg_fabs(sample->current_a) <= R(CURRENT_AT_MOST_A)) &&
                          clock_time(&state->clock, stamp_s, &now.time_s));
    if (state->is_refused) {
        return false;
    }
    if (model->effects > 0) {
        (void)cg_evaluate(self); /* effects may hold this sample back, which keeps the last one */
    }
    state->implausible = drop_implausible(&now, model->nominal_v);
    if (state->memory.samples == 0) {
        state->memory.first_s = now.time_s;
    }
    state->memory.samples += 1;
    const cg_time newest_s = now.time_s;
    const int32_t skew = cg_skew_of(model);
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

static uint32_t outside_model(const cg_model *model, cg_real soc_pct, const cg_sample *sample)
{
    uint32_t reasons = 0U;
    if ((soc_pct < (model->soc_range_pct[0] - R(SOC_MARGIN_PCT))) ||
        (soc_pct > (model->soc_range_pct[1] + R(SOC_MARGIN_PCT)))) {
        reasons |= CG_SOC_OUTSIDE_MODEL;
    }
    if ((sample->temperature_c < (model->temperature_range_c[0] - R(OUTSIDE_MARGIN_K))) ||
        (sample->temperature_c > (model->temperature_range_c[1] + R(OUTSIDE_MARGIN_K)))) {
        reasons |= CG_TEMPERATURE_OUTSIDE_MODEL;
    }
    if ((sample->current_a < (R(CURRENT_MARGIN) * model->current_range_a[0])) ||
        (sample->current_a > (R(CURRENT_MARGIN) * model->current_range_a[1]))) {
        reasons |= CG_CURRENT_OUTSIDE_MODEL;
    }
    return reasons;
}

static uint32_t reason_if(bool is_set, uint32_t reason)
{
    return is_set ? reason : 0U;
}

static uint32_t reasons_now(const cg_estimator *self, const cg_sample *sample, cg_real soc_pct,
                            cg_real std_pct)
{
    const cg_model *model = self->model;
    const cg_memory *memory = &self->state.memory;
    const cg_time longest_s = (cg_time)model->delay_s[model->delays - 1];
    const cg_time time_s = sample->time_s;
    uint32_t reasons = self->settings.reasons | self->state.implausible;
    reasons |= reason_if(isnan(soc_pct) != 0, CG_NO_INITIAL_SOC);
    reasons |= reason_if(std_pct > self->settings.valid_std_pct, CG_SOC_UNCERTAIN);
    reasons |= reason_if(cg_line_filled_s(&self->line) < longest_s, CG_DELAY_LINE_FILLING);
    reasons |= reason_if(time_s < memory->gap_until_s, CG_CURRENT_GAP);
    reasons |= reason_if(isnan(sample->voltage_v) != 0, CG_VOLTAGE_MISSING);
    reasons |= reason_if(isnan(sample->temperature_c) != 0, CG_TEMPERATURE_MISSING);
    reasons |= reason_if(!memory->newton_inside, CG_VOLTAGE_OUTSIDE_MODEL);
    reasons |= reason_if(time_s < memory->contradicted_until_s, CG_INNOVATION_LARGE);
    reasons |= reason_if(time_s < memory->mismatch_until_s, CG_MODEL_MISMATCH);
    return reasons | outside_model(model, soc_pct, sample);
}

static int32_t status_of(uint32_t reasons)
{
    if (reasons == 0U) {
        return (int32_t)CG_VALID;
    }
    if ((reasons & CG_NO_INITIAL_SOC) != 0U) {
        return (int32_t)CG_INITIALISING;
    }
    if ((reasons & (CG_INPUT_STALE | CG_CURRENT_MISSING)) != 0U) {
        return (int32_t)CG_INVALID;
    }
    return (int32_t)CG_DEGRADED;
}

cg_estimate cg_evaluate(cg_estimator *self)
{
    cg_state *state = &self->state;
    cg_estimate *latest = &state->latest;
    if (state->is_pending) {
        const cg_sample *sample = &state->pending;
        cg_real std_pct;
        cg_real slope;
        const cg_real soc_pct = soc_now(self, &std_pct);
        state->is_pending = false;
        latest->time_s = state->pending_stamp_s;
        latest->soc_pct = soc_pct;
        latest->soc_std_pct = std_pct;
        latest->soc_newton_pct = state->memory.newton_pct;
        latest->soc_coulomb_pct = cg_clip_soc((cg_real)coulomb_pct(state));
        latest->voltage_model_v = CG_NAN;
        if (!isnan(soc_pct)) {
            const cg_real ocv_v = cg_pseudo_ocv(self, soc_pct, &slope);
            latest->voltage_model_v = ocv_v + without_ocv_v(self);
        }
        latest->residual_v = sample->voltage_v - latest->voltage_model_v;
        latest->reasons = reasons_now(self, sample, soc_pct, std_pct);
        latest->status = status_of(latest->reasons);
        latest->samples = state->memory.samples;
    }
    cg_estimate estimate = *latest;
    if (state->is_refused) {
        estimate.reasons |= CG_IMPLAUSIBLE_INPUT;
        estimate.status = status_of(estimate.reasons);
    }
    return estimate;
}

/* ------------------------------------------------------------------ begin and continue */

cg_settings cg_default_settings(void)
{
    cg_settings settings = {0};
    settings.method = (int32_t)CG_EKF;
    settings.initial_soc_pct = CG_NAN;
    settings.initial_soc_std_pct = R(1.0);
    settings.valid_std_pct = R(1.5);
    settings.gap_s = R(2.0);
    settings.full_voltage_v = CG_NAN;
    settings.rest_after_s = CG_NAN;
    return settings;
}

static void forget(cg_state *state)
{
    const cg_real nan = CG_NAN;
    *state = (cg_state){0};
    state->clock.last_s = (cg_time)NAN;
    state->clock.behind_s = (cg_time)NAN;
    state->counter.time_s = (cg_time)NAN;
    state->filter.hypotheses = 1;
    state->filter.wide_std_pct = R(CG_UNKNOWN_SOC_STD_PCT);
    state->filter.stated_pct = nan;
    state->memory.tick = -1;
    state->memory.temperature_c = nan;
    state->memory.newton_pct = nan;
    state->memory.newton_inside = true;
    state->memory.newton_std_pct = nan;
    state->memory.coulomb_start_pct = (cg_sum)NAN;
    state->memory.coulomb_var_pct2 = nan;
    state->memory.gap_until_s = (cg_time)NAN;
    state->memory.contradicted_until_s = (cg_time)NAN;
    state->memory.mismatch_until_s = (cg_time)NAN;
    state->memory.rest_since_s = (cg_time)NAN;
    state->memory.level_s = (cg_time)NAN;
    state->memory.full_since_s = (cg_time)NAN;
    state->latest = (cg_estimate){(cg_time)NAN, nan, nan, nan, nan, nan, nan,
                                  (int32_t)CG_INITIALISING, CG_NO_INITIAL_SOC, 0};
}

void cg_init(cg_estimator *self, const cg_model *model, const cg_settings *settings,
             const cg_line *line, cg_skew *skew)
{
    self->model = model;
    self->settings = *settings;
    self->line = *line;
    self->line.first = 0;
    self->line.count = 0;
    self->skew = skew;
    self->hook = (cg_hook){NULL, NULL, NULL, NULL};
    self->without_ocv_v = CG_NAN;
    if (skew != NULL) {
        skew->first = 0;
        skew->count = 0;
        skew->waiting_first = 0;
        skew->waiting_count = 0;
    }
    forget(&self->state);
    if (!isnan(settings->initial_soc_pct)) {
        start(self, cg_clip_soc(settings->initial_soc_pct + model->initial_offset_pct),
              settings->initial_soc_std_pct);
    }
}

static bool is_filter_plausible(const cg_filter *filter, const cg_model *model)
{
    if ((filter->hypotheses < 1) || (filter->hypotheses > 2) ||
        (filter->verdict < (int32_t)CG_NO_TEST) || (filter->verdict > (int32_t)CG_UNCLEAR) ||
        !isfinite(filter->log_odds) || !isfinite(filter->prior_log_odds) ||
        !isfinite(filter->wide_std_pct) || !isfinite(filter->outlier_s)) {
        return false;
    }
    const int32_t size = cg_states(model);
    for (int32_t i = 0; i < filter->hypotheses; ++i) {
        const cg_ekf *ekf = &filter->ekf[i];
        bool is_finite = isfinite(ekf->mean_innovation_v) && isfinite(ekf->mean_seconds);
        for (int32_t k = 0; k < size; ++k) {
            is_finite = is_finite && isfinite(ekf->x[k]);
            for (int32_t j = 0; j < CG_LEARNED; ++j) {
                is_finite = is_finite && isfinite(ekf->p[j][k]);
            }
        }
        if (!is_finite) {
            return false;
        }
        for (int32_t j = 0; j < CG_LEARNED; ++j) {
            if (ekf->p[j][j] < R(0.0)) {
                return false;
            }
        }
    }
    return true;
}

static bool are_effects_plausible(const cg_state *state, const cg_model *model)
{
    bool is_finite = true;
    for (int32_t k = 0; k < model->effects; ++k) {
        for (int32_t j = 0; j < model->effect[k].lags; ++j) {
            const cg_lag *lag = &state->effect[k].lag[j];
            is_finite = is_finite &&
                        (!lag->is_started || (isfinite(lag->time_s) && isfinite(lag->input) &&
                                              isfinite(lag->value)));
        }
    }
    return is_finite;
}

static bool is_plausible(const cg_state *state, const cg_model *model)
{
    const cg_clock *clock = &state->clock;
    const cg_counter *counter = &state->counter;
    const cg_memory *memory = &state->memory;
    const bool are_counts = (clock->behind >= 0) && (memory->samples >= 0) &&
                            (memory->resets >= 0) && (memory->tick >= -1);
    const bool are_times = (isnan(clock->last_s) || (fabs(clock->last_s) <= (2.0 * LATEST_S))) &&
                           isfinite(clock->shift_s) && !isinf(counter->time_s);
    const bool is_charge = isfinite(counter->current_a) && isfinite(counter->mean_square_a2) &&
                           isfinite(counter->mean_a) && isfinite(counter->discharged_pct) &&
                           isfinite(counter->moved_pct) && isfinite(counter->counted_s) &&
                           !isinf(memory->coulomb_start_pct) && !isinf(memory->newton_pct) &&
                           !isinf(memory->temperature_c);
    return are_counts && are_times && is_charge && are_effects_plausible(state, model) &&
           (!state->is_filtering || is_filter_plausible(&state->filter, model));
}

bool cg_restore(cg_estimator *self, const cg_state *state, cg_time age_s)
{
    if (!is_plausible(state, self->model)) {
        return false;
    }
    self->state = *state;
    self->state.is_pending = false; /* its delay line is gone */
    self->state.clock.age_s = age_s;
    self->state.clock.is_restored = true;
    self->state.counter.is_restored = true;
    self->line.count = 0;
    self->without_ocv_v = CG_NAN;
    return true;
}

cg_real cg_current_at(const cg_estimator *self, cg_time ago_s)
{
    return cg_line_at(&self->line, ago_s);
}
