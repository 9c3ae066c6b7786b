/* fmu.c - what both units and both interfaces share; see fmu.h. */
#include "fmu.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

fmu *fmu_new(const char *token)
{
    if ((token == NULL) || (strcmp(token, FMU_TOKEN) != 0)) {
        return NULL;
    }
    fmu *self = calloc(1, sizeof(fmu));
    if (self != NULL) {
        fmu_reset(self);
    }
    return self;
}

void fmu_reset(fmu *self)
{
    memcpy(self->value, FMU_START, sizeof(self->value));
}

bool fmu_get(const fmu *self, const uint32_t *reference, size_t count, double *value)
{
    for (size_t k = 0; k < count; ++k) {
        if (reference[k] >= FMU_VARIABLES) {
            return false;
        }
        value[k] = self->value[reference[k]];
    }
    return true;
}

bool fmu_set(fmu *self, const uint32_t *reference, size_t count, const double *value)
{
    for (size_t k = 0; k < count; ++k) {
        if (reference[k] >= FMU_VARIABLES) {
            (void)snprintf(self->message, FMU_TEXT, "no variable has the value reference %lu",
                           (unsigned long)reference[k]);
            return false;
        }
        const double *range = FMU_RANGE[reference[k]];
        if (!isnan(range[0]) && !((value[k] >= range[0]) && (value[k] <= range[1]))) {
            (void)snprintf(self->message, FMU_TEXT,
                           "the value %g of value reference %lu is outside %g ... %g", value[k],
                           (unsigned long)reference[k], range[0], range[1]);
            return false;
        }
        self->value[reference[k]] = value[k];
    }
    return true;
}
