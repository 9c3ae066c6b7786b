/* cangauge_internal.h - what the files of the core share; see cangauge.h. */
#ifndef CANGAUGE_INTERNAL_H
#define CANGAUGE_INTERNAL_H

#include "cangauge.h"

#include <math.h>
#include <stddef.h>

#if CG_HAS_FLOATS
#define CG_CLOSE_PCT 1e-4 /* where an iteration on a SoC stops */
#define CG_REBASE_S 128.0 /* age of the delay line's base at which floats need another one */
#define cg_exp expf
#define cg_expm1 expm1f
#define cg_pow powf
#define cg_sqrt sqrtf
#define cg_asinh asinhf
#define cg_fabs fabsf
#define cg_log logf
#else
#define CG_CLOSE_PCT 1e-9
#define CG_REBASE_S INFINITY
#define cg_exp exp
#define cg_expm1 expm1
#define cg_pow pow
#define cg_sqrt sqrt
#define cg_asinh asinh
#define cg_fabs fabs
#define cg_log log
#endif

/* A constant in the type of the numbers. */
#define R(number) ((cg_real)(number))
#define CG_NAN R(NAN)

/* As Python's min and max: the first unless the second is beyond it, so that NAN stays first. */
static inline cg_real cg_min(cg_real a, cg_real b) { return (b < a) ? b : a; }
static inline cg_real cg_max(cg_real a, cg_real b) { return (b > a) ? b : a; }
static inline cg_real cg_clip(cg_real value, cg_real low, cg_real high)
{
    return cg_min(cg_max(value, low), high);
}
static inline cg_real cg_square(cg_real value) { return value * value; }

#if CG_HAS_FLOATS
#define CG_SECOND ((cg_time)CG_TICKS_PER_S)
#define CG_LONGEST_S 2e9 /* that an int32_t holds */
/* Time of a number of seconds, to the nearest tick, and back. The conversion of a float to 64 bits
 * would go through doubles: whole seconds and the rest are converted to 32 bits. */
static inline cg_time cg_span(cg_real seconds)
{
    const cg_real within_s = cg_clip(seconds, R(-CG_LONGEST_S), R(CG_LONGEST_S));
    const int32_t whole_s = (int32_t)within_s;
    const cg_real ticks = (within_s - (cg_real)whole_s) * R(CG_TICKS_PER_S);
    const int32_t rest = (int32_t)(ticks + ((ticks < R(0.0)) ? R(-0.5) : R(0.5)));
    return ((cg_time)whole_s * CG_TICKS_PER_S) + rest;
}
static inline cg_real cg_seconds(cg_time span) { return (cg_real)span * R(1.0 / CG_TICKS_PER_S); }
static inline bool cg_is_time(cg_time time_s) { return time_s != CG_NO_TIME; }
/* Number of whole periods in a time; within a part of one of the next it is the next. */
static inline int64_t cg_periods(cg_time span, cg_real period_s, cg_real part)
{
    return (span + cg_span(part * period_s)) / cg_span(period_s);
}
/* Where the times of a delay line count from: near its entries, so that floats keep their digits. */
static inline cg_time cg_base_of(cg_time time_s) { return time_s; }

/* A sum as two floats (Knuth's TwoSum, Dekker's FastTwoSum): some 48 bits. */
static inline cg_sum cg_plus(cg_sum sum, cg_real value)
{
    const cg_real total = sum.high + value;
    const cg_real part = total - sum.high;
    const cg_real lost = (sum.high - (total - part)) + (value - part) + sum.low;
    const cg_real high = total + lost;
    const cg_sum found = {high, lost - (high - total)};
    return found;
}
static inline cg_sum cg_plus_sum(cg_sum a, cg_sum b) { return cg_plus(cg_plus(a, b.high), b.low); }
static inline cg_real cg_minus(cg_sum a, cg_sum b) { return (a.high - b.high) + (a.low - b.low); }
static inline cg_real cg_value(cg_sum sum) { return sum.high + sum.low; }
static inline cg_sum cg_sum_of(cg_real value)
{
    const cg_sum found = {value, R(0.0)};
    return found;
}
static inline cg_sum cg_mean(cg_sum sum, cg_real number)
{
    const cg_real high = sum.high / number;
    const cg_sum found = {high, (fmaf(-high, number, sum.high) + sum.low) / number};
    return found;
}
#else
#define CG_NO_TIME ((cg_time)NAN)
#define CG_SECOND ((cg_time)1)
static inline cg_time cg_span(cg_real seconds) { return seconds; }
static inline cg_real cg_seconds(cg_time span) { return span; }
static inline bool cg_is_time(cg_time time_s) { return isnan(time_s) == 0; }
static inline int64_t cg_periods(cg_time span, cg_real period_s, cg_real part)
{
    return (int64_t)floor((span / period_s) + part);
}
static inline cg_time cg_base_of(cg_time time_s)
{
    (void)time_s;
    return 0.0;
}
static inline cg_sum cg_plus(cg_sum sum, cg_real value) { return sum + value; }
static inline cg_sum cg_plus_sum(cg_sum a, cg_sum b) { return a + b; }
static inline cg_real cg_minus(cg_sum a, cg_sum b) { return a - b; }
static inline cg_real cg_value(cg_sum sum) { return sum; }
static inline cg_sum cg_sum_of(cg_real value) { return value; }
static inline cg_sum cg_mean(cg_sum sum, cg_real number) { return sum / number; }
#endif

/* States of the filter; the functions follow. Biases. */
#define CG_X_SOC 0
#define CG_X_OFFSET 1
#define CG_X_SLOW 2
#define CG_X_LEVEL 3
#define CG_X_FUNCTIONS 4
#define CG_B_CAPACITY 0
#define CG_B_RESISTANCE 1

#define CG_UNKNOWN_VAR_PCT2 2000.0 /* of an unknown SoC */
#define CG_WRONG_STD_PCT 25.0 /* of a given start that is wrong */
#define CG_WRONG_PRIOR 0.3
#define CG_LEAST_SLOPE 1e-3

static inline cg_real cg_pct_per_as(const cg_model *model)
{
    return R(100.0) / (R(3600.0) * model->capacity_ah);
}
static inline int32_t cg_states(const cg_model *model) { return CG_X_FUNCTIONS + model->functions; }
static inline int32_t cg_currents(const cg_model *model)
{
    return model->delays + model->low_passes;
}
static inline int32_t cg_loads(const cg_model *model)
{
    return 1 + cg_currents(model) + ((model->has_arrhenius != 0) ? 1 : 0);
}
/* SoC within 0-100 %; NAN stays. */
static inline cg_real cg_clip_soc(cg_real soc_pct) { return cg_clip(soc_pct, R(0.0), R(100.0)); }
static inline cg_real cg_dot(const cg_real *a, const cg_real *b, int32_t size)
{
    cg_real total = R(0.0);
    for (int32_t k = 0; k < size; ++k) {
        total += a[k] * b[k];
    }
    return total;
}

/* delay line */
void cg_line_push(cg_line *line, cg_real longest_s, bool is_gap, cg_time time_s,
                  cg_real current_a);
cg_real cg_line_at(const cg_line *line, cg_real ago_s);
cg_time cg_line_filled_s(const cg_line *line);
void cg_line_lengthen(cg_line *line);

/* voltage model */
cg_real cg_cold(const cg_model *model, cg_real temperature_c);
void cg_functions_of_load(const cg_model *model, const cg_real *load, cg_real *row);
void cg_functions_row(const cg_model *model, cg_real soc_pct, const cg_real *of_load, cg_real *row);
cg_real cg_unknown_temperature_v(const cg_model *model, const cg_real *load);
cg_real cg_curve_at(const cg_model *model, const cg_real *drive, cg_real soc_pct, cg_real *slope);
cg_real cg_newton(const cg_estimator *self, cg_real ocv_v, cg_real guess_pct, bool *inside);

/* effects: corrections of a sample, then the load columns and the extra voltages */
int32_t cg_skew_of(const cg_model *model);
void cg_correct(cg_estimator *self, cg_sample *sample, int32_t from, int32_t to);
void cg_skew_push(cg_skew *skew, const cg_sample *sample);
bool cg_skew_pop(cg_skew *skew, cg_real skew_s, cg_time now_s, cg_sample *sample);
void cg_advance(cg_estimator *self, const cg_sample *sample, cg_real temperature_c,
                bool is_gap);

/* Means over the rows of a block, or one row. */
typedef struct {
    cg_sum counted_s;
    cg_sum discharged_pct;
    cg_real voltage_v;
    cg_real temperature_c; /* NAN: missing */
    cg_real drop_v;
    cg_real unseen_v2;
    const cg_real *load;
    const cg_real *drive;
} cg_means;

/* Time in which charge was counted [s], the charge, its variance, further time without samples. */
typedef struct {
    cg_real seconds;
    cg_real discharged_pct;
    cg_real variance_pct2;
    cg_real away_s;
} cg_passed;

/* filter */
void cg_filter_start(cg_filter *filter, const cg_model *model, cg_real soc_pct, cg_real std_pct,
                     bool is_doubtful);
void cg_filter_take_over(cg_filter *filter, const cg_model *model, const cg_model *model_before,
                         cg_real soc_pct, cg_real std_pct);
void cg_filter_predict(cg_filter *filter, const cg_model *model, const cg_passed *passed);
void cg_filter_update(cg_filter *filter, const cg_model *model, const cg_means *block);
void cg_filter_correct(cg_filter *filter, const cg_model *model, cg_real soc_pct, cg_real std_pct);
void cg_filter_doubt(cg_filter *filter, const cg_model *model, cg_real probability,
                     cg_real std_pct, cg_real away_s, cg_real parked_std_pct);
bool cg_filter_is_valid(const cg_filter *filter, const cg_model *model);
bool cg_filter_is_plausible(const cg_filter *filter, const cg_model *model);
bool cg_filter_is_rejected(const cg_filter *filter, const cg_model *model);
cg_real cg_filter_soc(const cg_filter *filter, const cg_model *model, const cg_passed *passed,
                      cg_real *std_pct);
cg_real cg_filter_residual(const cg_filter *filter, const cg_model *model,
                           const cg_passed *passed, const cg_means *row);
const cg_ekf *cg_likelier(const cg_filter *filter, const cg_model *model);
cg_real cg_strain(const cg_ekf *ekf, const cg_model *model);

#endif
