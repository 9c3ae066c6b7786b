/* hostile.c - samples that no battery gives; run under sanitizers. */
#include <math.h>
#include <stdio.h>
#include "pack_model.h"

static cg_current storage[PACK_LINE_SIZE];
static cg_skew skew;
static cg_estimator pack;
static uint32_t seed = 1U;

static uint32_t draw(void)
{
    seed = (seed * 1664525U) + 1013904223U;
    return seed >> 8;
}

static double odd(double usual)
{
    static const double ODD[] = {0.0, -1.0, 1e-300, 1e9, -1e9, 1e18, 1e38, -1e38, 1e300, -1e300};
    const uint32_t kind = draw() % 40U;
    if (kind < 10U) {
        return ODD[kind];
    }
    return (kind == 10U) ? (double)NAN : (kind == 11U) ? (double)INFINITY : (kind == 12U) ? -(double)INFINITY
           : (usual + ((double)(draw() % 1000U) / 100.0));
}

int main(void)
{
    const cg_settings settings = cg_default_settings();
    for (int run = 0; run < 400; ++run) {
        const cg_line line = CG_LINE(storage, PACK_LINE_SIZE, PACK_SPACING_S);
        double time_s = 0.0;
        cg_init(&pack, &pack_model, &settings, &line, &skew);
        for (int k = 0; k < 500; ++k) {
            time_s += (double)(draw() % 200U) / 100.0;
            const bool is_odd = (run % 2) == 1;
            const cg_sample sample = {
                cg_time_of_s((is_odd && (draw() % 8U) == 0U) ? odd(time_s) : time_s),
                (cg_real)(is_odd ? odd(10.0) : 10.0), (cg_real)(is_odd ? odd(380.0) : 380.0),
                (cg_real)(is_odd ? odd(20.0) : 20.0)};
            (void)cg_update(&pack, &sample);
            const cg_estimate now = cg_evaluate(&pack);
            if ((now.status == CG_VALID) && !(isfinite(now.soc_pct) && isfinite(now.soc_std_pct))) {
                printf("VALID without a number\n");
                return 1;
            }
            if (is_odd && ((time_s > 0.0) && (draw() % 50U) == 0U)) {
                time_s = fabs(odd(0.0));
                time_s = isfinite(time_s) ? time_s : 0.0;
            }
        }
    }
    printf("PASSED\n");
    return 0;
}
