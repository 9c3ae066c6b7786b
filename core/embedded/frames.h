/* frames.h - the estimate as the frame SOC_ESTIMATE of soc_estimate.dbc. */
#ifndef FRAMES_H
#define FRAMES_H

#include "cangauge.h"

/* Pack an estimate. `age_s`: whole seconds since its sample; `counter`: 0 ... 15, one more each. */
void frames_soc_estimate(const cg_estimate *estimate, uint32_t age_s, uint8_t counter,
                         uint8_t data[8]);

#endif
