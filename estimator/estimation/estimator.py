"""The streaming estimator: rows in, an estimate at regular intervals of message time.

It owns the window and nothing else that moves: no clock, no bus, no thread. Fed the same rows it concludes the same.
"""

from collections import Counter
from collections.abc import Iterator

import numpy as np

from estimator.config import Config
from estimator.estimate import Coverage, Estimate, Status
from estimator.estimation import kinematics, moments, posterior
from estimator.estimation.admission import Reason, admit, row_reasons
from estimator.estimation.gate import Gate
from estimator.estimation.window import Window
from estimator.samples import STEP, Rows, Samples

BLOCK = 200  # rows turned into samples at a time: 20 s
CALIBRATION = 1800  # moving rows after which the smoother and the lag are settled: 3 min
NOTHING_COVERED = Coverage(0, 0)


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
        self._rng = rng
        self._gate = Gate(config.gate, self.window.grid)
        self._pending: Rows | None = None
        self._smoother: kinematics.Kernels | None = None
        self._lag = 0.0
        self._moving = 0
        self._due: int | None = None
        self._at_last = 0
        self._below = 0
        self._latest: Estimate | None = None

    @property
    def latest(self) -> Estimate | None:
        """The newest conclusion; None before the first."""
        return self._latest

    @property
    def rejected(self) -> Counter[str]:
        """Rows that did not count, by reason; the fit's own choice is that of the newest update."""
        own = {Reason.BELOW_MODEL_POWER: self._below, Reason.EVICTED: self.window.evicted}
        return self._rejected + Counter({reason.value: count for reason, count in own.items()})

    def feed(self, rows: Rows) -> Iterator[Estimate]:
        """Take the next rows of the grid; yields an estimate whenever one falls due."""
        if self._pending is not None and rows.index[0] != self._pending.index[-1] + 1:
            yield from self.finish()
        self._pending = rows if self._pending is None else Rows.concatenate(self._pending, rows)
        self._moving += int((rows.speed > self._config.admission.minimum_speed_m_s).sum())
        if self._smoother is None and self._moving < CALIBRATION:
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

    def forget(self) -> None:
        """Start a new window: what follows is another drive, perhaps with another load."""
        self.window.clear()
        self._pending, self._due, self._latest = None, None, None
        self._at_last = self.window.added

    def _calibrate(self, rows: Rows) -> kinematics.Kernels:
        self._lag = kinematics.fit_lag(rows.speed, rows.power, STEP, self._config.kinematics.maximum_lag_s)
        return kinematics.smoother_kernels(kinematics.fit_ratio(rows.speed, STEP), STEP)

    def _consume(self, least: int) -> Iterator[Estimate]:
        assert self._pending is not None
        margin = kinematics.margin(STEP)
        if self._smoother is None:
            self._smoother = self._calibrate(self._pending)
        while len(self._pending) >= least + 2 * margin:
            core = min(BLOCK, len(self._pending) - 2 * margin)
            yield from self._take(self._pending[: core + 2 * margin], margin)
            self._pending = self._pending[core:]

    def _take(self, rows: Rows, margin: int) -> Iterator[Estimate]:
        assert self._smoother is not None
        inertial = self._config.kinematics.acceleration == "inertial"
        samples = kinematics.to_samples(rows, self._smoother, self._lag, inertial)
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

    def _conclude(self, t: float) -> Estimate:
        """Fit, judge, sample: one update."""
        samples = self.window.samples
        self._latest = self._estimate(t, samples)
        if self._latest.status == Status.ESTIMATED:
            self._at_last = self.window.added
        return self._latest

    def _estimate(self, t: float, samples: Samples) -> Estimate:
        fit = moments.fit(samples, self._config.admission.power_sigmas)
        held = int(fit.kept.sum()) if fit else len(samples)
        self._below = len(samples) - held

        def unestimated(reason: str, coverage: Coverage = NOTHING_COVERED) -> Estimate:
            return Estimate(t, Status.UNESTIMATED, reason, coverage, held)

        reason = self._gate.is_calculable(fit, held, posterior.box(self._config.prior))
        if fit is None or reason:
            common = self.rejected.most_common(1)
            return unestimated(reason + (f"; most others: {common[0][0]}" if common else ""))
        coverage = self._gate.coverage(self.window.counts, np.maximum(fit.theta[:3], 0.0), samples.P)
        if reason := self._gate.is_covered(fit, coverage):
            return unestimated(reason, coverage)
        draws = posterior.sample(posterior.target_of(samples, fit, self._config), self._config, self._rng)
        if not draws.has_converged:
            c = draws.convergence
            return unestimated(f"chains did not converge: R-hat {c.r_hat:.3f}, ESS {c.ess_bulk:.0f}", coverage)
        A, C, m = (draws.marginal(i) for i in range(3))
        return Estimate(t, Status.ESTIMATED, "", coverage, held, m, A, C, draws.convergence, fit.rms)
