/* fmi2.c - co-simulation by FMI 2.0 (fmi-standard.org). */
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

FMU_API const char *fmi2GetTypesPlatform(void) { return "default"; }
FMU_API const char *fmi2GetVersion(void) { return "2.0"; }

FMU_API fmu *fmi2Instantiate(const char *name, int type, const char *token, const char *resources,
                             const void *callbacks, int visible, int logging)
{
    (void)name, (void)resources, (void)callbacks, (void)visible, (void)logging;
    return (type == 1) ? fmu_new(token) : NULL; /* co-simulation only */
}

FMU_API void fmi2FreeInstance(fmu *self) { free(self); }

FMU_API status fmi2SetupExperiment(fmu *self, int has_tolerance, double tolerance, double start,
                                   int has_stop, double stop)
{
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    self->value[FMU_TIME_S] = start;
    return OK;
}

FMU_API status fmi2SetDebugLogging(fmu *self, int on, size_t count, const char *const *category)
{
    (void)self, (void)on, (void)count, (void)category;
    return OK;
}

FMU_API status fmi2EnterInitializationMode(fmu *self) { return (self != NULL) ? OK : ERROR; }

FMU_API status fmi2ExitInitializationMode(fmu *self)
{
    fmu_begin(self, self->value[FMU_TIME_S]);
    return OK;
}

FMU_API status fmi2Terminate(fmu *self) { return (self != NULL) ? OK : ERROR; }

FMU_API status fmi2Reset(fmu *self)
{
    fmu_reset(self);
    return OK;
}

FMU_API status fmi2GetReal(fmu *self, const uint32_t *reference, size_t count, double *value)
{
    return fmu_get(self, reference, count, value) ? OK : ERROR;
}

FMU_API status fmi2SetReal(fmu *self, const uint32_t *reference, size_t count, const double *value)
{
    return fmu_set(self, reference, count, value) ? OK : ERROR;
}

FMU_API status fmi2GetInteger(fmu *self, const uint32_t *reference, size_t count, int *value)
{
    for (size_t k = 0; k < count; ++k) {
        double number;
        if (!fmu_get(self, &reference[k], 1, &number)) {
            return ERROR;
        }
        value[k] = (int)number;
    }
    return OK;
}

FMU_API status fmi2DoStep(fmu *self, double time_s, double step_s, int keeps_no_state)
{
    (void)keeps_no_state;
    fmu_sample(self, time_s + step_s);
    return OK;
}

FMU_API status fmi2GetFMUstate(fmu *self, void **state)
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

FMU_API status fmi2SetFMUstate(fmu *self, const void *state)
{
    memcpy(self, state, sizeof(fmu)); /* its pointers are those into the unit itself */
    return OK;
}

FMU_API status fmi2FreeFMUstate(fmu *self, void **state)
{
    (void)self;
    free(*state);
    *state = NULL;
    return OK;
}

/* What the model description does not offer. */
REFUSED(fmi2GetBoolean)
REFUSED(fmi2GetString)
REFUSED(fmi2SetInteger)
REFUSED(fmi2SetBoolean)
REFUSED(fmi2SetString)
REFUSED(fmi2SerializedFMUstateSize)
REFUSED(fmi2SerializeFMUstate)
REFUSED(fmi2DeSerializeFMUstate)
REFUSED(fmi2GetDirectionalDerivative)
REFUSED(fmi2SetRealInputDerivatives)
REFUSED(fmi2GetRealOutputDerivatives)
REFUSED(fmi2CancelStep)
REFUSED(fmi2GetStatus)
REFUSED(fmi2GetRealStatus)
REFUSED(fmi2GetIntegerStatus)
REFUSED(fmi2GetBooleanStatus)
REFUSED(fmi2GetStringStatus)
