"""Columns that are proposed for a table that has no plain ones: tried before they are printed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import islice, product
from typing import Final

from cangauge.errors import InputError
from cangauge.logs.column_map import DOCS, ColumnMap
from cangauge.logs.columns import NEEDED, UnknownColumnsError
from cangauge.logs.quantities import FIELDS

_TRIALS: Final = 24
"""Most proposals that are tried [-]: each reads the beginning of the file."""

_Likely = Mapping[str, Sequence[str]]
"""Likely columns of each quantity, as texts of `--columns`."""


def proposing(error: UnknownColumnsError, reads: Callable[[ColumnMap], bool]) -> InputError:
    """Return the error with the columns to paste that read the file.

    A quantity of which several columns do has a `?`, and so has one without a likely column.

    Parameters
    ----------
    error : UnknownColumnsError
    reads : callable
        Whether columns read the file.
    """
    likely: _Likely = {**error.likely, **{name: [text] for name, text in error.stated.items()}}
    proposed: _Likely = likely
    if set(NEEDED) <= set(likely):
        proposed = _that_read(likely, reads)
        if not proposed:  # without temperature and SoC, if one of them is not read
            proposed = _that_read({name: likely[name] for name in NEEDED}, reads)
        if not proposed:
            return error
    shown = [name for name in FIELDS if name in proposed or name in NEEDED]
    texts, several = [], []
    for name in shown:
        found = proposed.get(name, ())
        is_one = len(found) == 1 or (name == "time" and len(found) > 0)
        texts.append(f"{name}={found[0] if is_one else '?'}")
        if len(found) > 1 and not is_one:
            several.append(f"{name} is {' or '.join(found)}")
    columns = ",".join(texts).replace("'", "'\\''")
    cure = "; ".join([f"name the columns, e.g. --columns '{columns}' ({DOCS})", *several])
    return InputError(error.problem, source=error.source, cure=cure)


def _that_read(likely: _Likely, reads: Callable[[ColumnMap], bool]) -> _Likely:
    """Return the columns of the combinations that read the file; {} if none does."""
    choices = [likely[name] if name in NEEDED else likely[name][:1] for name in likely]
    trials = [dict(zip(likely, each, strict=True)) for each in islice(product(*choices), _TRIALS)]
    read = [trial for trial in trials if reads(ColumnMap(trial))]
    if not read:
        return {}
    return {name: list(dict.fromkeys(trial[name] for trial in read)) for name in likely}
