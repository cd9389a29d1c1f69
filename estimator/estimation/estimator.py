"""The streaming estimator: rows in, an estimate at regular intervals of message time and at the end of each load.

Its only state is the window and the conclusions from it: no clock, no bus, no thread. The same rows give the same
estimates.
"""

from collections import Counter
from collections.abc import Iterator
from math import inf
from typing import Any

import msgspec
import numpy as np

from estimator.checkpoint.validation import Count, State, read, substate
from estimator.config import Config
from estimator.errors import StateError
from estimator.estimates import Coverage, Estimate, Status
from estimator.estimation.evidence import Evidence
from estimator.estimation.gate import has_news
from estimator.estimation.paper_inference import PaperInference
from estimator.estimation.road_inference import RoadInference
from estimator.estimation.road_now import MAX_AGE, RoadAhead, RoadNow
from estimator.estimation.scale_check import ScaleCheck
from estimator.estimation.window import Window
from estimator.preparation.admission import Reason
from estimator.preparation.stage import Piece, StrideStage
from estimator.samples import STEP, Rows

# Errors of an update beyond the range of floating point; a matrix that is not positive definite is an ArithmeticError.
NUMERICAL_ERRORS = (np.linalg.LinAlgError, ArithmeticError)


class Estimator:
    """Admits rows to the window and, when the gate opens, samples the posterior.

    Parameters
    ----------
    config
        All settings; ``sampler.likelihood`` selects the inference.
    rng
        Source of all randomness.
    is_live
        True if the road under the vehicle is estimated between two conclusions.
    """

    def __init__(self, config: Config, rng: np.random.Generator, is_live: bool = False) -> None:
        self.window = Window(config)
        self.segment = 0  # number of the load, counted since the start of this process
        self.failed_updates = 0  # updates that failed numerically, since the start of this process
        self._config = config
        self._interval = round(config.gate.interval_s / STEP)  # rows
        self._stage = StrideStage(config)
        inference = RoadInference if config.sampler.likelihood == "road" else PaperInference
        self._inference: RoadInference | PaperInference = inference(config, self.window, rng)
        self._next: int | None = None  # index of the row that would follow without a gap
        self._due: int | None = None
        self._at_last = 0
        self._latest: Estimate | None = None
        self._scale = ScaleCheck(config.binding)
        self._road = RoadNow(config.admission, is_live)
        self._resting = False  # restored, and `resume` has not been called: the downtime is not known yet

    @property
    def latest(self) -> Estimate | None:
        """The newest estimate; None before the first, and between `restore` and `resume`."""
        return None if self._resting else self._latest

    @property
    def load_until(self) -> float:
        """Time [s] from which on the load may be another than that of `latest`, by the newest row.

        A stop has then lasted `load.stop_s`, or a departure from one waits for its block of rows. In motion, the next
        rows may be MAX_AGE late.
        """
        if self._stage.departures:
            return self._stage.departures[0] * STEP
        if self._next is None:
            return inf
        standing, stop = self._stage.standstill.rows, self._config.load.stop_s
        return (self._next - standing) * STEP + (stop if standing else max(stop, MAX_AGE))

    @property
    def road_now(self) -> RoadAhead | None:
        """Road under the vehicle and ahead of it by the newest fit; None without a fit or before `resume`."""
        return None if self._resting else self._road.here()

    @property
    def progress(self) -> tuple[int, int, int]:
        """Counts of rows in motion, of rows admitted to the window, and of rows admitted at the last estimate.

        The last two are equal while there is no new data.
        """
        return self._stage.moving, self.window.added, self._at_last

    @property
    def evidence(self) -> Evidence | None:
        """Trace and draws of the newest estimate; None without an estimate."""
        return self._inference.evidence

    @property
    def rejected(self) -> Counter[str]:
        """Counts of the rows not used, by reason."""
        return self._stage.rejected + Counter({Reason.EVICTED.value: self.window.evicted})

    def feed(self, rows: Rows) -> Iterator[Estimate]:
        """Process the next rows of the grid; yield an estimate whenever one is due."""
        if self._next is not None and rows.index[0] != self._next:
            yield from self.finish()
            self._stage.pause(max(int(rows.index[0] - self._next), 0))
        self._next = int(rows.index[-1]) + 1
        for piece in self._stage.feed(rows):
            yield from self._take(piece)
        self._road.feed(rows, self._stage.wanted)

    def finish(self) -> Iterator[Estimate]:
        """Process the buffered rows, at the end of a log or before a gap, and yield the estimates due."""
        end = self._stage.waiting
        if end is None:
            return
        for piece in self._stage.finish():
            yield from self._take(piece)
        self._road.finish()
        yield self._conclude(end, is_last=True)

    def forget(self, vehicle: bool = False) -> None:
        """Start a new window: another drive follows, perhaps with another load.

        With ``vehicle``, also discard the parameters of the vehicle: the next drive may be of another vehicle, or the
        same drive again.
        """
        self._stage.forget()
        self._road.forget()
        self._due, self._next = None, None
        self._start_segment()
        if vehicle:
            self._inference.forget_vehicle()
            self._scale = ScaleCheck(self._config.binding)

    def state(self) -> dict[str, Any]:
        """Return the state that `restore` reads, without the evidence, which the next update computes."""
        return {
            "likelihood": self._config.sampler.likelihood,
            "window": self.window.state(),
            "stage": self._stage.state(),
            "next": self._next,
            "due": self._due,
            "at_last": self._at_last,
            "latest": msgspec.to_builtins(self._latest),
            "scale": self._scale.state(),
            "inference": self._inference.state(),
            "road": self._road.state(),
        }

    def restore(self, state: State) -> None:
        """Load the state of another estimator; `resume` must follow. After an error, discard this estimator.

        Raises
        ------
        StateError
            The state does not belong to an estimator with this configuration, whose gate may have other limits.
        """
        if read(state, "likelihood", str) != self._config.sampler.likelihood:
            raise StateError("likelihood: is another one")
        self.window.restore(substate(state, "window"))
        self._stage.restore(substate(state, "stage"))
        self._next, self._due = read(state, "next", int | None), read(state, "due", int | None)
        if self._next is not None and self._due is not None:  # the state may be one of a longer interval
            self._due = min(self._due, self._next + self._interval)
        self._at_last = read(state, "at_last", Count)
        self._latest = read(state, "latest", Estimate | None)
        self._scale.restore(substate(state, "scale"))
        self._inference.restore(substate(state, "inference"))
        self._road.restore(substate(state, "road"))
        if self._at_last > self.window.added:
            raise StateError("counts: are out of range")
        if len(self.window) and frozenset(self.window.strides.context) != self._stage.wanted:
            raise StateError("window: has other columns than are wanted")
        self._resting = True

    def resume(self, same_load: bool, hidden: float = 0.0) -> Iterator[Estimate]:
        """Continue after `restore`: process the buffered rows; keep the window only if ``same_load``.

        ``hidden`` [s] of standing are not in the times of the rows.
        """
        self._resting = False
        yield from self.finish()
        self._stage.pause(round(hidden / STEP))
        if not same_load:
            self.forget()

    def _take(self, piece: Piece) -> Iterator[Estimate]:
        if piece.departs:
            departure = float(piece.rows.t[0])
            if self._has_news:
                yield self._conclude(departure, is_last=True)
            self._start_segment(departure)
        self._scale.add(piece.rows)
        self.window.add(piece.strides)
        if not len(piece.rows):
            return
        newest = int(piece.rows.index[-1])
        if self._due is None:
            self._due = int(piece.rows.index[0]) + self._interval
        if newest >= self._due:
            self._due += self._interval * ((newest - self._due) // self._interval + 1)
            if self._has_news:
                yield self._conclude(newest * STEP)

    @property
    def _has_news(self) -> bool:
        return has_news(self._config.gate, self.window.added, self._at_last, len(self.window))

    def _start_segment(self, departure: float | None = None) -> None:
        """Begin a load segment at ``departure`` [s] from a stop: discard the mass, keep A / m and C."""
        self.segment += 1
        kept_from = self._inference.start_segment(departure)
        if kept_from is None:
            self.window.clear()
        else:
            self.window.forget_before(kept_from)
        self._road.conclude(None)
        self._latest = None
        self._at_last = self.window.added

    def _conclude(self, t: float, is_last: bool = False) -> Estimate:
        context = self._stage.wanted or frozenset()
        before, evidence = self._inference.state(), self.evidence
        try:
            self._latest = self._inference.conclude(t, context, self._scale, self.rejected, is_last)
        except NUMERICAL_ERRORS as error:
            self._inference.recover(before)
            self.failed_updates += 1
            self._latest = Estimate(
                t=t,
                status=Status.UNESTIMATED,
                reason=f"this update failed numerically ({error}); the next one starts anew",
                coverage=Coverage(0, 0),
                admitted=len(self.window),
            )
        except BaseException:  # such as Ctrl-C: the estimate before and its evidence stay together
            self._inference.restore(before)
            self._inference.evidence = evidence
            raise
        fit = None if self.evidence is None else self.evidence.fit
        self._road.conclude(None if fit is None else (fit, self.window.strides.without(fit.contradicted)))
        if self._latest.status == Status.ESTIMATED:
            self._at_last = self.window.added
        return self._latest
