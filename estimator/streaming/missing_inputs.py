"""Advice for a bus that lacks inputs of the model."""

import json
from collections.abc import Collection, Mapping, Sequence, Set

from estimator.can_io.binding import BoundMessage
from estimator.can_io.time_order import divided, finer_unit
from estimator.config import Config
from estimator.settings import SignalPaths, Vehicle
from estimator.signals import Role
from estimator.streaming import engine_power

UNKNOWN = "MESSAGE.signal"
SETTINGS = {  # that do instead of a signal
    Role.REFERENCE_TORQUE: "vehicle.reference_torque_Nm = ... (reference torque of the engine, SPN 544)",
    Role.PARASITIC_FRACTION: "vehicle.subtract_parasitic_losses = false",
}
SLOWEST = 1.0  # s, between readings of speed or power on a bus


def needed(vehicle: Vehicle, bound: Set[Role]) -> list[Role]:
    """Roles that speed and power are computed from, given those that are ``bound``."""
    return [_speed(bound), *engine_power.needed(vehicle, bound)]


def listed(missing: Collection[Role], names: Mapping[Role, str], config: Config) -> str:
    """The ``missing`` roles, by the ``names`` of their signals where bound; a bus may have the speeds of wheels too."""
    others = {} if config.table is not None else {Role.SPEED: f"{Role.SPEED} or {Role.WHEEL_SPEEDS}"}
    return ", ".join(names.get(role) or others.get(role, role.value) for role in missing)


def unbound(config: Config, bound: Set[Role]) -> str:
    """Sentence that names the needed roles that are not ``bound``, and the remedy; empty if none is missing."""
    missing = [role for role in needed(config.vehicle, bound) if role not in bound]
    return f"no signal for {listed(missing, {}, config)}; {remedy(missing, bound, config.binding)}" if missing else ""


def remedy(missing: Collection[Role], seen: Collection[Role], binding: Mapping[str, SignalPaths]) -> str:
    """Advice which lines of the configuration replace the ``missing`` roles, or bind them to other signals.

    Parameters
    ----------
    missing, seen
        Needed roles without a reading, and roles with readings.
    binding
        Signals by role, as configured.
    """
    signals = [role for role in missing if role not in SETTINGS]
    chosen = _shortest(seen) if signals else list(missing)
    lines = [SETTINGS[role] for role in missing if role in SETTINGS and _is_needed(role, chosen)]
    if signals:
        table = ", ".join(f"{role} = {_bound(role, seen, binding)}" for role in chosen)
        lines.append(
            f"signals = {{{table}}} and other roles that the bus has (roadload check --print-config lists all)"
        )
    note = f", {UNKNOWN} as in your DBC (--dbc FILE.dbc)" if UNKNOWN in lines[-1] else ""
    note += ", where friction counts as road load" if signals == [Role.FRICTION_FRACTION] else ""
    return f"start the configuration (--config FILE.toml) with {' and '.join(lines)}{note}"


def advice(
    missing: Collection[Role], seen: Collection[Role], messages: Sequence[BoundMessage], answers: int, config: Config
) -> str:
    """Advice on the ``missing`` roles of a log or bus.

    Parameters
    ----------
    missing, seen
        Needed roles without a reading, and roles with readings.
    messages
        Messages that the configuration binds.
    answers
        Number of frames that answer OBD-II requests, while no bound message came.
    config
        All settings.
    """
    if pids := _pids_of(missing, messages):
        return f"the logger has to ask for PID {', '.join(pids)}"
    if answers:
        return f"{answers:,} frames are answers to OBD-II requests: give --config obd2"
    if config.table is not None:
        return _advice_on_columns(missing)
    if not seen and not config.signals:
        return (
            "if the vehicle does not speak J1939, roadload init FILE.dbc LOG -o FILE.toml proposes a configuration "
            "from its DBC; give that as --config FILE.toml"
        )
    return remedy(missing, seen, config.binding)


def _advice_on_columns(missing: Collection[Role]) -> str:
    """Advice on the ``missing`` roles of a table, some of which are constants of the vehicle."""
    columns = 'give them columns with numbers, as in --map speed="COLUMN [km/h]" --map power="COLUMN [kW]"'
    settings = [SETTINGS[role] for role in missing if role in SETTINGS]
    if not settings:
        return columns
    constants = f"start the configuration (--config FILE.toml) with {' and '.join(settings)}"
    return constants if len(settings) == len(missing) else f"{constants}; {columns.replace('them', 'the others')}"


def _pids_of(missing: Collection[Role], messages: Sequence[BoundMessage]) -> list[str]:
    """PIDs of missing roles that an ECU sends on request."""
    asked = [bound for message in messages if message.of_any_ecu for bound in message.signals if bound.role in missing]
    return [f"0x{pid:02X}" for bound in asked for pid in bound.signal.multiplexer_ids or ()]


def _is_needed(role: Role, chosen: list[Role]) -> bool:
    """True if a setting must replace ``role`` where the ``chosen`` roles are bound."""
    return role in chosen or Role.TORQUE_FRACTION in chosen


def _shortest(seen: Collection[Role]) -> list[Role]:
    """Smallest set of roles that speed and power follow from; roles ``seen`` are preferred."""
    speed = _speed(seen)
    if Role.TORQUE_FRACTION in seen and Role.ENGINE_SPEED in seen:
        reference = [Role.REFERENCE_TORQUE] if Role.REFERENCE_TORQUE in seen else []
        return [speed, Role.TORQUE_FRACTION, Role.ENGINE_SPEED, *reference]
    if Role.ENGINE_TORQUE in seen or Role.ENGINE_SPEED in seen:
        return [speed, Role.ENGINE_TORQUE, Role.ENGINE_SPEED]
    return [speed, Role.ENGINE_POWER]


def _speed(roles: Collection[Role]) -> Role:
    """The speed that is used of some ``roles``, or would be."""
    return Role.WHEEL_SPEEDS if Role.WHEEL_SPEEDS in roles and Role.SPEED not in roles else Role.SPEED


def _bound(role: Role, seen: Collection[Role], binding: Mapping[str, SignalPaths]) -> str:
    path = binding.get(role, UNKNOWN) if role in seen else UNKNOWN
    return json.dumps(path)  # a string or list of strings of TOML too


def too_seldom(name: str, interval: float, most: float) -> str:
    """Sentence on a signal whose ``interval`` exceeds ``most`` [s], with a unit of time that would fit; else empty."""
    if interval <= most:
        return ""
    unit = finer_unit(interval, SLOWEST)
    change = divided(unit) if unit else "record it faster"
    return (
        f"{name} comes every {interval:.3g} s, too seldom to see how it changes (every {most:g} s at least); {change}"
    )
