/* foxbms_soc.c - the estimator as the SoC module of foxBMS 2, in place of its own.
 *
 * Implements the three functions of its state_estimation.h that a SoC module has. Written against
 * the public interface of foxBMS 2, v1.6.0; it holds no code of foxBMS.
 *
 * Every string is a pack of the model. Sign of the current: BS_POSITIVE_DISCHARGE_CURRENT. The core
 * estimates one SoC of the string, so minimum and maximum are the average less and plus two standard
 * deviations. While the SoC is not known the values in the database stay as they are.
 */
#include <math.h>

#include "cangauge_internal.h"
#include "database.h"
#include "fram.h"
#include "pack_model.h"
#include "state_estimation.h"

#ifdef CANGAUGE_FRAM_BLOCK
#include "foxbms_soc.h"
/* Time between two writes of the whole state [ms]: at 1 C the SoC moves by 0.3 % meanwhile. */
#define SAVE_EVERY_MS (10000U)
#endif

#define MILLI (1000.0) /* of the units of the database: mA, mV, ms */
#define DECI (10.0) /* 0.1 degC */
#define SIGMAS (2.0) /* from the average to minimum and maximum */

typedef struct {
    cg_estimator estimator;
    cg_current storage[PACK_LINE_SIZE];
    cg_skew skew;
    uint64_t elapsed_ms; /* time stamp of the latest current; its own 32 bits wrap in 49.7 days */
    uint32_t stamp_ms;
    bool is_begun;
#ifdef CANGAUGE_FRAM_BLOCK
    uint64_t saved_ms;
#endif
} string_s;

static string_s strings[BS_NR_OF_STRINGS];

static DATA_BLOCK_CURRENT_SENSOR_s current_table = {
    .header.uniqueId = DATA_BLOCK_ID_CURRENT_SENSOR};
static DATA_BLOCK_PACK_VALUES_s pack_table = {.header.uniqueId = DATA_BLOCK_ID_PACK_VALUES};
static DATA_BLOCK_MIN_MAX_s cell_table = {.header.uniqueId = DATA_BLOCK_ID_MIN_MAX};

static float_t within(double percent)
{
    return (float_t)fmin(fmax(percent, 0.0), 100.0);
}

/* Begin with a SoC and its standard deviation [%]; NAN: found from the first voltage. */
static void begin(string_s *string, double soc_pct, double std_pct)
{
    const cg_line line = CG_LINE(string->storage, PACK_LINE_SIZE, PACK_SPACING_S);
    cg_settings settings = cg_default_settings();
    settings.initial_soc_pct = (cg_real)soc_pct;
    settings.initial_soc_std_pct = (cg_real)fmax(std_pct, (double)settings.initial_soc_std_pct);
    cg_init(&string->estimator, &pack_model, &settings, &line, &string->skew);
    string->is_begun = true;
}

static void publish(DATA_BLOCK_SOC_s *values, uint8_t s, double soc_pct, double std_pct)
{
    values->averageSoc_perc[s] = within(soc_pct);
    values->minimumSoc_perc[s] = within(soc_pct - (SIGMAS * std_pct));
    values->maximumSoc_perc[s] = within(soc_pct + (SIGMAS * std_pct));
    fram_soc.averageSoc_perc[s] = values->averageSoc_perc[s];
    fram_soc.minimumSoc_perc[s] = values->minimumSoc_perc[s];
    fram_soc.maximumSoc_perc[s] = values->maximumSoc_perc[s];
}

void SE_InitializeStateOfCharge(DATA_BLOCK_SOC_s *pSocValues, bool ccPresent, uint8_t stringNumber)
{
    const bool is_known = (FRAM_ReadData(FRAM_BLOCK_ID_SOC) == FRAM_ACCESS_OK);
    string_s *const string = &strings[stringNumber];
    (void)ccPresent; /* the core counts the current itself */
    if (is_known) {
        const double soc_pct = (double)fram_soc.averageSoc_perc[stringNumber];
        const double below = soc_pct - (double)fram_soc.minimumSoc_perc[stringNumber];
        const double above = (double)fram_soc.maximumSoc_perc[stringNumber] - soc_pct;
        /* One of the two may end at 0 or 100 %. */
        const double std_pct = fmax(below, above) / SIGMAS;
        begin(string, soc_pct, std_pct);
        publish(pSocValues, stringNumber, soc_pct, std_pct);
    } else {
        begin(string, (double)NAN, 0.0);
    }
#ifdef CANGAUGE_FRAM_BLOCK
    if ((FRAM_ReadData(CANGAUGE_FRAM_BLOCK) == FRAM_ACCESS_OK) &&
        (cangauge_fram.model_id[stringNumber] == PACK_MODEL_ID)) {
        /* No clock measures how long the processor was off. False: it begins with the SoC. */
        (void)cg_restore(&string->estimator, &cangauge_fram.state[stringNumber], (cg_real)NAN);
    }
#endif
}

/* The latest values of the database as a sample. */
static cg_sample sample_of(const string_s *string, uint8_t s)
{
    cg_sample sample = {cg_time_of_s((double)string->elapsed_ms / MILLI), (cg_real)NAN,
                        (cg_real)NAN, (cg_real)NAN};
    if (current_table.invalidCurrentMeasurement[s] == 0U) {
        const double current_a = (double)current_table.current_mA[s] / MILLI;
#if BS_POSITIVE_DISCHARGE_CURRENT == true
        sample.current_a = (cg_real)current_a;
#else
        sample.current_a = (cg_real)-current_a;
#endif
    }
    if (pack_table.invalidStringVoltage[s] == 0U) {
        sample.voltage_v = (cg_real)((double)pack_table.stringVoltage_mV[s] / MILLI);
    }
    if (cell_table.validMeasuredCellTemperatures[s] > 0U) {
        sample.temperature_c = (cg_real)((double)cell_table.averageTemperature_ddegC[s] / DECI);
    }
    return sample;
}

#ifdef CANGAUGE_FRAM_BLOCK
static void save(string_s *string, uint8_t s)
{
    if ((string->elapsed_ms - string->saved_ms) >= SAVE_EVERY_MS) {
        string->saved_ms = string->elapsed_ms;
        cangauge_fram.state[s] = string->estimator.state;
        cangauge_fram.model_id[s] = PACK_MODEL_ID;
        (void)FRAM_WriteData(CANGAUGE_FRAM_BLOCK);
    }
}
#endif

void SE_CalculateStateOfCharge(DATA_BLOCK_SOC_s *pSocValues)
{
    bool is_changed = false;
    (void)DATA_READ_DATA(&current_table, &pack_table, &cell_table);
    for (uint8_t s = 0U; s < (uint8_t)BS_NR_OF_STRINGS; ++s) {
        string_s *const string = &strings[s];
        const uint32_t stamp_ms = current_table.timestampCurrent[s];
        if (string->is_begun && (stamp_ms != string->stamp_ms)) {
            cg_sample sample;
            cg_estimate estimate;
            string->elapsed_ms += (uint32_t)(stamp_ms - string->stamp_ms);
            string->stamp_ms = stamp_ms;
            sample = sample_of(string, s);
            (void)cg_update(&string->estimator, &sample);
            estimate = cg_evaluate(&string->estimator);
            if (!isnan(estimate.soc_pct) && !isnan(estimate.soc_std_pct)) {
                publish(pSocValues, s, (double)estimate.soc_pct, (double)estimate.soc_std_pct);
                is_changed = true;
            }
#ifdef CANGAUGE_FRAM_BLOCK
            save(string, s);
#endif
        }
    }
    if (is_changed) {
        (void)FRAM_WriteData(FRAM_BLOCK_ID_SOC);
    }
}

/* Inverse of the model's pseudo-OCV for a string of equal cells. */
float_t SE_GetStateOfChargeFromVoltage(int16_t voltage_mV)
{
    const cg_real wanted_v =
        (cg_real)(((double)voltage_mV * (double)BS_NR_OF_CELL_BLOCKS_PER_STRING) / MILLI);
    bool is_inside;
    if (!strings[0].is_begun) {
        begin(&strings[0], (double)NAN, 0.0);
    }
    return within((double)cg_newton(&strings[0].estimator, wanted_v, (cg_real)50.0, &is_inside));
}
