"""What readers do about the sign of current."""

from __future__ import annotations

from dataclasses import replace

from cangauge.inspect.sign import sign_of_current
from cangauge.logs.log import Log


def settle_sign(log: Log, *, stored_sign_unknown: bool) -> Log:
    """Check the sign of current against the data; turn it only where the format leaves it open.

    Parameters
    ----------
    log : Log
    stored_sign_unknown : bool
        Whether the format does not say which way current is counted (copies from CAN).

    Returns
    -------
    Log
        With a remark where the data disagree with the sign, or cannot confirm an unknown one.
    """
    finding = sign_of_current(log)
    if stored_sign_unknown and finding.sign < 0:
        text = f"current negated, sign found from the data: {finding.strongest.text}"
        return replace(log, current_a=0.0 - log.current_a, remarks=(*log.remarks, text))
    if stored_sign_unknown and finding.sign == 0:
        text = "sign of current unknown and not to be told from the data: kept as stored"
    elif finding.sign < 0:
        text = f"current looks turned and was kept as stored: {finding.sentence}"
    else:
        return log
    return replace(log, remarks=(*log.remarks, text))
