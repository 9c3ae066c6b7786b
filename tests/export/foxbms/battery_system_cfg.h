/* Stand-in for the header of this name of foxBMS 2: only the names that foxbms_soc.c uses, so that
 * it is compiled and run in the tests without foxBMS. Not a copy. */
#ifndef BATTERY_SYSTEM_CFG_H
#define BATTERY_SYSTEM_CFG_H

#include <math.h>
#include <stdbool.h>
#include <stdint.h>

#ifndef BS_POSITIVE_DISCHARGE_CURRENT
#define BS_POSITIVE_DISCHARGE_CURRENT (true)
#endif
#define BS_NR_OF_STRINGS (2u)
#define BS_NR_OF_CELL_BLOCKS_PER_STRING (96u)

#endif
