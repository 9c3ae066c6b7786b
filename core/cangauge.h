/* cangauge.h - state of charge of a battery pack from current, voltage and temperature.
 *
 *     static cg_estimator pack;                      all memory: no heap, nothing hidden
 *     cg_init(&pack, &model, &settings, &line, NULL);
 *     cg_update(&pack, &sample);                     at every sample of the current
 *     cg_estimate soc = cg_evaluate(&pack);          whenever an estimate is wanted
 *
 * The same operations in the same order as the Python package `cangauge`, and with doubles
 * (and -ffp-contract=off) the same bits. One sign: positive current discharges. NAN is a value that
 * is missing. The time is that of the samples, never a clock: the same samples give the same
 * numbers. Every function returns after a bounded number of operations; none calls itself.
 */
#ifndef CANGAUGE_H
#define CANGAUGE_H

#include <stdbool.h>
#include <stdint.h>

/* ------------------------------------------------------------------ sizes and types */

/* double, or float for a processor that has no others in hardware: -DCANGAUGE_REAL=float */
#ifndef CANGAUGE_REAL
#define CANGAUGE_REAL double
#endif
typedef CANGAUGE_REAL cg_real;
/* What would lose its digits as float: times, running sums, and the coefficients of the pseudo-OCV,
 * whose terms of up to 1e8 V cancel. */
typedef double cg_time;
typedef double cg_sum;
typedef double cg_wide;

/* Upper limits of a model; an exported model states its own, which are smaller. */
#ifdef CANGAUGE_CONFIG
#include "cangauge_config.h"
#else
#define CG_DELAYS 64
#define CG_KNOTS 201
#define CG_FUNCTIONS 16
#define CG_EFFECTS 32
#define CG_WAITING 8192 /* samples that an effect `time_skew` holds back */
#endif
#define CG_OCV 8
#define CG_LAGS 5
#define CG_VALUES 12
#define CG_LEARNED 5 /* states that a voltage corrects: SoC, offset, slow, lasting, capacity */
#define CG_STATES (CG_LEARNED + 1 + CG_FUNCTIONS)
#define CG_MEMORIES (CG_EFFECTS * CG_LAGS)

/* ------------------------------------------------------------------ constants of a model */

typedef enum {
    CG_NO_EFFECT = 0, /* or one that changes the count only */
    CG_CURRENT_SENSOR, /* offset, gain */
    CG_VOLTAGE_SENSOR, /* offset, gain */
    CG_TIME_SKEW, /* `skew_s` of the model */
    CG_TEMPERATURE_LAG, /* ahead; lag: smoothing */
    CG_CORE_TEMPERATURE, /* rise_k, late, capacity_ah; lags: Joule heat, temperature */
    CG_RESISTANCE_TEMPERATURE, /* share, activation_k, delayed, reference_per_k, ohm; lag: inner */
    CG_RESISTANCE_SOC, /* at_empty, at_full, width_pct, delayed, ohm */
    CG_RESISTANCE_ASYMMETRY, /* charging_ohm */
    CG_RESISTANCE_STEP, /* step_ohm, start_s */
    CG_CHARGE_TRANSFER, /* scale_v, per_a, bend_only, activation_k, zero_a */
    CG_RC, /* activation_k, by_slope, mean_slope, ohm of each lag; lags: elements */
    CG_HYSTERESIS, /* half_width_v, travel_as */
    CG_ENTROPIC, /* level, slope, curve, t_ref_c; lag: interior */
    CG_INNER_TEMPERATURE, /* voltage_v_per_k, drop_per_k; lag: interior */
    CG_OCV_SHAPE, /* height of each bump */
    CG_WEAK_CELL /* fraction, ahead */
} cg_effect_kind;

typedef struct {
    int32_t kind; /* cg_effect_kind */
    int32_t lags;
    cg_real value[CG_VALUES]; /* in the order stated above */
    cg_real tau_s[CG_LAGS];
} cg_effect;

/* What `cangauge fit` found. Constant: it may stay in flash. */
typedef struct {
    /* U = k0 + k1/s + k2/s^2 + k3/s^3 + k4/s^4 + k5 s + k6 ln s + k7 ln(1 - s)
     *     + kt (T - T_r) + sum Rj I(t - dj),  s = SoC scaled into [epsilon, 1 - epsilon] */
    cg_wide ocv_v[CG_OCV];
    cg_wide epsilon;
    cg_real slope_beyond[2]; /* dU/dS below and above the identified SoC [V per %] */
    cg_real kt_v_per_k;
    cg_real t_ref_c;
    cg_real soc_range_pct[2]; /* identified ranges */
    cg_real temperature_range_c[2];
    cg_real current_range_a[2];
    int32_t delays;
    cg_real delay_s[CG_DELAYS];
    cg_real resistance_ohm[CG_DELAYS];
    cg_real rate_hz; /* voltages used per second */
    cg_real capacity_ah;
    cg_real charge_efficiency;
    cg_real initial_offset_pct; /* error of a given initial SoC */
    cg_real steady_ohm; /* change of the voltage with a lasting current [V/A] */
    cg_real nominal_v; /* voltage at half charge [V] */

    /* error of the model: standard deviations */
    cg_real fast_std_v;
    cg_real slow_std_v;
    cg_real slow_time_s;
    cg_real lasting_std_v;
    cg_real lasting_time_s;
    cg_real lasting_soc_pct;
    cg_real mean_c; /* temperature of the logs [degC] */
    cg_real kt_std_v_per_k;
    cg_real resistance_std_per_k;
    int32_t knots; /* functions of the curve's error over SoC */
    int32_t functions;
    cg_real knot_pct[CG_KNOTS];
    cg_real function_v[CG_KNOTS][CG_FUNCTIONS];

    /* effects, in the order of their application */
    int32_t effects;
    cg_effect effect[CG_EFFECTS];
    cg_time skew_s; /* of CG_TIME_SKEW: how late the time stamps of the current are */
    int32_t memories; /* RC elements of effects: what currents before the first sample left */
    cg_real memory_ohm[CG_MEMORIES];
    cg_real memory_tau_s[CG_MEMORIES];
} cg_model;

/* ------------------------------------------------------------------ settings */

typedef enum { CG_EKF = 0, CG_NEWTON, CG_COULOMB } cg_method;

typedef struct {
    int32_t method; /* cg_method: whose SoC is the estimate */
    cg_real initial_soc_pct; /* NAN: found from the first voltage */
    cg_real initial_soc_std_pct;
    cg_real valid_std_pct; /* a larger standard deviation is degraded */
    cg_real gap_s; /* a longer step between samples is a gap in the current */
    uint32_t reasons; /* that hold throughout */
    /* The pack is full once the voltage is high and the current small for a time. NAN: off. */
    cg_real full_voltage_v;
    cg_real full_current_a;
    cg_real full_hold_s;
    cg_real full_soc_pct;
    cg_real full_soc_std_pct;
    /* After a long rest the voltage is the open-circuit voltage. NAN: off. */
    cg_real rest_after_s;
    cg_real rest_soc_std_pct;
} cg_settings;

/* 2 s, 1 %, 1.5 %, extended Kalman filter, no rules. */
cg_settings cg_default_settings(void);

/* ------------------------------------------------------------------ samples and estimates */

typedef struct {
    cg_time time_s;
    cg_real current_a; /* positive = discharge */
    cg_real voltage_v; /* NAN: missing */
    cg_real temperature_c; /* NAN: missing */
} cg_sample;

typedef enum {
    CG_INITIALISING = 0,
    CG_VALID = 1,
    CG_DEGRADED = 2,
    CG_INVALID = 3
} cg_status;

/* Bits of `reasons`: why an estimate is not valid. */
#define CG_DELAY_LINE_FILLING (UINT32_C(1) << 0)
#define CG_CURRENT_GAP (UINT32_C(1) << 1)
#define CG_VOLTAGE_MISSING (UINT32_C(1) << 2)
#define CG_TEMPERATURE_MISSING (UINT32_C(1) << 3)
#define CG_VOLTAGE_OUTSIDE_MODEL (UINT32_C(1) << 4)
#define CG_SOC_OUTSIDE_MODEL (UINT32_C(1) << 5)
#define CG_TEMPERATURE_OUTSIDE_MODEL (UINT32_C(1) << 6)
#define CG_CURRENT_OUTSIDE_MODEL (UINT32_C(1) << 7)
#define CG_TEMPERATURE_SOURCE_MISMATCH (UINT32_C(1) << 8)
#define CG_INNOVATION_LARGE (UINT32_C(1) << 9)
#define CG_NO_INITIAL_SOC (UINT32_C(1) << 10)
#define CG_INPUT_STALE (UINT32_C(1) << 11)
#define CG_IMPLAUSIBLE_INPUT (UINT32_C(1) << 12)
#define CG_CURRENT_MISSING (UINT32_C(1) << 15)
#define CG_SOC_UNCERTAIN (UINT32_C(1) << 16)
#define CG_MODEL_MISMATCH (UINT32_C(1) << 18)

typedef struct {
    cg_time time_s;
    cg_real soc_pct; /* of the chosen method, 0 ... 100 */
    cg_real soc_std_pct;
    cg_real soc_newton_pct; /* by inverse of the voltage model alone */
    cg_real soc_coulomb_pct; /* by counting alone */
    cg_real voltage_model_v;
    cg_real residual_v; /* measured minus predicted */
    int32_t status; /* cg_status */
    uint32_t reasons;
    int64_t samples; /* accepted so far */
} cg_estimate;

/* ------------------------------------------------------------------ state */

typedef struct {
    cg_time last_s; /* time of the last accepted sample */
    cg_time shift_s; /* time minus stamp */
    int64_t behind; /* consecutive samples stamped before the last accepted one */
    cg_time behind_s;
    cg_time age_s; /* least age of a restored state; NAN: no clock measured it */
    bool is_restored;
} cg_clock;

typedef struct {
    cg_time time_s;
    cg_real current_a;
    cg_real mean_square_a2;
    cg_real mean_a;
    cg_sum discharged_pct;
    cg_sum moved_pct;
    cg_sum counted_s;
    bool is_restored;
} cg_counter;

typedef struct {
    cg_real seconds;
    cg_real away_s;
    cg_real discharged_pct;
    cg_real moved_pct;
    cg_real gap_var_pct2;
    cg_real unseen_var_pct2;
} cg_since;

/* SoC, current offset, slow and lasting error, capacity, and the curve's errors. Covariance of the
 * learned states with all; the others have variance 1 and no covariance among each other. */
typedef struct {
    cg_real x[CG_STATES];
    cg_real p[CG_LEARNED][CG_STATES];
    cg_real mean_innovation_v;
    cg_real mean_seconds;
    bool was_outlier;
} cg_ekf;

typedef enum { CG_NO_TEST = 0, CG_OPEN, CG_PARKED, CG_MOVED, CG_UNCLEAR } cg_verdict;

/* One or two hypotheses: parked or moved while unobserved; a given SoC right or wrong. */
typedef struct {
    cg_ekf ekf[2];
    int32_t hypotheses;
    int32_t verdict; /* cg_verdict */
    cg_real log_odds;
    cg_real prior_log_odds;
    cg_real wide_std_pct;
    cg_real stated_pct; /* standard deviation of two hypotheses; NAN until it is needed */
    cg_real outlier_s;
    bool is_untested;
} cg_filter;

typedef struct {
    cg_time time_s;
    cg_real input;
    cg_real value;
    bool is_started;
} cg_lag;

typedef struct {
    cg_real volts; /* extra voltage, or what it is computed from over SoC */
    cg_lag lag[CG_LAGS]; /* resistance_step and hysteresis use the first for theirs */
} cg_effect_state;

typedef struct {
    int64_t samples;
    int64_t resets;
    cg_time first_s;
    int64_t tick;
    cg_real temperature_c;
    cg_real newton_pct;
    bool newton_inside;
    cg_real newton_std_pct;
    cg_sum coulomb_start_pct;
    cg_real coulomb_var_pct2;
    cg_sum coulomb_counted_s;
    cg_sum coulomb_moved_pct;
    cg_time gap_until_s;
    cg_time contradicted_until_s;
    cg_time mismatch_until_s;
    cg_real bias_pct;
    cg_time rest_since_s;
    cg_time level_s;
    cg_real level_residual_v;
    cg_real level_drop_v;
    cg_time full_since_s;
    bool is_full;
    bool is_rested;
} cg_memory;

/* All that must be kept to continue after a reset, but the delay line: plain data, to be copied to
 * non-volatile memory and back. Without its delay line the estimate is degraded for the model's
 * longest delay. */
typedef struct {
    cg_clock clock;
    cg_counter counter;
    cg_since since;
    cg_filter filter;
    cg_memory memory;
    cg_effect_state effect[CG_EFFECTS];
    cg_estimate latest;
    cg_sample pending; /* sample that `latest` is not computed for yet */
    cg_time pending_stamp_s;
    bool is_pending;
    bool is_filtering;
    bool is_refused; /* the latest sample: without a plausible current, or not later */
    bool has_other_capacity; /* what the hook returned last */
    uint32_t implausible;
    cg_real beside_soc_v; /* voltage of the effects that do not depend on the SoC */
} cg_state;

/* One sample of the current in the delay line. */
typedef struct {
    cg_time time_s;
    cg_real current_a;
} cg_current;

/* Currents over the longest delay, in a ring. */
typedef struct {
    cg_current *at; /* memory of the caller */
    int32_t size;
    int32_t first;
    int32_t count;
    int32_t block; /* stale currents dropped at once; 0: as soon as they are */
    cg_real spacing_s; /* least time between every second of the samples kept */
    cg_time since_s; /* start of the stretch without a gap */
} cg_line;

/* Samples that `time_skew` holds back until their current is known. */
typedef struct {
    cg_sample waiting[CG_WAITING];
    cg_current at[CG_WAITING];
    int32_t waiting_first;
    int32_t waiting_count;
    int32_t first;
    int32_t count;
} cg_skew;

/* A voltage that was used, for whoever learns the pack's health from it. */
typedef struct {
    cg_since since; /* charge and time since the last one */
    cg_real seconds; /* time since the last one */
    bool has_voltage; /* else nothing follows */
    cg_real voltage_v;
    cg_real without_ocv_v; /* predicted voltage less the pseudo-OCV */
    cg_real drop_v; /* part of it over the resistances */
    cg_real soc_newton_pct; /* NAN: outside the model */
    cg_real soc_counted_pct;
    bool is_filled; /* the delay line */
    bool is_inside; /* the temperature, of the identified range */
} cg_tick;

/* Optional: who learns the capacity. Each returns whether it is surely another than the model's. */
typedef struct {
    void *context;
    bool (*count)(void *context, const cg_since *since); /* after an unobserved interval */
    bool (*tick)(void *context, const cg_tick *tick); /* at the model's rate */
    bool (*correct)(void *context, cg_real soc_pct, cg_real std_pct); /* a SoC became known */
} cg_hook;

typedef struct {
    const cg_model *model;
    cg_settings settings;
    cg_state state;
    cg_line line;
    cg_skew *skew; /* memory of the caller; NULL: the model has no `time_skew` */
    cg_hook hook; /* functions NULL: none */
    cg_real without_ocv_v; /* at the latest sample; NAN: not computed yet */
    cg_real delayed_a[CG_DELAYS];
} cg_estimator;

/* ------------------------------------------------------------------ functions */

/* Storage for the delay line at samples `spacing_s` apart; for static arrays. Rounded up. */
#define CG_LINE_SIZE(longest_s, spacing_s) ((int32_t)(2.0 * (longest_s) / (spacing_s)) + 9)

/* Begin, with memory for the delay line (CG_LINE_SIZE) and, for a model with `time_skew`, for the
 * samples that it holds back. */
void cg_init(cg_estimator *self, const cg_model *model, const cg_settings *settings,
             const cg_line *line, cg_skew *skew);

/* Continue from a state that was copied, after cg_evaluate. `age_s`: least time since then by
 * another clock; NAN: none measured it. False: implausible numbers, nothing is changed. */
bool cg_restore(cg_estimator *self, const cg_state *state, cg_time age_s);

/* Process one sample. False: refused (no plausible current, or not later than the last). */
bool cg_update(cg_estimator *self, const cg_sample *sample);

/* Return the estimate after the latest sample. Changes nothing that a later one depends on. */
cg_estimate cg_evaluate(cg_estimator *self);

/* Return the estimated offset of the current sensor [A]. */
cg_real cg_offset_a(const cg_estimator *self);

/* Return the standard deviation that the SoC lacks after a time without samples [%]. */
cg_real cg_uncounted_std_pct(const cg_estimator *self, cg_real seconds);

/* Return the voltage without the model's drop and kt [V], and its slope [V per %]. */
cg_real cg_pseudo_ocv(const cg_estimator *self, cg_real soc_pct, cg_real *slope);

/* Return the current some time before the latest sample [A]. */
cg_real cg_current_at(const cg_estimator *self, cg_time ago_s);

#endif
