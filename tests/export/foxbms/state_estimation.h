/* Stand-in for the header of this name of foxBMS 2: the functions of a SoC module. Not a copy. */
#ifndef STATE_ESTIMATION_H
#define STATE_ESTIMATION_H

#include "database.h"

extern void SE_InitializeStateOfCharge(DATA_BLOCK_SOC_s *values, bool ccPresent, uint8_t string);
extern void SE_CalculateStateOfCharge(DATA_BLOCK_SOC_s *values);
extern float_t SE_GetStateOfChargeFromVoltage(int16_t voltage_mV);

#endif
