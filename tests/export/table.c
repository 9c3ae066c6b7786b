/* table.c - samples from standard input; before one of them another model's constants. */
#include <stdio.h>
#include <stdlib.h>
#include "pack_model.h"

extern const cg_model later_model;
static cg_current storage[PACK_LINE_SIZE];
static cg_estimator pack;

int main(int count, char **argument)
{
    const cg_settings settings = cg_default_settings();
    const cg_line line = CG_LINE(storage, PACK_LINE_SIZE, PACK_SPACING_S);
    const int at = (count > 1) ? atoi(argument[1]) : 0;
    double time_s, current_a, voltage_v, temperature_c;
    cg_init(&pack, &pack_model, &settings, &line, NULL);
    for (int k = 0; scanf("%lf,%lf,%lf,%lf", &time_s, &current_a, &voltage_v, &temperature_c) == 4; ++k) {
        const cg_sample sample = {cg_time_of_s(time_s), (cg_real)current_a, (cg_real)voltage_v, (cg_real)temperature_c};
        if (k == at) {
            cg_set_table(&pack, &later_model);
        }
        (void)cg_update(&pack, &sample);
        const cg_estimate now = cg_evaluate(&pack);
        printf("%.15g %.15g %.15g %.15g %lu\n", (double)now.soc_pct, (double)now.soc_std_pct,
               (double)now.soc_newton_pct, (double)now.soc_coulomb_pct, (unsigned long)now.reasons);
    }
    return 0;
}
