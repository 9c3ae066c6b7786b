"""Functional mock-up units (FMI 2.0, co-simulation) of a model, from the C core.

The *pack* takes current and temperature and gives voltage and SoC: the voltage model, its delays,
and the effects that a diagnosis found, whose constants are parameters of the unit. Effects of
sensors are no part of a pack. The *estimator* takes voltage, current and temperature and gives SoC,
its standard deviation and status, as `cangauge run` does on a bus, but for the learned capacity.

A unit holds a binary for this platform and the sources for others. Its interface is `core/fmi`, by
FMI 2.0: fmpy, OMSimulator and Simulink all read it.
"""

from __future__ import annotations

import hashlib
import math
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, Literal, NamedTuple

from cangauge._files import atomic_path
from cangauge._resources import shared_file
from cangauge._version import __version__
from cangauge.errors import CangaugeError, InputError
from cangauge.extras.embedded.c_source import (
    CORE_HEADERS,
    CORE_SOURCES,
    exported_constants,
    initialiser,
    line_size,
    model_definition,
)
from cangauge.model.delay_line import SPACING_S
from cangauge.model.effects.base import CoreForm
from cangauge.model.model_file import Model

Kind = Literal["pack", "estimator"]

FLAGS: Final = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared", "-fvisibility=hidden")
"""Without contraction: the same bits as the Python reference."""
PLATFORMS: Final = {
    ("Linux", "x86_64"): ("linux64", ".so"),
    ("Linux", "aarch64"): ("aarch64-linux", ".so"),
    ("Darwin", "x86_64"): ("darwin64", ".dylib"),
    ("Darwin", "arm64"): ("darwin64", ".dylib"),
    ("Windows", "AMD64"): ("win64", ".dll"),
}
"""System and machine → folder of the binary, and its suffix."""
VALUES: Final = {
    "temperature_lag": ("ahead",),
    "core_temperature": ("rise_k", "late", "capacity_ah"),
    "resistance_growth": ("share", "delayed", "ohm"),
    "resistance_temperature": ("share", "activation_k", "delayed", "reference_per_k", "ohm"),
    "resistance_soc": ("at_empty", "at_full", "width_pct", "delayed", "ohm"),
    "resistance_asymmetry": ("charging_ohm",),
    "resistance_step": ("step_ohm", "start_s"),
    "charge_transfer": ("scale_v", "per_a", "bend_only", "activation_k", "zero_a"),
    "rc": ("activation_k", "by_slope", "mean_slope", "ohm_1"),
    "hysteresis": ("half_width_v", "travel_as"),
    "entropic": ("level", "slope", "curve", "t_ref_c"),
    "weak_cell": ("fraction", "ahead"),
}
"""Kind of effect → names of its values, in the order of `cg_effect_kind`."""
SENSORS: Final = ("current_sensor", "voltage_sensor", "time_skew", "temperature_sensor")
"""Kinds that change what is measured, not the pack."""
LONGEST_NAME: Final = 60
"""Characters of a unit's name, a C identifier and the name of its binary."""
STEP_S: Final = 0.1
"""Step that a unit proposes [s], the period of a current sensor: the inputs of a step are those of
its beginning, so that outputs are late by one step."""
DESCRIPTION: Final = """\
<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="{name}" guid="{token}"
    generationTool="cangauge {version}" variableNamingConvention="structured">
  <CoSimulation modelIdentifier="{name}" canHandleVariableCommunicationStepSize="true"
      canGetAndSetFMUstate="true">
    <SourceFiles>
{files}
    </SourceFiles>
  </CoSimulation>
  <UnitDefinitions>
    <Unit name="A"><BaseUnit A="1"/></Unit>
    <Unit name="V"><BaseUnit kg="1" m="2" s="-3" A="-1"/></Unit>
    <Unit name="degC"><BaseUnit K="1" offset="273.15"/></Unit>
    <Unit name="%"><BaseUnit factor="0.01"/></Unit>
    <Unit name="A.h"><BaseUnit A="1" s="1" factor="3600"/></Unit>
    <Unit name="s"><BaseUnit s="1"/></Unit>
  </UnitDefinitions>
  <DefaultExperiment startTime="0" stepSize="{step_s}"/>
  <ModelVariables>
{variables}
  </ModelVariables>
  <ModelStructure>
    <Outputs>
{unknowns}
    </Outputs>
    <InitialUnknowns>
{unknowns}
    </InitialUnknowns>
  </ModelStructure>
</fmiModelDescription>
"""
"""modelDescription.xml of FMI 2.0."""
FINITE: Final = (-sys.float_info.max, sys.float_info.max)
AMPERE_HOURS: Final = (1e-3, 1e5)
"""Capacities that the commands take too [A h]."""
TAU_S: Final = (1e-3, FINITE[1])
"""Time constants [s]: a shorter one is over within any step."""
DIVISORS: Final = {
    "capacity_ah": AMPERE_HOURS,
    **dict.fromkeys(
        ("width_pct", "mean_slope", "travel_as", "zero_a"), (sys.float_info.min, FINITE[1])
    ),
}
"""Names of an effect's values by which the core divides → range."""


class Variable(NamedTuple):
    """A variable of a unit; its value reference is its place."""

    name: str
    causality: Literal["independent", "input", "output", "parameter"]
    description: str
    unit: str | None = None
    start: float | None = None
    is_integer: bool = False
    range: tuple[float, float] | None = None
    """Lowest and highest value that can be set; None: any, NaN too."""

    def xml(self, reference: int) -> str:
        """Return the variable's element of the description."""
        variability = "discrete" if self.is_integer else "continuous"
        if self.causality == "parameter":
            variability = "fixed"
        initials = {"parameter": ' initial="exact"', "output": ' initial="calculated"'}
        initial = initials.get(self.causality, "")
        low, high = self.range or FINITE
        values = {
            "min": None if low == FINITE[0] else low,
            "max": None if high == FINITE[1] else high,
            "start": self.start,
            "unit": self.unit,
        }
        stated = "".join(
            f' {name}="{value}"' for name, value in values.items() if value is not None
        )
        return (
            f'    <ScalarVariable name="{self.name}" valueReference="{reference}"'
            f' causality="{self.causality}" variability="{variability}"{initial}'
            f' description="{self.description}">'
            f"<{'Integer' if self.is_integer else 'Real'}{stated}/></ScalarVariable>"
        )


def export_fmu(model: Model, path: Path, *, kind: Kind = "pack") -> Path:
    """Write the functional mock-up unit of a model.

    Parameters
    ----------
    model : Model
    path : Path
        File to write, `.fmu`.
    kind : {"pack", "estimator"}

    Raises
    ------
    InputError
        If there is no C compiler, or an effect of the model has no form in the core.
    CangaugeError
        If the compiler fails.
    """
    unit = _Unit(model, kind)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        unit.write_sources(root / "sources")
        unit.compile(root)
        (root / "modelDescription.xml").write_text(unit.description(), encoding="utf-8")
        with atomic_path(path) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
            for file in sorted(root.rglob("*")):
                if file.is_file():
                    archive.write(file, file.relative_to(root).as_posix())
    return path


class _Unit:
    """What a unit is made of."""

    def __init__(self, model: Model, kind: Kind) -> None:
        self.constants, self.kind = exported_constants(model), kind
        self.parameters: dict[Variable, tuple[int, str]] = {}
        """Effect and place in C of each parameter of an effect: the last of the variables."""
        if kind == "pack":
            forms = [
                CoreForm("no_effect") if form.kind in SENSORS else form
                for form in self.constants.effects
            ]
            self.constants = replace(self.constants, effects=forms)
            self.parameters = _effect_parameters(forms)
        self.variables = [*_variables(model, kind), *self.parameters]
        name = re.sub(r"\W+", "_", f"{kind} {model.name}", flags=re.ASCII).rstrip("_")
        self.identifier = name[:LONGEST_NAME]
        token = f"{kind} {__version__} {model.to_json()}"
        self.token = hashlib.sha256(token.encode()).hexdigest()

    @property
    def sources(self) -> list[str]:
        """Names of the C files."""
        return [*CORE_SOURCES, f"{self.kind}.c", "fmi2.c", "fmu_model.c"]

    def write_sources(self, folder: Path) -> None:
        """Write the sources, with the constants of the model."""
        folder.mkdir()
        for name in (*CORE_SOURCES, *CORE_HEADERS):
            shutil.copyfile(shared_file("core", name), folder / name)
        for name in ("fmu.h", f"{self.kind}.c", "fmi2.c"):
            shutil.copyfile(shared_file("core", f"fmi/{name}"), folder / name)
        config = {
            "FMU_TOKEN": f'"{self.token}"',
            "FMU_VARIABLES": len(self.variables),
            "FMU_PARAMETERS": len(self.parameters),
            "FMU_SPACING_S": SPACING_S,
            "FMU_LINE": line_size(self.constants, SPACING_S),
        }
        lines = [f"#define {name} {value}" for name, value in config.items()]
        (folder / "fmu_config.h").write_text("\n".join(lines) + "\n", encoding="utf-8")
        (folder / "fmu_model.c").write_text(self._constants(), encoding="utf-8")

    def _constants(self) -> str:
        ranges = [item.range or (math.nan, math.nan) for item in self.variables]
        start = [0.0 if item.start is None else item.start for item in self.variables]
        first = len(self.variables) - len(self.parameters)
        table = [[first + k, *where] for k, where in enumerate(self.parameters.values())]
        return (
            '#include "fmu.h"\n\n'
            f"{model_definition('FMU_MODEL', self.constants)}"
            f"const cg_settings FMU_SETTINGS = {initialiser(self.constants.settings)};\n"
            f"const double FMU_START[FMU_VARIABLES] = {initialiser(start)};\n"
            f"const double FMU_RANGE[FMU_VARIABLES][2] = {initialiser(ranges)};\n"
            f"const fmu_parameter FMU_PARAMETER[FMU_PARAMETERS + 1] = {initialiser(table)};\n"
        )

    def compile(self, root: Path) -> None:
        """Compile the sources into the binary of this platform."""
        key = platform.system(), platform.machine()
        if key not in PLATFORMS:
            raise InputError("no name in FMI for this platform", value=" ".join(key))
        folder, suffix = PLATFORMS[key]
        binary = root / "binaries" / folder / f"{self.identifier}{suffix}"
        binary.parent.mkdir(parents=True)
        sources = [str(root / "sources" / name) for name in self.sources]
        command = [*_compiler(), *FLAGS, *sources, "-o", str(binary), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
        if done.returncode != 0:
            raise CangaugeError(f"the C compiler failed: {done.stderr.strip()[-400:]}")

    def description(self) -> str:
        """Return modelDescription.xml."""
        outputs = [k for k, item in enumerate(self.variables) if item.causality == "output"]
        return DESCRIPTION.format(
            name=self.identifier,
            token=self.token,
            version=__version__,
            files="\n".join(f'      <File name="{name}"/>' for name in self.sources),
            step_s=STEP_S,
            variables="\n".join(item.xml(k) for k, item in enumerate(self.variables)),
            unknowns="\n".join(f'      <Unknown index="{k + 1}"/>' for k in outputs),
        )


def _variables(model: Model, kind: Kind) -> list[Variable]:
    """Return the variables of a unit but for the parameters of effects."""
    extended, is_pack = model.extended_model(), kind == "pack"
    usual_c = extended.model.loads.t_ref_c if is_pack else 20.0
    start = Variable(
        "initial_soc_pct",
        "parameter",
        "state of charge at the start",
        "%",
        50.0,
        range=(0.0, 100.0),
    )
    found = [
        Variable("time", "independent", "time", "s"),
        Variable("current_a", "input", "current, positive = discharge", "A", 0.0),
        Variable("temperature_c", "input", "measured temperature", "degC", usual_c),
        Variable("voltage_v", "input", "measured voltage", "V", 0.0),
        Variable("soc_pct", "output", "state of charge", "%"),
    ]
    if is_pack:
        found[3] = Variable("voltage_v", "output", "voltage at the terminals", "V")
        capacity_ah = extended.counting(50.0).capacity_ah
        what = "charge from full to empty"
        capacity = Variable(
            "capacity_ah", "parameter", what, "A.h", capacity_ah, range=AMPERE_HOURS
        )
        return [*found, start, capacity]
    text = f"{start.description}; negative: found from the first voltages"
    return [
        *found,
        start._replace(description=text, start=-1.0, range=(-1.0, 100.0)),
        Variable("soc_std_pct", "output", "its standard deviation", "%"),
        Variable(
            "status", "output", "0 initialising, 1 valid, 2 degraded, 3 invalid", is_integer=True
        ),
        Variable("reasons", "output", "bits, as CG_… in cangauge.h", is_integer=True),
        Variable("soc_newton_pct", "output", "by the voltage model alone", "%"),
        Variable("soc_coulomb_pct", "output", "by counting alone", "%"),
        Variable("voltage_model_v", "output", "predicted voltage", "V"),
    ]


def _effect_parameters(forms: Sequence[CoreForm]) -> dict[Variable, tuple[int, str]]:
    """Return the effects' constants as variables, with effect and place in C of each."""
    found = {}
    for number, form in enumerate(forms):
        prefix = f"effect_{number + 1}_{form.kind}"
        text = f"effect {number + 1} of the model, as in cangauge.h"
        parameter = Variable(prefix, "parameter", text)
        named = zip(VALUES.get(form.kind, ()), form.values, strict=False)
        for place, (name, value) in enumerate(named):
            bounds = DIVISORS.get(name, FINITE)
            variable = parameter._replace(name=f"{prefix}.{name}", start=value, range=bounds)
            found[variable] = number, f"{place}"
        for place, value in enumerate(form.tau_s):
            name = f"{prefix}.tau_{place + 1}_s"
            variable = parameter._replace(name=name, start=value, range=TAU_S)
            found[variable] = number, f"CG_VALUES + {place}"
    return found


def _compiler() -> list[str]:
    """Return the command of the compiler: `CC` with its options, or `cc`."""
    name, *options = shlex.split(os.environ.get("CC") or "cc")
    if found := shutil.which(name):
        return [found, *options]
    cure = "install gcc or clang, or name one in CC"
    raise InputError("no C compiler", value=name, cure=cure)
