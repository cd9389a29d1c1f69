"""Pipeline of two stages: frames to rows (`RowStream`), rows to estimates (`Estimator`)."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from estimator.can_io.frames import Frames
from estimator.checkpoint.validation import State, substate
from estimator.config import Config
from estimator.estimates import Estimate, Status
from estimator.estimation.estimator import Estimator
from estimator.estimation.road_now import RoadAhead
from estimator.streaming.row_stream import Block, Interruption, RowStream


class Pipeline:
    """Turns frames into estimates, live, replayed or from a log.

    Parameters
    ----------
    config
        All settings.
    is_live
        True if the road under the vehicle is followed, for `road_now`.

    Attributes
    ----------
    traffic : RowStream
        First stage, with the counts of frames, readings and rows.
    estimator : Estimator
        Second stage.
    """

    def __init__(self, config: Config, is_live: bool = False) -> None:
        self.config, self._is_live = config, is_live
        self.traffic = RowStream(config)
        self.estimator = self._new()
        self._is_restored = False  # and not fed since

    def _new(self) -> Estimator:
        return Estimator(self.config, np.random.default_rng(self.config.sampler.seed), self._is_live)

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects in the model."""
        return tuple(dict.fromkeys(self.config.effects))

    @property
    def latest(self) -> Estimate | None:
        """Newest estimate; without values while an input is contested."""
        latest = self.estimator.latest
        return None if latest is None else self._withheld(latest)

    @property
    def load_until(self) -> float:
        """Message time [s] from which on the load may be another than that of `latest`."""
        return self.estimator.load_until

    @property
    def road_now(self) -> RoadAhead | None:
        """Road under the vehicle; None without a fit, or while an input is contested."""
        return None if self.traffic.contested else self.estimator.road_now

    def feed(self, frames: Frames, now: float | None = None) -> Iterator[Estimate]:
        """Take the next frames in order of arrival; yields estimates as they fall due; ``now`` as in `RowStream`."""
        for item in self.traffic.feed(frames, now):
            yield from self.take(item)

    def finish(self) -> Iterator[Estimate]:
        """Use the frames and rows still waiting, at the end of the traffic."""
        for item in self.traffic.finish():
            yield from self.take(item)
        if not self._is_restored:
            yield from map(self._withheld, self.estimator.finish())

    def take(self, item: Block | Interruption) -> Iterator[Estimate]:
        """Take the next item of the first stage; yields estimates as they fall due."""
        yield from map(self._withheld, self._take(item))

    def _take(self, item: Block | Interruption) -> Iterator[Estimate]:
        if isinstance(item, Interruption):
            yield from self._interrupt(item)
        else:
            for rows in item.rows:
                yield from self.estimator.feed(rows)

    def state(self) -> dict[str, Any]:
        """State for `restore`; see `RowStream.state`."""
        return {**self.traffic.state(), "estimator": self.estimator.state()}

    def restore(self, state: State, same_clock: bool = True) -> None:
        """Take the state of another pipeline with the same configuration, before the first frame.

        The length of the downtime follows from the next frames. If it begins a new drive (see `RowStream.restore`), the
        parameters of the vehicle are carried over as after a long stop. Until then there is no estimate.

        Raises
        ------
        StateError
            The state does not fit; the pipeline is as it was before.
        """
        estimator = self._new()
        estimator.restore(substate(state, "estimator"))
        self.traffic.restore(state, same_clock)
        self.estimator, self._is_restored = estimator, True

    def _interrupt(self, item: Interruption) -> Iterator[Estimate]:
        if self._is_restored:
            self._is_restored = False
            yield from self.estimator.resume(not item.is_new_drive, item.hidden)
            return
        yield from self.estimator.finish()
        if item.is_new_drive:
            self.estimator.forget(vehicle=item.is_step_back or item.is_sender_replaced)

    def _withheld(self, estimate: Estimate) -> Estimate:
        """Return the estimate, without its values while an input is contested."""
        if not self.traffic.contested:
            return estimate
        path, reason = next(iter(self.traffic.contested.items()))
        return Estimate(
            t=estimate.t,
            status=Status.UNESTIMATED,
            reason=f"{path} is contested: {reason}",
            coverage=estimate.coverage,
            admitted=estimate.admitted,
        )
