/* fmi2.c - a unit by FMI 2.0, co-simulation (fmi-standard.org); see fmu.h. */
#include "fmu.h"

#include <stdlib.h>
#include <string.h>

#if defined(_WIN32)
#define FMU_API __declspec(dllexport)
#else
#define FMU_API __attribute__((visibility("default")))
#endif

typedef enum { OK = 0, ERROR = 3 } status;

typedef struct {
    fmu_logger log;
    void (*others[3])(void); /* memory, end of a step: not used */
    void *environment;
} callbacks;

#define REFUSED(name) \
    FMU_API status fmi2##name(fmu *self) \
    { \
        (void)self; \
        return ERROR; \
    }
#define REPORT(...) \
    if (self->logger != NULL) { \
        self->logger(self->environment, self->name, ERROR, "error", __VA_ARGS__); \
    }

FMU_API const char *fmi2GetTypesPlatform(void) { return "default"; }
FMU_API const char *fmi2GetVersion(void) { return "2.0"; }

FMU_API status fmi2Reset(fmu *self)
{
    memcpy(self->value, FMU_START, sizeof(self->value));
    return OK;
}

FMU_API fmu *fmi2Instantiate(const char *name, int type, const char *token, const char *resources,
                             const callbacks *of, int visible, int logging)
{
    (void)resources, (void)visible, (void)logging;
    if ((type != 1) || (token == NULL) || (strcmp(token, FMU_TOKEN) != 0)) {
        return NULL; /* co-simulation only, of this unit */
    }
    fmu *self = calloc(1, sizeof(fmu));
    if (self != NULL) {
        strncpy(self->name, (name != NULL) ? name : "", sizeof(self->name) - 1U);
        self->logger = (of != NULL) ? of->log : NULL;
        self->environment = (of != NULL) ? of->environment : NULL;
        (void)fmi2Reset(self);
    }
    return self;
}

FMU_API void fmi2FreeInstance(fmu *self) { free(self); }

FMU_API status fmi2SetDebugLogging(fmu *self, int on, size_t count, const char *const *category)
{
    (void)self, (void)on, (void)count, (void)category;
    return OK;
}

FMU_API status fmi2SetupExperiment(fmu *self, int has_tolerance, double tolerance, double start,
                                   int has_stop, double stop)
{
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    self->value[FMU_TIME_S] = start;
    return OK;
}

FMU_API status fmi2EnterInitializationMode(fmu *self) { return (self != NULL) ? OK : ERROR; }

FMU_API status fmi2ExitInitializationMode(fmu *self)
{
    fmu_begin(self, self->value[FMU_TIME_S]);
    return OK;
}

FMU_API status fmi2Terminate(fmu *self) { return (self != NULL) ? OK : ERROR; }

FMU_API status fmi2DoStep(fmu *self, double time_s, double step_s, int keeps_no_state)
{
    (void)keeps_no_state;
    fmu_sample(self, time_s + step_s);
    return OK;
}

FMU_API status fmi2GetReal(fmu *self, const uint32_t *reference, size_t count, double *value)
{
    for (size_t k = 0; k < count; ++k) {
        if (reference[k] >= FMU_VARIABLES) {
            return ERROR;
        }
        value[k] = self->value[reference[k]];
    }
    return OK;
}

FMU_API status fmi2GetInteger(fmu *self, const uint32_t *reference, size_t count, int *value)
{
    status done = OK;
    for (size_t k = 0; (k < count) && (done == OK); ++k) {
        double number = 0.0;
        done = fmi2GetReal(self, &reference[k], 1, &number);
        value[k] = (int)number;
    }
    return done;
}

FMU_API status fmi2SetReal(fmu *self, const uint32_t *reference, size_t count, const double *value)
{
    for (size_t k = 0; k < count; ++k) {
        const unsigned place = reference[k];
        if (place >= FMU_VARIABLES) {
            REPORT("no variable has the value reference %u", place)
            return ERROR;
        }
        const double *range = FMU_RANGE[place];
        if (!isnan(range[0]) && !((value[k] >= range[0]) && (value[k] <= range[1]))) {
            REPORT("the value %g of value reference %u is outside %g ... %g", value[k], place,
                   range[0], range[1])
            return ERROR;
        }
        self->value[place] = value[k];
    }
    return OK;
}

FMU_API status fmi2GetFMUstate(fmu *self, void **state)
{
    *state = (*state == NULL) ? malloc(sizeof(fmu)) : *state;
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
REFUSED(GetBoolean) REFUSED(GetString) REFUSED(SetBoolean) REFUSED(SetString)
REFUSED(GetDirectionalDerivative)
REFUSED(SetInteger) REFUSED(SerializedFMUstateSize) REFUSED(SerializeFMUstate)
REFUSED(DeSerializeFMUstate) REFUSED(SetRealInputDerivatives) REFUSED(GetRealOutputDerivatives)
REFUSED(CancelStep) REFUSED(GetStatus) REFUSED(GetRealStatus) REFUSED(GetIntegerStatus)
REFUSED(GetBooleanStatus) REFUSED(GetStringStatus)
