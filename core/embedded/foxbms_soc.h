/* foxbms_soc.h - the state that foxbms_soc.c keeps in FRAM beside the SoC, if it has a block there.
 *
 * Without a block of its own the module keeps average, minimum and maximum in the block that foxBMS 2
 * has for the SoC. With one it keeps its whole state, so that what it has learned of the sensors
 * outlasts a reset: add a block to fram_cfg.h and fram_cfg.c, whose variable is `cangauge_fram`, and
 * compile with -DCANGAUGE_FRAM_BLOCK=FRAM_BLOCK_ID_... .
 */
#ifndef FOXBMS_SOC_H
#define FOXBMS_SOC_H

#include "battery_system_cfg.h"
#include "cangauge.h"

typedef struct {
    uint32_t model_id[BS_NR_OF_STRINGS]; /* PACK_MODEL_ID of the saved state; 0: none */
    cg_state state[BS_NR_OF_STRINGS];
} cangauge_fram_s;

extern cangauge_fram_s cangauge_fram;

#endif
