"""Exported sources in the form of a platform: its manifest, its layout, and an example.

The sources are the same everywhere. ESP-IDF and Zephyr get them as a component and as a module, the
Arduino IDE as a library, foxBMS 2 with the functions of its SoC module (`foxbms_soc.c`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal

from cangauge._version import __version__
from cangauge.extras.embedded.c_source import CORE_HEADERS, CORE_SOURCES

Platform = Literal["generic", "esp-idf", "zephyr", "arduino", "foxbms"]

SOURCES: Final = (*CORE_SOURCES, "pack_model.c", "frames.c")
"""What a program compiles."""
HEADERS: Final = (*CORE_HEADERS, "cangauge_config.h", "pack_model.h", "frames.h")
ABOUT: Final = "State of charge of a battery pack from current, voltage and temperature"

_GAUGE: Final = """\
static cg_current storage[PACK_LINE_SIZE];
static cg_skew skew;
static cg_estimator pack;

/* Replace these three by your sensors; NAN: missing. */
static float current_a(void) { return 10.0F; } /* positive discharges */
static float voltage_v(void) { return 380.0F; }
static float temperature_c(void) { return 25.0F; }

static void gauge_begin(void)
{
    const cg_settings settings = cg_default_settings();
    const cg_line line = CG_LINE(storage, PACK_LINE_SIZE, PACK_SPACING_S);
    cg_init(&pack, &pack_model, &settings, &line, &skew);
}

static cg_estimate gauge_at(double time_s)
{
    const cg_sample sample = {cg_time_of_s(time_s), current_a(), voltage_v(), temperature_c()};
    (void)cg_update(&pack, &sample);
    return cg_evaluate(&pack);
}
"""
"""Three numbers in, an estimate out: the same in each example."""

_ESP_MAIN: Final = f"""\
/* gauge.c - the state of charge every 0.1 s, on ESP-IDF. */
#include <math.h>
#include <stdio.h>

#include "esp_timer.h"
#include "freertos/FreeRTOS.h"
#include "freertos/task.h"
#include "pack_model.h"

{_GAUGE}
void app_main(void)
{{
    gauge_begin();
    for (;;) {{
        const cg_estimate soc = gauge_at(1e-6 * (double)esp_timer_get_time());
        printf("%.2f +- %.2f %%\\n", (double)soc.soc_pct, (double)soc.soc_std_pct);
        vTaskDelay(pdMS_TO_TICKS(100));
    }}
}}
"""
_ZEPHYR_MAIN: Final = f"""\
/* main.c - the state of charge every 0.1 s, on Zephyr. */
#include <math.h>

#include <zephyr/kernel.h>

#include "pack_model.h"

{_GAUGE}
int main(void)
{{
    gauge_begin();
    for (;;) {{
        const cg_estimate soc = gauge_at(1e-3 * (double)k_uptime_get());
        printk("%d +- %d hundredths of a %%\\n", (int)(100.0F * soc.soc_pct),
               (int)(100.0F * soc.soc_std_pct));
        k_msleep(100);
    }}
    return 0;
}}
"""
_ARDUINO_SKETCH: Final = f"""\
// Gauge.ino - the state of charge every 0.1 s, in the Arduino IDE.
#include <math.h>

extern "C" {{
#include <pack_model.h>
}}

{_GAUGE}
void setup()
{{
    Serial.begin(115200);
    gauge_begin();
}}

void loop()
{{
    const cg_estimate soc = gauge_at(1e-3 * (double)millis());
    Serial.print(soc.soc_pct);
    Serial.print(" +- ");
    Serial.println(soc.soc_std_pct);
    delay(100);
}}
"""


ADDED: Final = {
    "esp-idf": {
        "CMakeLists.txt": f"idf_component_register(SRCS {' '.join(SOURCES)} INCLUDE_DIRS .)\n"
        "target_compile_definitions(${COMPONENT_LIB} PUBLIC CANGAUGE_CONFIG CANGAUGE_REAL=float)\n",
        "idf_component.yml": f'version: "{__version__}"\ndescription: {ABOUT}\n'
        'license: Apache-2.0\ndependencies:\n  idf: ">=4.4"\n',
        "examples/gauge/CMakeLists.txt": "cmake_minimum_required(VERSION 3.16)\n"
        "set(EXTRA_COMPONENT_DIRS ../..)\n"
        "include($ENV{IDF_PATH}/tools/cmake/project.cmake)\nproject(gauge)\n",
        "examples/gauge/main/CMakeLists.txt": 'idf_component_register(SRCS "gauge.c")\n',
        "examples/gauge/main/gauge.c": _ESP_MAIN,
    },
    "zephyr": {
        "zephyr/module.yml": "name: cangauge\nbuild:\n  cmake: .\n  kconfig: Kconfig\n",
        "Kconfig": f'config CANGAUGE\n\tbool "{ABOUT}"\n',
        "CMakeLists.txt": "if(CONFIG_CANGAUGE)\n  zephyr_library()\n"
        f"  zephyr_library_sources({' '.join(SOURCES)})\n  zephyr_include_directories(.)\n"
        "  zephyr_compile_definitions(CANGAUGE_CONFIG CANGAUGE_REAL=float)\nendif()\n",
        "samples/gauge/CMakeLists.txt": "cmake_minimum_required(VERSION 3.20.0)\n"
        "list(APPEND ZEPHYR_EXTRA_MODULES ${CMAKE_CURRENT_SOURCE_DIR}/../..)\n"
        "find_package(Zephyr REQUIRED HINTS $ENV{ZEPHYR_BASE})\nproject(gauge)\n"
        "target_sources(app PRIVATE src/main.c)\n",
        "samples/gauge/prj.conf": "CONFIG_CANGAUGE=y\n",
        "samples/gauge/src/main.c": _ZEPHYR_MAIN,
    },
}
"""Platform → files beside the sources."""


def arranged(platform: Platform, texts: Mapping[str, str]) -> dict[str, str]:
    """Return the files of an export by their path, as a platform expects them."""
    if platform == "arduino":
        return _arduino(texts)
    return {**texts, **ADDED.get(platform, {})}


def _arduino(texts: Mapping[str, str]) -> dict[str, str]:
    """Return a library: only what it compiles, since the IDE compiles all of `src`."""
    files = {f"src/{name}": texts[name] for name in (*SOURCES, *HEADERS)}
    # The IDE gives no definitions to the compiler.
    files["src/cangauge.h"] = (
        f"#define CANGAUGE_CONFIG\n#define CANGAUGE_REAL float\n{texts['cangauge.h']}"
    )
    properties = {
        "name": "cangauge",
        "version": __version__,
        "author": "The authors of cangauge",
        "maintainer": "The authors of cangauge",
        "sentence": f"{ABOUT}.",
        "paragraph": "An extended Kalman filter over voltage and charge, for one identified pack.",
        "category": "Data Processing",
        "url": "",
        "architectures": "*",
        "includes": "pack_model.h",
    }
    lines = "".join(f"{name}={value}\n" for name, value in properties.items())
    return {**files, "library.properties": lines, "examples/Gauge/Gauge.ino": _ARDUINO_SKETCH}
