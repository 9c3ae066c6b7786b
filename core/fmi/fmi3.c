/* fmi3.c - co-simulation by FMI 3.0 (fmi-standard.org). */
#include "fmu.h"

#include <stdlib.h>
#include <string.h>

typedef enum { OK = 0, ERROR = 3 } status;

#define REFUSED(name) \
    FMU_API status name(fmu *self) \
    { \
        (void)self; \
        return ERROR; \
    }
#define NO_INSTANCE(name) \
    FMU_API fmu *name(void) { return NULL; }

FMU_API const char *fmi3GetVersion(void) { return "3.0"; }

FMU_API fmu *fmi3InstantiateCoSimulation(
    const char *name, const char *token, const char *resources, bool visible, bool logging,
    bool event_mode, bool early_return, const uint32_t *intermediate, size_t intermediates,
    void *environment, void *log, void *update)
{
    (void)name, (void)resources, (void)visible, (void)logging, (void)early_return;
    (void)intermediate, (void)intermediates, (void)environment, (void)log, (void)update;
    return event_mode ? NULL : fmu_new(token);
}

FMU_API void fmi3FreeInstance(fmu *self) { free(self); }

FMU_API status fmi3SetDebugLogging(fmu *self, bool on, size_t count, const char *const *category)
{
    (void)self, (void)on, (void)count, (void)category;
    return OK;
}

FMU_API status fmi3EnterInitializationMode(fmu *self, bool has_tolerance, double tolerance,
                                           double start, bool has_stop, double stop)
{
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    self->value[FMU_TIME_S] = start;
    return OK;
}

FMU_API status fmi3ExitInitializationMode(fmu *self)
{
    fmu_begin(self, self->value[FMU_TIME_S]);
    return OK;
}

FMU_API status fmi3Terminate(fmu *self) { return (self != NULL) ? OK : ERROR; }

FMU_API status fmi3Reset(fmu *self)
{
    fmu_reset(self);
    return OK;
}

FMU_API status fmi3GetFloat64(fmu *self, const uint32_t *reference, size_t references,
                              double *value, size_t values)
{
    return ((references == values) && fmu_get(self, reference, values, value)) ? OK : ERROR;
}

FMU_API status fmi3SetFloat64(fmu *self, const uint32_t *reference, size_t references,
                              const double *value, size_t values)
{
    return ((references == values) && fmu_set(self, reference, values, value)) ? OK : ERROR;
}

FMU_API status fmi3GetInt32(fmu *self, const uint32_t *reference, size_t references,
                            int32_t *value, size_t values)
{
    for (size_t k = 0; k < values; ++k) {
        double number;
        if ((references != values) || !fmu_get(self, &reference[k], 1, &number)) {
            return ERROR;
        }
        value[k] = (int32_t)number;
    }
    return OK;
}

FMU_API status fmi3DoStep(fmu *self, double time_s, double step_s, bool keeps_no_state,
                          bool *needs_event, bool *terminates, bool *returns_early, double *last_s)
{
    (void)keeps_no_state;
    fmu_sample(self, time_s + step_s);
    *needs_event = false;
    *terminates = false;
    *returns_early = false;
    *last_s = time_s + step_s;
    return OK;
}

FMU_API status fmi3GetFMUState(fmu *self, void **state)
{
    if (*state == NULL) {
        *state = malloc(sizeof(fmu));
    }
    if (*state == NULL) {
        return ERROR;
    }
    memcpy(*state, self, sizeof(fmu));
    return OK;
}

FMU_API status fmi3SetFMUState(fmu *self, const void *state)
{
    memcpy(self, state, sizeof(fmu)); /* its pointers are those into the unit itself */
    return OK;
}

FMU_API status fmi3FreeFMUState(fmu *self, void **state)
{
    (void)self;
    free(*state);
    *state = NULL;
    return OK;
}

/* What the model description does not offer. */
NO_INSTANCE(fmi3InstantiateModelExchange)
NO_INSTANCE(fmi3InstantiateScheduledExecution)
REFUSED(fmi3EnterEventMode)
REFUSED(fmi3GetFloat32)
REFUSED(fmi3GetInt8)
REFUSED(fmi3GetUInt8)
REFUSED(fmi3GetInt16)
REFUSED(fmi3GetUInt16)
REFUSED(fmi3GetUInt32)
REFUSED(fmi3GetInt64)
REFUSED(fmi3GetUInt64)
REFUSED(fmi3GetBoolean)
REFUSED(fmi3GetString)
REFUSED(fmi3GetBinary)
REFUSED(fmi3GetClock)
REFUSED(fmi3SetFloat32)
REFUSED(fmi3SetInt8)
REFUSED(fmi3SetUInt8)
REFUSED(fmi3SetInt16)
REFUSED(fmi3SetUInt16)
REFUSED(fmi3SetInt32)
REFUSED(fmi3SetUInt32)
REFUSED(fmi3SetInt64)
REFUSED(fmi3SetUInt64)
REFUSED(fmi3SetBoolean)
REFUSED(fmi3SetString)
REFUSED(fmi3SetBinary)
REFUSED(fmi3SetClock)
REFUSED(fmi3GetNumberOfVariableDependencies)
REFUSED(fmi3GetVariableDependencies)
REFUSED(fmi3SerializedFMUStateSize)
REFUSED(fmi3SerializeFMUState)
REFUSED(fmi3DeserializeFMUState)
REFUSED(fmi3GetDirectionalDerivative)
REFUSED(fmi3GetAdjointDerivative)
REFUSED(fmi3EnterConfigurationMode)
REFUSED(fmi3ExitConfigurationMode)
REFUSED(fmi3GetIntervalDecimal)
REFUSED(fmi3GetIntervalFraction)
REFUSED(fmi3GetShiftDecimal)
REFUSED(fmi3GetShiftFraction)
REFUSED(fmi3SetIntervalDecimal)
REFUSED(fmi3SetIntervalFraction)
REFUSED(fmi3SetShiftDecimal)
REFUSED(fmi3SetShiftFraction)
REFUSED(fmi3EvaluateDiscreteStates)
REFUSED(fmi3UpdateDiscreteStates)
REFUSED(fmi3EnterContinuousTimeMode)
REFUSED(fmi3CompletedIntegratorStep)
REFUSED(fmi3SetTime)
REFUSED(fmi3SetContinuousStates)
REFUSED(fmi3GetContinuousStateDerivatives)
REFUSED(fmi3GetEventIndicators)
REFUSED(fmi3GetContinuousStates)
REFUSED(fmi3GetNominalsOfContinuousStates)
REFUSED(fmi3GetNumberOfEventIndicators)
REFUSED(fmi3GetNumberOfContinuousStates)
REFUSED(fmi3EnterStepMode)
REFUSED(fmi3GetOutputDerivatives)
REFUSED(fmi3ActivateModelPartition)
