/* fmi2.c - co-simulation by FMI 2.0 (fmi-standard.org). */
#include "fmu.h"

#include <stdlib.h>
#include <string.h>

typedef enum { OK = 0, ERROR = 3 } status;

#define REFUSED(name) \
    FMU_API status fmi2##name(fmu *self) \
    { \
        (void)self; \
        return ERROR; \
    }

typedef void (*logger)(void *environment, const char *name, int status, const char *category,
                       const char *message, ...);

typedef struct {
    logger log;
    void (*others[3])(void); /* memory, end of a step: not used */
    void *environment;
} callbacks;

/* Give the simulator the message of a unit. */
static void report(const fmu *self)
{
    ((logger)self->logger)(self->environment, self->name, ERROR, "error", self->message);
}

/* A new unit that reports to the simulator. */
static fmu *instantiated(const char *name, const char *token, void (*logger)(void),
                         void *environment)
{
    fmu *self = fmu_new(token);
    if (self != NULL) {
        strncpy(self->name, (name != NULL) ? name : "", FMU_TEXT - 1U);
        self->logger = logger;
        self->environment = environment;
    }
    return self;
}

static status set_reals(fmu *self, const uint32_t *reference, size_t count, const double *value)
{
    if (fmu_set(self, reference, count, value)) {
        return OK;
    }
    if (self->logger != NULL) {
        report(self);
    }
    return ERROR;
}

FMU_API void fmi2FreeInstance(fmu *self) { free(self); }

FMU_API status fmi2SetDebugLogging(fmu *self, int on, size_t count, const char *const *category)
{
    (void)self, (void)on, (void)count, (void)category;
    return OK;
}

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

/* Integer outputs, one by one. */
static status get_integers(const fmu *self, const uint32_t *reference, size_t count, int32_t *value)
{
    for (size_t k = 0; k < count; ++k) {
        double number;
        if (!fmu_get(self, &reference[k], 1, &number)) {
            return ERROR;
        }
        value[k] = (int32_t)number;
    }
    return OK;
}

FMU_API const char *fmi2GetTypesPlatform(void) { return "default"; }
FMU_API const char *fmi2GetVersion(void) { return "2.0"; }

FMU_API fmu *fmi2Instantiate(const char *name, int type, const char *token, const char *resources,
                             const callbacks *of, int visible, int logging)
{
    (void)resources, (void)visible, (void)logging;
    if (type != 1) {
        return NULL; /* co-simulation only */
    }
    return (of == NULL) ? instantiated(name, token, NULL, NULL)
                        : instantiated(name, token, (void (*)(void))of->log, of->environment);
}

FMU_API status fmi2SetupExperiment(fmu *self, int has_tolerance, double tolerance, double start,
                                   int has_stop, double stop)
{
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    self->value[FMU_TIME_S] = start;
    return OK;
}

FMU_API status fmi2EnterInitializationMode(fmu *self) { return (self != NULL) ? OK : ERROR; }

FMU_API status fmi2GetReal(fmu *self, const uint32_t *reference, size_t count, double *value)
{
    return fmu_get(self, reference, count, value) ? OK : ERROR;
}

FMU_API status fmi2SetReal(fmu *self, const uint32_t *reference, size_t count, const double *value)
{
    return set_reals(self, reference, count, value);
}

FMU_API status fmi2GetInteger(fmu *self, const uint32_t *reference, size_t count, int *value)
{
    return get_integers(self, reference, count, value);
}

FMU_API status fmi2DoStep(fmu *self, double time_s, double step_s, int keeps_no_state)
{
    (void)keeps_no_state;
    fmu_sample(self, time_s + step_s);
    return OK;
}

/* What the model description does not offer. */
REFUSED(GetBoolean) REFUSED(GetString) REFUSED(SetBoolean) REFUSED(SetString)
REFUSED(GetDirectionalDerivative)
REFUSED(SetInteger) REFUSED(SerializedFMUstateSize) REFUSED(SerializeFMUstate)
REFUSED(DeSerializeFMUstate) REFUSED(SetRealInputDerivatives) REFUSED(GetRealOutputDerivatives)
REFUSED(CancelStep) REFUSED(GetStatus) REFUSED(GetRealStatus) REFUSED(GetIntegerStatus)
REFUSED(GetBooleanStatus) REFUSED(GetStringStatus)
