/* fmi2.c - co-simulation by FMI 2.0 (fmi-standard.org). */
typedef int flag;
#define FMI(name) fmi2##name
#define STATE(name) fmi2##name##FMUstate
#include "fmi.h"

typedef void (*logger)(void *environment, const char *name, int status, const char *category,
                       const char *message, ...);

typedef struct {
    logger log;
    void (*others[3])(void); /* memory, end of a step: not used */
    void *environment;
} callbacks;

static void report(const fmu *self)
{
    ((logger)self->logger)(self->environment, self->name, ERROR, "error", self->message);
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
REFUSED(SetInteger) REFUSED(SerializedFMUstateSize) REFUSED(SerializeFMUstate)
REFUSED(DeSerializeFMUstate) REFUSED(SetRealInputDerivatives) REFUSED(GetRealOutputDerivatives)
REFUSED(CancelStep) REFUSED(GetStatus) REFUSED(GetRealStatus) REFUSED(GetIntegerStatus)
REFUSED(GetBooleanStatus) REFUSED(GetStringStatus)
