/* python_health.h - the sums of `HealthEstimator` between its updates, for the extension.
 *
 * Operation by operation as `count` and `use` of estimation/health.py. What changes its filter
 * (the end of a window, a start, an unobserved interval) stays in Python: `health_takes` is false.
 */
#ifndef CG_PYTHON_HEALTH_H
#define CG_PYTHON_HEALTH_H

#include "cangauge_internal.h"

#define HEALTH_BLOCK 4
#define HEALTH_SCALES 4

typedef struct {
    double residual_v;
    double drop_v;
} health_pair;

typedef struct {
    double seconds, away_s, discharged_pct, moved_pct, gap_var_pct2;
    bool is_started;
    double sum_v, sum_drop_v, window_s;
    int64_t ticks;
    double block[HEALTH_BLOCK];          /* sums of residual and drop, number, time */
    double waiting[2 * HEALTH_SCALES];   /* residual and drop by scale */
    double sums[4 * HEALTH_SCALES];      /* drop^2, drop * residual, residual^2, number */
    double soc_pct, gain, offset_a;      /* of the filter, when it was last propagated */
    double pct_per_as;
    double full_window_s, full_block_s, memory_s;
} health;

static bool health_takes(const health *self, const cg_tick *tick)
{
    if (tick->since.away_s != 0.0) {
        return false;
    }
    if (!tick->has_voltage || !tick->is_filled || !tick->is_inside) {
        return true;
    }
    return self->is_started ? ((self->window_s + tick->seconds) < self->full_window_s)
                            : (bool)isnan(tick->soc_newton_pct);
}

static void health_restart(health *self)
{
    for (int k = 0; k < HEALTH_BLOCK; ++k) {
        self->block[k] = 0.0;
    }
    for (int k = 0; k < (2 * HEALTH_SCALES); ++k) {
        self->waiting[k] = CG_NAN;
    }
}

static void health_use_block(health *self, health_pair mean)
{
    for (int k = 0; k < HEALTH_SCALES; ++k) {
        double *waiting = &self->waiting[2 * k];
        double *sums = &self->sums[4 * k];
        if (isnan(waiting[0] + waiting[1])) {
            waiting[0] = mean.residual_v;
            waiting[1] = mean.drop_v;
            return;
        }
        const double y = mean.residual_v - waiting[0];
        const double x = mean.drop_v - waiting[1];
        sums[0] += x * x;
        sums[1] += x * y;
        sums[2] += y * y;
        sums[3] += 1.0;
        mean.residual_v = 0.5 * (mean.residual_v + waiting[0]);
        mean.drop_v = 0.5 * (mean.drop_v + waiting[1]);
        waiting[0] = waiting[1] = CG_NAN;
    }
}

static void health_add(health *self, health_pair found, double seconds)
{
    double *block = self->block;
    if (seconds > self->full_block_s) {
        health_restart(self);
        return;
    }
    block[0] += found.residual_v;
    block[1] += found.drop_v;
    block[2] += 1.0;
    block[3] += seconds;
    if (block[3] < self->full_block_s) {
        return;
    }
    const double kept = cg_exp(-block[3] / self->memory_s);
    for (int k = 0; k < (4 * HEALTH_SCALES); ++k) {
        self->sums[k] = kept * self->sums[k];
    }
    const health_pair mean = {block[0] / block[2], block[1] / block[2]};
    for (int k = 0; k < HEALTH_BLOCK; ++k) {
        block[k] = 0.0;
    }
    health_use_block(self, mean);
}

static void health_take(health *self, const cg_estimator *estimator, const cg_tick *tick)
{
    double slope;
    self->seconds += tick->since.seconds;
    self->away_s += tick->since.away_s;
    self->discharged_pct += tick->since.discharged_pct;
    self->moved_pct += tick->since.moved_pct;
    self->gap_var_pct2 += tick->since.gap_var_pct2;
    if (!tick->has_voltage) {
        return;
    }
    if (!tick->is_filled) {
        health_restart(self);
        return;
    }
    const double above_v = tick->voltage_v - tick->without_ocv_v;
    const double counted_v = cg_pseudo_ocv(estimator, tick->soc_counted_pct, &slope);
    health_add(self, (health_pair){above_v - counted_v, tick->drop_v}, tick->seconds);
    if (!tick->is_inside || !self->is_started) {
        return;
    }
    const double offset_pct = self->pct_per_as * (self->seconds - self->away_s) * self->offset_a;
    const double soc_pct = self->soc_pct - self->gain * (self->discharged_pct - offset_pct);
    self->sum_v += above_v - cg_pseudo_ocv(estimator, soc_pct, &slope);
    self->sum_drop_v += tick->drop_v;
    self->ticks += 1;
    self->window_s += tick->seconds;
}

#endif
