"""`cangauge export-ecm`: a model as the equivalent circuit of other simulators."""

from __future__ import annotations

import json
from functools import partial
from keyword import iskeyword
from pathlib import Path

from cangauge._files import write_text_atomic
from cangauge._text import number, significant
from cangauge.cli.declare import command
from cangauge.cli.options import check_outputs
from cangauge.cli.output import finish, print_table
from cangauge.errors import InputError


@command()
def export_ecm_command(*, model: Path, output: Path, json_output: bool = False) -> None:
    """Write a model as an equivalent circuit: open-circuit voltage, R0 and RC pairs as tables.

    The RC pairs are fitted to the model's step response; the error of that fit is printed.

    Examples
    --------
    `cangauge export-ecm -m pack.json -o pack_ecm.py`

    Parameters
    ----------
    output : -o, --output FILE.py|.json
        .py: a module with the parameters of PyBaMM's Thevenin model and of `thevenin`; .json: the
        tables alone.
    """
    is_module = output.suffix.lower() == ".py"
    if is_module and (not output.stem.isidentifier() or iskeyword(output.stem)):
        raise InputError(
            "Python cannot import a module of this name", field="--output", value=output.name,
            cure="use letters, digits and _, as in pack_ecm.py",
        )  # fmt: skip
    check_outputs([output], [model])
    # Deferred, so that the help page does not wait for numpy and scipy.
    from cangauge.extras.embedded.equivalent_circuit import equivalent_circuit, module_of
    from cangauge.model.model_file import Model

    circuit = equivalent_circuit(Model.load(model))
    write_text_atomic(output, module_of(circuit) if is_module else json.dumps(circuit) + "\n")
    taus_s, error_pct = circuit["pair_tau_s"], circuit["step_error_pct"]
    rows = [["capacity", number(circuit["capacity_ah"], 2), "Ah"]]
    rows += [
        [f"time constant of RC pair {k}", significant(tau_s, 3), "s"]
        for k, tau_s in enumerate(taus_s, start=1)
    ]
    rows.append(["step response, RMS error", number(error_pct, 2), "%"])
    title = f"Equivalent circuit of {circuit['name']}"
    show = partial(print_table, title, ["", "value", "unit"], rows)
    found = {"pairs": len(taus_s), "pair_tau_s": taus_s, "step_error_pct": error_pct}
    finish(found, show, {"output": output}, as_json=json_output)
