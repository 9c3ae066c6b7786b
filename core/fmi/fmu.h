/* fmu.h - a functional mock-up unit: its variables by value reference, and a step.
 *
 * `pack.c` and `estimator.c` say what a unit does, `fmi2.c` how a simulator calls it. `fmu_config.h`
 * and `fmu_model.c` are written by `cangauge export-fmu`.
 *
 * An input that is set before a step is the sample at the end of that step; between two samples the
 * current is linear. A parameter outside its range is refused with a message.
 */
#ifndef CANGAUGE_FMU_H
#define CANGAUGE_FMU_H

#include "cangauge_internal.h"
#include "fmu_config.h"

/* Value references: time and inputs first, then what the unit is given, then outputs. */
enum {
    FMU_TIME_S = 0,
    FMU_CURRENT_A = 1,
    FMU_TEMPERATURE_C = 2,
    FMU_VOLTAGE_V = 3, /* input of the estimator, output of the pack */
    FMU_SOC_PCT = 4,
    FMU_INITIAL_SOC_PCT = 5,
    FMU_CAPACITY_AH = 6, /* pack */
    FMU_SOC_STD_PCT = 6, /* estimator, as all below */
    FMU_STATUS = 7,
    FMU_REASONS = 8,
    FMU_SOC_NEWTON_PCT = 9,
    FMU_SOC_COULOMB_PCT = 10,
    FMU_VOLTAGE_MODEL_V = 11
};

typedef void (*fmu_logger)(void *environment, const char *name, int status, const char *category,
                           const char *message, ...);

typedef struct {
    double value[FMU_VARIABLES];
    cg_model model; /* with the parameters that the simulator sets */
    cg_estimator core;
    cg_current line[FMU_LINE];
    cg_skew skew;
    cg_sample last; /* pack */
    cg_sum discharged_ah; /* pack */
    char name[128]; /* of the instance */
    fmu_logger logger; /* of the simulator, NULL without */
    void *environment;
} fmu;

/* A parameter of an effect: its effect, and its place among the values, then the time constants. */
typedef struct {
    int32_t reference;
    int32_t effect;
    int32_t place;
} fmu_parameter;

extern const cg_model FMU_MODEL;
extern const cg_settings FMU_SETTINGS;
extern const double FMU_START[FMU_VARIABLES];
extern const double FMU_RANGE[FMU_VARIABLES][2]; /* lowest and highest value; NAN: any */
extern const fmu_parameter FMU_PARAMETER[FMU_PARAMETERS + 1];

/* The unit: begin at a time with the values that are set, take a sample at a later time. */
void fmu_begin(fmu *self, double time_s);
void fmu_sample(fmu *self, double time_s);

#endif
