/* driver.c - database and FRAM around foxbms_soc.c, in place of those of foxBMS 2.
 *
 *     ./driver RESET [FRAM] < drive.txt
 *
 * A line of the drive: time stamp [ms], current [mA], voltage [mV], temperature [0.1 degC], `x`
 * where it is invalid. A line of output: average, minimum and maximum of the last string, as bits.
 * Before the line RESET all but FRAM is lost. FRAM: file that keeps it from one run to the next.
 * At the end: the SoC of a cell at 3900 mV.
 */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "foxbms_soc.c" /* the source: a reset clears its variables */

#ifdef CANGAUGE_FRAM_BLOCK
cangauge_fram_s cangauge_fram;
#endif

#define LAST ((uint8_t)(BS_NR_OF_STRINGS - 1u))

FRAM_SOC_s fram_soc;
static bool is_written;
static DATA_BLOCK_CURRENT_SENSOR_s current;
static DATA_BLOCK_PACK_VALUES_s pack;
static DATA_BLOCK_MIN_MAX_s cells;

STD_RETURN_TYPE_e DATA_Read3DataBlocks(void *first, void *second, void *third)
{
    if ((*(DATA_BLOCK_ID_e *)first != DATA_BLOCK_ID_CURRENT_SENSOR) ||
        (*(DATA_BLOCK_ID_e *)second != DATA_BLOCK_ID_PACK_VALUES) ||
        (*(DATA_BLOCK_ID_e *)third != DATA_BLOCK_ID_MIN_MAX)) {
        return STD_NOT_OK;
    }
    memcpy(first, &current, sizeof current);
    memcpy(second, &pack, sizeof pack);
    memcpy(third, &cells, sizeof cells);
    return STD_OK;
}

FRAM_RETURN_TYPE_e FRAM_ReadData(FRAM_BLOCK_ID_e blockId)
{
    (void)blockId;
    return is_written ? FRAM_ACCESS_OK : FRAM_ACCESS_CRC_ERROR;
}

FRAM_RETURN_TYPE_e FRAM_WriteData(FRAM_BLOCK_ID_e blockId)
{
    (void)blockId;
    is_written = true;
    return FRAM_ACCESS_OK;
}

static size_t write_to(void *from, size_t size, size_t count, FILE *file)
{
    return fwrite(from, size, count, file);
}

/* Read FRAM from a file, or write it there. */
static void exchange_fram(const char *path, bool is_start)
{
    FILE *file = (path == NULL) ? NULL : fopen(path, is_start ? "rb" : "wb");
    size_t (*const move)(void *, size_t, size_t, FILE *) = is_start ? fread : write_to;
    if (file != NULL) {
        is_written = (move(&fram_soc, sizeof fram_soc, 1, file) == 1);
#ifdef CANGAUGE_FRAM_BLOCK
        is_written = is_written && (move(&cangauge_fram, sizeof cangauge_fram, 1, file) == 1);
#endif
        (void)fclose(file);
    }
}

static int32_t number(const char *word, int32_t otherwise)
{
    return (word[0] == 'x') ? otherwise : (int32_t)strtol(word, NULL, 10);
}

static uint32_t bits(float_t value)
{
    const float single = (float)value;
    uint32_t found;
    memcpy(&found, &single, sizeof found);
    return found;
}

int main(int argc, char **argv)
{
    const long reset = (argc > 1) ? strtol(argv[1], NULL, 10) : 0;
    const char *const fram_path = (argc > 2) ? argv[2] : NULL;
    char word[4][32];
    DATA_BLOCK_SOC_s values;
    long line = 0;
    memset(&values, 0, sizeof values);
    current.header.uniqueId = DATA_BLOCK_ID_CURRENT_SENSOR;
    pack.header.uniqueId = DATA_BLOCK_ID_PACK_VALUES;
    cells.header.uniqueId = DATA_BLOCK_ID_MIN_MAX;
    exchange_fram(fram_path, true);
    SE_InitializeStateOfCharge(&values, false, LAST);
    while (scanf("%31s %31s %31s %31s", word[0], word[1], word[2], word[3]) == 4) {
        line += 1;
        if (line == reset) {
            memset(strings, 0, sizeof strings);
            SE_InitializeStateOfCharge(&values, false, LAST);
        }
        current.timestampCurrent[LAST] = (uint32_t)strtoul(word[0], NULL, 10);
        current.current_mA[LAST] = number(word[1], 0);
        current.invalidCurrentMeasurement[LAST] = (word[1][0] == 'x') ? 1U : 0U;
        pack.stringVoltage_mV[LAST] = number(word[2], 0);
        pack.invalidStringVoltage[LAST] = (word[2][0] == 'x') ? 1U : 0U;
        cells.averageTemperature_ddegC[LAST] = (float_t)number(word[3], 0);
        cells.validMeasuredCellTemperatures[LAST] = (word[3][0] == 'x') ? 0U : 8U;
        SE_CalculateStateOfCharge(&values);
        printf("%08" PRIx32 " %08" PRIx32 " %08" PRIx32 "\n", bits(values.averageSoc_perc[LAST]),
               bits(values.minimumSoc_perc[LAST]), bits(values.maximumSoc_perc[LAST]));
    }
    printf("%.4f\n", (double)SE_GetStateOfChargeFromVoltage(3900));
    exchange_fram(fram_path, false);
    return 0;
}
