"""Make the terms of stretches of a hidden road that are steeper than the rest: neither effects nor processes.

The slopes of the road model are a Gaussian process of one sd. Real roads are nearly level for kilometres, and steep on
a bridge or a hill. On seven trips of a car whose accelerometer shows the slopes, their kurtosis is 2.5 to 8; that of
the process is 3. A load or a brake that switches would then explain the ends of a steep stretch better than the
process. The times at which an effect may act are therefore candidates for stretches too, each with its own slope. A
switching load differs from them by equal power in all its times, at all speeds. A brake differs because its force
changes at once, while the slope under a vehicle changes over a vertical curve and the wheelbase.
"""

from collections.abc import Iterator

import numpy as np

from estimator.components.term import Frame, Term
from estimator.components.time_prior import MAX_ON_SHARE, cost_apart
from estimator.model.effects.effect import Effect, Timing, always
from estimator.model.spans import Spans, covered
from estimator.signals import Floats
from estimator.strides import DURATION
from estimator.units import STANDARD_GRAVITY

LOG_ODDS = 1.4  # prior, of any stretches against none: 22 of 27 trips of that car have some
CHANGE_LENGTH = 10.0  # m over which the slope felt changes at least: 5 m between a truck's axles, and a curve besides
SLOPE_SD = 0.02  # of the prior of the slope of a stretch, over that of the process
STEEPEST = 0.15  # sine: public roads are hardly steeper

# What they are to the search for times: a force in proportion to the mass, of either sign.
STRETCHES = Effect(
    name="steep stretches of the road",
    equation="m g v sin(th) on [t1, t2] ...",
    source="component of gravity along the road",
    symbol="slope",
    unit="1",
    power=lambda view, shape: view.m * STANDARD_GRAVITY * view.v,
    usual_magnitude=always(SLOPE_SD),
    positive=False,
    timing=Timing.SWITCHING,
    dwell_times=(12.0, 60.0, 200.0),  # as brakes and loads have: the same times are as likely for either
)


def stretches(frame: Frame, spans: Spans) -> Iterator[Term]:
    """Term with one additional slope of the road in each of ``spans``.

    There is none if they cover more than MAX_ON_SHARE of the drive, because A includes a constant slope, or if one of
    them covers no stride.
    """
    on = [covered(frame.strides.t, DURATION, (span,)).mean() for span in spans]
    if not on or min(on) == 0.0 or sum(on) > MAX_ON_SHARE:
        return

    def columns(frame: Frame) -> Floats:
        felt = np.maximum(CHANGE_LENGTH / frame.strides.speed, DURATION)
        on = np.column_stack([covered(frame.strides.t, felt, (span,)) for span in spans])
        return -STANDARD_GRAVITY * on

    yield Term(
        name=STRETCHES.name,
        columns=columns,
        sd=SLOPE_SD,
        max_size=STEEPEST,
        cost=cost_apart(spans, STRETCHES.dwell_times, frame.strides.t),
        is_slope=True,
        spans=spans,
    )
