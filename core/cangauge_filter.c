/* cangauge_filter.c - Kalman filter of one hypothesis, and the weighing of two.
 *
 * Follows the Python modules estimation.ekf, estimation.health (the biases) and estimation.start;
 * their docstrings state equations and sources, and units and reasons of the constants below.
 */
#include "cangauge_internal.h"

#define OFFSET_STD_A 1.0
#define LEVEL_TIME_S (4.0 * 3600.0)
#define FUNCTIONS_TIME_S (72.0 * 3600.0)
#define DRIFT_PCT2_PER_S 1e-6
#define OUTSIDE_PCT_PER_K 0.2
#define LINEAR_PCT 1.0
#define ITERATIONS_AT_MOST 8
#define CLOSE_PCT 0.05
#define LOWEST_PCT (-25.0)
#define HIGHEST_PCT 125.0

#define CAPACITY_STD 0.1
#define RESISTANCE_STD 0.3
#define CAPACITY_WALK 1e-3
#define RESISTANCE_WALK 0.02
#define DAY_S 86400.0

#define UNKNOWN_PCT 50.0
#define FOUND_STD_PCT 3.0
#define DROPPED_LOG_ODDS 20.0
#define CLEAR_LOG_ODDS 4.605170185988092 /* ln 100 */
#define LEAST_VAR_PCT2 1e-6

/* ------------------------------------------------------------------ one filter */

/* Place of a covariance among the pairs, i >= j. */
static int32_t pair(int32_t i, int32_t j) { return (i * (i + 1) / 2) + j; }
static cg_real var_of(const cg_ekf *ekf, int32_t k) { return ekf->p[pair(k, k)]; }

/* Variance of a state before any voltage, but of the SoC. */
static cg_real prior_var(const cg_model *model, int32_t k)
{
    cg_real variance = R(1.0);
    if (k == CG_X_OFFSET) {
        variance = cg_square(R(OFFSET_STD_A));
    } else if (k == CG_X_SLOW) {
        variance = cg_square(model->slow_std_v);
    }
    return variance;
}

/* What is left of each state's distance from its prior after a time. */
static void remainders(const cg_model *model, cg_real seconds, cg_real *keep)
{
    const cg_real of_functions = cg_exp(-seconds / R(FUNCTIONS_TIME_S));
    keep[CG_X_SOC] = R(1.0);
    keep[CG_X_OFFSET] = R(1.0);
    keep[CG_X_SLOW] = cg_exp(-seconds / model->slow_time_s);
    keep[CG_X_LEVEL] = cg_exp(-seconds / R(LEVEL_TIME_S));
    for (int32_t k = CG_X_FUNCTIONS; k < cg_states(model); ++k) {
        keep[k] = of_functions;
    }
}

static void ekf_start(cg_ekf *ekf, const cg_model *model, cg_real soc_pct, cg_real var_pct2)
{
    *ekf = (cg_ekf){0};
    ekf->x[CG_X_SOC] = soc_pct;
    for (int32_t k = CG_X_OFFSET; k < cg_states(model); ++k) {
        ekf->p[pair(k, k)] = prior_var(model, k);
    }
    ekf->p[pair(CG_X_SOC, CG_X_SOC)] = var_pct2;
    ekf->b_p[CG_B_CAPACITY][CG_B_CAPACITY] = cg_square(R(CAPACITY_STD));
    ekf->b_p[CG_B_RESISTANCE][CG_B_RESISTANCE] = cg_square(R(RESISTANCE_STD));
}

static cg_real offset_gain(const cg_model *model, cg_real seconds)
{
    return R(100.0) * seconds / (R(3600.0) * model->capacity_ah);
}

/* P <- F P F' + Q; V <- F V + G. The SoC takes up the offset; the voltage's errors return to their
 * priors. */
static void ekf_predict(cg_ekf *ekf, const cg_model *model, const cg_passed *passed,
                        cg_real variance_pct2)
{
    const int32_t size = cg_states(model);
    const cg_real gain = offset_gain(model, passed->seconds);
    const cg_real all_s = passed->seconds + passed->away_s;
    cg_real *offset_var = &ekf->p[pair(CG_X_OFFSET, CG_X_OFFSET)];
    cg_real *p = ekf->p;
    cg_real keep[CG_STATES];
    ekf->x[CG_X_SOC] += (gain * ekf->x[CG_X_OFFSET]) - passed->discharged_pct;
    ekf->p[pair(CG_X_SOC, CG_X_SOC)] +=
        (R(2.0) * gain * ekf->p[pair(CG_X_OFFSET, CG_X_SOC)]) + (gain * gain * *offset_var);
    ekf->p[pair(CG_X_OFFSET, CG_X_SOC)] += gain * *offset_var;
    for (int32_t i = CG_X_SLOW; i < size; ++i) {
        ekf->p[pair(i, CG_X_SOC)] += gain * ekf->p[pair(i, CG_X_OFFSET)];
    }
    remainders(model, all_s, keep);
    for (int32_t i = 0; i < size; ++i) {
        const cg_real kept = keep[i];
        for (int32_t j = 0; j <= i; ++j, ++p) {
            *p *= kept * keep[j];
        }
        p[-1] += (R(1.0) - cg_square(kept)) * prior_var(model, i);
        ekf->x[i] *= keep[i];
    }
    ekf->p[pair(CG_X_SOC, CG_X_SOC)] += (R(DRIFT_PCT2_PER_S) * passed->seconds) + variance_pct2;
    for (int32_t k = 0; k < 2; ++k) {
        ekf->b_v[CG_X_SOC][k] += gain * ekf->b_v[CG_X_OFFSET][k];
        for (int32_t i = CG_X_OFFSET; i < size; ++i) {
            ekf->b_v[i][k] *= keep[i];
        }
    }
    ekf->b_v[CG_X_SOC][CG_B_CAPACITY] -= passed->discharged_pct;
    ekf->b_p[CG_B_CAPACITY][CG_B_CAPACITY] += cg_square(R(CAPACITY_WALK)) / R(DAY_S) * all_s;
    ekf->b_p[CG_B_RESISTANCE][CG_B_RESISTANCE] +=
        cg_square(R(RESISTANCE_WALK)) / R(DAY_S) * all_s;
}

/* One linearised measurement: gradient, spread P H', gain. */
typedef struct {
    cg_real h[CG_STATES];
    cg_real spread[CG_STATES];
    cg_real gain[CG_STATES];
    cg_real innovation;
    cg_real variance;
} linear;

static void weigh(linear *at, const cg_ekf *ekf, int32_t size, cg_real noise)
{
    const cg_real *p = ekf->p;
    for (int32_t i = 0; i < size; ++i) {
        const cg_real h = at->h[i];
        cg_real total = R(0.0);
        for (int32_t j = 0; j < i; ++j) {
            const cg_real covariance = *p++;
            total += covariance * at->h[j];
            at->spread[j] += covariance * h;
        }
        at->spread[i] = total + (*p++ * h);
    }
    at->variance = cg_dot(at->h, at->spread, size) + noise;
    for (int32_t k = 0; k < size; ++k) {
        at->gain[k] = at->spread[k] / at->variance;
    }
}

/* P v of the covariance of the biases, and v' P v. */
static cg_real bias_spread(const cg_ekf *ekf, const cg_real *v, cg_real *spread)
{
    spread[0] = cg_dot(ekf->b_p[0], v, 2);
    spread[1] = cg_dot(ekf->b_p[1], v, 2);
    return cg_dot(v, spread, 2);
}

/* P <- P - K (P H')', symmetric; then the biases (Friedland). */
static void condition(cg_ekf *ekf, const linear *at, int32_t size, cg_real drop_v)
{
    cg_real *p = ekf->p;
    for (int32_t i = 0; i < size; ++i) {
        const cg_real gain_i = at->gain[i];
        for (int32_t j = 0; j <= i; ++j, ++p) {
            *p -= gain_i * at->spread[j];
        }
    }
    cg_real t[2] = {R(0.0), drop_v};
    for (int32_t k = 0; k < size; ++k) {
        t[0] += at->h[k] * ekf->b_v[k][0];
        t[1] += at->h[k] * ekf->b_v[k][1];
    }
    for (int32_t k = 0; k < size; ++k) {
        ekf->b_v[k][0] -= at->gain[k] * t[0];
        ekf->b_v[k][1] -= at->gain[k] * t[1];
    }
    cg_real spread[2];
    const cg_real variance = at->variance + bias_spread(ekf, t, spread);
    const cg_real left = at->innovation - cg_dot(t, ekf->b, 2);
    const cg_real gain[2] = {spread[0] / variance, spread[1] / variance};
    ekf->b[0] += gain[0] * left;
    ekf->b[1] += gain[1] * left;
    ekf->b_p[0][0] -= gain[0] * spread[0];
    ekf->b_p[1][1] -= gain[1] * spread[1];
    ekf->b_p[0][1] -= gain[0] * spread[1];
    ekf->b_p[1][0] = ekf->b_p[0][1];
}

/* What the measurement by a block has the same at every SoC. */
typedef struct {
    const cg_means *block;
    cg_real load_v;
    cg_real cold;
    cg_real level_v2;
    cg_real outside_pct2; /* level's variance by the square of the curve's slope */
    cg_real noise_v2;
    cg_real functions_v[CG_FUNCTIONS];
} observed;

static observed observe(const cg_model *model, const cg_means *block)
{
    const bool is_missing = isnan(block->temperature_c) != 0;
    const cg_real temperature_c = is_missing ? model->usual_c : block->temperature_c;
    const cg_real *range = model->temperature_range_c;
    const cg_real outside_k =
        cg_max(cg_max(range[0] - temperature_c, temperature_c - range[1]), R(0.0));
    const cg_real unknown_v = is_missing ? cg_unknown_temperature_v(model, block->load) : R(0.0);
    observed of;
    of.block = block;
    of.load_v = cg_dot(block->load, model->load, cg_loads(model));
    of.cold = cg_cold(model, temperature_c);
    of.level_v2 = cg_square(of.cold * model->level_std_v) + cg_square(unknown_v);
    of.outside_pct2 = cg_square(model->soc_std_pct) + cg_square(R(OUTSIDE_PCT_PER_K) * outside_k);
    of.noise_v2 = cg_square(of.cold * model->fast_std_v) + block->unseen_v2;
    cg_functions_of_load(model, block->load, of.functions_v);
    return of;
}

/* Voltage at a state, its gradient and the variance of the measurement. */
static cg_real measurement(const cg_model *model, const cg_real *x, const observed *of, cg_real *h,
                           cg_real *noise)
{
    cg_real slope;
    cg_real volts = cg_curve_at(model, of->block->drive, x[CG_X_SOC], &slope);
    slope = cg_max(slope, R(CG_LEAST_SLOPE));
    h[CG_X_SOC] = slope;
    h[CG_X_OFFSET] = R(0.0);
    h[CG_X_SLOW] = of->cold;
    h[CG_X_LEVEL] = cg_sqrt(of->level_v2 + (of->outside_pct2 * cg_square(slope)));
    cg_functions_row(model, x[CG_X_SOC], of->functions_v, &h[CG_X_FUNCTIONS]);
    volts += of->load_v;
    volts += cg_dot(&h[CG_X_SLOW], &x[CG_X_SLOW], cg_states(model) - CG_X_SLOW);
    *noise = of->noise_v2 + cg_square(model->soc_std_pct * slope);
    return volts;
}

/* Linearise a measurement at a state: the innovation of the filter's own one and its variance. */
static void linearise(linear *at, const cg_model *model, const cg_ekf *ekf, const cg_real *x,
                      const observed *of)
{
    const int32_t size = cg_states(model);
    cg_real noise;
    const cg_real voltage_v = measurement(model, x, of, at->h, &noise);
    weigh(at, ekf, size, noise);
    at->innovation = of->block->voltage_v - voltage_v;
    for (int32_t k = 0; k < size; ++k) {
        at->innovation -= at->h[k] * (ekf->x[k] - x[k]);
    }
}

/* Update with the mean voltage of a block; iterated while the SoC is uncertain. */
static void ekf_update(const cg_model *model, cg_ekf *ekf, const observed *of)
{
    const int32_t size = cg_states(model);
    const bool is_wide = var_of(ekf, CG_X_SOC) > cg_square(R(LINEAR_PCT));
    cg_real x[CG_STATES];
    linear at;
    for (int32_t k = 0; k < size; ++k) {
        x[k] = ekf->x[k];
    }
    int32_t left = is_wide ? ITERATIONS_AT_MOST : 1;
    cg_real part = R(1.0);
    cg_real last_pct = R(0.0);
    do {
        linearise(&at, model, ekf, x, of);
        const cg_real to_pct = cg_clip(ekf->x[CG_X_SOC] + (at.gain[CG_X_SOC] * at.innovation),
                                       R(LOWEST_PCT), R(HIGHEST_PCT));
        const cg_real step_pct = to_pct - x[CG_X_SOC];
        /* Damp: full Newton steps oscillate across a kink. */
        part *= ((step_pct * last_pct) < (R(-0.5) * cg_square(last_pct))) ? R(0.5) : R(1.0);
        last_pct = step_pct;
        x[CG_X_SOC] += part * step_pct;
        for (int32_t k = CG_X_OFFSET; k < size; ++k) {
            const cg_real step_k = ekf->x[k] + (at.gain[k] * at.innovation) - x[k];
            x[k] += part * step_k;
        }
        left = (cg_fabs(step_pct) < R(CLOSE_PCT)) ? 0 : (left - 1);
    } while (left > 0);
    for (int32_t k = 0; k < size; ++k) {
        ekf->x[k] = x[k];
    }
    condition(ekf, &at, size, of->block->drop_v);
    ekf->innovation2 = cg_square(at.innovation) / at.variance;
    ekf->evidence = cg_plus(ekf->evidence, R(-0.5) * (ekf->innovation2 + cg_log(at.variance)));
}

/* Correct by a SoC that is known otherwise. */
static void ekf_correct(cg_ekf *ekf, int32_t size, cg_real soc_pct, cg_real std_pct)
{
    linear at = {{R(1.0)}, {R(0.0)}, {R(0.0)}, soc_pct - ekf->x[CG_X_SOC], R(0.0)};
    weigh(&at, ekf, size, cg_square(std_pct));
    for (int32_t k = 0; k < size; ++k) {
        ekf->x[k] += at.gain[k] * at.innovation;
    }
    condition(ekf, &at, size, R(0.0));
}

/* SoC and its variance after charge, without a change of the state; with the mean square error by
 * the biases. */
static cg_real soc_after(const cg_ekf *ekf, const cg_model *model, const cg_passed *passed,
                         cg_real *var_pct2)
{
    const cg_real a = offset_gain(model, passed->seconds);
    const cg_real *v = ekf->b_v[CG_X_SOC];
    cg_real spread[2];
    *var_pct2 = var_of(ekf, CG_X_SOC) + (R(2.0) * a * ekf->p[pair(CG_X_OFFSET, CG_X_SOC)]) +
                (a * a * var_of(ekf, CG_X_OFFSET)) +
                (R(DRIFT_PCT2_PER_S) * passed->seconds) + passed->variance_pct2 +
                cg_square(cg_dot(v, ekf->b, 2)) + bias_spread(ekf, v, spread);
    return ekf->x[CG_X_SOC] + (a * ekf->x[CG_X_OFFSET]) - passed->discharged_pct;
}

/* Sum of (learned / prior deviation)^2 of all constants. */
cg_real cg_strain(const cg_ekf *ekf, const cg_model *model)
{
    const cg_real *level = &ekf->x[CG_X_LEVEL];
    return cg_square(ekf->x[CG_X_OFFSET] / R(OFFSET_STD_A)) +
           cg_dot(level, level, cg_states(model) - CG_X_LEVEL) +
           cg_square(ekf->b[CG_B_CAPACITY] / R(CAPACITY_STD)) +
           cg_square(ekf->b[CG_B_RESISTANCE] / R(RESISTANCE_STD));
}

/* ------------------------------------------------------------------ hypotheses */

static cg_real log_odds_of(cg_real probability)
{
    return cg_log(probability / (R(1.0) - probability));
}

/* Of the wide hypothesis: on a plateau not below the prior ones until it has found the SoC. */
static cg_real log_odds(const cg_filter *filter, const cg_model *model)
{
    if (filter->hypotheses == 1) {
        return R(-INFINITY);
    }
    cg_real gained = cg_minus(filter->ekf[1].evidence, filter->ekf[0].evidence);
    if ((gained < R(0.0)) && (model->soc_std_pct > R(LINEAR_PCT)) &&
        (var_of(&filter->ekf[1], CG_X_SOC) > cg_square(R(FOUND_STD_PCT)))) {
        gained = R(0.0);
    }
    return filter->prior_log_odds + gained;
}

const cg_ekf *cg_likelier(const cg_filter *filter, const cg_model *model)
{
    return &filter->ekf[(log_odds(filter, model) > R(0.0)) ? 1 : 0];
}

bool cg_filter_is_rejected(const cg_filter *filter, const cg_model *model)
{
    return (filter->hypotheses == 2) ? (log_odds(filter, model) > R(0.0)) : (filter->decision > 0);
}

static void keep_likelier(cg_filter *filter, const cg_model *model)
{
    if (log_odds(filter, model) > R(0.0)) {
        filter->ekf[0] = filter->ekf[1];
    }
    filter->hypotheses = 1;
}

/* Begin from a SoC [%]; NAN: unknown. */
void cg_filter_start(cg_filter *filter, const cg_model *model, cg_real soc_pct, cg_real std_pct,
                     bool is_doubtful)
{
    filter->prior_log_odds = R(0.0);
    filter->decision = 0;
    filter->hypotheses = 1;
    if (isnan(soc_pct)) {
        ekf_start(&filter->ekf[0], model, R(UNKNOWN_PCT), R(CG_UNKNOWN_VAR_PCT2));
        return;
    }
    ekf_start(&filter->ekf[0], model, soc_pct, cg_square(std_pct));
    if (is_doubtful && (std_pct < R(CG_WRONG_STD_PCT))) {
        ekf_start(&filter->ekf[1], model, soc_pct, cg_square(R(CG_WRONG_STD_PCT)));
        filter->hypotheses = 2;
        filter->prior_log_odds = log_odds_of(R(CG_WRONG_PRIOR));
    }
}

/* Begin with another model: keep the offset of the current, and the capacity. */
void cg_filter_take_over(cg_filter *filter, const cg_model *model, const cg_model *model_before,
                         cg_real soc_pct, cg_real std_pct)
{
    cg_ekf *ekf = &filter->ekf[0];
    const cg_ekf *before = cg_likelier(filter, model_before);
    const cg_real capacity_ratio = model->capacity_ah / model_before->capacity_ah;
    const cg_real *v = before->b_v[CG_X_OFFSET];
    cg_real spread[2];
    const cg_real offset_a = before->x[CG_X_OFFSET] + cg_dot(v, before->b, 2);
    const cg_real offset_var = var_of(before, CG_X_OFFSET) + bias_spread(before, v, spread);
    const cg_real capacity = (R(1.0) + before->b[CG_B_CAPACITY]) * capacity_ratio;
    const cg_real capacity_var = before->b_p[CG_B_CAPACITY][CG_B_CAPACITY];
    cg_filter_start(filter, model, soc_pct, std_pct, false);
    ekf->x[CG_X_OFFSET] = offset_a;
    ekf->p[pair(CG_X_OFFSET, CG_X_OFFSET)] = offset_var;
    ekf->b[CG_B_CAPACITY] = capacity - R(1.0);
    ekf->b_p[CG_B_CAPACITY][CG_B_CAPACITY] = capacity_var * cg_square(capacity_ratio);
}

void cg_filter_predict(cg_filter *filter, const cg_model *model, const cg_passed *passed)
{
    for (int32_t k = 0; k < filter->hypotheses; ++k) {
        ekf_predict(&filter->ekf[k], model, passed, passed->variance_pct2);
    }
}

void cg_filter_update(cg_filter *filter, const cg_model *model, const cg_means *block)
{
    const observed of = observe(model, block);
    for (int32_t k = 0; k < filter->hypotheses; ++k) {
        ekf_update(model, &filter->ekf[k], &of);
    }
    const cg_real odds = log_odds(filter, model);
    if ((filter->hypotheses == 2) && (cg_fabs(odds) > R(CLEAR_LOG_ODDS))) {
        filter->decision = (odds > R(0.0)) ? 1 : -1;
        if (cg_fabs(odds) > R(DROPPED_LOG_ODDS)) {
            keep_likelier(filter, model);
        }
    }
}

void cg_filter_correct(cg_filter *filter, const cg_model *model, cg_real soc_pct, cg_real std_pct)
{
    keep_likelier(filter, model);
    ekf_correct(&filter->ekf[0], cg_states(model), soc_pct, std_pct);
}

/* Allow for the hypothesis that the SoC has become another one. */
void cg_filter_doubt(cg_filter *filter, const cg_model *model, cg_real probability,
                     cg_real std_pct, cg_real away_s, cg_real parked_std_pct)
{
    const cg_passed passed = {R(0.0), R(0.0), R(0.0), away_s};
    const cg_real now = log_odds(filter, model);
    if ((filter->hypotheses == 2) && (cg_fabs(now) < R(CLEAR_LOG_ODDS))) {
        const cg_real before = R(1.0) / (R(1.0) + cg_exp(-now));
        filter->prior_log_odds =
            log_odds_of(R(1.0) - ((R(1.0) - before) * (R(1.0) - probability)));
        filter->ekf[1].evidence = filter->ekf[0].evidence; /* it is in the prior now */
    } else {
        keep_likelier(filter, model);
        filter->ekf[1] = filter->ekf[0];
        filter->hypotheses = 2;
        filter->prior_log_odds = log_odds_of(probability);
    }
    filter->decision = 0;
    ekf_predict(&filter->ekf[0], model, &passed, cg_square(parked_std_pct));
    ekf_predict(&filter->ekf[1], model, &passed, cg_square(std_pct));
}

/* SoC after charge, and its standard deviation, both hypotheses weighed [%]. */
cg_real cg_filter_soc(const cg_filter *filter, const cg_model *model, const cg_passed *passed,
                      cg_real *std_pct)
{
    cg_real variance;
    cg_real soc_pct = soc_after(&filter->ekf[0], model, passed, &variance);
    if (filter->hypotheses == 2) {
        cg_real wide_var;
        const cg_real wide_pct = soc_after(&filter->ekf[1], model, passed, &wide_var);
        const cg_real p = R(1.0) / (R(1.0) + cg_exp(-log_odds(filter, model)));
        const cg_real mean_pct = ((R(1.0) - p) * soc_pct) + (p * wide_pct);
        variance = ((R(1.0) - p) * (variance + cg_square(soc_pct - mean_pct))) +
                   (p * (wide_var + cg_square(wide_pct - mean_pct)));
        soc_pct = mean_pct;
    }
    *std_pct = cg_sqrt(cg_max(variance, R(LEAST_VAR_PCT2)));
    return soc_pct;
}

/* Measured minus predicted voltage of one row over its standard deviation. */
cg_real cg_filter_residual(const cg_filter *filter, const cg_model *model,
                           const cg_passed *passed, const cg_means *row)
{
    const cg_ekf *likelier = cg_likelier(filter, model);
    const observed of = observe(model, row);
    cg_ekf counted = *likelier;
    linear at;
    cg_real var_pct2;
    counted.x[CG_X_SOC] = soc_after(likelier, model, passed, &var_pct2);
    linearise(&at, model, &counted, counted.x, &of);
    return at.innovation /
           cg_sqrt(at.variance + cg_square(of.cold * model->residual_std_v));
}

/* Whether states and variances are usable numbers. A covariance that an update makes infinite does
 * so to its two variances. */
bool cg_filter_is_valid(const cg_filter *filter, const cg_model *model)
{
    const int32_t size = cg_states(model);
    bool is_valid = true;
    for (int32_t i = 0; i < filter->hypotheses; ++i) {
        const cg_ekf *ekf = &filter->ekf[i];
        is_valid = is_valid && isfinite(cg_value(ekf->evidence));
        for (int32_t k = 0; k < size; ++k) {
            const cg_real variance = var_of(ekf, k);
            is_valid = is_valid && isfinite(ekf->x[k]) && isfinite(variance) && (variance > R(0.0));
        }
    }
    return is_valid;
}

/* The same of a state that was kept elsewhere, with its covariances. */
bool cg_filter_is_plausible(const cg_filter *filter, const cg_model *model)
{
    const bool has_number = (filter->hypotheses == 1) || (filter->hypotheses == 2);
    bool is_plausible = has_number && cg_filter_is_valid(filter, model);
    for (int32_t i = 0; is_plausible && (i < filter->hypotheses); ++i) {
        for (int32_t k = 0; k < pair(cg_states(model), 0); ++k) {
            is_plausible = is_plausible && isfinite(filter->ekf[i].p[k]);
        }
    }
    return is_plausible;
}
