/* Stand-in for database.h and database_cfg.h of foxBMS 2: the blocks and members that foxbms_soc.c
 * reads. Not a copy. */
#ifndef DATABASE_H
#define DATABASE_H

#include "battery_system_cfg.h"

typedef enum {
    DATA_BLOCK_ID_CURRENT_SENSOR, DATA_BLOCK_ID_MIN_MAX, DATA_BLOCK_ID_PACK_VALUES
} DATA_BLOCK_ID_e;

typedef struct { DATA_BLOCK_ID_e uniqueId; } DATA_BLOCK_HEADER_s;

typedef struct {
    DATA_BLOCK_HEADER_s header;
    int32_t current_mA[BS_NR_OF_STRINGS];
    uint8_t invalidCurrentMeasurement[BS_NR_OF_STRINGS];
    uint32_t timestampCurrent[BS_NR_OF_STRINGS];
} DATA_BLOCK_CURRENT_SENSOR_s;

typedef struct {
    DATA_BLOCK_HEADER_s header;
    int32_t stringVoltage_mV[BS_NR_OF_STRINGS];
    uint8_t invalidStringVoltage[BS_NR_OF_STRINGS];
} DATA_BLOCK_PACK_VALUES_s;

typedef struct {
    DATA_BLOCK_HEADER_s header;
    float_t averageTemperature_ddegC[BS_NR_OF_STRINGS];
    uint16_t validMeasuredCellTemperatures[BS_NR_OF_STRINGS];
} DATA_BLOCK_MIN_MAX_s;

typedef struct {
    float_t averageSoc_perc[BS_NR_OF_STRINGS];
    float_t minimumSoc_perc[BS_NR_OF_STRINGS];
    float_t maximumSoc_perc[BS_NR_OF_STRINGS];
} DATA_BLOCK_SOC_s;

typedef enum { STD_OK, STD_NOT_OK } STD_RETURN_TYPE_e;

extern STD_RETURN_TYPE_e DATA_Read3DataBlocks(void *first, void *second, void *third);
#define DATA_READ_DATA(first, second, third) DATA_Read3DataBlocks(first, second, third)

#endif
