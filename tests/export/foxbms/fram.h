/* Stand-in for fram.h and fram_cfg.h of foxBMS 2: what foxbms_soc.c keeps there. Not a copy. */
#ifndef FRAM_H
#define FRAM_H

#include "battery_system_cfg.h"

typedef enum { FRAM_ACCESS_OK, FRAM_ACCESS_CRC_ERROR } FRAM_RETURN_TYPE_e;
typedef enum { FRAM_BLOCK_ID_SOC, FRAM_BLOCK_ID_CANGAUGE } FRAM_BLOCK_ID_e;

typedef struct {
    float_t minimumSoc_perc[BS_NR_OF_STRINGS];
    float_t maximumSoc_perc[BS_NR_OF_STRINGS];
    float_t averageSoc_perc[BS_NR_OF_STRINGS];
} FRAM_SOC_s;

extern FRAM_SOC_s fram_soc;
extern FRAM_RETURN_TYPE_e FRAM_ReadData(FRAM_BLOCK_ID_e blockId);
extern FRAM_RETURN_TYPE_e FRAM_WriteData(FRAM_BLOCK_ID_e blockId);

#endif
