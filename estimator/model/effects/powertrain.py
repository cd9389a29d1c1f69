"""Effects between the engine and the wheels: losses, inertia and auxiliary consumers."""

import numpy as np

from estimator.model.effects.cold import (
    WARM_SPEED,
    cold_by_speed,
    cold_by_time,
    excess,
    excesses,
    finer_excesses,
    finer_times,
    told_excess,
    told_time,
)
from estimator.model.effects.effect import TYPICAL_MASS, Effect, Shape, Timing, View, always, by_mass
from estimator.roles import PAST_SPEEDS
from estimator.signals import Floats, Quantity

GEAR_TIMES = tuple(60.0 * minutes for minutes in (6, 10, 16, 25, 40))  # s
OIL_TIMES = tuple(60.0 * minutes for minutes in (10, 16, 25, 40, 60))  # s
CHURNED = (0.5, 1.0)  # share of the drag of oil at WARM_SPEED that rises with the speed; tyres have none
COLD_OILS = tuple((*cooled, churned) for cooled in excesses(OIL_TIMES) for churned in CHURNED)
FAN_EXPONENT = 3  # power of a fan over its speed
FAN_SPEED = 220.0  # rad/s, 2,100 1/min: of a truck's fan that runs, at which its power is given


def _fan(view: View, source: Shape) -> Floats:
    if source is None:
        return np.ones_like(view.v)
    power: Floats = (view.context[source] / FAN_SPEED) ** FAN_EXPONENT
    return power


def _cold_oil(view: View, oil: Shape) -> Floats:
    """Power [W] (n,) per 1 N s/m of drag over speed, at WARM_SPEED with cold oil."""
    time, steepness, churned = oil
    drag: Floats = view.v * ((1 - churned) * WARM_SPEED + churned * view.v)
    return drag * excess(cold_by_speed(view, time), steepness)


def _finer_oils(oil: Shape, size: float) -> tuple[Shape, ...]:
    time, steepness, churned = oil
    return tuple((*near, churned) for near in finer_excesses((time, steepness), size))


def _crank(view: View) -> Floats:
    """Inertia [kg] (n,) that the vehicle feels per 1 kg m^2 on the crankshaft."""
    inertia: Floats = (view.context[Quantity.ENGINE_SPEED] / view.v) ** 2
    return inertia


VISCOUS_DRAG = Effect(
    name="viscous_drag",
    equation="B v^2",
    source="churning of oil in axles and gearbox",
    symbol="B",
    unit="N s/m",
    power=lambda view, shape: view.v**2,
    usual_magnitude=lambda road_load: 0.5 * float(road_load[0]) / 20.0,
    alike_unseen=("headwind",),  # C ((v + w)^2 - v^2) v = 2 C w v^2 + C w^2 v, if it blows from ahead all the time
    shown_by="a coast-down over a wide range of speed, or A from a data sheet",
)

OIL_WARM_UP = Effect(
    name="oil_warm_up",
    equation="B v ((1 - s) v_w + s v) (exp(k x) - 1) / (exp(k) - 1), x = 1 - v_tau / v_w, v_w = 80 km/h",
    source="cold oil in axles, gearbox, seals and bearings",
    symbol="B when cold",
    unit="N s/m",
    power=_cold_oil,
    usual_magnitude=lambda road_load: 0.25 * float(road_load[0]) / 20.0,
    needs=tuple(PAST_SPEEDS),
    shapes=COLD_OILS,
    finer_shapes=_finer_oils,
    describe=told_excess,
    shown_by="a drive that starts with warm oil",
)

COLD_LOSS = Effect(
    name="cold_loss",
    equation="e abs(P) exp(-t / tau)",
    source="cold gears and tyres lose a share of what they transmit",
    symbol="share lost when cold",
    unit="1",
    power=lambda view, time: np.abs(view.P) * cold_by_time(view, time),
    usual_magnitude=always(0.05),
    needs=(Quantity.ELAPSED,),
    shapes=GEAR_TIMES,
    finer_shapes=finer_times,
    describe=told_time,
    is_noisy=True,
    shown_by="a drive that starts with a warm driveline",
)

LOAD_LOSS = Effect(
    name="load_loss",
    equation="k F^2 v",
    source="tyre slip and gear mesh, in proportion to the square of the force",
    symbol="k",
    unit="1/N",
    power=lambda view, shape: view.P**2 / view.v,
    usual_magnitude=lambda road_load: 1e-6 * TYPICAL_MASS / float(road_load[2]),
    is_noisy=True,
    shown_by="the speed of a wheel that is not driven",
)

AUXILIARY_LOAD = Effect(
    name="auxiliary_load",
    equation="P0",
    source="alternator, steering pump, compressor, air conditioning",
    symbol="P0",
    unit="W",
    power=lambda view, shape: np.ones_like(view.v),
    usual_magnitude=by_mass(8e3),
    max_size=40e3,
    at_rest=lambda rest, shape: 1.0,
    shown_by="two minutes of idling at rest",
)

AUXILIARY_CYCLING = Effect(
    name="auxiliary_cycling",
    equation="Pf u(t), or Pf (w / 220)^3 with the speed w of the fan [rad/s]",
    source="engine fan or air compressor, switched by temperature or pressure",
    symbol="Pf",
    unit="W",
    power=_fan,
    usual_magnitude=by_mass(25e3),
    max_size=65e3,
    shapes=(Quantity.FAN_SPEED, None),
    timing=Timing.SWITCHING,
    dwell_times=(200.0, 25.0),
    shown_by="the state of the fan on the bus",
)

ROTATING_INERTIA = Effect(
    name="rotating_inertia",
    equation="J (w / v)^2 v a",
    source="kinetic energy of engine and flywheel",
    symbol="J",
    unit="kg m^2",
    power=lambda view, shape: _crank(view) * view.a * view.v,
    inertia=_crank,
    usual_magnitude=by_mass(3.0),
    max_size=10.0,
    needs=(Quantity.ENGINE_SPEED,),
    is_noisy=True,
    shown_by="accelerations in low gears",
)
