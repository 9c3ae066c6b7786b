/* example.c - the core in a program: samples from standard input, frames to standard output.
 *
 *     ./example < drive.csv        lines of time [s], current [A], voltage [V], temperature [degC]
 *
 * In a battery management system the loop is a task at the rate of the current sensor.
 */
#include <stdio.h>

#include "frames.h"
#include "pack_model.h"

static cg_current storage[PACK_LINE_SIZE];
static cg_skew skew;
static cg_estimator pack;

int main(void)
{
    const cg_settings settings = cg_default_settings();
    const cg_line line = {storage, PACK_LINE_SIZE, 0, 0, 0, PACK_SPACING_S, 0.0};
    double time_s, current_a, voltage_v, temperature_c;
    uint8_t counter = 0;
    cg_init(&pack, &pack_model, &settings, &line, &skew);
    while (scanf("%lf,%lf,%lf,%lf", &time_s, &current_a, &voltage_v, &temperature_c) == 4) {
        const cg_sample sample = {time_s, (cg_real)current_a, (cg_real)voltage_v,
                                  (cg_real)temperature_c};
        uint8_t data[8];
        cg_estimate estimate;
        (void)cg_update(&pack, &sample);
        estimate = cg_evaluate(&pack);
        frames_soc_estimate(&estimate, 0, counter, data);
        counter = (uint8_t)((counter + 1U) & 0xFU);
        printf("%.3f %.4f +- %.4f %%, status %d, reasons %05lx,", estimate.time_s,
               (double)estimate.soc_pct, (double)estimate.soc_std_pct, (int)estimate.status,
               (unsigned long)estimate.reasons);
        for (int k = 0; k < 8; ++k) {
            printf(" %02X", (unsigned)data[k]);
        }
        printf("\n");
    }
    return 0;
}
