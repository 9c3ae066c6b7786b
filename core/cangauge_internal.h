/* cangauge_internal.h - what the two files of the core share; see cangauge.h. */
#ifndef CANGAUGE_INTERNAL_H
#define CANGAUGE_INTERNAL_H

#include "cangauge.h"

#include <math.h>
#include <stddef.h>

#define CG_REAL_IS_double 0
#define CG_REAL_IS_float 1
#define CG_JOIN_(a, b) a##b
#define CG_JOIN(a, b) CG_JOIN_(a, b)

#if CG_JOIN(CG_REAL_IS_, CANGAUGE_REAL)
/* Where an iteration on a SoC, and on a standard deviation, stops. */
#define CG_CLOSE_PCT 1e-4
#define CG_LAST_STEP_PCT 1e-4
#define cg_exp expf
#define cg_expm1 expm1f
#define cg_log logf
#define cg_log1p log1pf
#define cg_sqrt sqrtf
#define cg_erf erff
#define cg_asinh asinhf
#define cg_fabs fabsf
#else
#define CG_CLOSE_PCT 1e-9
#define CG_LAST_STEP_PCT 1e-6
#define cg_exp exp
#define cg_expm1 expm1
#define cg_log log
#define cg_log1p log1p
#define cg_sqrt sqrt
#define cg_erf erf
#define cg_asinh asinh
#define cg_fabs fabs
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

/* States of the filter; the curve's functions follow. */
#define CG_X_SOC 0
#define CG_X_OFFSET 1
#define CG_X_SLOW 2
#define CG_X_LASTING 3
#define CG_X_CAPACITY 4
#define CG_X_KT 5

/* Standard deviations: of the current's offset [A/Ah], of the capacity (relative), of a SoC that is
 * unknown and of one that may have moved unobserved [%]. */
#define CG_OFFSET_STD_PER_AH 0.025
#define CG_CAPACITY_STD 0.05
#define CG_UNKNOWN_SOC_STD_PCT 30.0
#define CG_MOVED_STD_AT_MOST_PCT 30.0

static inline cg_real cg_pct_per_as(const cg_model *model)
{
    return R(100.0) / (R(3600.0) * model->capacity_ah);
}
static inline int32_t cg_states(const cg_model *model) { return CG_X_KT + 1 + model->functions; }
/* SoC within 0-100 %; NAN stays. */
static inline cg_real cg_clip_soc(cg_real soc_pct) { return cg_clip(soc_pct, R(0.0), R(100.0)); }
static inline cg_real cg_dot(const cg_real *a, const cg_real *b, int32_t from, int32_t to)
{
    cg_real total = R(0.0);
    for (int32_t k = from; k < to; ++k) {
        total += a[k] * b[k];
    }
    return total;
}

/* delay line */
void cg_line_push(cg_line *line, cg_real longest_s, cg_real gap_s, cg_time time_s,
                  cg_real current_a);
cg_real cg_line_at(const cg_line *line, cg_time ago_s);
cg_time cg_line_filled_s(const cg_line *line);

/* voltage model */
cg_real cg_ocv(const cg_model *model, cg_real soc_pct, cg_real *slope);
cg_real cg_offset_v(const cg_model *model, cg_real temperature_c, const cg_real *delayed_a);
cg_real cg_newton(const cg_estimator *self, cg_real ocv_v, cg_real guess_pct, bool *inside);

/* effects: corrections of a sample, then the extra voltages */
int32_t cg_skew_of(const cg_model *model);
void cg_correct(cg_estimator *self, cg_sample *sample, int32_t from, int32_t to);
void cg_skew_push(cg_skew *skew, const cg_sample *sample);
bool cg_skew_pop(cg_skew *skew, cg_time skew_s, cg_time now_s, cg_sample *sample);
void cg_advance(cg_estimator *self, const cg_sample *sample, cg_real temperature_c);

/* noise of a voltage */
cg_real cg_fast_std_v(const cg_estimator *self, cg_real temperature_c, cg_real *kt_std_v);
cg_real cg_resistance_std(const cg_model *model, cg_real temperature_c);
void cg_curve_functions(const cg_model *model, cg_real soc_pct, cg_real *values);

/* One voltage, with the terms of its prediction. */
typedef struct {
    cg_real voltage_v;
    cg_real without_ocv_v;
    cg_real soc_pct;
    cg_real std_v;
    cg_real kt_std_v;
    cg_real resistance_std_v;
} cg_measurement;

/* filter */
void cg_filter_start(cg_filter *filter, const cg_model *model, cg_real soc_pct, cg_real std_pct);
void cg_filter_predict(cg_filter *filter, const cg_model *model, const cg_since *since);
bool cg_filter_update(cg_estimator *self, const cg_measurement *seen, const cg_since *since);
void cg_filter_set_soc(cg_filter *filter, const cg_model *model, cg_real soc_pct, cg_real std_pct);
void cg_filter_shrink_bias(cg_filter *filter, const cg_model *model);
bool cg_filter_is_lost(const cg_filter *filter);
cg_real cg_filter_soc(cg_estimator *self, cg_real *std_pct);
const cg_ekf *cg_likelier(const cg_filter *filter);
cg_real cg_strain(const cg_ekf *ekf, const cg_model *model);

#endif
