/* cangauge_filter.c - extended Kalman filter with one or two hypotheses of the SoC.
 *
 * Follows the Python modules estimation.ekf and estimation.hypothesis_filter operation by
 * operation; their docstrings state equations and sources.
 */
#include "cangauge_internal.h"

/* filter */
#define OFFSET_WALK_PER_SQRT_H 0.1
#define PERSISTENT_S 60.0
#define PERSISTENT_SIGMAS 4.5
#define OUTLIER_SIGMAS 5.0
#define RESTED_BIAS 0.6
#define LOWEST_PCT (-10.0)
#define HIGHEST_PCT 110.0
#define LINEAR_PCT 1.0
#define ITERATIONS_AT_MOST 8

/* hypotheses */
#define CLEAR_LOG_ODDS 6.907755278982137 /* ln 1000 */
#define FORGOTTEN 0.01
#define NEGLIGIBLE 0.02
#define LOG_ODDS_AT_MOST 50.0
#define TWO_SIGMA 0.9544997361036416 /* erf(sqrt 2) */
#define NARROWEST_PCT 1e-9
#define WRONG_LOG_ODDS (-4.59511985013459) /* -ln 99 */
#define DIVERGED_S 180.0
#define OUTLIER_STEP_AT_MOST_S 10.0
#define WIDTH_STEPS_AT_MOST 200
#define SQRT_2 1.4142135623730951
#define SQRT_PI 1.7724538509055159

/* priors of an unobserved interval */
#define MOVED_AT_MOST 0.3
#define MOVED_TIME_S 1800.0
#define SHORTEST_S 1.0
#define FASTEST_PCT_PER_HOUR 150.0

/* ------------------------------------------------------------------ filter */

static void ekf_start(cg_ekf *ekf, const cg_model *model, cg_real soc_pct, cg_real std_pct)
{
    const int32_t size = cg_states(model);
    const cg_real offset_std_a = R(CG_OFFSET_STD_PER_AH) * model->capacity_ah;
    for (int32_t k = 0; k < size; ++k) {
        ekf->x[k] = R(0.0);
        for (int32_t j = 0; j < CG_LEARNED; ++j) {
            ekf->p[j][k] = R(0.0);
        }
    }
    ekf->x[CG_X_SOC] = soc_pct;
    ekf->p[CG_X_SOC][CG_X_SOC] = cg_square(std_pct);
    ekf->p[CG_X_OFFSET][CG_X_OFFSET] = cg_square(offset_std_a);
    ekf->p[CG_X_SLOW][CG_X_SLOW] = cg_square(model->slow_std_v);
    ekf->p[CG_X_LASTING][CG_X_LASTING] = cg_square(model->lasting_std_v);
    ekf->p[CG_X_CAPACITY][CG_X_CAPACITY] = cg_square(R(CG_CAPACITY_STD));
    ekf->mean_innovation_v = R(0.0);
    ekf->mean_seconds = R(0.0);
}

static void ekf_clip(cg_ekf *ekf)
{
    ekf->x[CG_X_SOC] = cg_clip(ekf->x[CG_X_SOC], R(LOWEST_PCT), R(HIGHEST_PCT));
}

/* x <- F x - charge, P <- F P F' + Q. */
static void ekf_predict(cg_ekf *ekf, const cg_model *model, const cg_since *since,
                        cg_real gap_var_pct2)
{
    const int32_t size = cg_states(model);
    const cg_real offset_std_a = R(CG_OFFSET_STD_PER_AH) * model->capacity_ah;
    const cg_real by_offset = cg_pct_per_as(model) * (since->seconds - since->away_s);
    const cg_real by_capacity = -since->discharged_pct;
    const cg_real slow_kept = cg_exp(-since->seconds / model->slow_time_s);
    const cg_real lasting_kept = cg_exp((-since->seconds / model->lasting_time_s) -
                                        (since->moved_pct / model->lasting_soc_pct));
    cg_real *x = ekf->x;
    cg_real *first = ekf->p[CG_X_SOC];
    cg_real *slow = ekf->p[CG_X_SLOW];
    cg_real *lasting = ekf->p[CG_X_LASTING];
    x[CG_X_SOC] += (by_offset * x[CG_X_OFFSET]) + (by_capacity * x[CG_X_CAPACITY]) -
                   since->discharged_pct;
    x[CG_X_SLOW] *= slow_kept;
    x[CG_X_LASTING] *= lasting_kept;
    for (int32_t k = 0; k < size; ++k) {
        first[k] = first[k] + (by_offset * ekf->p[CG_X_OFFSET][k]) +
                   (by_capacity * ekf->p[CG_X_CAPACITY][k]);
        slow[k] = slow_kept * slow[k];
        lasting[k] = lasting_kept * lasting[k];
    }
    first[CG_X_SOC] += (by_offset * first[CG_X_OFFSET]) + (by_capacity * first[CG_X_CAPACITY]);
    first[CG_X_SLOW] *= slow_kept;
    first[CG_X_LASTING] *= lasting_kept;
    slow[CG_X_SLOW] *= slow_kept;
    lasting[CG_X_SLOW] *= slow_kept;
    lasting[CG_X_LASTING] *= lasting_kept;
    slow[CG_X_LASTING] = lasting[CG_X_SLOW];
    slow[CG_X_SOC] = first[CG_X_SLOW];
    lasting[CG_X_SOC] = first[CG_X_LASTING];
    for (int32_t k = 1; k < CG_LEARNED; ++k) {
        ekf->p[k][CG_X_SOC] = first[k];
        ekf->p[k][CG_X_SLOW] = slow[k];
        ekf->p[k][CG_X_LASTING] = lasting[k];
    }
    const cg_real walk_a = R(OFFSET_WALK_PER_SQRT_H) * offset_std_a;
    first[CG_X_SOC] += gap_var_pct2;
    ekf->p[CG_X_OFFSET][CG_X_OFFSET] += cg_square(walk_a) * since->seconds / R(3600.0);
    slow[CG_X_SLOW] += cg_square(model->slow_std_v) * (R(1.0) - cg_square(slow_kept));
    lasting[CG_X_LASTING] += cg_square(model->lasting_std_v) * (R(1.0) - cg_square(lasting_kept));
    ekf_clip(ekf);
}

/* The Jacobian at a SoC; returns the voltage without the model's errors. */
static cg_real ekf_linearize(const cg_estimator *self, const cg_ekf *ekf,
                             const cg_measurement *seen, cg_real soc_pct, cg_real *jacobian)
{
    const cg_real steady_ohm = self->model->steady_ohm;
    const cg_real ocv_v = cg_pseudo_ocv(self, soc_pct, &jacobian[CG_X_SOC]);
    jacobian[CG_X_OFFSET] = -steady_ohm;
    jacobian[CG_X_SLOW] = R(1.0);
    jacobian[CG_X_LASTING] = R(1.0);
    jacobian[CG_X_CAPACITY] = R(0.0);
    jacobian[CG_X_KT] = seen->kt_std_v;
    cg_curve_functions(self->model, soc_pct, &jacobian[CG_X_KT + 1]);
    return ocv_v + seen->without_ocv_v - (steady_ohm * ekf->x[CG_X_OFFSET]);
}

/* Whether the mean error of the prediction contradicts state and error model. */
static bool ekf_is_contradicted(cg_ekf *ekf, const cg_model *model, const cg_measurement *seen,
                                cg_real unbiased_v, const cg_real *jacobian, cg_real seconds)
{
    if (seconds > R(PERSISTENT_S)) {
        ekf->mean_innovation_v = R(0.0);
        ekf->mean_seconds = R(0.0);
        return false;
    }
    const cg_real weight = cg_exp(-seconds / R(PERSISTENT_S));
    ekf->mean_innovation_v *= weight;
    ekf->mean_innovation_v += (R(1.0) - weight) * (seen->voltage_v - unbiased_v);
    ekf->mean_seconds += seconds;
    if (ekf->mean_seconds < R(PERSISTENT_S)) {
        return false;
    }
    cg_real mean_var = cg_square(model->slow_std_v) + cg_square(model->lasting_std_v) +
                       cg_dot(jacobian, jacobian, CG_X_KT, cg_states(model));
    mean_var += (cg_square(jacobian[CG_X_SOC]) * ekf->p[CG_X_SOC][CG_X_SOC]) +
                cg_square(seen->resistance_std_v);
    mean_var += cg_square(seen->std_v) * seconds / (R(2.0) * R(PERSISTENT_S));
    const cg_real known = R(1.0) - cg_exp(-ekf->mean_seconds / R(PERSISTENT_S));
    const cg_real mean = ekf->mean_innovation_v / known;
    return cg_square(mean) > (cg_square(R(PERSISTENT_SIGMAS)) * mean_var);
}

/* Correct the learned states by one measurement with P H' = spread. */
static void ekf_correct(cg_ekf *ekf, int32_t size, const cg_real *spread, cg_real innovation,
                        cg_real total)
{
    for (int32_t k = 0; k < CG_LEARNED; ++k) {
        const cg_real gain = spread[k] / total;
        ekf->x[k] += gain * innovation;
        for (int32_t j = 0; j < size; ++j) {
            ekf->p[k][j] = ekf->p[k][j] - (gain * spread[j]);
        }
    }
    for (int32_t k = 1; k < CG_LEARNED; ++k) {
        for (int32_t j = 0; j < k; ++j) {
            ekf->p[k][j] = ekf->p[j][k];
        }
    }
    ekf_clip(ekf);
}

/* P H' of a voltage, to which slow and lasting error count in full. */
static void ekf_spread(const cg_ekf *ekf, int32_t size, const cg_real *jacobian, cg_real *spread)
{
    for (int32_t k = 0; k < size; ++k) {
        spread[k] = (jacobian[CG_X_SOC] * ekf->p[CG_X_SOC][k]) +
                    (jacobian[CG_X_OFFSET] * ekf->p[CG_X_OFFSET][k]) + ekf->p[CG_X_SLOW][k] +
                    ekf->p[CG_X_LASTING][k];
    }
    for (int32_t k = 0; k < CG_LEARNED; ++k) {
        spread[k] += cg_dot(ekf->p[k], jacobian, CG_LEARNED, size);
    }
    for (int32_t k = CG_LEARNED; k < size; ++k) {
        spread[k] += jacobian[k];
    }
}

/* Update with one voltage. Whether a lasting contradiction made the SoC unknown again. */
static bool ekf_update(const cg_estimator *self, cg_ekf *ekf, const cg_measurement *seen,
                       cg_real seconds)
{
    const cg_model *model = self->model;
    const int32_t size = cg_states(model);
    cg_real jacobian[CG_STATES];
    cg_real spread[CG_STATES];
    cg_real fast_v2 = cg_square(seen->std_v);
    const cg_real forgotten = -cg_expm1(R(-2.0) * seconds / model->slow_time_s);
    ekf->p[CG_X_SLOW][CG_X_SLOW] += cg_square(seen->resistance_std_v) * forgotten;
    cg_real unbiased_v = ekf_linearize(self, ekf, seen, ekf->x[CG_X_SOC], jacobian);
    const bool is_contradicted =
        ekf_is_contradicted(ekf, model, seen, unbiased_v, jacobian, seconds);
    if (is_contradicted) {
        const cg_real offset_a = ekf->x[CG_X_OFFSET];
        const cg_real offset_var = ekf->p[CG_X_OFFSET][CG_X_OFFSET];
        ekf_start(ekf, model, ekf->x[CG_X_SOC], R(CG_UNKNOWN_SOC_STD_PCT));
        ekf->x[CG_X_OFFSET] = offset_a;
        ekf->p[CG_X_OFFSET][CG_X_OFFSET] = offset_var;
    }
    const cg_real start_pct = ekf->x[CG_X_SOC];
    cg_real at_pct = start_pct;
    cg_real innovation = R(0.0);
    cg_real of_state = R(0.0);
    for (int32_t step = 0; step < ITERATIONS_AT_MOST; ++step) {
        innovation = seen->voltage_v - unbiased_v - (ekf->x[CG_X_SLOW] + ekf->x[CG_X_LASTING]);
        ekf_spread(ekf, size, jacobian, spread);
        of_state = cg_max(cg_dot(spread, jacobian, 0, size), R(0.0));
        cg_real corrected_pct = start_pct + (spread[CG_X_SOC] / (of_state + fast_v2) * innovation);
        corrected_pct = cg_clip(corrected_pct, R(LOWEST_PCT), R(HIGHEST_PCT));
        if (cg_fabs(corrected_pct - at_pct) < R(LINEAR_PCT)) {
            break;
        }
        at_pct = corrected_pct;
        unbiased_v = ekf_linearize(self, ekf, seen, at_pct, jacobian);
        unbiased_v += jacobian[CG_X_SOC] * (start_pct - at_pct);
    }
    const cg_real square = innovation * innovation;
    ekf->was_outlier = square > (cg_square(R(OUTLIER_SIGMAS)) * (of_state + fast_v2));
    if (ekf->was_outlier) {
        fast_v2 = cg_max(fast_v2, square - of_state);
    }
    ekf_correct(ekf, size, spread, innovation, of_state + fast_v2);
    return is_contradicted;
}

/* Update with a SoC known otherwise. */
static void ekf_set_soc(cg_ekf *ekf, int32_t size, cg_real soc_pct, cg_real std_pct)
{
    cg_real spread[CG_STATES];
    for (int32_t k = 0; k < size; ++k) {
        spread[k] = ekf->p[CG_X_SOC][k];
    }
    ekf_correct(ekf, size, spread, soc_pct - ekf->x[CG_X_SOC],
                spread[CG_X_SOC] + cg_square(std_pct));
}

/* Reduce the slow error after a long rest. */
static void ekf_shrink_bias(cg_ekf *ekf, const cg_model *model)
{
    const int32_t size = cg_states(model);
    const cg_real limit = cg_square(R(RESTED_BIAS)) * cg_square(model->slow_std_v);
    if (ekf->p[CG_X_SLOW][CG_X_SLOW] > limit) {
        const cg_real shrink = cg_sqrt(limit / ekf->p[CG_X_SLOW][CG_X_SLOW]);
        ekf->x[CG_X_SLOW] *= shrink;
        for (int32_t k = 0; k < size; ++k) {
            ekf->p[CG_X_SLOW][k] = shrink * ekf->p[CG_X_SLOW][k];
        }
        ekf->p[CG_X_SLOW][CG_X_SLOW] *= shrink;
        for (int32_t k = 0; k < CG_LEARNED; ++k) {
            ekf->p[k][CG_X_SLOW] = ekf->p[CG_X_SLOW][k];
        }
    }
}

static bool ekf_is_valid(const cg_ekf *ekf)
{
    for (int32_t k = 0; k < CG_LEARNED; ++k) {
        if (!((ekf->p[k][k] >= R(0.0)) && (cg_fabs(ekf->x[k]) < R(INFINITY)))) {
            return false;
        }
    }
    return true;
}

/* Largest of offset, lasting bias and capacity error, in prior standard deviations. */
cg_real cg_strain(const cg_ekf *ekf, const cg_model *model)
{
    const cg_real offset_std_a = R(CG_OFFSET_STD_PER_AH) * model->capacity_ah;
    const cg_real lasting_std_v = cg_sqrt(cg_square(model->lasting_std_v));
    const cg_real lasting =
        (lasting_std_v > R(0.0)) ? (cg_fabs(ekf->x[CG_X_LASTING]) / lasting_std_v) : R(0.0);
    const cg_real offset = cg_fabs(ekf->x[CG_X_OFFSET]) / offset_std_a;
    const cg_real capacity = cg_fabs(ekf->x[CG_X_CAPACITY]) / R(CG_CAPACITY_STD);
    return cg_max(cg_max(offset, capacity), lasting);
}

/* ------------------------------------------------------------------ hypotheses */

static cg_real moved_std_pct(cg_real seconds)
{
    return cg_min(R(FASTEST_PCT_PER_HOUR) * seconds / R(3600.0), R(CG_MOVED_STD_AT_MOST_PCT));
}

static cg_real moved_log_odds(cg_real seconds)
{
    const cg_real times = -cg_max(seconds, R(SHORTEST_S)) / R(MOVED_TIME_S);
    const cg_real probability = R(-MOVED_AT_MOST) * cg_expm1(times);
    return cg_log(probability / (R(1.0) - probability));
}

static cg_real bounded(cg_real log_odds)
{
    return cg_clip(log_odds, R(-LOG_ODDS_AT_MOST), R(LOG_ODDS_AT_MOST));
}

static cg_real second_probability(const cg_filter *filter)
{
    return R(1.0) / (R(1.0) + cg_exp(-filter->log_odds));
}

static cg_real mean_of(const cg_filter *filter, cg_real first, cg_real second)
{
    const cg_real probability = second_probability(filter);
    return ((R(1.0) - probability) * first) + (probability * second);
}

void cg_filter_start(cg_filter *filter, const cg_model *model, cg_real soc_pct, cg_real std_pct)
{
    filter->stated_pct = CG_NAN;
    filter->hypotheses = 1;
    ekf_start(&filter->ekf[0], model, soc_pct, std_pct);
    filter->ekf[0].was_outlier = false;
    filter->is_untested = std_pct < R(CG_UNKNOWN_SOC_STD_PCT);
    filter->outlier_s = R(0.0);
    if (filter->verdict == (int32_t)CG_OPEN) {
        filter->verdict = (int32_t)CG_UNCLEAR;
    }
}

/* Open the second hypothesis, whose filter is in place. */
static void filter_open(cg_filter *filter, cg_real log_odds, cg_real wide_std_pct)
{
    filter->hypotheses = 2;
    filter->stated_pct = CG_NAN;
    filter->ekf[1].was_outlier = false;
    filter->log_odds = log_odds;
    filter->prior_log_odds = log_odds;
    filter->wide_std_pct = wide_std_pct;
}

static cg_real soc_std_pct(const cg_ekf *ekf)
{
    return cg_sqrt(cg_max(ekf->p[CG_X_SOC][CG_X_SOC], R(0.0)));
}

/* Probability of +-width of a normal distribution with a mean, and its slope. */
static cg_real within(cg_real width, cg_real away, cg_real std, cg_real *density)
{
    const cg_real scale = cg_max(std, R(NARROWEST_PCT)) * R(SQRT_2);
    const cg_real low = (-width - away) / scale;
    const cg_real high = (width - away) / scale;
    *density = (cg_exp(-(low * low)) + cg_exp(-(high * high))) / (scale * R(SQRT_PI));
    return R(0.5) * (cg_erf(high) - cg_erf(low));
}

/* Half of the half-width that contains as much of two hypotheses as two sigma of a normal one. */
static cg_real stated_std_pct(const cg_filter *filter, const cg_real *away, const cg_real *std)
{
    cg_real low = R(0.0);
    cg_real high = cg_max(away[0] + (R(3.0) * std[0]), away[1] + (R(3.0) * std[1]));
    cg_real width = cg_min(R(2.0) * mean_of(filter, std[0], std[1]), high);
    cg_real step = high;
    for (int32_t k = 0; (k < WIDTH_STEPS_AT_MOST) && (cg_fabs(step) > R(CG_LAST_STEP_PCT)); ++k) {
        cg_real density[2];
        const cg_real one = within(width, away[0], std[0], &density[0]);
        const cg_real other = within(width, away[1], std[1], &density[1]);
        const cg_real missing = R(TWO_SIGMA) - mean_of(filter, one, other);
        if (missing > R(0.0)) {
            low = width;
        } else {
            high = width;
        }
        const cg_real slope = mean_of(filter, density[0], density[1]);
        cg_real following = (slope > R(0.0)) ? (width + (missing / slope)) : R(INFINITY);
        if (!((low < following) && (following < high))) {
            following = R(0.5) * (low + high);
        }
        step = following - width;
        width = following;
    }
    return R(0.5) * width;
}

/* SoC, its standard deviation and the charge that the offset adds, of one or two hypotheses. */
typedef struct {
    cg_real soc_pct;
    cg_real std_pct;
    cg_real offset_pct;
} mixture;

static mixture mix(cg_filter *filter, cg_real pct_per_a)
{
    const cg_ekf *one = &filter->ekf[0];
    const cg_ekf *other = &filter->ekf[1];
    mixture mixed = {one->x[CG_X_SOC], soc_std_pct(one), pct_per_a * one->x[CG_X_OFFSET]};
    if (filter->hypotheses > 1) {
        const cg_real std[2] = {mixed.std_pct, soc_std_pct(other)};
        mixed.soc_pct = mean_of(filter, one->x[CG_X_SOC], other->x[CG_X_SOC]);
        mixed.offset_pct =
            mean_of(filter, mixed.offset_pct, pct_per_a * other->x[CG_X_OFFSET]);
        const cg_real away[2] = {cg_fabs(one->x[CG_X_SOC] - mixed.soc_pct),
                                 cg_fabs(other->x[CG_X_SOC] - mixed.soc_pct)};
        if (isnan(filter->stated_pct)) {
            filter->stated_pct = stated_std_pct(filter, away, std);
        }
        mixed.std_pct = filter->stated_pct;
    }
    return mixed;
}

/* Replace two hypotheses by one with their mean, covariance, and the deviation stated. */
static void filter_merge(cg_filter *filter, int32_t size)
{
    if (filter->hypotheses == 1) {
        return;
    }
    cg_ekf *one = &filter->ekf[0];
    const cg_ekf *other = &filter->ekf[1];
    const cg_real std_pct = mix(filter, R(0.0)).std_pct;
    cg_real from_one[CG_STATES];
    cg_real from_other[CG_STATES];
    for (int32_t k = 0; k < size; ++k) {
        const cg_real x = mean_of(filter, one->x[k], other->x[k]);
        from_one[k] = one->x[k] - x;
        from_other[k] = other->x[k] - x;
        one->x[k] = x;
    }
    for (int32_t k = 0; k < CG_LEARNED; ++k) {
        for (int32_t j = 0; j < size; ++j) {
            one->p[k][j] = mean_of(filter, one->p[k][j] + (from_one[k] * from_one[j]),
                                   other->p[k][j] + (from_other[k] * from_other[j]));
        }
    }
    const cg_real variance = one->p[CG_X_SOC][CG_X_SOC];
    const cg_real scale = (variance > R(0.0)) ? (std_pct / cg_sqrt(variance)) : R(1.0);
    for (int32_t k = 0; k < size; ++k) {
        one->p[CG_X_SOC][k] = scale * one->p[CG_X_SOC][k];
    }
    for (int32_t k = 0; k < CG_LEARNED; ++k) {
        one->p[k][CG_X_SOC] *= scale;
    }
    if (filter->log_odds > R(0.0)) {
        one->mean_innovation_v = other->mean_innovation_v;
        one->mean_seconds = other->mean_seconds;
    }
    one->was_outlier = false;
    filter->hypotheses = 1;
    if (filter->verdict == (int32_t)CG_OPEN) {
        filter->verdict = (int32_t)CG_UNCLEAR;
    }
}

/* Keep one hypothesis; whether this changes the SoC assumed so far. */
static bool filter_decide(cg_filter *filter, bool is_second, bool is_contradicted)
{
    if (is_second) {
        filter->ekf[0] = filter->ekf[1];
    }
    filter->hypotheses = 1;
    if (filter->verdict != (int32_t)CG_OPEN) {
        return is_contradicted || is_second;
    }
    filter->verdict = is_second ? (int32_t)CG_MOVED : (int32_t)CG_PARKED;
    return is_contradicted;
}

void cg_filter_predict(cg_filter *filter, const cg_model *model, const cg_since *since)
{
    const cg_real parked_var_pct2 = since->gap_var_pct2 + since->unseen_var_pct2;
    cg_real second_var_pct2 = parked_var_pct2;
    filter->stated_pct = CG_NAN;
    if (since->away_s != R(0.0)) {
        const cg_real moved_pct = moved_std_pct(since->away_s);
        filter_merge(filter, cg_states(model));
        filter->ekf[1] = filter->ekf[0];
        filter_open(filter, moved_log_odds(since->away_s), moved_pct);
        filter->verdict = (int32_t)CG_OPEN;
        second_var_pct2 = since->gap_var_pct2 + cg_square(moved_pct);
    }
    ekf_predict(&filter->ekf[0], model, since, parked_var_pct2);
    if (filter->hypotheses > 1) {
        ekf_predict(&filter->ekf[1], model, since, second_var_pct2);
    }
}

/* Set the log odds from all voltages (Savage-Dickey ratio); whether the less likely counts. */
static bool weigh(cg_filter *filter)
{
    const cg_real first_pct2 = cg_square(soc_std_pct(&filter->ekf[0]));
    const cg_real second_pct2 = cg_square(soc_std_pct(&filter->ekf[1]));
    const cg_real more_pct2 = second_pct2 - first_pct2;
    const cg_real apart_pct = filter->ekf[1].x[CG_X_SOC] - filter->ekf[0].x[CG_X_SOC];
    if (more_pct2 > (R(FORGOTTEN) * second_pct2)) {
        const cg_real square = cg_square(apart_pct) / more_pct2;
        const cg_real ratio = filter->wide_std_pct * cg_sqrt(more_pct2) / second_pct2;
        filter->log_odds = bounded(filter->prior_log_odds + (R(0.5) * square) - cg_log(ratio));
    }
    const cg_real second = second_probability(filter);
    const cg_real first = R(1.0) - second;
    const cg_real spread_pct2 = first * second * apart_pct * apart_pct;
    if (second > R(0.5)) {
        return cg_fabs(spread_pct2 - (first * more_pct2)) > (R(NEGLIGIBLE) * second_pct2);
    }
    return cg_fabs(spread_pct2 + (second * more_pct2)) > (R(NEGLIGIBLE) * first_pct2);
}

/* Update with one voltage. Whether it shows that the SoC was wrong until now. */
bool cg_filter_update(cg_estimator *self, const cg_measurement *seen, const cg_since *since)
{
    cg_filter *filter = &self->state.filter;
    filter->stated_pct = CG_NAN;
    if (filter->is_untested) {
        filter->is_untested = false;
        if (filter->hypotheses == 1) {
            ekf_start(&filter->ekf[1], self->model, seen->soc_pct, R(CG_UNKNOWN_SOC_STD_PCT));
            filter_open(filter, R(WRONG_LOG_ODDS), R(CG_UNKNOWN_SOC_STD_PCT));
        }
    }
    const bool is_contradicted = ekf_update(self, &filter->ekf[0], seen, since->seconds);
    bool is_second_contradicted = is_contradicted;
    bool are_outliers = filter->ekf[0].was_outlier;
    if (filter->hypotheses > 1) {
        is_second_contradicted = ekf_update(self, &filter->ekf[1], seen, since->seconds);
        are_outliers = are_outliers && filter->ekf[1].was_outlier;
    }
    if (are_outliers) {
        filter->outlier_s += cg_min(since->seconds, R(OUTLIER_STEP_AT_MOST_S));
    } else {
        filter->outlier_s = R(0.0);
    }
    if (filter->hypotheses == 1) {
        return is_contradicted;
    }
    const bool is_open = weigh(filter);
    if (is_contradicted != is_second_contradicted) {
        return filter_decide(filter, is_contradicted, false);
    }
    const cg_real prior =
        (filter->verdict == (int32_t)CG_OPEN) ? R(0.0) : filter->prior_log_odds;
    const bool is_clear = (filter->log_odds > R(CLEAR_LOG_ODDS)) ||
                          (filter->log_odds < (prior - R(CLEAR_LOG_ODDS)));
    if (is_open && !(is_contradicted || is_clear)) {
        return false;
    }
    return filter_decide(filter, filter->log_odds > R(0.0), is_contradicted);
}

bool cg_filter_is_lost(const cg_filter *filter)
{
    if (filter->outlier_s > R(DIVERGED_S)) {
        return true;
    }
    for (int32_t k = 0; k < filter->hypotheses; ++k) {
        if (!ekf_is_valid(&filter->ekf[k])) {
            return true;
        }
    }
    return false;
}

/* SoC after the charge counted since the last update, and its standard deviation. */
cg_real cg_filter_soc(cg_estimator *self, cg_real *std_pct)
{
    cg_filter *filter = &self->state.filter;
    const cg_since *since = &self->state.since;
    const cg_real counted_s = since->seconds - since->away_s;
    const mixture mixed = mix(filter, cg_pct_per_as(self->model) * counted_s);
    const cg_real soc_pct = mixed.soc_pct - (since->discharged_pct - mixed.offset_pct);
    cg_real var_pct2 = since->gap_var_pct2 + since->unseen_var_pct2;
    if (since->away_s != R(0.0)) {
        const cg_real odds = cg_exp(moved_log_odds(since->away_s));
        const cg_real moved_pct = moved_std_pct(since->away_s);
        var_pct2 += odds / (R(1.0) + odds) * cg_square(moved_pct);
    }
    *std_pct = cg_sqrt(cg_square(mixed.std_pct) + var_pct2);
    return cg_clip_soc(soc_pct);
}

const cg_ekf *cg_likelier(const cg_filter *filter)
{
    return &filter->ekf[((filter->hypotheses > 1) && (filter->log_odds > R(0.0))) ? 1 : 0];
}

cg_real cg_offset_a(const cg_estimator *self)
{
    const cg_filter *filter = &self->state.filter;
    if (filter->hypotheses == 1) {
        return filter->ekf[0].x[CG_X_OFFSET];
    }
    return mean_of(filter, filter->ekf[0].x[CG_X_OFFSET], filter->ekf[1].x[CG_X_OFFSET]);
}

/* Update with a SoC that is known otherwise. */
void cg_filter_set_soc(cg_filter *filter, const cg_model *model, cg_real soc_pct, cg_real std_pct)
{
    filter->stated_pct = CG_NAN;
    filter_merge(filter, cg_states(model));
    filter->is_untested = false;
    ekf_set_soc(&filter->ekf[0], cg_states(model), soc_pct, std_pct);
}

/* Reduce the slow error of all hypotheses after a long rest. */
void cg_filter_shrink_bias(cg_filter *filter, const cg_model *model)
{
    filter->stated_pct = CG_NAN;
    for (int32_t k = 0; k < filter->hypotheses; ++k) {
        ekf_shrink_bias(&filter->ekf[k], model);
    }
}
