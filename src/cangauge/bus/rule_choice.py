"""Which protection a message has: the words of a mapping → a rule, with helpful errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from cantools.database.can import Message

from cangauge.bus.counter_rule import CounterRule
from cangauge.bus.e2e_rule import PROFILES, E2eRule
from cangauge.bus.mapping import MessageMap, RuleMap
from cangauge.bus.protection import RULES, Protection
from cangauge.bus.signal_codec import Field
from cangauge.errors import InputError

COUNTER: Final = "counter"
"""Protection by a counter alone."""

_OF_COUNTER: Final = ("counter", "counter_modulus")
_OF_PROFILE: Final = ("data_id", "data_id_list", "data_id_mode", "header_byte", "protected_bytes")


def choose_rule(
    message: Message, stated: MessageMap, own: Mapping[str, RuleMap], *, source: str
) -> Protection | None:
    """Return the rule that a mapping states for a message; None where it states none.

    Parameters
    ----------
    message : cantools.database.can.Message
    stated : MessageMap
    own : mapping of str to RuleMap
        The user's own rules.
    source : str
        The file, for messages.

    Raises
    ------
    InputError
        If the rule is not known, lacks a figure, has one too many, or does not fit.
    """
    name, where = stated.protection, f"messages.{message.name}"
    _refuse_strangers(name, stated, where, source)
    if name is None:
        return None
    try:
        rule = _rule(name, message, stated, own)
    except InputError as error:
        field = (error.field or "").rpartition(".")[2]
        raise InputError(
            error.problem,
            source=source,
            field=f"{where}.{field}",
            value=error.value,
            cure=error.cure,
        ) from error
    if not rule.fits(message.length):
        raise InputError(
            f"the rule does not fit into the {message.length} bytes of the message",
            source=source,
            field=f"{where}.protection",
            value=name,
        )
    return rule


def _rule(
    name: str, message: Message, stated: MessageMap, own: Mapping[str, RuleMap]
) -> Protection:
    if name in own:
        return own[name].rule(name)
    if name == COUNTER:
        return _counter_rule(message, stated)
    if name in PROFILES:
        return _profile_rule(name, stated)
    try:
        return RULES[name]
    except KeyError:
        raise InputError(
            "unknown protection rule",
            field="protection",
            value=name,
            cure=f"known are {', '.join([*RULES, COUNTER, *PROFILES, *own])};"
            f" or define it under [rules.{name}]",
        ) from None


def _counter_rule(message: Message, stated: MessageMap) -> CounterRule:
    if stated.counter is None:
        raise InputError(
            "is missing", field="counter", cure="name the signal that counts, in the DBC"
        )
    signal = next((each for each in message.signals if each.name == stated.counter), None)
    if signal is None:
        raise InputError(
            f"message {message.name} has no such signal", field="counter", value=stated.counter
        )
    place = Field.of(signal, message.length)
    return CounterRule(COUNTER, place, message.length, stated.counter_modulus or 1 << place.width)


def _profile_rule(name: str, stated: MessageMap) -> E2eRule:
    wanted = "data_id" if PROFILES[name].id_bits else "data_id_list"
    if getattr(stated, wanted) is None:
        raise InputError(
            "is missing", field=wanted, cure=f"the CRC of {name} covers it: ask the sender's maker"
        )
    return E2eRule(
        name,
        data_id=stated.data_id or 0,
        data_ids=bytes(stated.data_id_list or ()),
        data_id_mode=stated.data_id_mode or "both",
        header_byte=stated.header_byte or 0,
        protected_bytes=stated.protected_bytes or 0,
    )


def _refuse_strangers(name: str | None, stated: MessageMap, where: str, source: str) -> None:
    """Refuse figures that the stated protection does not have: a sign of a mistake."""
    strange = (
        *(() if name == COUNTER else _OF_COUNTER),
        *(() if name in PROFILES else _OF_PROFILE),
    )
    for key in strange:
        if getattr(stated, key) is not None:
            needs = "an e2e profile" if key in _OF_PROFILE else f'"{COUNTER}"'
            raise InputError(
                f"belongs to {needs}",
                source=source,
                field=f"{where}.{key}",
                cure=f"set protection to {needs}, or take it out",
            )
