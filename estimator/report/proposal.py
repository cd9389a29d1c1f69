"""A configuration for a database, proposed: commented TOML text with the candidates of each role."""

import json
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path

from estimator.can_io.role_candidates import LEAST_REACH, MENTIONED, Candidate, corner, is_one_of_two, wheels
from estimator.can_io.switch_states import SWITCHES
from estimator.report import usual_units
from estimator.signals import DIMENSION, STATE, Role
from estimator.streaming.survey import Presence, Survey

LIGHT_VEHICLE = """[prior]  # boxes of a car or van; leave them out for a truck
mass_kg = [300, 5000]
A_N = [0, 1000]
C_N_s2_m2 = [0, 3]

[gate]
acceleration_step_m_s2 = 0.25  # a car accelerates more than a truck
relative_sd = [1.0, 3.0, 0.1]  # largest sd of A, C and mass
"""
POWER_WAYS: Sequence[tuple[Role, ...]] = (
    (Role.ENGINE_POWER,),
    (Role.ENGINE_TORQUE, Role.ENGINE_SPEED),
    (Role.TORQUE_FRACTION, Role.ENGINE_SPEED, Role.REFERENCE_TORQUE),
    (Role.BATTERY_VOLTAGE, Role.BATTERY_CURRENT),
)
OF_POWER = {role for way in POWER_WAYS for role in way} | {
    Role.TORQUE_FRACTION_FINE,
    Role.FRICTION_FRACTION,
    Role.PARASITIC_FRACTION,
}
DISCHARGE = {  # sign of the battery current while it drives
    "positive": "by the log: above 0 where the vehicle speeds up",
    "negative": "by the log: below 0 where the vehicle speeds up",
    None: 'no log shows it: "negative" if the current is below 0 while the vehicle drives',
}
GOOD = 4.5  # score of a candidate that power may be had from
SHOWN = 4  # candidates of a role
ON_THE_BUS, ALIVE = 3.0, 2.0  # points
SMALL = 3.0  # points that a guess loses whose values are those of something smaller, such as a battery of 12 V


def proposal(
    databases: Sequence[Path], candidates: Mapping[Role, Sequence[Candidate]], found: Survey | None, log: Path | None
) -> str:
    """TOML text; ``found`` says which candidates are in the ``log``, if one was given."""
    ranked = {role: _ranked(fit, found) for role, fit in candidates.items()}
    bound = _bound(ranked, found)
    lines = [
        "# Proposed by roadload init from names, units and sizes in the database. Look at each signal; then run",
        f"# roadload check {log or 'LOG'} --config FILE.toml with this file, then roadload estimate likewise.",
        "",
        "[bus]",
        f"dbc = [{', '.join(json.dumps(str(path.resolve()), ensure_ascii=False) for path in databases)}]",
        *_bus(bound, found),
        "",
        "[signals]",
    ]
    for need, roles in (
        ("speed", (Role.SPEED, Role.WHEEL_SPEEDS)),
        ("power", tuple(role for role in Role if role in OF_POWER)),
    ):
        if not any(role in bound for role in roles):
            lines.append(f"# No signal was found for {need}: write {' or '.join(_ways(need))} here.")
            lines += _guesses([role for role in roles if role in ranked and ranked[role][0].is_guess], ranked, found)
    for role in Role:
        if role in ranked and not ranked[role][0].is_guess:
            lines += _role(role, ranked[role], bound.get(role, []), found)
    is_truck = any(candidate.message.protocol == "j1939" for fit in bound.values() for candidate in fit)
    return "\n".join(lines) + "\n" + ("" if is_truck else f"\n{LIGHT_VEHICLE}")


def _guesses(roles: Sequence[Role], ranked: Mapping[Role, list[Candidate]], found: Survey | None) -> list[str]:
    """Comments with the signals whose unit alone speaks for ``roles``."""
    lines = [line for role in roles for line in _role(role, ranked[role], [], found)]
    return ["# By its unit it may be:", *lines] if lines else []


def battery(sign: str | None) -> str:
    """TOML text of the ``sign`` of a battery current, None where it is not known."""
    return f'\n[vehicle]\ndischarge_current = "{sign or "positive"}"  # {DISCHARGE[sign]}\n'


def _ways(need: str) -> list[str]:
    if need == "speed":
        return ["speed", "wheel_speeds"]
    return [" and ".join(way) for way in POWER_WAYS]


def _ranked(fit: Sequence[Candidate], found: Survey | None) -> list[Candidate]:
    """The best first: what is on the bus and changes before what is not."""
    return sorted(fit, key=lambda candidate: -_score(candidate, found))


def _score(candidate: Candidate, found: Survey | None) -> float:
    there = None if found is None else found.presences.get(candidate.path)
    if there is None:
        return candidate.score
    is_small = candidate.is_guess and max(-there.minimum, there.maximum) < LEAST_REACH[candidate.role]
    alive = ALIVE * (there.is_alive or candidate.role in SWITCHES) - SMALL * is_small
    return candidate.score + ON_THE_BUS + alive + min(there.rate, 10) / 10


def _bound(ranked: Mapping[Role, list[Candidate]], found: Survey | None) -> dict[Role, list[Candidate]]:
    """The candidates that are proposed: one way to speed, one to power, and what else is there."""
    there = {role: [c for c in fit if c.is_sure and _is_there(c, found)] for role, fit in ranked.items()}
    best = {role: fit[:1] for role, fit in there.items() if fit}
    if Role.WHEEL_SPEEDS in best:
        best[Role.WHEEL_SPEEDS] = wheels(there[Role.WHEEL_SPEEDS]) or best[Role.WHEEL_SPEEDS]
    if Role.SPEED in best and Role.WHEEL_SPEEDS in best:
        speed, wheel = best[Role.SPEED][0], best[Role.WHEEL_SPEEDS][0]
        del best[Role.WHEEL_SPEEDS if _score(speed, found) >= _score(wheel, found) - 1.0 else Role.SPEED]
    for role in OF_POWER & best.keys():
        if is_one_of_two(best[role][0], ranked[role]):
            del best[role]  # a half of the power
    whole = [way for way in POWER_WAYS if set(way) <= best.keys()]
    ways = [way for way in whole if all(best[role][0].score >= GOOD for role in way)] + whole
    almost = [way[:2] for way in POWER_WAYS if way[-1] == Role.REFERENCE_TORQUE and set(way[:2]) <= best.keys()]
    chosen = next(iter([*ways, *almost]), ())
    if len(chosen) > 1:
        best |= _together(chosen[:2], there, found)
    extra = {Role.FRICTION_FRACTION, Role.TORQUE_FRACTION_FINE} if Role.TORQUE_FRACTION in chosen else set()
    return {role: fit for role, fit in best.items() if role not in OF_POWER or role in {*chosen, *extra}}


def _together(
    roles: Sequence[Role], there: Mapping[Role, list[Candidate]], found: Survey | None
) -> dict[Role, list[Candidate]]:
    """The best of two roles whose product is the power: those of one message count as said by it."""

    def score(pair: tuple[Candidate, ...]) -> float:
        is_one_message = pair[0].message is pair[1].message
        return sum(_score(candidate, found) for candidate in pair) + MENTIONED * is_one_message

    best = max(product(*(there[role] for role in roles)), key=score)
    return {role: [candidate] for role, candidate in zip(roles, best, strict=True)}


def _is_there(candidate: Candidate, found: Survey | None) -> bool:
    if found is None:
        return True
    there = found.presences.get(candidate.path)
    return there is not None and there.known > 0 and (there.is_alive or _is_steady(candidate.role))


def _is_steady(role: Role) -> bool:
    """Whether a signal of the role need not change within a drive."""
    return DIMENSION[role] == STATE or role == Role.REFERENCE_TORQUE


def _bus(bound: Mapping[Role, list[Candidate]], found: Survey | None) -> list[str]:
    lines = []
    if found is not None and found.is_by_group:
        lines.append('match = "pgn"  # the log has the parameter groups of the DBC from other addresses: it is J1939')
    units = {
        candidate.path: candidate.unit for fit in bound.values() for candidate in fit if candidate.unit is not None
    }
    if units:
        table = ", ".join(
            f"{json.dumps(path)} = {json.dumps(unit, ensure_ascii=False)}" for path, unit in units.items()
        )
        lines.append(f"units = {{ {table} }}  # guessed: the DBC has none that is known; correct them")
    return lines


def _role(role: Role, ranked: list[Candidate], bound: list[Candidate], found: Survey | None) -> list[str]:
    """The line of a role, and comments with its other candidates."""
    lines = []
    if bound and role == Role.WHEEL_SPEEDS:
        paths = ", ".join(json.dumps(candidate.path) for candidate in bound)
        lines.append(f"{role} = [{paths}]{_about(bound[0], found)}")
    elif bound:
        lines.append(f"{role} = {json.dumps(bound[0].path)}{_about(bound[0], found)}")
    others = [candidate for candidate in ranked if candidate not in bound]
    if role == Role.WHEEL_SPEEDS and bound:
        others = [candidate for candidate in others if corner(candidate.signal) == corner(bound[0].signal)]
    for candidate in others[: SHOWN - bool(bound)]:
        lines.append(f"# {role} = {json.dumps(candidate.path)}{_about(candidate, found)}")
    return lines


def _about(candidate: Candidate, found: Survey | None) -> str:
    """A comment with unit, presence and comment of a signal; empty where there is nothing to say."""
    signal = candidate.signal
    parts = [signal.unit or ("" if DIMENSION[candidate.role] == STATE else "no unit")]
    if signal.choices:
        parts.append(", ".join(f"{value} {text}" for value, text in list(signal.choices.items())[:4]))
    if found is not None:
        there = found.presences.get(candidate.path)
        parts.append("not in the log" if there is None else _presence(there, candidate.role))
    if signal.comment:
        parts.append(" ".join(signal.comment.split())[:80])
    text = "; ".join(filter(None, parts)).replace("\n", " ")
    printed = "".join(letter for letter in text if letter.isprintable())
    return f"  # {printed}" if printed else ""


def _presence(there: Presence, role: Role) -> str:
    rate = f"{there.rate:.3g} Hz"
    if not there.known:
        return f"{rate}, never valid"
    span = usual_units.between(role, there.minimum, there.maximum)
    return f"{rate}, {span}{'' if there.is_alive else ', hardly changes'}"
