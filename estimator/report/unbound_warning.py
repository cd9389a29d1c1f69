"""A warning for each part of the torque that is not bound, with the line that binds it where the database has it."""

from estimator.can_io.binding import load_database
from estimator.config import Config
from estimator.model.effects import unbound
from estimator.signals import Role

SPNS = {Role.FRICTION_FRACTION: 514, Role.TORQUE_FRACTION_FINE: 4154}  # J1939-71


def warnings_of(config: Config) -> tuple[str, ...]:
    """The warnings of an estimate with this configuration, in one line each.

    Raises
    ------
    DatabaseError
        A database cannot be read.
    """
    lacking = unbound(config.binding.keys())
    if not lacking:
        return ()
    found = {
        signal.spn: f'in [signals] write {role} = "{message.name}.{signal.name}" if the bus carries it'
        for message in load_database(config.bus.dbc).messages
        for signal in message.signals
        for role, spn in SPNS.items()
        if signal.spn == spn
    }
    return tuple(
        f"{role} is not bound: the torque contains {effect.source.split(',')[0]}, whose size ({effect.name}) is "
        "estimated beside A and C and widens them; "
        + found.get(SPNS[role], f"bind it where the bus has it (SPN {SPNS[role]} of J1939)")
        for role, effect in lacking.items()
    )
