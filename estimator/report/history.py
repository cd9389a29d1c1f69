"""Past conclusions in bounded memory: where there are too many, every other one is left out."""

from estimator.answers.run import Past
from estimator.estimates import Estimate
from estimator.report.summary import past

MOST = 60  # points, which a chart of that many columns can show


class History:
    """Conclusions in order of time; an hour of them a minute apart, later ones further apart."""

    def __init__(self) -> None:
        self._points: list[Past] = []

    @property
    def points(self) -> tuple[Past, ...]:
        """The conclusions that are kept, oldest first; the newest is always among them."""
        return tuple(self._points)

    def add(self, estimate: Estimate, start: float) -> None:
        """Keep a conclusion; ``start`` is the time of the first frame [s]. Where time steps back, begin anew."""
        point = past(estimate, start)
        if self._points and point.t_s < self._points[-1].t_s:
            self._points.clear()
        self._points.append(point)
        if len(self._points) > MOST:
            del self._points[-2::-2]
