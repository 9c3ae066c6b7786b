/* test.c - the core on this processor against the Python package, on a drive with events.
 *
 * The drive is in golden.h: a gap, missing signals, implausible values and an unobserved interval.
 */
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "frames.h"
#include "pack_model.h"

typedef struct {
    double time_s;
    double current_a;
    double voltage_v;
    double temperature_c;
    double number[4]; /* SoC, its deviation, by voltage, by counting [%] */
    int32_t status;
    uint32_t reasons;
    float packed[2]; /* SoC and its deviation as both precisions hold them [%] */
    uint8_t frame[8]; /* of these two, status and reasons */
} golden;

#include "golden.h"

#ifdef CG_CLOCK
#include "clock.h"
#else
static unsigned long instructions(void) { return 0; }
#endif

/* Largest error allowed [% SoC]: none with doubles, 0.02 with floats. */
#define TOLERANCE_PCT ((sizeof(cg_real) == sizeof(double)) ? 1e-9 : 0.02)

static cg_current storage[PACK_LINE_SIZE];
static cg_skew skew;
static cg_estimator pack;
static int failures;

static double apart(double expected, double found)
{
    if ((isnan(expected) != 0) && (isnan(found) != 0)) {
        return 0.0;
    }
    return isnan(found - expected) ? INFINITY : fabs(found - expected);
}

static cg_sample sample_of(const golden *each)
{
    const cg_sample sample = {cg_time_of_s(each->time_s), (cg_real)each->current_a,
                              (cg_real)each->voltage_v, (cg_real)each->temperature_c};
    return sample;
}

static void check(const char *what, double error, double at_most)
{
    const int is_met = error <= at_most;
    printf("%-28s %.3g, at most %.3g: %s\n", what, error, at_most, is_met ? "ok" : "FAILED");
    failures += is_met ? 0 : 1;
}

/* Whether the numbers of the Python package are packed into its frame. */
static bool is_packed(const golden *each, int k)
{
    cg_estimate estimate = {0};
    uint8_t data[8];
    estimate.soc_pct = (cg_real)each->packed[0];
    estimate.soc_std_pct = (cg_real)each->packed[1];
    estimate.status = each->status;
    estimate.reasons = each->reasons;
    frames_soc_estimate(&estimate, 0, (uint8_t)(k & 0xF), data);
    return memcmp(data, each->frame, sizeof(data)) == 0;
}

/* A state that is copied back after a reset gives the SoC at once and the drive goes on from it;
 * one with impossible numbers is refused. */
static void test_reset(const cg_settings *settings, const cg_line *line)
{
    static cg_state kept;
    static cg_state broken;
    const int at = GOLDEN_SAMPLES / 4;
    cg_init(&pack, &pack_model, settings, line, &skew);
    for (int k = 0; k < at; ++k) {
        const cg_sample sample = sample_of(&golden_samples[k]);
        (void)cg_update(&pack, &sample);
    }
    kept = pack.state; /* its last sample is pending */
    const double before_pct = (double)cg_evaluate(&pack).soc_pct;
    const cg_state evaluated = pack.state;
    cg_init(&pack, &pack_model, settings, line, &skew);
    check("refused: a sound state", cg_restore(&pack, &kept, (cg_real)1.0) ? 0.0 : 1.0, 0.0);
    (void)cg_evaluate(&pack);
    check("refused: one evaluated", cg_restore(&pack, &evaluated, (cg_real)1.0) ? 0.0 : 1.0, 0.0);
    check("SoC after a reset [%]", apart(before_pct, (double)cg_evaluate(&pack).soc_pct), 0.0);
    const cg_sample next = sample_of(&golden_samples[at]);
    (void)cg_update(&pack, &next);
    /* Charge between the two samples. */
    check("SoC goes on [%]", apart(before_pct, (double)cg_evaluate(&pack).soc_pct), 2.0);
    broken = evaluated;
    broken.filter.hypotheses = 1000;
    check("accepted: hypotheses", cg_restore(&pack, &broken, (cg_real)1.0) ? 1.0 : 0.0, 0.0);
    broken = evaluated;
    broken.filter.ekf[0].x[0] = (cg_real)NAN;
    check("accepted: a SoC of NAN", cg_restore(&pack, &broken, (cg_real)1.0) ? 1.0 : 0.0, 0.0);
    broken = evaluated;
    broken.memory.samples = -1;
    check("accepted: a negative count", cg_restore(&pack, &broken, (cg_real)1.0) ? 1.0 : 0.0, 0.0);
}

int main(void)
{
    const cg_settings settings = cg_default_settings();
    const cg_line line = CG_LINE(storage, PACK_LINE_SIZE, PACK_SPACING_S);
    double worst[4] = {0.0, 0.0, 0.0, 0.0};
    long differing = 0, other_status = 0, other_frames = 0;
    unsigned long steps[2] = {0, 0}, all[2] = {0, 0}, longest = 0;
    cg_init(&pack, &pack_model, &settings, &line, &skew);
    for (int k = 0; k < GOLDEN_SAMPLES; ++k) {
        const golden *each = &golden_samples[k];
        const int64_t tick = pack.state.memory.tick;
        const cg_sample sample = sample_of(each);
        const unsigned long before = instructions();
        (void)cg_update(&pack, &sample);
        const cg_estimate found = cg_evaluate(&pack);
        const unsigned long taken = instructions() - before;
        const double number[4] = {(double)found.soc_pct, (double)found.soc_std_pct,
                                  (double)found.soc_newton_pct, (double)found.soc_coulomb_pct};
        const int uses_voltage = (pack.state.memory.tick != tick) ? 1 : 0;
        steps[uses_voltage] += 1;
        all[uses_voltage] += taken;
        longest = (taken > longest) ? taken : longest;
        for (int j = 0; j < 4; ++j) {
            const double error = apart(each->number[j], number[j]);
            worst[j] = (error > worst[j]) ? error : worst[j];
            differing += (error != 0.0) ? 1 : 0;
        }
        other_status += (found.status != each->status) || (found.reasons != each->reasons);
        other_frames += is_packed(each, k) ? 0 : 1;
    }
    printf("%d samples, %ld of %d numbers differ in a bit\n", GOLDEN_SAMPLES, differing,
           4 * GOLDEN_SAMPLES);
    check("SoC [%]", worst[0], TOLERANCE_PCT);
    check("its deviation [%]", worst[1], TOLERANCE_PCT);
    check("SoC by voltage [%]", worst[2], TOLERANCE_PCT);
    check("SoC by counting [%]", worst[3], TOLERANCE_PCT);
    /* A value at a limit may fall on the other side with floats. */
    const double share = (sizeof(cg_real) == sizeof(double)) ? 0.0 : 0.01;
    check("other status or reasons", (double)other_status, share * GOLDEN_SAMPLES);
    check("other frames", (double)other_frames, 0.0);
    printf("bytes: state %lu, delay line %lu, held back %lu, constants %lu\n",
           (unsigned long)sizeof(cg_estimator), (unsigned long)sizeof(storage),
           (unsigned long)sizeof(skew),
           (unsigned long)sizeof(pack_model));
    if ((all[1] > 0U) && (steps[0] > 0U)) {
        printf("instructions: %lu a sample, %lu where its voltage is used, at most %lu\n",
               all[0] / steps[0], all[1] / steps[1], longest);
    }
    test_reset(&settings, &line);
    printf("%s\n", (failures == 0) ? "PASSED" : "FAILED");
    return (failures == 0) ? 0 : 1;
}
