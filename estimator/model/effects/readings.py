"""Effects of the instruments: errors of the signals that control units send."""

import numpy as np

from estimator.model.effects.effect import Effect, always, by_mass
from estimator.signals import Quantity
from estimator.units import HOUR

TORQUE_GAIN = Effect(
    name="torque_gain",
    equation="e P",
    source="error of the torque signal, or losses of the driveline",
    symbol="gain error",
    unit="1",
    power=lambda view, shape: view.P,
    usual_magnitude=always(0.05),
    positive=False,
    is_absorbed=True,
    equivalent=("speed_scale",),
    shown_by="a known mass (weigh ticket)",
)

TORQUE_BIAS = Effect(
    name="torque_bias",
    equation="T0 w",
    source="offset of the torque signal, or engine drag that the friction torque leaves out",
    symbol="T0",
    unit="N m",
    power=lambda view, shape: view.context[Quantity.ENGINE_SPEED],
    usual_magnitude=by_mass(50.0),
    max_size=300.0,
    positive=False,
    needs=(Quantity.ENGINE_SPEED,),
    at_rest=lambda rest, shape: rest.engine_speed,
    shown_by="driving the same speed in several gears, or coasting in gear",
)

SENSOR_DRIFT = Effect(
    name="sensor_drift",
    equation="g t P",
    source="a torque signal that drifts as it warms",
    symbol="drift per hour",
    unit="1/h",
    power=lambda view, shape: view.P * view.context[Quantity.ELAPSED] / HOUR,
    usual_magnitude=always(0.08),
    positive=False,
    needs=(Quantity.ELAPSED,),
    is_noisy=True,
    shown_by="the same stretch at the beginning and the end of the drive",
)

SPEED_SCALE = Effect(
    name="speed_scale",
    equation="v -> (1 + e) v",
    source="tyre wear or a wrong rolling radius",
    symbol="scale error",
    unit="1",
    power=lambda view, shape: view.P,
    usual_magnitude=always(0.02),
    positive=False,
    is_absorbed=True,
    equivalent=("torque_gain",),
    shown_by="a distance that is known, as by GPS or from a map",
)

TIME_LAG = Effect(
    name="time_lag",
    equation="P(t - tau) - P(t)",
    source="power and speed reach the bus with different delays",
    symbol="lag of power",
    unit="s",
    power=lambda view, shape: np.zeros_like(view.v),
    usual_magnitude=always(0.2),
    positive=False,
    is_absorbed=True,
    equivalent=("speed_filter",),
    shown_by="both signals from one control unit, at a high rate",
)

SPEED_FILTER = Effect(
    name="speed_filter",
    equation="P(t + tau) - P(t)",
    source="a control unit filters the wheel speed, which delays it",
    symbol="lag of power",
    unit="s",
    power=lambda view, shape: np.zeros_like(view.v),
    usual_magnitude=always(0.2),
    positive=False,
    is_absorbed=True,
    equivalent=("time_lag",),
    shown_by="both signals from one control unit, at a high rate",
)
