"""`cangauge inspect`: the contents of a log or capture."""

from __future__ import annotations

import shlex
from datetime import UTC, datetime
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cangauge._extras import extra
from cangauge._files import write_texts_atomic
from cangauge._text import counted, duration, rounded
from cangauge.cli.options import (
    Json,
    ReadingOptions,
    Report,
    argument,
    assumed_of,
    check_outputs,
    command,
)
from cangauge.cli.output import finish, note, print_table, remark, say
from cangauge.errors import InputError

if TYPE_CHECKING:
    from cangauge.inspect.capture import CaptureInspection
    from cangauge.inspect.log import LogInspection

_STAMPS_SINCE_1970_S = 1e9
"""Earlier stamps count from the start of the capture or of the logger [s]."""
_COUNTS = {
    "error_frames": "error frames",
    "remote_frames": "remote frames",
    "time_reversals": "stamps that step back",
}
_FAULTS = {"crc_errors": "wrong CRC", "frames_lost": "lost", "counter_repeats": "repeated"}
_RANGES = {"current_a": "A", "voltage_v": "V", "temperature_c": "°C", "soc_pct": "%"}


@command()
def inspect_command(
    path: Annotated[
        Path,
        argument(
            "LOG|CAPTURE",
            "Log or CAN capture. A log is cangauge's Parquet or CSV, an ANL D3 test, a BMW i3"
            " trip, a cycler export, or any table with a heading for each column; it may be"
            " gzipped or zipped.",
        ),
    ],
    *,
    reading: ReadingOptions,
    report: Report = None,
    json_output: Json = False,
) -> None:
    """Show what a log or capture holds, and the sign of its current.

    The report has rates, gaps longer than 2 s, ranges, quantization, stuck channels, charge moved
    [Ah], the capacity that the reference SoC implies [Ah per 100 %], and the resistance from steps
    of current [Ω]. It states what the log can and cannot identify. The sign of the current is
    found from the data. The report of a capture also has frames, CRC errors and counter errors.

    Examples
    --------
    `cangauge inspect drive.parquet`

    `cangauge inspect TripA01.csv.gz --json`

    `cangauge inspect drive.parquet --report drive.html`

    `cangauge inspect 1C-Discharge.csv --temperature 24`

    `cangauge inspect logger.csv --columns 'time=Stamp,current=I_batt[mA]:-1,voltage=U_batt'`

    `cangauge inspect capture.log --vehicle leaf_ze0`
    """
    # Deferred: the readers and the decoder take half a second to import.
    from cangauge.inspect.capture import inspect_capture
    from cangauge.inspect.log import inspect_log
    from cangauge.logs.read import LogFile

    check_outputs([report], [path])
    recording = reading.open(path)
    logs = []
    if isinstance(recording, LogFile):
        reading.note_log(path)
        logs = [log := recording.read(temperature_c=reading.temperature)]
        if log.assumed:
            remark(f"{path}: read as {', '.join(log.assumed)}")
        of_log = inspect_log(log)
        found = of_log.to_dict()
        show = partial(_show_log, of_log)
        if report is not None:
            page = extra("report.inspection:inspect_page")(of_log, log)
            write_texts_atomic({report: page.html()})
            note(f"report: {report}")
    elif report is not None:
        raise InputError(
            "shows a log, and this is a capture",
            source=path,
            field="--report",
            value=str(report),
            cure="omit it, or use cangauge estimate --report",
        )
    else:
        of_capture = inspect_capture(path, reading.car() if reading.names_vehicle else None)
        found = of_capture.to_dict()
        show = partial(_show_capture, of_capture)
    finish(found | {"assumed": assumed_of(logs)}, show, as_json=json_output)


def _show_log(found: LogInspection) -> None:
    from cangauge.inspect.log import ability_rows, channel_rows

    timing = found.timing
    charge = found.charge
    soc = found.soc
    rate = "no rate"
    if timing.rate_hz:
        exact = f"{timing.rate_hz:.4g} Hz (regular)"
        rate = exact if timing.regular else f"about {rounded(timing.rate_hz, 2)} Hz (irregular)"
    say(f"{found.name}: {found.answer}.")
    say(
        f"{counted(found.rows, 'row')}, {duration(timing.duration_s)}, {rate},"
        f" temperature of: {found.temperature_source}"
    )
    print_table("Channels", *channel_rows(found))
    say(
        f"Charge: {charge.discharged_ah:.4g} Ah discharged, {charge.charged_ah:.4g} Ah charged,"
        f" net {charge.net_ah:+.4g} Ah."
    )
    if soc is not None:
        say(
            f"Reference SoC: {soc.first_pct:.1f} → {soc.last_pct:.1f} %, in"
            f" {100.0 * soc.coverage:.1f} % of the rows."
        )
    say(f"Sign: {found.sign.sentence}.")
    head, rows = ability_rows(found)
    print_table("What this log can identify", head, rows[1:])  # the first is the sign
    for heading, lines in (("Remarks", found.remarks), ("Warning", found.warnings)):
        for line in lines:
            say(f"{heading}: {line}")


def _show_capture(found: CaptureInspection) -> None:
    """Print the frames, the vehicle and the faults of a capture; what is zero is left out."""
    info = found.info
    begins = ""
    if found.start_s > _STAMPS_SINCE_1970_S:
        begins = f", from {datetime.fromtimestamp(found.start_s, UTC):%Y-%m-%d %H:%M:%S} UTC"
    say(
        f"{found.name}: {info['format']}, {info['frames']:,} frames of {len(found.ids)} ids,"
        f" {found.duration_s:.1f} s{begins}."
    )
    for preset in found.presets:
        if preset.matches:
            spans = ((getattr(preset, name), unit) for name, unit in _RANGES.items())
            shown = ", ".join(f"{s[0]:.5g} … {s[1]:.5g} {unit}" for s, unit in spans if s)
            say(
                f"Vehicle: {preset.about} (--vehicle {preset.preset}), {preset.samples:,} samples:"
                f" {shown}."
            )
    if not found.matching and found.log is None:
        say(
            "No known vehicle. Find its signals: cangauge init"
            f" {shlex.quote(found.source)} -o mycar"
        )
    print_table("Frames", *_rows_of_ids(found))
    counts = {words: getattr(found, name) for name, words in _COUNTS.items()}
    if shown := ", ".join(f"{count:,} {words}" for words, count in counts.items() if count):
        say(f"{shown[0].upper()}{shown[1:]}.")
    if found.gaps:
        gap = max(found.gaps, key=itemgetter("length_s"))
        others = f", the longest of {len(found.gaps)}" if len(found.gaps) > 1 else ""
        say(
            f"Silence of {gap['length_s']:.3g} s after {gap['start_s'] - found.start_s:.1f} s"
            f"{others}."
        )
    for line in info["remarks"] if found.log is None else ():  # the log's hold them
        say(f"Remarks: {line}")
    if found.log is not None:
        _show_log(found.log)


def _rows_of_ids(found: CaptureInspection) -> tuple[list[str], list[list[str]]]:
    rows = []
    for each in found.ids:
        counts = {words: getattr(each, name) for name, words in _FAULTS.items()}
        faults = [f"{count} {words}" for words, count in counts.items() if count]
        faults += ["two senders"] * each.two_senders
        seconds = ["–" if s is None else f"{s:.3g}" for s in (each.period_s, each.longest_s)]
        state = ", ".join(faults) or ("none" if each.protection else "not protected")
        rows.append([each.id, each.bus, f"{each.frames:,}", each.bytes, *seconds, state])
    return ["id", "bus", "frames", "bytes", "period [s]", "longest [s]", "faults"], rows
