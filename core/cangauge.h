/* cangauge.h - state of charge of a battery pack from current, voltage and temperature.
 *
 *     static cg_estimator pack;                      all memory: no heap, nothing hidden
 *     cg_init(&pack, &model, &settings, &line, NULL);
 *     cg_update(&pack, &sample);                     at every sample of the current
 *     cg_estimate soc = cg_evaluate(&pack);          whenever an estimate is wanted
 *
 * The same equations as the Python package `cangauge`; with doubles both agree within 1e-9.
 * One sign: positive current discharges. NAN is a value that
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
#define CG_REAL_IS_double 0
#define CG_REAL_IS_float 1
#define CG_JOIN_(a, b) a##b
#define CG_JOIN(a, b) CG_JOIN_(a, b)
#define CG_HAS_FLOATS CG_JOIN(CG_REAL_IS_, CANGAUGE_REAL)

/* What would lose its digits as float. Time: seconds as double; with floats an integer of 0.1 us, as a
 * timer counts. Running sum: a double, or a float with what its additions lost. Coefficients of the
 * pseudo-OCV, whose terms of up to 1e8 V cancel: doubles, which an exported model does not need. */
#if CG_HAS_FLOATS
#define CG_TICKS_PER_S 10000000
#define CG_NO_TIME INT64_MIN
typedef int64_t cg_time;
typedef struct {
    cg_real high;
    cg_real low;
} cg_sum;
#else
typedef double cg_time;
typedef double cg_sum;
#endif
typedef double cg_wide;

/* Upper limits of a model; an exported model states its own, which are smaller. */
#ifdef CANGAUGE_CONFIG
#include "cangauge_config.h"
#else
#define CG_DELAYS 64
#define CG_LOW_PASSES 4
#define CG_KNOTS 201
#define CG_FUNCTIONS 16
#define CG_EFFECTS 32
#define CG_WAITING 8192 /* samples that an effect `time_skew` holds back */
#endif
#define CG_OCV 8
#define CG_LAGS 2
#define CG_VALUES 5
#define CG_TESTED 64 /* innovations that are tested together, at most */
#define CG_CURRENTS (CG_DELAYS + CG_LOW_PASSES)
#define CG_LOADS (CG_CURRENTS + 2)
#define CG_STATES (CG_FUNCTIONS + 4)
#define CG_PAIRS (CG_STATES * (CG_STATES + 1) / 2)
#define CG_SUMS (CG_LOADS + 6)

/* ------------------------------------------------------------------ constants of a model */

typedef enum {
    CG_NO_EFFECT = 0, /* or one that changes the count only */
    CG_CURRENT_SENSOR, /* offset, gain */
    CG_VOLTAGE_SENSOR, /* offset, gain */
    CG_TIME_SKEW, /* `skew_s` of the model */
    CG_TEMPERATURE_SENSOR, /* offset */
    CG_TEMPERATURE_LAG, /* ahead; lag: smoothing */
    CG_CORE_TEMPERATURE, /* rise_k, late, capacity_ah; lags: Joule heat, temperature */
    CG_RESISTANCE_GROWTH, /* share, delayed, ohm */
    CG_RESISTANCE_TEMPERATURE, /* share, activation_k, delayed, reference_per_k, ohm */
    CG_RESISTANCE_SOC, /* at_empty, at_full, width_pct, delayed, ohm */
    CG_RESISTANCE_ASYMMETRY, /* charging_ohm */
    CG_RESISTANCE_STEP, /* step_ohm, start_s */
    CG_CHARGE_TRANSFER, /* scale_v, per_a, bend_only, activation_k, zero_a */
    CG_RC, /* activation_k, by_slope, mean_slope, ohm; lag: the element */
    CG_HYSTERESIS, /* half_width_v, travel_as */
    CG_ENTROPIC, /* level, slope, curve, t_ref_c */
    CG_WEAK_CELL /* fraction, ahead */
} cg_effect_kind;

typedef struct {
    int32_t kind; /* cg_effect_kind */
    cg_real value[CG_VALUES]; /* in the order stated above */
    cg_real tau_s[CG_LAGS];
} cg_effect;

/* What `cangauge fit` found. Constant: it may stay in flash.
 *
 *     U = g(S) + kt (T - T_r) + sum Rm Im + b (a(T)/a(mean) - 1) sum R0m Im + errors
 *
 * g is the published equation (knots = 0), or a cubic Hermite curve. Im: the delayed, then the
 * low-passed currents. Load columns: T - T_r, I1 ... IM and, with Arrhenius, (a(T)/a(mean) - 1) sum. */
typedef struct {
    cg_wide ocv_v[CG_OCV];
    cg_wide epsilon;
    cg_real slope_beyond[2]; /* of the published equation outside the identified SoC [V per %] */
    int32_t knots;
    cg_real knot_pct[CG_KNOTS];
    cg_real knot_v[CG_KNOTS];
    cg_real knot_slope[CG_KNOTS]; /* [V per %] */
    cg_real t_ref_c;
    cg_real temperature_limits_c[2]; /* beyond which the load columns are constant */
    int32_t delays;
    cg_real delay_s[CG_DELAYS];
    int32_t low_passes;
    cg_real low_pass_s[CG_LOW_PASSES];
    int32_t has_arrhenius;
    cg_real arrhenius_ohm[CG_CURRENTS]; /* R0m */
    cg_real arrhenius_mean; /* a(mean) */
    cg_real usual_c; /* temperature where none is known */
    cg_real load[CG_LOADS]; /* coefficients of the load columns: kt, R1 ... RM and b */
    cg_real soc_range_pct[2]; /* identified ranges */
    cg_real temperature_range_c[2];
    cg_real current_range_a[2];
    cg_real rate_hz; /* rows per second: inverse and residual */
    cg_real capacity_ah;
    cg_real charge_efficiency;
    cg_real initial_offset_pct; /* error of a given initial SoC */
    cg_real nominal_v; /* voltage at half charge [V] */

    /* Errors of the voltage: standard deviations; of the SoC against the voltage [%]. */
    cg_real level_std_v;
    cg_real slow_std_v;
    cg_real slow_time_s;
    cg_real fast_std_v;
    cg_real soc_std_pct;
    cg_real cold_exponent;
    cg_real residual_std_v;
    cg_real block_s;
    int32_t tested_blocks; /* limits of the tests for a model that the pack contradicts */
    cg_real innovations_at_most;
    cg_real residual_at_most;
    cg_real strain_at_most;

    /* Principal functions of the coefficients' covariance: over SoC, and of the load columns. */
    int32_t functions;
    int32_t function_knots;
    cg_real function_pct[CG_KNOTS];
    cg_real function_v[CG_KNOTS][CG_FUNCTIONS];
    cg_real function_slope[CG_KNOTS][CG_FUNCTIONS];
    cg_real function_load[CG_LOADS][CG_FUNCTIONS];

    /* effects, in the order of their application */
    int32_t effects;
    cg_effect effect[CG_EFFECTS];
    cg_real skew_s; /* of CG_TIME_SKEW: how late the time stamps of the current are */
} cg_model;

/* ------------------------------------------------------------------ settings */

typedef enum { CG_EKF = 0, CG_NEWTON, CG_COULOMB } cg_method;

typedef struct {
    int32_t method; /* cg_method: whose SoC is the estimate */
    cg_real initial_soc_pct; /* NAN: found from the first voltages */
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

/* 2 s, 1 %, 5 %, extended Kalman filter, no rules. */
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

/* Bits of `reasons`: why an estimate is not valid. The notes leave it valid: what they say, the
 * standard deviation contains. */
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
#define CG_SIGN_SUSPECT (UINT32_C(1) << 20)

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
    cg_real age_s; /* least age of a restored state; NAN: no clock measured it */
    bool is_restored;
} cg_clock;

typedef struct {
    cg_time time_s;
    cg_real current_a;
    cg_real mean_square_a2;
    cg_real turned_a2; /* variance of the current between the last two samples */
    cg_sum discharged_pct;
    cg_sum moved_pct;
    cg_sum counted_s;
    cg_sum gap_var_pct2;
} cg_counter;

/* Sums of the rows of the open block: counted time, charge, voltage, temperature, drop, variance of the
 * load between samples, loads; and of the effects' drives. */
typedef struct {
    int64_t number;
    int32_t rows;
    bool is_broken;
    cg_sum sums[CG_SUMS];
    cg_sum drive[CG_EFFECTS];
} cg_block;

/* State x = (SoC, current offset, slow error, level, functions) with its covariance, and beside it
 * the biases b = (capacity, resistance) with their covariance and their influence v on x. */
typedef struct {
    cg_real x[CG_STATES];
    cg_real p[CG_PAIRS]; /* of the symmetric matrix: row by row up to the diagonal */
    cg_sum evidence; /* log-likelihood of all voltages */
    cg_real b[2];
    cg_real b_p[2][2];
    cg_real b_v[CG_STATES][2];
    cg_real innovation2; /* of the last voltage, over its variance */
} cg_ekf;

/* One or two hypotheses: the SoC is the stated one, or another. */
typedef struct {
    cg_ekf ekf[2]; /* narrow, wide */
    int32_t hypotheses;
    int32_t decision; /* -1 narrow, 0 open, 1 wide */
    cg_real prior_log_odds;
} cg_filter;

typedef struct {
    cg_time time_s;
    cg_real input;
    cg_real value;
    bool is_started;
} cg_lag;

typedef struct {
    cg_lag lag[CG_LAGS]; /* resistance_step and hysteresis use the first for theirs */
} cg_effect_state;

typedef struct {
    int64_t samples;
    cg_time first_s;
    int64_t tick;
    cg_real temperature_c;
    cg_real row_v; /* of the last row; NAN after a gap */
    cg_real row_a;
    cg_real steps; /* weight of the latest steps of the current, and their sums */
    cg_real steps_v2;
    cg_real steps_a2;
    cg_real steps_va;
    bool is_sign_wrong;
    bool is_unseen; /* a block had no usable voltage, and none was used since */
    cg_real newton_pct;
    cg_real newton_std_pct;
    bool newton_inside;
    cg_real voltage_model_v;
    cg_real residual_v;
    bool is_known; /* a start was given, or a block was used */
    cg_sum filter_discharged_pct;
    cg_sum filter_counted_s;
    cg_sum filter_gap_var_pct2;
    cg_sum coulomb_start_pct;
    cg_real coulomb_var_pct2;
    cg_sum coulomb_counted_s;
    cg_sum coulomb_moved_pct;
    cg_sum coulomb_gap_var_pct2;
    cg_time gap_until_s;
    cg_time contradicted_until_s;
    cg_time mismatch_until_s;
    int32_t innovations;
    cg_real innovation2[CG_TESTED]; /* the newest first */
    cg_time rest_since_s;
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
    cg_block block;
    cg_filter filter;
    cg_memory memory;
    cg_lag low_pass[CG_LOW_PASSES];
    cg_effect_state effect[CG_EFFECTS];
    cg_estimate latest;
    cg_sample pending; /* sample that `latest` is not computed for yet */
    cg_time pending_stamp_s;
    bool is_pending;
    bool is_refused; /* the latest sample: without a plausible current, or not later */
    uint32_t implausible;
    cg_real load[CG_LOADS]; /* load columns at the latest sample */
    cg_real load_v; /* their voltage, and its part over the resistances */
    cg_real drop_v;
    cg_real drive[CG_EFFECTS]; /* voltage of each effect, or what it is computed from over SoC */
} cg_state;

/* One sample of the current in the delay line. */
typedef struct {
    cg_real time_s; /* since `base_s` of the line, so that a float keeps its digits */
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
    cg_time base_s; /* 0 with doubles */
} cg_line;

/* The latest samples in a ring, which `time_skew` holds back until their current is known. The numbers
 * count from the first of all. */
typedef struct {
    cg_sample at[CG_WAITING];
    int64_t first; /* whose current is needed */
    int64_t waiting; /* the oldest that is held back */
    int64_t count;
} cg_skew;

typedef struct {
    const cg_model *model;
    cg_settings settings;
    cg_state state;
    cg_line line;
    cg_skew *skew; /* memory of the caller; NULL: the model has no `time_skew` */
} cg_estimator;

/* ------------------------------------------------------------------ functions */

/* Time of a number of seconds, and back. Costs software doubles where the processor has floats only: there a
 * timer's count is better scaled to CG_TICKS_PER_S. */
cg_time cg_time_of_s(double time_s);
double cg_s_of_time(cg_time time_s);

/* Storage for the delay line at samples `spacing_s` apart; for static arrays. Rounded up. */
#define CG_LINE_SIZE(longest_s, spacing_s) ((int32_t)(2.0 * (longest_s) / (spacing_s)) + 9)
/* An empty delay line in an array of a size. */
#define CG_LINE(array, size, spacing_s) {(array), (size), 0, 0, 0, (cg_real)(spacing_s), 0, 0}

/* Begin, with memory for the delay line (CG_LINE_SIZE) and, for a model with `time_skew`, for the
 * samples that it holds back. */
void cg_init(cg_estimator *self, const cg_model *model, const cg_settings *settings,
             const cg_line *line, cg_skew *skew);

/* After cg_init: start from the SoC of an estimator that ended `away_s` ago, with its standard
 * deviation [%], where its state cannot be restored: it is of an earlier core or model. */
void cg_start_from(cg_estimator *self, cg_real soc_pct, cg_real std_pct, cg_real away_s);

/* Continue from a state that was copied, after cg_evaluate. `age_s`: least time since then by
 * another clock; NAN: none measured it. False: impossible numbers, nothing is changed; against a
 * copy that was torn or lost a bit the caller keeps a checksum. */
bool cg_restore(cg_estimator *self, const cg_state *state, cg_real age_s);

/* Continue with the constants of another model, as one that was fitted to the pack later. SoC, offset
 * of the current, learned capacity and delay line are kept; what the voltage taught is not. The sizes
 * of cangauge_config.h must hold for both models, and one with `time_skew` needs its memory. */
void cg_set_table(cg_estimator *self, const cg_model *model);

/* Process one sample. False: refused (no plausible current, or not later than the last). */
bool cg_update(cg_estimator *self, const cg_sample *sample);

/* Return the estimate after the latest sample. Changes nothing that a later one depends on. */
cg_estimate cg_evaluate(cg_estimator *self);

/* Return the standard deviation that the SoC lacks after a time without samples [%]. */
cg_real cg_uncounted_std_pct(const cg_estimator *self, cg_real seconds);

/* Return the voltage without the load's [V], with effects, and its slope [V per %]. */
cg_real cg_pseudo_ocv(const cg_estimator *self, cg_real soc_pct, cg_real *slope);

#endif
