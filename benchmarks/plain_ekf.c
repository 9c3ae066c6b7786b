/* plain_ekf.c - a plain extended Kalman filter of a cell on a Cortex-M4F, for comparison.
 *
 * SoC and three RC pairs, floats, an open-circuit voltage of 201 knots, a prediction and an update
 * at every sample, in generic matrix code as TinyEKF has it: whole matrices, products in three
 * loops. core_cost.py runs it in place of an export's test.c.
 */
#include <stdio.h>

#include "cangauge_internal.h"
#include "clock.h"
#include "pack_model.h"

#define N 4
#define KNOTS 201
#define SAMPLES 600 /* one a second */
#define START_OFF_PCT 10.0F
#define NOISE_V 0.2F
#define OHM 0.08F

static const float pair_ohm[N] = {0.0F, 0.02F, 0.03F, 0.04F};
static const float pair_tau_s[N] = {INFINITY, 5.0F, 60.0F, 600.0F};

typedef struct {
    float x[N];
    float P[N * N];
    float F[N * N], Q[N * N], H[N];
    float T[N * N], FT[N * N], G[N];
    float ocv_v[KNOTS];
} ekf_t;

static void mulmat(const float *a, const float *b, float *c, int rows, int inner, int columns)
{
    for (int i = 0; i < rows; ++i) {
        for (int j = 0; j < columns; ++j) {
            float total = 0.0F;
            for (int k = 0; k < inner; ++k) {
                total += a[(i * inner) + k] * b[(k * columns) + j];
            }
            c[(i * columns) + j] = total;
        }
    }
}

static void transpose(const float *a, float *at)
{
    for (int i = 0; i < N; ++i) {
        for (int j = 0; j < N; ++j) {
            at[(j * N) + i] = a[(i * N) + j];
        }
    }
}

static void predict(ekf_t *ekf, float current_a, float seconds, float pct_per_as)
{
    for (int i = 1; i < N; ++i) {
        const float keep = expf(-seconds / pair_tau_s[i]);
        ekf->F[(i * N) + i] = keep;
        ekf->x[i] = (keep * ekf->x[i]) + (pair_ohm[i] * (1.0F - keep) * current_a);
    }
    ekf->x[0] -= current_a * seconds * pct_per_as;
    mulmat(ekf->F, ekf->P, ekf->T, N, N, N);
    transpose(ekf->F, ekf->FT);
    mulmat(ekf->T, ekf->FT, ekf->P, N, N, N);
    for (int i = 0; i < N * N; ++i) {
        ekf->P[i] += ekf->Q[i];
    }
}

static float ocv(const ekf_t *ekf, float soc_pct, float *slope)
{
    const float at = fminf(fmaxf(2.0F * soc_pct, 0.0F), (float)(KNOTS - 2));
    const int left = (int)at;
    const float rise_v = ekf->ocv_v[left + 1] - ekf->ocv_v[left];
    *slope = 2.0F * rise_v;
    return ekf->ocv_v[left] + ((at - (float)left) * rise_v);
}

/* One measurement, so that the inverse is a division. */
static void update(ekf_t *ekf, float current_a, float voltage_v)
{
    float variance;
    float error_v = voltage_v - ocv(ekf, ekf->x[0], &ekf->H[0]) + (OHM * current_a);
    for (int i = 1; i < N; ++i) {
        ekf->H[i] = -1.0F;
        error_v += ekf->x[i];
    }
    mulmat(ekf->P, ekf->H, ekf->G, N, N, 1);
    mulmat(ekf->H, ekf->G, &variance, 1, N, 1);
    variance += NOISE_V * NOISE_V;
    for (int i = 0; i < N; ++i) {
        ekf->G[i] /= variance;
        ekf->x[i] += ekf->G[i] * error_v;
    }
    mulmat(ekf->G, ekf->H, ekf->T, N, 1, N);
    for (int i = 0; i < N; ++i) {
        for (int j = 0; j < N; ++j) {
            ekf->T[(i * N) + j] = ((i == j) ? 1.0F : 0.0F) - ekf->T[(i * N) + j];
        }
    }
    mulmat(ekf->T, ekf->P, ekf->FT, N, N, N);
    for (int i = 0; i < N * N; ++i) {
        ekf->P[i] = ekf->FT[i];
    }
}

int main(void)
{
    static ekf_t ekf;
    const cg_real drive[CG_EFFECTS] = {R(0.0)};
    const float pct_per_as = cg_pct_per_as(&pack_model);
    float truth[N] = {70.0F};
    float slope;
    unsigned long taken = 0, longest = 0;
    for (int k = 0; k < KNOTS; ++k) {
        ekf.ocv_v[k] = cg_curve_at(&pack_model, drive, 0.5F * (float)k, &slope);
    }
    ekf.x[0] = truth[0] - START_OFF_PCT;
    for (int i = 0; i < N; ++i) {
        ekf.F[(i * N) + i] = 1.0F;
        ekf.P[(i * N) + i] = (i == 0) ? (START_OFF_PCT * START_OFF_PCT) : 1.0F;
        ekf.Q[(i * N) + i] = 1e-6F;
    }
    for (int k = 0; k < SAMPLES; ++k) {
        const float current_a = 10.0F + (float)(k % 11);
        truth[0] -= current_a * pct_per_as;
        float voltage_v = ocv(&ekf, truth[0], &slope) - (OHM * current_a);
        for (int i = 1; i < N; ++i) {
            const float keep = expf(-1.0F / pair_tau_s[i]);
            truth[i] = (keep * truth[i]) + (pair_ohm[i] * (1.0F - keep) * current_a);
            voltage_v -= truth[i];
        }
        const unsigned long before = instructions();
        predict(&ekf, current_a, 1.0F, pct_per_as);
        update(&ekf, current_a, voltage_v);
        const unsigned long each = instructions() - before;
        taken += each;
        longest = (each > longest) ? each : longest;
    }
    printf("plain filter: %lu instructions, at most %lu; %lu bytes\n", taken / SAMPLES, longest,
           (unsigned long)sizeof(ekf));
    return (fabsf(ekf.x[0] - truth[0]) < 1.0F) ? 0 : 1;
}
