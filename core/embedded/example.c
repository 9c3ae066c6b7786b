/* example.c - the core in a program: samples from standard input, frames to standard output.
 *
 *     ./example < drive.csv        lines of time [s], current [A], voltage [V], temperature [degC]
 *
 * in this order; a first line of headings is skipped, any other line without numbers is an error.
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
    const cg_line line = CG_LINE(storage, PACK_LINE_SIZE, PACK_SPACING_S);
    double time_s, current_a, voltage_v, temperature_c;
    char text[256];
    unsigned long lines = 0, samples = 0;
    uint8_t counter = 0;
    cg_init(&pack, &pack_model, &settings, &line, &skew);
    while (fgets(text, sizeof(text), stdin) != NULL) {
        lines++;
        if (sscanf(text, "%lf,%lf,%lf,%lf", &time_s, &current_a, &voltage_v, &temperature_c) != 4) {
            if (lines > 1) {
                fprintf(stderr, "line %lu is not time,current,voltage,temperature\n", lines);
                return 1;
            }
            continue;
        }
        samples++;
        const cg_sample sample = {cg_time_of_s(time_s), (cg_real)current_a, (cg_real)voltage_v,
                                  (cg_real)temperature_c};
        uint8_t data[8];
        cg_estimate estimate;
        (void)cg_update(&pack, &sample);
        estimate = cg_evaluate(&pack);
        frames_soc_estimate(&estimate, 0, counter, data);
        counter = (uint8_t)((counter + 1U) & 0xFU);
        printf("%.3f %.4f +- %.4f %%, status %d, reasons %05lx,", cg_s_of_time(estimate.time_s),
               (double)estimate.soc_pct, (double)estimate.soc_std_pct, (int)estimate.status,
               (unsigned long)estimate.reasons);
        for (int k = 0; k < 8; ++k) {
            printf(" %02X", (unsigned)data[k]);
        }
        printf("\n");
    }
    if (samples == 0) {
        fprintf(stderr, "no samples: lines of time,current,voltage,temperature are needed\n");
        return 1;
    }
    return 0;
}
