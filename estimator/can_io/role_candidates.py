"""Signals of a database that may have a role: by their name and that of the message, unit, range, comment, values.

A score has no unit: it orders the candidates of a role. A signal below `MIN_SCORE` is no candidate. Words are those of
public DBC files, English and German.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from cantools.database.can import Database, Message, Signal

from estimator.can_io.switch_states import SWITCHES, states_of
from estimator.roles import GRADES
from estimator.signals import DIMENSION, STATE, Role
from estimator.units import Conversion, conversion_of

MIN_SCORE = 3.0
NAMED, MENTIONED, UNLIKE = 4.0, 1.0, -4.0  # points for the names, for the comment, for a foreign word in the names
RIGHT_UNIT, NO_UNIT, STRANGE_UNIT = 2.0, -1.5, -2.0
MAX_STATE_BITS = 4  # of a switch
MAX_CANDIDATES = 6  # of a role; each wheel may have as many
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
_WHEEL = r"(wheel|whl|wss|rad(?=geschw|drehz|[vh][lr]|_0)|(?<![a-z])(fl|fr|rl|rr|lf|rf|lr)(?![a-z]))"
_CORNER = (
    r"(?<![a-z])(fl|fr|rl|rr|lf|rf|lr|vl|vr|hl|hr|front left|front right|rear left|rear right|"
    r"left front|right front|left rear|right rear)(?![a-z])"
)
_COMMAND = (
    r"(command|commanded|cmd|request|requested|req|rq|target|tgt|set ?point|desired|limit|limiting|"
    r"max|min|maximum|minimum|mx|mn|lim|charge|chrg|dchrg|available|allowed|demand|set|rated|rating|rel|relative|"
    r"assist|lka|lkas|wish|wunsch\w*|"
    r"demanded|error|fault|diag|counter|checksum|crc|valid|quality|accuracy|status|enable|mode|offset|calibration|"
    r"soll\w*|cruise|acc|lead|obj|object|radar|hud|display|dash|raw|delta|slip|trailer|steer|steering|eps|driver)"
)
_ELSEWHERE = (  # names of messages about other things than the vehicle and its drive
    r"(steer\w*|eps|epas|pscm|mdps|lka\w*|hca|scc|fca|aeb|tsr|radar|srr|track|object|obj|camera|"
    r"dcdc|charg\w*|compressor|klima|hvac|seat|door|trailer|twelve|rating|limits?|commands?|requests?)"
)


@dataclass(frozen=True, slots=True)
class _Words:
    role: Role
    like: str  # any of them names the role
    unlike: str  # any of them is of something else


_WORDS = [
    _Words(
        Role.SPEED,
        r"(wheel ?based ?vehicle ?speed|vehicle ?speed|vitesse ?vehicule( roues)?|"
        r"veh ?spd|veh(icle)? ?v(el)?|vehicle velocity|v ?ego|v ?veh|speed vehicle|"
        r"ground ?speed|car ?speed|"
        r"xmission ?speed|speed|spd|geschwindigkeit|fahrgeschw|velocity)",
        rf"({_WHEEL}|engine|motor|rpm|fan|wind|wiper|gps|sat|turbine|shaft|yaw|angular|input|output|pump|"
        rf"mean|av|idle|inv|axle|trap|sign|tsr|navi|wind|"
        r"inverter|angle|lateral|lat|long|rad s)",
    ),
    _Words(
        Role.WHEEL_SPEEDS,
        rf"({_WHEEL}.*(speed|spd|vel|kph|geschw|drehz)|(speed|spd|vel).*{_WHEEL})",
        r"(motor|inv|rpm|mean|rad s)",
    ),
    _Words(
        Role.ENGINE_POWER,
        r"((motor|engine|eng|inv|drive|wheel|traction|mech|shaft) ?(power|pwr|leistung)|power)",
        r"(steering|heater|aircond|air conditioner|ac|hvac|dcdc|dc dc|charg|brake|window|reactive|supply|"
        r"key|battery|lv|aux|generator|compressor|light|heat|waste|optimal|ideal|consumption|clima|climate)",
    ),
    _Words(
        Role.ENGINE_TORQUE,
        r"((engine|eng|motor|mot|mo|inv|drive|fast|effective|mg)? ?"
        r"(mom(ent)? ?ist( summe)?|istmoment|(torque|trq|tq|moment|drehmoment)"
        r"( ?feedback| ?actual| ?act( out)?| ?estimate| ?est)?))",
        r"(brake|brk|brems\w*|wheel|whl|rad|lenk\w*|friction|loss|lost|lss|verlust\w*|verbraucher|hv|acn|wank|gradient|shudder|reference|converter|regen|adjustment|clutch|"
        r"percent|pct|fraction|stnd|std|4 wd|wd|tqc)",
    ),
    _Words(
        Role.ENGINE_SPEED,
        r"((engine|eng|motor|mot|inv|drive|mg)( ?output)? ?(speed|spd|rpm|n(?![a-z])|rev\w*)|rpm|n ?(mot|eng)|^n$|"
        r"axle ?speed|motordrehzahl|drehzahl)",
        rf"({_WHEEL}|fan|turbine|compressor|pump|idle|output|input|shaft|mean|blower)",
    ),
    _Words(
        Role.TORQUE_FRACTION,
        r"(actual ?eng(ine)? ?percent ?torque|(torque|tq ?i?|trq).*(percent|pct|fraction)|(percent|"
        r"pct).*(torque|trq)|tqi)",
        r"(friction|loss|fractional|reference|retarder|nominal)",
    ),
    _Words(
        Role.FRICTION_FRACTION, r"(friction.*(percent|pct)?.*(torque|tq)|tqfr|tq ?fr)", r"(brake|clutch|coefficient)"
    ),
    _Words(Role.REFERENCE_TORQUE, r"(reference ?torque|torque ?ref(erence)?|tq ?stn?d|tqn)", r"(percent)"),
    _Words(
        Role.BRAKE_SWITCH,
        r"(brake ?(pedal)? ?(switch|pressed|applied|act(ive)?|light ?switch|on|state|lamp|lights|status)|"
        r"brk ?(sw|act|on)|bls|bremse ?betaetigt|bremslicht|(?<![a-z])brake(?![a-z])|"
        r"driver ?brake ?apply)",
        r"(park|pbrake|p brake|epb|hand|pressure|press$|temp|fuse|channel|hold|regen|abs|fluid|pad|wear|"
        r"auto|emergency|aeb|fcw|while|warning|power brake)",
    ),
    _Words(
        Role.BRAKE_PEDAL,
        r"(brake ?(pedal)? ?(position|pos|percent|travel|pct|way)|brk ?ped ?(pos|pct))",
        r"(park|pressure|regen)",
    ),
    _Words(
        Role.GEAR,
        r"(current ?gear|act(ual)? ?gear|gear ?(actual|act|engaged|number|pos)?|trans ?gear|gang)",
        r"(shift|lever|selector|shifter|target|reverse|ratio|steering|knob|display|park)",
    ),
    _Words(
        Role.CLUTCH_SWITCH,
        r"(clutch ?(switch|pedal|pressed|depressed|sw|act)?|kupplung)",
        r"(torque|lock|temp|fan|pressure|air ?cond|ac|slip)",
    ),
    _Words(Role.PARK_BRAKE, r"((park(ing)?|hand|e?p) ?brake|epb|handbremse)", r"(temp|force|clamp|voltage)"),
    _Words(Role.ALTITUDE, r"(altitude|elevation|hoehe|msl)", r"(suspension|chassis|ride|headlight|seat|air ?spring)"),
    _Words(
        Role.GRADE,
        r"(grade|slope|incline|inclination|road ?gradient|steigung)",
        r"(fuel|torque|tq|pressure|colou?r|offset|oil|est\w*)",
    ),
    _Words(
        Role.GRADE_REFERENCE,
        r"((grade|slope|inclination|road ?gradient) ?est\w*|est\w* ?(road ?)?(grade|slope|inclination|gradient))",
        r"(fuel|torque|tq|pressure|internal)",
    ),
    _Words(
        Role.MASS_REFERENCE,
        r"((est\w* )?(vehicle|veh|gross|gross ?vehicle|gross ?combination( ?vehicle)?|total|car|truck)? ?"
        r"(mass|weight)( ?est\w*)?|fahrzeugmasse|(?<![a-z])masse)",
        r"(air|luft|flow|fuel|kraftstoff|soot|ash|axle|seat|occupant|passenger|confidence|cell|gradient|trailer)",
    ),
    _Words(
        Role.LONGITUDINAL_ACCELERATION,
        r"(long(itudinal|it|l)? ?(acc(el(eration)?)?)|accel(eration)? ?(x|long)|acc ?x|ax|laengsbeschl)",
        r"(lat|cruise|pedal|limit)",
    ),
    _Words(
        Role.LATERAL_ACCELERATION,
        r"(lat(eral)? ?(acc(el(eration)?)?)|accel(eration)? ?(y|lat)|acc ?y|querbeschl)",
        r"(long)",
    ),
    _Words(Role.YAW_RATE, r"(yaw ?(rate|rt|vel|speed)?|gierrate)", r"(angle|accel|torque)"),
    _Words(Role.HEADING, r"(heading|compass ?bearing|course|bearing)", r"(error|warning)"),
    _Words(Role.GPS_SPEED, r"((gps|gnss|sat|nav(igation)?).*(speed|velocity|vel))", r"(vertical|up|north|east|down)"),
    _Words(Role.LATITUDE, r"latitude", r"(minutes|direction|hemisphere|north)"),
    _Words(Role.LONGITUDE, r"longitude", r"(minutes|direction|hemisphere|east)"),
    _Words(
        Role.AMBIENT_TEMPERATURE,
        r"((ambient|outside|outdoor|external|exterior|out|amb).*(temp|temperature|tmp|te)|aussentemp)",
        r"(battery|coolant|cabin|seat|cell)",
    ),
    _Words(
        Role.AIR_PRESSURE,
        r"(baro(metric)? ?(pressure|press)?|ambient ?(air)? ?press(ure)?|atmospheric|luftdruck)",
        r"(tire|tyre|boost)",
    ),
    _Words(
        Role.COOLANT_TEMPERATURE,
        r"(coolant ?(temp)?|eng(ine)? ?(coolant|cool)? ?temp(erature)?|kuehlmittel)",
        r"(battery|inverter|heater|cabin|oil)",
    ),
    _Words(Role.FAN_SPEED, r"((radiator|cooling|engine)? ?fan ?(speed|spd|rpm))", r"(cabin|blower|hvac|seat)"),
    _Words(Role.RETARDER_FRACTION, r"(retarder.*(torque|percent)|actual ?retarder)", r"(reference|selection)"),
    _Words(
        Role.BATTERY_VOLTAGE,
        r"((?<![a-z])[uv] ?bat(t(ery)?)?|(hv|lb|pack|traction|trac|bat(t(ery)?)?|dc ?bus|bus|shunt|ivt|bms)"
        r".*(volt(age)?|(?<![a-z])u(?![a-z])|"
        r"(?<![a-z])v(?![a-z]))|dc ?bus ?voltage)",
        r"(cell|12 ?v|lv|lo|ulo|low|aux|motor|phase|charger|sensor|snsr|ref|hist|wave)",
    ),
    _Words(
        Role.BATTERY_CURRENT,
        r"((?<![a-z])i ?bat(t(ery)?)?|(hv|lb|pack|traction|trac|bat(t(ery)?)?|dc ?bus|bus|shunt|ivt|bms)"
        r".*(current|curr|amps?|"
        r"(?<![a-z])i(?![a-z]))|dc ?bus ?current)",
        r"(cell|12 ?v|v ?12|lv|lo|ulo|low|aux|motor|phase|charger|brake|light|channel|fan|pump|snsr|hist|integrated)",
    ),
]


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """Signal that may have a role; ``unit`` is the usual one if the DBC has no known unit."""

    role: Role
    message: Message
    signal: Signal
    score: float
    unit: str | None = None

    @property
    def is_sure(self) -> bool:
        """True if the meaning of its values is known; it may be unknown for a gear or switch with special states."""
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
    """Candidates by role, the best first; only roles with candidates."""
    signals = [
        (message, signal, _Texts.of(message, signal)) for message in database.messages for signal in message.signals
    ]
    out: dict[Role, list[Candidate]] = {}
    for words in _WORDS:
        fit = [candidate for texts in signals if (candidate := _candidate(words, *texts)) is not None]
        fit.sort(key=lambda candidate: -candidate.score)
        if fit:
            out[words.role] = fit[: MAX_CANDIDATES * (4 if words.role == Role.WHEEL_SPEEDS else 1)]
    return out


def corner(signal: Signal) -> str:
    """Wheel in the name of a signal, such as "fl"; empty if there is none."""
    match = re.search(_CORNER, spaced(signal.name))
    return "" if match is None else match[0]


def is_one_of_two(candidate: Candidate, fit: Iterable[Candidate]) -> bool:
    """Whether another candidate has the name of this one, for the other axle."""
    name = _without_digits(candidate.signal)
    others = {name.replace("front", "rear"), name.replace("rear", "front")} - {name}
    return any(_without_digits(other.signal) in others for other in fit)


def _without_digits(signal: Signal) -> str:
    return re.sub(r"\d+", "", spaced(signal.name))


def wheels(fit: Iterable[Candidate]) -> list[Candidate]:
    """Signals of the wheels of one vehicle: those of one message if it has several, else those with similar names."""
    groups: dict[tuple[str, str], dict[str, Candidate]] = {}
    for candidate in fit:
        if wheel := corner(candidate.signal):
            like = re.sub(_CORNER, "", spaced(candidate.signal.name))
            for message in (candidate.message.name, ""):
                groups.setdefault((message, like), {}).setdefault(wheel, candidate)
    best = max(groups.items(), key=lambda item: (len(item[1]), bool(item[0][0])), default=None)
    return [] if best is None else list(best[1].values())


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


def _candidate(words: _Words, message: Message, signal: Signal, texts: _Texts) -> Candidate | None:
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
    if score < MIN_SCORE:
        return None
    return Candidate(role=words.role, message=message, signal=signal, score=score, unit=unit)


def _points(words: _Words, texts: _Texts) -> float:
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
        return -np.inf
    rest = texts.name if in_name is None else texts.name.replace(in_name[0], " ")
    foreign = {*_words_in(f"{words.unlike}|{_COMMAND}", rest), *_words_in(_ELSEWHERE, texts.message)}
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
