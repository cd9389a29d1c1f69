"""Warnings of a wider or biased estimate: torque that is not bound, power of a battery, wheels that contradict."""

from collections.abc import Mapping

from estimator.can_io.binding import load_database
from estimator.config import Config
from estimator.model.effects import unbound
from estimator.roles import is_electric
from estimator.signals import Role
from estimator.streaming.wheels import DIFFERS, STANDS_STILL, UNDECIDED

SPNS = {Role.FRICTION_FRACTION: 514, Role.TORQUE_FRACTION_FINE: 4154}  # J1939-71
CONSUMERS = frozenset({"auxiliary_load", "cabin_heater"})  # effects that are fed by the battery
WHEELS = (STANDS_STILL, DIFFERS, UNDECIDED)


def warnings_of(config: Config, errors: Mapping[str, int]) -> tuple[str, ...]:
    """The warnings of an estimate with this configuration and counts of what was refused, in one line each.

    Raises
    ------
    DatabaseError
        A database cannot be read.
    """
    return (
        *_unbound(config),
        *_of_the_battery(config),
        *(f"{what}, in {rows:,} rows" for what, rows in errors.items() if what.endswith(WHEELS)),
    )


def _unbound(config: Config) -> tuple[str, ...]:
    """Each part of the torque that is not bound, with the line that binds it where the database has it."""
    lacking = unbound(config.binding.keys())
    if not lacking:
        return ()
    advice = _advice_on_a_bus(config) if config.table is None else _advice_on_a_table()
    return tuple(
        f"{role} is not bound: the torque contains {effect.source.split(',')[0]}, whose size ({effect.name}) is "
        f"estimated beside A and C and widens them; {advice[role]}"
        for role, effect in lacking.items()
    )


def _advice_on_a_bus(config: Config) -> dict[Role, str]:
    """Advice on each part of the torque, with its signal where the database has it."""
    found = {
        signal.spn: f"{message.name}.{signal.name}"
        for message in load_database(config.bus.dbc).messages
        for signal in message.signals
        if signal.spn in SPNS.values()
    }
    return {
        role: f'in [signals] write {role} = "{found[spn]}" if the bus carries it'
        if spn in found
        else f"bind it where the bus has it (SPN {spn} of J1939)"
        for role, spn in SPNS.items()
    }


def _advice_on_a_table() -> dict[Role, str]:
    """Advice on each part of the torque, with the option that names a column."""
    return {role: f'if the table has a column of it, add --map {role}="COLUMN [%]"' for role in SPNS}


def _of_the_battery(config: Config) -> tuple[str, ...]:
    """Advice where the power of a battery is taken for that at the wheels: neither losses nor consumers are given."""
    is_given = config.vehicle.driveline_efficiency < 1 or CONSUMERS & set(config.effects)
    if is_given or not is_electric(config.binding.keys()):
        return ()
    return (
        "the power is that of the battery: losses up to the wheels and consumers such as lights make mass and A too "
        'large; write [vehicle] driveline_efficiency = 0.9, or what is known of it, and effects = ["auxiliary_load"]',
    )
