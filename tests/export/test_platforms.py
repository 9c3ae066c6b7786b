"""Exports for platforms: their manifests are read, and their examples compile against stubs."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml
from untested import export_untested

from cangauge.extras.embedded.platforms import Platform
from cangauge.model.model_file import Model

pytestmark = pytest.mark.skipif(not shutil.which("cc"), reason="no C compiler")
STUBS = {
    "esp_timer.h": "long long esp_timer_get_time(void);",
    "freertos/FreeRTOS.h": "#define pdMS_TO_TICKS(ms) (ms)",
    "freertos/task.h": "void vTaskDelay(unsigned ticks);",
    "zephyr/kernel.h": "long long k_uptime_get(void); void k_msleep(int ms);"
    "void printk(const char *format, ...);",
    "Arduino.h": "struct port { void begin(long); template <class T> void print(T);"
    "template <class T> void println(T); };"
    "extern port Serial; unsigned long millis(); void delay(unsigned long);",
}


@pytest.fixture(scope="module")
def stubs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stubs")
    for name, text in STUBS.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    return folder


@pytest.fixture(scope="module")
def exports(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A folder exported for each platform."""
    platforms: tuple[Platform, ...] = ("esp-idf", "zephyr", "arduino")
    folders = {each: tmp_path_factory.mktemp(each) for each in platforms}
    for platform, folder in folders.items():
        export_untested(Model.prior("oxide", 96, 60.0), folder, platform=platform)
    return dict(folders)


def compile_all(folder: Path, stubs: Path, *files: str, defines: tuple[str, ...] = ()) -> None:
    compiler = "c++" if files[0].endswith(".ino") else "cc"
    kind = ["-x", "c++"] if compiler == "c++" else ["-std=c99"]
    flags = [*kind, "-Wall", "-Werror", "-fsyntax-only", *(f"-D{each}" for each in defines)]
    places = [f"-I{stubs}", "-I.", "-Isrc"]
    done = subprocess.run(
        [compiler, *flags, *places, *files], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("platform", "example"),
    [("esp-idf", "examples/gauge/main/gauge.c"), ("zephyr", "samples/gauge/src/main.c")],
)
def test_what_the_build_names_compiles(
    exports: dict[str, Path], stubs: Path, platform: str, example: str
) -> None:
    folder = exports[platform]
    build = (folder / "CMakeLists.txt").read_text()
    sources = re.findall(r"[a-z_]+\.c\b", build)
    assert len(sources) == 5
    defines = re.search(r"CANGAUGE_CONFIG CANGAUGE_REAL=float", build)
    assert defines is not None
    compile_all(folder, stubs, *sources, example, defines=tuple(defines[0].split()))
    assert not (folder / "foxbms_soc.c").exists()


def test_manifests_are_read(exports: dict[str, Path]) -> None:
    component = exports["esp-idf"] / "idf_component.yml"
    assert {"version", "description"} <= set(yaml.safe_load(component.read_text()))
    module = exports["zephyr"] / "zephyr" / "module.yml"
    build = yaml.safe_load(module.read_text())["build"]
    assert build == {"cmake": ".", "kconfig": "Kconfig"}
    kconfig = (exports["zephyr"] / build["kconfig"]).read_text()
    assert kconfig.startswith("config CANGAUGE\n\tbool")


@pytest.mark.skipif(not shutil.which("c++"), reason="no C++ compiler")
def test_an_arduino_library_compiles_without_definitions(
    exports: dict[str, Path], stubs: Path
) -> None:
    folder = exports["arduino"]
    lines = (folder / "library.properties").read_text().splitlines()
    properties = dict(line.split("=", 1) for line in lines)
    # Of the library specification 1.5.
    assert {"name", "version", "author", "maintainer", "sentence", "paragraph", "category", "url",
            "architectures"} <= set(properties)  # fmt: skip
    compile_all(folder, stubs, *(f"src/{each.name}" for each in (folder / "src").glob("*.c")))
    sketch = folder / "examples" / "Gauge" / "Gauge.ino"
    sketch.write_text("#include <Arduino.h>\n" + sketch.read_text())
    compile_all(folder, stubs, "examples/Gauge/Gauge.ino")
