/* pack.c - the pack: current and temperature in; voltage and SoC out. */
#include "fmu.h"

#include <string.h>

void fmu_begin(fmu *self, double time_s)
{
    const cg_line line = CG_LINE(self->line, FMU_LINE, FMU_SPACING_S);
    self->model = FMU_MODEL;
    self->model.capacity_ah = self->value[FMU_CAPACITY_AH];
    for (int32_t k = 0; k < FMU_PARAMETERS; ++k) {
        const fmu_parameter *parameter = &FMU_PARAMETER[k];
        cg_effect *effect = &self->model.effect[parameter->effect];
        cg_real *place = (parameter->place < CG_VALUES)
                             ? &effect->value[parameter->place]
                             : &effect->tau_s[parameter->place - CG_VALUES];
        *place = self->value[parameter->reference];
    }
    cg_init(&self->core, &self->model, &FMU_SETTINGS, &line, NULL);
    self->discharged_ah = 0.0;
    self->last.time_s = NAN;
    fmu_sample(self, time_s);
}

void fmu_sample(fmu *self, double time_s)
{
    cg_estimator *core = &self->core;
    const cg_model *model = &self->model;
    double *value = self->value;
    cg_sample now = {time_s, value[FMU_CURRENT_A], CG_NAN, value[FMU_TEMPERATURE_C]};
    cg_correct(core, &now, 0, model->effects);
    const cg_real counted =
        (now.current_a < 0.0) ? (model->charge_efficiency * now.current_a) : now.current_a;
    if (!isnan(self->last.time_s)) {
        const double seconds = time_s - self->last.time_s;
        self->discharged_ah += 0.5 * (counted + self->last.current_a) * seconds / 3600.0;
    }
    self->last.time_s = time_s;
    self->last.current_a = counted;
    /* No gap: between samples the current is linear, however long. */
    cg_advance(core, &now, now.temperature_c, false);
    const double soc_pct =
        value[FMU_INITIAL_SOC_PCT] - (100.0 * self->discharged_ah / model->capacity_ah);
    cg_real slope;
    value[FMU_TIME_S] = time_s;
    value[FMU_SOC_PCT] = soc_pct;
    value[FMU_VOLTAGE_V] = cg_pseudo_ocv(core, soc_pct, &slope) + core->state.load_v;
}
