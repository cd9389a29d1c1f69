"""The streaming estimator: rows in, an estimate at regular intervals of message time.

It owns the window and nothing else that moves: no clock, no bus, no thread. Fed the same rows it concludes the same.
"""

from collections import Counter
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np

from estimator.config import Config
from estimator.effects import named
from estimator.errors import StateError
from estimator.estimate import Estimate, Status
from estimator.estimation import kinematics, smoothing
from estimator.estimation.admission import Reason, admit, row_reasons
from estimator.estimation.columns import wanted_by
from estimator.estimation.gate import Gate
from estimator.estimation.inference import Evidence, Inference
from estimator.estimation.lag import LONGEST_LAG, fit_lag
from estimator.estimation.load import Standstill
from estimator.estimation.model_check import SpeedScale
from estimator.estimation.window import Window
from estimator.samples import STEP, Rows
from estimator.signals import Quantity
from estimator.state import Count, State, optional, read, substate

BLOCK = 200  # rows turned into samples at a time: 20 s
CALIBRATION = 1800  # moving rows after which the smoother and the lag are settled: 3 min
LONGEST_WAIT = 18_000  # rows kept waiting for that: 30 min
HEARD = 0.05  # share of the first minutes in which a quantity must be known to be used


class Estimator:
    """Admits rows to the window and, when the gate opens, samples the posterior.

    Parameters
    ----------
    config
        All settings.
    rng
        Source of all randomness.
    """

    def __init__(self, config: Config, rng: np.random.Generator) -> None:
        self.window = Window(config)
        self._rejected: Counter[str] = Counter()
        self._config = config
        self._gate = Gate(config.gate, self.window.grid)
        self._inference = Inference(config, self.window.grid, rng)
        # Rows that a sample needs on either side, for its instruments and for what it must keep away from.
        self._margin = max(kinematics.margin(STEP), round(config.admission.margin_s / STEP))
        self._pending: Rows | None = None
        self._smoother: smoothing.Kernels | None = None
        self._lag = 0.0
        self._effects = named(config.effects)
        self._wanted: frozenset[Quantity] | None = None  # context that the effects need, once it is known what there is
        self._start: float | None = None  # [s] of the drive
        self._moving = 0
        self._next: int | None = None  # index of the row that would follow without a gap
        self._due: int | None = None
        self._at_last = 0
        self._latest: Estimate | None = None
        self._standstill = Standstill(config.load, config.admission.minimum_speed_m_s)
        self._scale = SpeedScale()
        self._resting = False  # restored, and nobody knows yet for how long it was away

    @property
    def latest(self) -> Estimate | None:
        """The newest conclusion; None before the first, and between `restore` and `resume`."""
        return None if self._resting else self._latest

    @property
    def progress(self) -> tuple[int, int, int]:
        """Changes with all that is learnt: rows heard in motion, samples admitted, and those at the last estimate."""
        return self._moving, self.window.added, self._at_last

    @property
    def evidence(self) -> Evidence | None:
        """What the newest estimate rests on; None while there is none."""
        return self._inference.evidence

    @property
    def rejected(self) -> Counter[str]:
        """Rows that did not count, by reason; the fit's own choice is that of the newest update."""
        own = {Reason.BELOW_MODEL_POWER: self._inference.below, Reason.EVICTED: self.window.evicted}
        return self._rejected + Counter({reason.value: count for reason, count in own.items()})

    def feed(self, rows: Rows) -> Iterator[Estimate]:
        """Take the next rows of the grid; yields an estimate whenever one falls due."""
        if self._pending is not None and rows.index[0] != self._pending.index[-1] + 1:
            yield from self.finish()
        if self._next is not None and rows.index[0] > self._next:
            self._standstill.pause(int(rows.index[0] - self._next))
        self._next = int(rows.index[-1]) + 1
        self._pending = rows if self._pending is None else Rows.concatenate(self._pending, rows)
        self._moving += int((rows.speed > self._config.admission.minimum_speed_m_s).sum())
        if self._moving < CALIBRATION and len(self._pending) < LONGEST_WAIT:
            return
        yield from self._consume(BLOCK)

    def finish(self) -> Iterator[Estimate]:
        """Use what is still waiting, at the end of a log or before a gap, and conclude."""
        if self._pending is None:
            return
        yield from self._consume(1)
        # The rows at the very ends have no complete surroundings.
        left = len(self._pending)
        end = float(self._pending.t[-1])
        self._rejected[Reason.INCOMPLETE] += left
        self._pending = None
        yield self._conclude(end)

    def forget(self, vehicle: bool = False) -> None:
        """Start a new window: what follows is another drive, perhaps with another load.

        With ``vehicle``, also forget what was learnt about the vehicle itself: nobody knows whose drive follows, or
        whether it is the same one once more.
        """
        self._pending, self._due, self._next = None, None, None
        self._wanted, self._start = None, None
        self._start_segment()
        if vehicle:
            self._inference.forget_vehicle()
            self._scale = SpeedScale()

    def state(self) -> dict[str, Any]:
        """What `restore` goes on from: all but the evidence, which the next update makes anew."""
        return {
            "window": self.window.state(),
            "rejected": dict(self._rejected),
            "pending": None if self._pending is None else self._pending.state(),
            "smoother": None if self._smoother is None else self._smoother.state(),
            "lag": self._lag,
            "wanted": None if self._wanted is None else sorted(self._wanted),
            "start": self._start,
            "moving": self._moving,
            "next": self._next,
            "due": self._due,
            "at_last": self._at_last,
            "latest": msgspec.to_builtins(self._latest),
            "standstill": self._standstill.state(),
            "scale": self._scale.state(),
            "inference": self._inference.state(),
        }

    def restore(self, state: State) -> None:
        """Know what another estimator knew; then `resume`. To be discarded when it fails.

        Raises
        ------
        StateError
            The state is not that of an estimator with this configuration.
        """
        self.window.restore(substate(state, "window"))
        self._rejected = Counter(read(state, "rejected", dict[str, Count]))
        self._pending = optional(state, "pending", Rows.restore)
        self._smoother = optional(state, "smoother", smoothing.Kernels.restore)
        self._lag, self._moving = read(state, "lag", float), read(state, "moving", Count)
        wanted = read(state, "wanted", list[Quantity] | None)
        self._wanted, self._start = None if wanted is None else frozenset(wanted), read(state, "start", float | None)
        self._next, self._due = read(state, "next", int | None), read(state, "due", int | None)
        self._at_last = read(state, "at_last", Count)
        self._latest = read(state, "latest", Estimate | None)
        self._standstill.restore(substate(state, "standstill"))
        self._scale.restore(substate(state, "scale"))
        self._inference.restore(substate(state, "inference"))
        if self._at_last > self.window.added or abs(self._lag) > LONGEST_LAG:
            raise StateError("counts or lag: are out of range")
        if (self._wanted is None) != (self._start is None):
            raise StateError("start: does not go with what is wanted")
        if len(self.window) and frozenset(self.window.samples.context) != self._wanted:
            raise StateError("window: has other columns than are wanted")
        self._resting = True

    def resume(self, same_load: bool) -> Iterator[Estimate]:
        """Go on after `restore`: use what was waiting, and keep the window if the load is the ``same_load``."""
        self._resting = False
        yield from self.finish()
        if not same_load:
            self.forget()

    def _calibrate(self, rows: Rows) -> smoothing.Kernels:
        speed = rows.plausible_speed
        self._lag = fit_lag(speed, rows.power, STEP, self._config.kinematics.maximum_lag_s)
        return smoothing.smoother_kernels(smoothing.fit_ratio(speed, STEP), STEP)

    def _context_of(self, rows: Rows) -> frozenset[Quantity]:
        """What the effects are to be computed from, of what the bus carries."""
        if not self._effects:
            return frozenset()
        there = kinematics.quantities(rows, 0.0).items()
        return wanted_by(self._effects, {q for q, values in there if np.isfinite(values).mean() > HEARD})

    def _consume(self, least: int) -> Iterator[Estimate]:
        assert self._pending is not None
        margin = self._margin
        if self._smoother is None:
            self._smoother = self._calibrate(self._pending)
        if self._wanted is None:
            self._start = float(self._pending.t[0])
            self._wanted = self._context_of(self._pending)
        while len(self._pending) >= least + 2 * margin:
            core = min(BLOCK, len(self._pending) - 2 * margin)
            yield from self._take(self._pending[: core + 2 * margin])
            self._pending = self._pending[core:]
        if self._moving < CALIBRATION:
            # A few moments of driving must not settle the smoother for all that follows.
            self._smoother, self._moving = None, 0

    def _take(self, rows: Rows) -> Iterator[Estimate]:
        assert self._smoother is not None
        assert self._wanted is not None
        assert self._start is not None
        margin = self._margin
        inertial = self._config.kinematics.acceleration == "inertial"
        spare = margin - kinematics.margin(STEP)
        part = rows[spare : len(rows) - spare]
        samples = kinematics.to_samples(part, self._smoother, self._lag, inertial, self._wanted, self._start)
        if self._standstill.drives_off(rows.speed[margin : len(rows) - margin]):
            self._start_segment()
        self._scale.add(rows[margin : len(rows) - margin])
        codes = row_reasons(rows, self._config.admission)[margin : len(rows) - margin]
        self.window.add(admit(samples, codes, self._rejected))
        newest = int(rows.index[-1 - margin])
        interval = round(self._config.gate.interval_s / STEP)
        if self._due is None:
            self._due = int(rows.index[margin]) + interval
        if newest >= self._due:
            self._due += interval * ((newest - self._due) // interval + 1)
            if self._gate.has_news(self.window.added, self._at_last, len(self.window)):
                yield self._conclude(newest * STEP)

    def _start_segment(self) -> None:
        """Another load, perhaps: forget the mass, keep what the vehicle has shown of itself."""
        self._inference.start_segment()
        self.window.clear()
        self._latest = None
        self._at_last = self.window.added

    def _conclude(self, t: float) -> Estimate:
        rejected = self._rejected + Counter({Reason.EVICTED.value: self.window.evicted})
        context, doubt = self._wanted or frozenset(), self._scale.verdict()
        self._latest = self._inference.conclude(t, self.window, context, self._lag, doubt, rejected)
        if self._latest.status == Status.ESTIMATED:
            self._at_last = self.window.added
        return self._latest
