/* matrix_ekf.c - the core's filter beside the same one in generic matrix code, on a Cortex-M4F.
 *
 * The second is written as TinyEKF is: whole matrices F, Q and H, products in three loops, a
 * temporary for each. Same states, same blocks, same linearisation; it learns no capacity and no
 * resistance. core_cost.py runs it in place of an export's test.c.
 */
#include <stdio.h>

#include "cangauge_internal.h"
#include "clock.h"
#include "pack_model.h"

#define N CG_STATES
#define BLOCKS 40 /* of 30 s; then the SoC is uncertain enough for the core to iterate */
#define SECONDS R(30.0)
#define DRAWN_PCT R(0.2)

/* ------------------------------------------------------------------ generic code */

typedef struct {
    cg_real x[N];
    cg_real P[N * N];
    cg_real F[N * N], Q[N * N], H[N]; /* of the caller */
    cg_real T[N * N], FT[N * N], G[N];
} ekf_t;

static void mulmat(const cg_real *a, const cg_real *b, cg_real *c, int rows, int inner, int columns)
{
    for (int i = 0; i < rows; ++i) {
        for (int j = 0; j < columns; ++j) {
            cg_real total = R(0.0);
            for (int k = 0; k < inner; ++k) {
                total += a[(i * inner) + k] * b[(k * columns) + j];
            }
            c[(i * columns) + j] = total;
        }
    }
}

static void transpose(const cg_real *a, cg_real *at, int rows, int columns)
{
    for (int i = 0; i < rows; ++i) {
        for (int j = 0; j < columns; ++j) {
            at[(j * rows) + i] = a[(i * columns) + j];
        }
    }
}

static void ekf_predict(ekf_t *ekf, const cg_real *fx)
{
    for (int i = 0; i < N; ++i) {
        ekf->x[i] = fx[i];
    }
    mulmat(ekf->F, ekf->P, ekf->T, N, N, N);
    transpose(ekf->F, ekf->FT, N, N);
    mulmat(ekf->T, ekf->FT, ekf->P, N, N, N);
    for (int i = 0; i < N * N; ++i) {
        ekf->P[i] += ekf->Q[i];
    }
}

/* One measurement, so that the inverse is a division. */
static void ekf_update(ekf_t *ekf, cg_real z, cg_real hx, cg_real noise)
{
    cg_real variance;
    mulmat(ekf->P, ekf->H, ekf->G, N, N, 1);
    mulmat(ekf->H, ekf->G, &variance, 1, N, 1);
    variance += noise;
    for (int i = 0; i < N; ++i) {
        ekf->G[i] /= variance;
        ekf->x[i] += ekf->G[i] * (z - hx);
    }
    mulmat(ekf->G, ekf->H, ekf->T, N, 1, N);
    for (int i = 0; i < N; ++i) {
        for (int j = 0; j < N; ++j) {
            ekf->T[(i * N) + j] = ((i == j) ? R(1.0) : R(0.0)) - ekf->T[(i * N) + j];
        }
    }
    mulmat(ekf->T, ekf->P, ekf->FT, N, N, N);
    for (int i = 0; i < N * N; ++i) {
        ekf->P[i] = ekf->FT[i];
    }
}

/* ------------------------------------------------------------------ the filter with it */

static void begin(ekf_t *ekf, const cg_ekf *of)
{
    for (int i = 0; i < N; ++i) {
        ekf->x[i] = of->x[i];
        ekf->F[(i * N) + i] = R(1.0);
        for (int j = 0; j <= i; ++j) {
            ekf->P[(i * N) + j] = of->p[(i * (i + 1) / 2) + j];
            ekf->P[(j * N) + i] = ekf->P[(i * N) + j];
        }
    }
}

static void step(ekf_t *ekf, const cg_model *model, const cg_passed *passed, const cg_means *block)
{
    cg_real fx[N];
    const cg_real gain = cg_pct_per_as(model) * passed->seconds;
    const cg_real keep = cg_exp(-passed->seconds / model->slow_time_s);
    ekf->F[(CG_X_SOC * N) + CG_X_OFFSET] = gain;
    ekf->F[(CG_X_SLOW * N) + CG_X_SLOW] = keep;
    ekf->Q[(CG_X_SOC * N) + CG_X_SOC] = R(1e-6) * passed->seconds;
    ekf->Q[(CG_X_SLOW * N) + CG_X_SLOW] =
        (R(1.0) - cg_square(keep)) * cg_square(model->slow_std_v);
    for (int i = 0; i < N; ++i) {
        fx[i] = ekf->x[i];
    }
    for (int i = CG_X_LEVEL; i < N; ++i) { /* back to their priors */
        const cg_real hours = (i == CG_X_LEVEL) ? R(4.0) : R(72.0);
        const cg_real kept = cg_exp(-passed->seconds / (hours * R(3600.0)));
        ekf->F[(i * N) + i] = kept;
        ekf->Q[(i * N) + i] = R(1.0) - cg_square(kept);
        fx[i] *= kept;
    }
    fx[CG_X_SOC] += (gain * fx[CG_X_OFFSET]) - passed->discharged_pct;
    fx[CG_X_SLOW] *= keep;
    ekf_predict(ekf, fx);

    cg_real slope;
    const cg_real cold = cg_cold(model, block->temperature_c);
    cg_real hx = cg_curve_at(model, block->drive, ekf->x[CG_X_SOC], &slope);
    const cg_real axis_v = model->soc_std_pct * slope;
    ekf->H[CG_X_SOC] = slope;
    ekf->H[CG_X_SLOW] = cold;
    const cg_real *range = model->temperature_range_c;
    const cg_real outside_k = cg_max(
        cg_max(range[0] - block->temperature_c, block->temperature_c - range[1]), R(0.0));
    ekf->H[CG_X_LEVEL] = cg_sqrt(cg_square(cold * model->level_std_v) + cg_square(axis_v) +
                                 cg_square(R(0.2) * outside_k * slope));
    cg_functions_row(model, ekf->x[CG_X_SOC], block->load, &ekf->H[CG_X_FUNCTIONS]);
    hx += cg_dot(block->load, model->load, cg_loads(model));
    hx += cg_dot(&ekf->H[CG_X_SLOW], &ekf->x[CG_X_SLOW], N - CG_X_SLOW);
    ekf_update(ekf, block->voltage_v, hx, cg_square(cold * model->fast_std_v) + cg_square(axis_v));
}

int main(void)
{
    static cg_filter filter;
    static ekf_t ekf;
    static cg_means block;
    const cg_model *model = &pack_model;
    const cg_passed passed = {SECONDS, DRAWN_PCT, R(0.0), R(0.0)};
    unsigned long core = 0, matrices = 0;
    cg_real worst = R(0.0);
    cg_filter_start(&filter, model, R(80.0), R(0.5), false);
    begin(&ekf, &filter.ekf[0]);
    for (int k = 0; k < BLOCKS; ++k) {
        cg_real slope;
        block.temperature_c = model->t_ref_c + (cg_real)(k % 7) - R(10.0);
        block.load[0] = block.temperature_c - model->t_ref_c;
        block.load[1] = R(10.0) + (cg_real)(k % 11);
        block.voltage_v = cg_curve_at(model, block.drive, R(75.0) - (DRAWN_PCT * (cg_real)k), &slope) +
                          cg_dot(block.load, model->load, cg_loads(model)) +
                          (R(0.4) * (cg_real)(k % 5));
        const unsigned long begun = instructions();
        cg_filter_predict(&filter, model, &passed);
        cg_filter_update(&filter, model, &block);
        const unsigned long between = instructions();
        step(&ekf, model, &passed, &block);
        core += between - begun;
        matrices += instructions() - between;
        const cg_real apart = cg_fabs(filter.ekf[0].x[CG_X_SOC] - ekf.x[CG_X_SOC]);
        worst = (apart > worst) ? apart : worst;
    }
    printf("states: %d; SoC apart by %.2g %%\n", N, (double)worst);
    printf("filter instructions: core %lu, matrices %lu\n", core / BLOCKS, matrices / BLOCKS);
    printf("filter bytes: core %lu, matrices %lu\n", (unsigned long)sizeof(cg_ekf),
           (unsigned long)sizeof(ekf_t));
    return (worst < R(0.01)) ? 0 : 1;
}
