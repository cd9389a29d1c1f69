"""States of a switch, on or off, from the texts of the DBC's value table.

Makers number the states of a switch differently: 0 off, 1 on; 1 not applied, 2 applied; 0 pressed, 1 released. The
texts of the table define them. A table whose texts do not name both states is not used.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from estimator.signals import Role

SWITCHES = frozenset(
    {Role.BRAKE_SWITCH, Role.CLUTCH_SWITCH, Role.SHIFT_IN_PROCESS, Role.DRIVELINE_ENGAGED, Role.PARK_BRAKE}
)
_WORD = re.compile(r"[A-ZÄÖÜ]+(?![a-zäöüß])|[A-ZÄÖÜ]?[a-zäöüß]+")


def _set(words: str) -> frozenset[str]:
    return frozenset(words.split())


_NO_STATE = _set(
    "invalid error err fault faulty faulted failure fail unavailable sna na reserved rsvd undefined unknown "
    "init initialisation initialization initializing implausible unused fehler ungueltig ungültig reserviert"
)
_NO_STATE_IF_NEGATED = _set("available avail defined used valid known supported present installed verfuegbar verfügbar")
_NEGATIONS = _set("not no non nicht kein keine nein")
_OFF = _set(
    "off false released release inactive deactivated disabled unpressed unapplied undepressed idle none unlocked aus "
    "inaktiv geloest gelöst unbetaetigt unbetätigt"
)
_ON = _set(
    "on true yes applied apply applying pressed press depressed active activated braking set locked progress process "
    "shifting parked actuated enabled ein aktiv ja betaetigt betätigt getreten angezogen"
)
# Of a clutch that is meant by its plates, not by its pedal.
_OPEN = _set("disengaged decoupled open opened offen")
_CLOSED = _set("engaged coupled closed geschlossen")


@dataclass(frozen=True, slots=True)
class States:
    """Values that mean on, and those without a meaning, as scaled by the DBC; all others mean off."""

    on: tuple[float, ...]
    unknown: tuple[float, ...] = ()


def states_of(choices: Mapping[int, object], scale: float, offset: float, is_clutch: bool = False) -> States | None:
    """Read states from the texts of a value table of raw values; None if they do not name both on and off.

    A clutch switch (``is_clutch``) is on if the pedal is pressed and the clutch is open.
    """
    meaning = {raw * scale + offset: is_on(str(text), is_clutch) for raw, text in choices.items()}
    if not {True, False} <= set(meaning.values()):
        return None
    return States(
        on=tuple(value for value, on in meaning.items() if on),
        unknown=tuple(value for value, on in meaning.items() if on is None),
    )


def configured(raw: Iterable[int], choices: Mapping[int, object], scale: float, offset: float) -> States:
    """States whose ``raw`` values for on are configured; the texts define only the values without a meaning."""
    on = tuple(value * scale + offset for value in raw)
    no_state = (value * scale + offset for value, text in choices.items() if not _is_state(_words(str(text))))
    return States(on=on, unknown=tuple(value for value in no_state if value not in on))


def is_on(text: str, is_clutch: bool = False) -> bool | None:
    """True if a text such as "BrakePressed" names the state on, False if off ("Not_Applied"), None if neither."""
    words = _words(text)
    if not _is_state(words):
        return None
    is_negated = bool(words & _NEGATIONS)
    if words & (_OPEN | _CLOSED):
        return (bool(words & _OPEN) == is_clutch) != is_negated
    if is_negated or words & _OFF:
        return False
    return True if words & _ON else None


def _is_state(words: frozenset[str]) -> bool:
    """True if a text may name a state: "invalid", "not available" and "n/a" name none."""
    is_negated = bool(words & _NEGATIONS)
    return not (words & _NO_STATE or (is_negated and words & _NO_STATE_IF_NEGATED) or words == {"n", "a"})


def _words(text: str) -> frozenset[str]:
    return frozenset(word.lower() for word in _WORD.findall(text))
