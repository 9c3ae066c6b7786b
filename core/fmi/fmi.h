/* fmi.h - functions that are the same in both interfaces; FMI(name), STATE(name), flag before it. */
#include "fmu.h"

#include <stdlib.h>
#include <string.h>

typedef enum { OK = 0, ERROR = 3 } status;

#define REFUSED(name) \
    FMU_API status FMI(name)(fmu *self) \
    { \
        (void)self; \
        return ERROR; \
    }

/* Give the simulator the message of a unit. */
static void report(const fmu *self);

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

FMU_API void FMI(FreeInstance)(fmu *self) { free(self); }

FMU_API status FMI(SetDebugLogging)(fmu *self, flag on, size_t count, const char *const *category)
{
    (void)self, (void)on, (void)count, (void)category;
    return OK;
}

FMU_API status FMI(ExitInitializationMode)(fmu *self)
{
    fmu_begin(self, self->value[FMU_TIME_S]);
    return OK;
}

FMU_API status FMI(Terminate)(fmu *self) { return (self != NULL) ? OK : ERROR; }

FMU_API status FMI(Reset)(fmu *self)
{
    fmu_reset(self);
    return OK;
}

FMU_API status STATE(Get)(fmu *self, void **state)
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

FMU_API status STATE(Set)(fmu *self, const void *state)
{
    memcpy(self, state, sizeof(fmu)); /* its pointers are those into the unit itself */
    return OK;
}

FMU_API status STATE(Free)(fmu *self, void **state)
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

/* What the model description does not offer. */
REFUSED(GetBoolean) REFUSED(GetString) REFUSED(SetBoolean) REFUSED(SetString)
REFUSED(GetDirectionalDerivative)
