"""Parts of the torque that are not bound to a signal; the model then gets an effect for each of them.

Torque as a fraction is *indicated*: the engine's friction is sent separately (SPN 514). Without it, friction of unknown
size acts as road load, in proportion to the turns of the engine per distance. SPN 513 gives whole per cent of torque,
up to 0.875 % too low; SPN 4154 gives the remainder. With these effects, the uncertainty of A and C includes that of the
unbound parts.
"""

from collections.abc import Set

import numpy as np

from estimator.model.effects.effect import Effect, Shape, View, by_mass
from estimator.roles import Role
from estimator.signals import Floats, Quantity

# Share of the friction at TURNS that rises with the engine's speed. C + 48 N / 1000 + 0.4 S^2 [kPa], with C of 75 to
# 110 (Heywood 1988, eq. 13.6, motored Diesel engines), has 0.5 to 0.65 between 600 and 2,000 rpm.
RISES = (0.0, 0.25, 0.5, 0.75, 1.0)
TURNS = 125.0  # rad/s, 1,200 rpm: of a truck's engine that cruises


def _friction(view: View, rise: Shape) -> Floats:
    turns = view.context[Quantity.ENGINE_SPEED]
    power: Floats = turns * (1 - rise + rise * turns / TURNS)
    return power


def _finer_rises(rise: Shape, size: float) -> tuple[Shape, ...]:
    index = int(np.argmin(np.abs(np.array(RISES) - rise)))
    return RISES[max(index - 1, 0) : index + 2]


UNBOUND_FRICTION = Effect(
    name="unbound_friction",
    equation="T w ((1 - r) + r w / 125)",
    source="friction of the engine, which friction_fraction would tell",
    symbol="T at 1,200 rpm",
    unit="N m",
    power=_friction,
    usual_magnitude=by_mass(300.0),
    needs=(Quantity.ENGINE_SPEED,),
    shapes=RISES,
    finer_shapes=_finer_rises,
    describe=lambda rise: f"{100 * rise:.0f} % of it rises with the engine's speed",
    shown_by="friction_fraction (SPN 514 of EEC3)",
)

UNBOUND_FRACTION = Effect(
    name="unbound_fraction",
    equation="T w",
    source="an error of up to a per cent, which torque_fraction_fine would tell",
    symbol="T",
    unit="N m",
    power=lambda view, shape: view.context[Quantity.ENGINE_SPEED],
    usual_magnitude=by_mass(12.0),  # 0.5 % of 2,500 N m
    positive=False,
    needs=(Quantity.ENGINE_SPEED,),
    shown_by="torque_fraction_fine (SPN 4154 of EEC1)",
)

NEARER = {Role.ENGINE_POWER, Role.ENGINE_TORQUE}  # roles that say what reaches the crankshaft
BY_ROLE = {Role.FRICTION_FRACTION: UNBOUND_FRICTION, Role.TORQUE_FRACTION_FINE: UNBOUND_FRACTION}


def unbound(roles: Set[str]) -> dict[Role, Effect]:
    """Effects of the unbound parts of the torque, by the role that would replace them; the largest first."""
    if roles & NEARER or Role.TORQUE_FRACTION not in roles:
        return {}
    return {role: effect for role, effect in BY_ROLE.items() if role not in roles}
