/* fmi3.c - co-simulation by FMI 3.0 (fmi-standard.org). */
#include <stdbool.h>

typedef bool flag;
#define FMI(name) fmi3##name
#define STATE(name) fmi3##name##FMUState
#include "fmi.h"

typedef void (*logger)(void *environment, int status, const char *category, const char *message);

static void report(const fmu *self)
{
    ((logger)self->logger)(self->environment, ERROR, "error", self->message);
}

#define NO_INSTANCE(name) \
    FMU_API fmu *name(void) { return NULL; }

FMU_API const char *fmi3GetVersion(void) { return "3.0"; }

FMU_API fmu *fmi3InstantiateCoSimulation(
    const char *name, const char *token, const char *resources, bool visible, bool logging,
    bool event_mode, bool early_return, const uint32_t *intermediate, size_t intermediates,
    void *environment, logger log, void *update)
{
    (void)resources, (void)visible, (void)logging, (void)early_return;
    (void)intermediate, (void)intermediates, (void)update;
    return event_mode ? NULL : instantiated(name, token, (void (*)(void))log, environment);
}

FMU_API status fmi3EnterInitializationMode(fmu *self, bool has_tolerance, double tolerance,
                                           double start, bool has_stop, double stop)
{
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    self->value[FMU_TIME_S] = start;
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
    return (references == values) ? set_reals(self, reference, values, value) : ERROR;
}

FMU_API status fmi3GetInt32(fmu *self, const uint32_t *reference, size_t references,
                            int32_t *value, size_t values)
{
    return (references == values) ? get_integers(self, reference, values, value) : ERROR;
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

/* What the model description does not offer. */
NO_INSTANCE(fmi3InstantiateModelExchange)
NO_INSTANCE(fmi3InstantiateScheduledExecution)
REFUSED(EnterEventMode) REFUSED(GetFloat32) REFUSED(GetInt8) REFUSED(GetUInt8) REFUSED(GetInt16)
REFUSED(GetUInt16) REFUSED(GetUInt32) REFUSED(GetInt64) REFUSED(GetUInt64) REFUSED(GetBinary)
REFUSED(GetClock) REFUSED(SetFloat32) REFUSED(SetInt8) REFUSED(SetUInt8) REFUSED(SetInt16)
REFUSED(SetUInt16) REFUSED(SetInt32) REFUSED(SetUInt32) REFUSED(SetInt64) REFUSED(SetUInt64)
REFUSED(SetBinary) REFUSED(SetClock) REFUSED(GetNumberOfVariableDependencies)
REFUSED(GetVariableDependencies) REFUSED(SerializedFMUStateSize) REFUSED(SerializeFMUState)
REFUSED(DeserializeFMUState) REFUSED(GetAdjointDerivative) REFUSED(EnterConfigurationMode)
REFUSED(ExitConfigurationMode) REFUSED(GetIntervalDecimal) REFUSED(GetIntervalFraction)
REFUSED(GetShiftDecimal) REFUSED(GetShiftFraction) REFUSED(SetIntervalDecimal)
REFUSED(SetIntervalFraction) REFUSED(SetShiftDecimal) REFUSED(SetShiftFraction)
REFUSED(EvaluateDiscreteStates) REFUSED(UpdateDiscreteStates) REFUSED(EnterContinuousTimeMode)
REFUSED(CompletedIntegratorStep) REFUSED(SetTime) REFUSED(SetContinuousStates)
REFUSED(GetContinuousStateDerivatives) REFUSED(GetEventIndicators) REFUSED(GetContinuousStates)
REFUSED(GetNominalsOfContinuousStates) REFUSED(GetNumberOfEventIndicators)
REFUSED(GetNumberOfContinuousStates) REFUSED(EnterStepMode) REFUSED(GetOutputDerivatives)
REFUSED(ActivateModelPartition)
