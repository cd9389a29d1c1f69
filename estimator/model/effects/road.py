"""Effects between the vehicle and the road: gravity, load, tyres and brakes."""

from estimator.model.effects.cold import cold_by_speed, excess, excesses, finer_excesses, told_excess
from estimator.model.effects.effect import Effect, Shape, Timing, View, always, by_mass
from estimator.roles import PAST_SPEEDS
from estimator.signals import Floats, Quantity
from estimator.units import STANDARD_GRAVITY

TYRE_TIMES = tuple(60.0 * minutes for minutes in (10, 16, 25, 40, 60, 80))  # s


def _climbing(view: View, source: Shape) -> Floats:
    climb: Floats = STANDARD_GRAVITY * view.context[source]
    return climb


GRADE = Effect(
    name="grade",
    equation="m g v sin(th)",
    source="component of gravity along the road",
    symbol="mass on slopes",
    unit="kg",
    power=_climbing,
    usual_magnitude=lambda road_load: 2.0 * float(road_load[2]),
    shapes=(Quantity.CLIMB_BY_GRADE, Quantity.CLIMB_BY_ALTITUDE, Quantity.CLIMB_BY_ACCELEROMETER),
    is_gravity=True,
    is_noisy=True,
    shown_by="altitude, grade or an inertial accelerometer on the bus",
)

MASS_STEP = Effect(
    name="mass_step",
    equation="dm (A + m dv/dt + m g sin(th)) v after a standstill",
    source="load taken on or off",
    symbol="share of the mass",
    unit="1",
    power=lambda view, shape: (view.A + view.m * view.a) * view.v,
    usual_magnitude=always(0.3),
    max_size=3.0,  # three quarters of the mass taken off
    max_positive_size=0.75,  # three times the mass taken on
    positive=False,
    timing=Timing.STEP,
    is_noisy=True,
    magnitude_from_coefficient=lambda share: share / (1 - share),
    shown_by="accelerations after the stop, or axle loads on the bus",
)

WARM_UP = Effect(
    name="warm_up",
    equation="A al (exp(k x) - 1) / (exp(k) - 1) v, x = 1 - v_tau / 80 km/h",
    source="rolling resistance falls as tyres warm (ISO 28580; Nielsen and Sandberg, SAE 2002-01-1200)",
    symbol="cold excess of A",
    unit="1",
    power=lambda view, shape: view.A * view.v * excess(cold_by_speed(view, shape[0]), shape[1]),
    usual_magnitude=always(0.25),
    needs=tuple(PAST_SPEEDS),
    shapes=excesses(TYRE_TIMES),
    finer_shapes=finer_excesses,
    describe=told_excess,
    shown_by="a drive that starts with warm tyres",
)

RESISTANCE_SEGMENT = Effect(
    name="resistance_segment",
    equation="dA v on [t1, t2]",
    source="wet road, dragging brake, soft tyre",
    symbol="share of A",
    unit="1",
    power=lambda view, shape: view.A * view.v,
    usual_magnitude=always(0.25),
    timing=Timing.WINDOW,
    shown_by="a change of speed inside the window",
)

CORNERING = Effect(
    name="cornering",
    equation="k v ay^2",
    source="induced drag of tyres under side force",
    symbol="k",
    unit="N s^4/m^2",
    power=lambda view, shape: view.v * view.context[Quantity.LATERAL_ACCELERATION] ** 2,
    usual_magnitude=by_mass(600.0),
    max_size=4e3,
    needs=(Quantity.LATERAL_ACCELERATION,),
    shown_by="yaw rate or lateral acceleration on the bus, and bends taken without braking",
)

BRAKE_USE = Effect(
    name="brake_use",
    equation="F v u(t) while the engine pulls",
    source="a service brake that drags, or is held against the engine",
    symbol="brake force",
    unit="N",
    power=lambda view, shape: view.v,
    usual_magnitude=by_mass(4e3),
    max_size=20e3,
    timing=Timing.SWITCHING,
    dwell_times=(12.0,),
    shown_by="brake switch or brake pressure on the bus",
)
