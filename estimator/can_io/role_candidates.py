"""Signals of a database that may have a role: by their name and that of the message, unit, range, comment, values.

A score has no unit: it orders the candidates of a role. A signal below `MIN_SCORE` is no candidate, but where a role of
`BY_UNIT` has none, signals with its unit are guesses.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace

from cantools.database.can import Database, Message, Signal

from estimator.can_io.role_words import COMMAND, CORNER, ELSEWHERE, WORDS, Words
from estimator.can_io.switch_states import SWITCHES, states_of
from estimator.roles import GRADES
from estimator.signals import DIMENSION, STATE, Role
from estimator.units import Conversion, conversion_of

MIN_SCORE = 3.0
NAMED, MENTIONED, UNLIKE = 4.0, 1.0, -4.0  # points for the names, for the comment, for a foreign word in the names
RIGHT_UNIT, NO_UNIT, STRANGE_UNIT = 2.0, -1.5, -2.0
MAX_STATE_BITS = 4  # of a switch
MAX_CANDIDATES = 6  # of a role; each wheel may have as many
MAX_GUESSES = 12  # of a role, of which the log shows the best
LEAST_REACH = {  # [SI] that a signal must be able to say, or it is of something smaller: 12 V, a cell, a window motor
    Role.SPEED: 20.0,
    Role.WHEEL_SPEEDS: 20.0,
    Role.ENGINE_TORQUE: 50.0,
    Role.ENGINE_SPEED: 200.0,
    Role.ENGINE_POWER: 5e3,
    Role.BATTERY_VOLTAGE: 60.0,
    Role.BATTERY_CURRENT: 20.0,
    Role.MASS_REFERENCE: 1000.0,
}
BY_UNIT = (  # roles of speed and power whose units few other signals have
    Role.SPEED,
    Role.ENGINE_POWER,
    Role.ENGINE_TORQUE,
    Role.ENGINE_SPEED,
    Role.BATTERY_VOLTAGE,
    Role.BATTERY_CURRENT,
)
NOT_OF_ONE_WHEEL = (Role.SPEED, Role.ENGINE_SPEED, Role.ENGINE_TORQUE, Role.ALTITUDE)
USUAL_UNIT = {  # where the DBC gives none
    "m/s": "km/h",
    "W": "kW",
    "N.m": "Nm",
    "rad/s": "rpm",
    "1": "%",
    "kg": "kg",
    "m": "m",
    "m/s^2": "m/s^2",
    "rad": "deg",
    "K": "°C",
    "Pa": "kPa",
    "V": "V",
    "A": "A",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """Signal that may have a role; ``unit`` is the usual one if the DBC has no known unit."""

    role: Role
    message: Message
    signal: Signal
    score: float
    unit: str | None = None

    @property
    def is_guess(self) -> bool:
        """True if its unit alone speaks for the role."""
        return self.score < MIN_SCORE

    @property
    def is_sure(self) -> bool:
        """True if the meaning of its values is known; it may be unknown for a gear or switch with special states."""
        if self.is_guess:
            return False
        if self.role == Role.GEAR:
            return self.message.protocol == "j1939" and not self.signal.choices
        if self.role not in SWITCHES or self.signal.length == 1:
            return True
        scale, offset = float(self.signal.scale), float(self.signal.offset)
        return states_of(self.signal.choices or {}, scale, offset, self.role == Role.CLUTCH_SWITCH) is not None

    @property
    def path(self) -> str:
        """Path MESSAGE.signal."""
        return f"{self.message.name}.{self.signal.name}"


def candidates(database: Database) -> dict[Role, list[Candidate]]:
    """Candidates by role, the best first, or guesses; only roles with any."""
    signals = [
        (message, signal, _Texts.of(message, signal)) for message in database.messages for signal in message.signals
    ]
    out: dict[Role, list[Candidate]] = {}
    for words in WORDS:
        fit = [candidate for texts in signals if (candidate := _candidate(words, *texts)) is not None]
        fit.sort(key=lambda candidate: -candidate.score)
        named = [candidate for candidate in fit if not candidate.is_guess]
        if named:
            out[words.role] = named[: MAX_CANDIDATES * (4 if words.role == Role.WHEEL_SPEEDS else 1)]
        elif fit:
            out[words.role] = fit[:MAX_GUESSES]
    return out


def corner(signal: Signal) -> str:
    """Wheel in the name of a signal, such as "fl"; empty if there is none."""
    match = re.search(CORNER, spaced(signal.name))
    return "" if match is None else match[0]


def is_one_of_two(candidate: Candidate, fit: Iterable[Candidate]) -> bool:
    """Whether another candidate has the name of this one, for the other axle."""
    name = _without_digits(candidate.signal)
    others = {name.replace("front", "rear"), name.replace("rear", "front")} - {name}
    return any(_without_digits(other.signal) in others for other in fit)


def _without_digits(signal: Signal) -> str:
    return re.sub(r"\d+", "", spaced(signal.name))


def wheels(fit: Iterable[Candidate]) -> list[Candidate]:
    """Signals of the wheels of one vehicle: those of one message if it has several, else those with similar names.

    They are in the order of identifiers and bits.
    """
    groups: dict[tuple[str, str], dict[str, Candidate]] = {}
    for candidate in fit:
        if wheel := corner(candidate.signal):
            like = re.sub(CORNER, "", spaced(candidate.signal.name))
            for message in (candidate.message.name, ""):
                groups.setdefault((message, like), {}).setdefault(wheel, candidate)
    best = max(groups.items(), key=lambda item: (len(item[1]), bool(item[0][0])), default=None)
    found = () if best is None else best[1].values()
    return sorted(found, key=lambda candidate: (candidate.message.frame_id, candidate.signal.start))


def spaced(name: str) -> str:
    """Convert a name to lower case with blanks between words: "INV_MotorSpeed" becomes "inv motor speed"."""
    parts = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name)
    return " ".join(parts).lower()


@dataclass(frozen=True, slots=True)
class _Texts:
    """Words about a signal, in lower case: its ``name``, that of its ``message``, and its ``comment``."""

    name: str
    message: str
    comment: str

    @classmethod
    def of(cls, message: Message, signal: Signal) -> "_Texts":
        """The texts of a signal."""
        return cls(spaced(signal.name), spaced(message.name), (signal.comment or "").lower())


def _candidate(words: Words, message: Message, signal: Signal, texts: _Texts) -> Candidate | None:
    """Candidate of a signal for a role, with its score; None if it cannot have the role."""
    dimension, unit = DIMENSION[words.role], None
    score = 0.0
    if words.role in NOT_OF_ONE_WHEEL and corner(signal):
        return None
    if dimension == STATE:
        if not _may_be_state(words.role, signal):
            return None
        if states_of(signal.choices or {}, float(signal.scale), float(signal.offset)):
            score += RIGHT_UNIT
    else:
        conversion = conversion_of(signal.unit)
        if conversion is not None and (conversion.dimension == dimension or _is_slope(words.role, conversion)):
            score += RIGHT_UNIT
        elif conversion is not None or signal.length <= MAX_STATE_BITS or _is_enumeration(signal):
            return None
        else:
            is_blank = not (signal.unit or "").strip()
            score, unit = score + (NO_UNIT if is_blank else STRANGE_UNIT), USUAL_UNIT[dimension]
        if _reach(signal, unit or signal.unit) < LEAST_REACH.get(words.role, 0.0):
            return None
    if words.role == Role.WHEEL_SPEEDS and corner(signal) and unit is None:
        texts = replace(texts, name=f"wheel speed {texts.name}")  # a speed of a corner of the vehicle has no other
    score += _points(words, texts)
    if score < MIN_SCORE and (unit is not None or words.role not in BY_UNIT):
        return None
    return Candidate(role=words.role, message=message, signal=signal, score=score, unit=unit)


def _points(words: Words, texts: _Texts) -> float:
    """Points for the words about a signal."""
    like, joined = rf"(?<![a-z]){words.like}", f"{texts.message} {texts.name}"
    in_name = re.search(like, texts.name)
    if in_name is not None:
        points = NAMED + len(in_name[0]) / max(len(texts.name), 1)  # a name that says nothing else is the better one
    elif any(match.end() > len(texts.message) for match in re.finditer(like, joined)):
        points = NAMED  # a speed in the message of the drive
    elif re.search(like, f"{texts.message} {texts.comment}"):
        points = MENTIONED
    else:
        points = 0.0
    rest = texts.name if in_name is None else texts.name.replace(in_name[0], " ")
    foreign = {*_words_in(f"{words.unlike}|{COMMAND}", rest), *_words_in(ELSEWHERE, texts.message)}
    return points + UNLIKE * len(foreign)


def _words_in(words: str, text: str) -> list[str]:
    """The whole words of a pattern in a text."""
    return [match[0] for match in re.finditer(rf"(?<![a-z])(?:{words})(?![a-z])", text)]


def _is_slope(role: Role, conversion: Conversion) -> bool:
    return role in GRADES and conversion.dimension == "rad"


def _is_enumeration(signal: Signal) -> bool:
    """Whether at least half of the values have names: a state, and no quantity."""
    return bool(len(signal.choices or {}) >= 2 ** (signal.length - 1))


def _reach(signal: Signal, unit: str | None) -> float:
    """The largest size that a signal can have by its bits and its stated range [SI], but for an offset of the unit."""
    conversion = conversion_of(unit)
    if signal.is_float or conversion is None:
        return float("inf")
    scale, offset = float(signal.scale), float(signal.offset)
    low, high = (-(2 ** (signal.length - 1)), 2 ** (signal.length - 1)) if signal.is_signed else (0, 2**signal.length)
    by_bits = max(abs(low * scale + offset), abs(high * scale + offset))
    stated = max(abs(float(signal.minimum or 0)), abs(float(signal.maximum or 0)))
    reach = min(by_bits, stated) if stated > 1 else by_bits
    return float(conversion.scale * reach)  # [0|1] and [0|0] are left blank


def _may_be_state(role: Role, signal: Signal) -> bool:
    if signal.unit and conversion_of(signal.unit) is not None:
        return False
    return signal.length <= (8 if role == Role.GEAR else MAX_STATE_BITS)
