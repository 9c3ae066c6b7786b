/* estimator.c - the estimator: current, voltage and temperature in; SoC, deviation, status out. */
#include "fmu.h"

void fmu_begin(fmu *self, double time_s)
{
    const cg_line line = CG_LINE(self->line, FMU_LINE, FMU_SPACING_S);
    self->model = FMU_MODEL;
    cg_settings settings = FMU_SETTINGS;
    const double initial_pct = self->value[FMU_INITIAL_SOC_PCT];
    settings.initial_soc_pct = (initial_pct < 0.0) ? CG_NAN : initial_pct;
    cg_init(&self->core, &self->model, &settings, &line, &self->skew);
    fmu_sample(self, time_s);
}

void fmu_sample(fmu *self, double time_s)
{
    double *value = self->value;
    const cg_sample now = {
        time_s, value[FMU_CURRENT_A], value[FMU_VOLTAGE_V], value[FMU_TEMPERATURE_C],
    };
    (void)cg_update(&self->core, &now);
    const cg_estimate found = cg_evaluate(&self->core);
    value[FMU_TIME_S] = time_s;
    value[FMU_SOC_PCT] = found.soc_pct;
    value[FMU_SOC_STD_PCT] = found.soc_std_pct;
    value[FMU_STATUS] = (double)found.status;
    value[FMU_REASONS] = (double)found.reasons;
    value[FMU_SOC_NEWTON_PCT] = found.soc_newton_pct;
    value[FMU_SOC_COULOMB_PCT] = found.soc_coulomb_pct;
    value[FMU_VOLTAGE_MODEL_V] = found.voltage_model_v;
}
