"""Effects of the instruments: errors of the reports of the control units, without effect on the motion."""

from dataclasses import replace
from math import pi

import numpy as np

from estimator.preparation.recursion import low_passed
from estimator.signals import Floats
from estimator.simulation.effects.effect import Effect
from estimator.simulation.moment import STEP, Action, Reading, Scene


def torque_gain(scene: Scene, effect: Effect) -> Action:
    """Torque is reported too high by a share."""
    return Action(reading=lambda read: replace(read, torque=(1.0 + effect.magnitude) * read.torque))


def torque_bias(scene: Scene, effect: Effect) -> Action:
    """Torque is reported too high by an offset [N.m]."""
    return Action(reading=lambda read: replace(read, torque=read.torque + effect.magnitude))


def sensor_drift(scene: Scene, effect: Effect) -> Action:
    """Gain of the reported torque grows steadily, to a share at the end of the drive."""
    gain = effect.magnitude / scene.duration
    return Action(reading=lambda read: replace(read, torque=read.torque * (1.0 + gain * read.t)))


def gain_walk(scene: Scene, effect: Effect) -> Action:
    """Gain of the reported torque is a random walk, with a standard deviation over the drive."""
    seconds = int(scene.duration) + 2
    walk = np.cumsum(scene.rng.normal(0.0, effect.magnitude / np.sqrt(seconds), seconds))

    def reading(read: Reading) -> Reading:
        return replace(read, torque=read.torque * (1.0 + np.interp(read.t, np.arange(seconds), walk)))

    return Action(reading=reading)


def torque_ripple(scene: Scene, effect: Effect) -> Action:
    """Torque error that oscillates in time [N.m]."""
    period, phase = scene.rng.uniform(30.0, 180.0), scene.rng.uniform(0.0, 2 * pi)

    def reading(read: Reading) -> Reading:
        return replace(read, torque=read.torque + effect.magnitude * np.sin(2 * pi * read.t / period + phase))

    return Action(reading=reading)


def torque_saturation(scene: Scene, effect: Effect) -> Action:
    """Torque is reported too low by a share at full load, with the cube of the torque."""
    full = scene.truck.peak_torque

    def reading(read: Reading) -> Reading:
        return replace(read, torque=read.torque * (1.0 - effect.magnitude * (read.torque / full) ** 2))

    return Action(reading=reading)


def time_lag(scene: Scene, effect: Effect) -> Action:
    """Torque and engine speed are sent late [s]."""

    def reading(read: Reading) -> Reading:
        torque, engine_speed = (_late(read.t, x, effect.magnitude) for x in (read.torque, read.engine_speed))
        return replace(read, torque=torque, engine_speed=engine_speed)

    return Action(reading=reading)


def _late(t: Floats, value: Floats, lag: float) -> Floats:
    late: Floats = np.interp(t - lag, t, value)
    return late


def speed_filter(scene: Scene, effect: Effect) -> Action:
    """Wheel speed is filtered by a first-order low-pass in the brakes' control unit, time constant [s]."""

    def reading(read: Reading) -> Reading:
        v = low_passed(read.v, 0.0, STEP, effect.magnitude)
        return replace(read, v=v, a=(read.v - v) / effect.magnitude)

    return Action(reading=reading)


def speed_scale(scene: Scene, effect: Effect) -> Action:
    """Wheel speed is too high by a share, with worn tyres."""
    scale = 1.0 + effect.magnitude
    return Action(reading=lambda read: replace(read, v=scale * read.v, a=scale * read.a))


def quantisation(scene: Scene, effect: Effect) -> Action:
    """Torque is reported in steps of a share of the reference torque."""
    step = effect.magnitude * scene.truck.reference_torque
    return Action(reading=lambda read: replace(read, torque_step=step))
