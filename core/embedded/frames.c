/* frames.c - SOC_ESTIMATE: its signals, and AUTOSAR's E2E profile 2 around. */
#include "frames.h"

#include <math.h>

/* E2EDataIdList of the message. */
static const uint8_t DATA_IDS[16] = {
    0x1E, 0xD2, 0x47, 0x9B, 0x60, 0xF5, 0x0C, 0xA8, 0x33, 0xE9, 0x74, 0x8D, 0x51, 0xB6, 0x2A, 0xCF,
};

/* Value of a signal in steps of its scale. All bits set: not available. */
static uint64_t raw_of(double value, double scale, uint32_t not_available)
{
    if (isnan(value)) {
        return not_available;
    }
    return (uint64_t)rint(fmin(fmax(value / scale, 0.0), (double)not_available - 1.0));
}

/* CRC-8 with the polynomial 0x2F, over one byte. */
static uint8_t crc8_h2f(uint8_t crc, uint8_t byte)
{
    uint8_t rest = crc ^ byte;
    for (int bit = 0; bit < 8; ++bit) {
        const uint8_t carry = ((rest & 0x80U) != 0U) ? 0x2FU : 0U;
        rest = (uint8_t)((uint8_t)(rest << 1) ^ carry);
    }
    return rest;
}

void frames_soc_estimate(const cg_estimate *estimate, uint32_t age_s, uint8_t counter,
                         uint8_t data[8])
{
    const uint64_t signals = ((uint64_t)(counter & 0xFU) << 8) |
                             ((uint64_t)((uint32_t)estimate->status & 3U) << 12) |
                             (raw_of((double)age_s, 1.0, 31U) << 14) |
                             (raw_of((double)estimate->soc_pct, 0.01, 16383U) << 19) |
                             (raw_of((double)estimate->soc_std_pct, 0.05, 2047U) << 33) |
                             ((uint64_t)(estimate->reasons & 0xFFFFFU) << 44);
    uint8_t crc = 0xFFU;
    for (int k = 1; k < 8; ++k) {
        data[k] = (uint8_t)(signals >> (8 * k));
        crc = crc8_h2f(crc, data[k]);
    }
    data[0] = crc8_h2f(crc, DATA_IDS[counter & 0xFU]) ^ 0xFFU;
}
