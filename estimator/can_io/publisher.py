"""Broadcast of the estimate on J1939: contents, times, and values that are withheld.

The layout is defined only by the shipped ``roadload.dbc``: positions, scales, limits and the raw values of "error" and
"not available". By J1939-71 a number is valid while its top byte is at most 0xFA. Parameters are sent only while the
status is "estimated"; they read "error" if it is "invalid", otherwise "not available". A conclusion older than
``stale_after_s`` is "stale": only its age is sent, never its values. The road under the vehicle is sent with the
status, every second.
"""

from functools import cache
from importlib.resources import files
from math import floor, inf, isnan, nan

import can
from cantools.database.can import Database, Message, Signal

from estimator.can_io.counter_crc import COUNTS, checksum
from estimator.estimates import Estimate, Marginal, Slope, Status
from estimator.settings import Publish

STALE = "stale"  # beside the values of `Status` in the signal EstimateStatus
_ERROR, _NOT_AVAILABLE = "error", "not available"  # labels in roadload.dbc
_STATUS, _ROAD = "RoadloadStatus", "RoadloadRoad"
_VALUES = ("RoadloadMass", "RoadloadA", "RoadloadC", "RoadloadDeviation")
_PARAMETER = {"Mass": "m", "A": "A", "C": "C"}  # of the estimate, by its name in the messages
_CVW = "CVW"  # SAE's own group, PGN 65136: no counter, no checksum
_PGN_MASK = 0x03FFFF00  # of the 29-bit id; every group here is a broadcast one (PDU2)


@cache
def output_database() -> Database:
    """Load the shipped ``roadload.dbc``; it also serves to decode what a `Publisher` sends."""
    database = Database()
    database.add_dbc_string(files("estimator.dbc").joinpath("roadload.dbc").read_text(encoding="utf-8"))
    return database


def output_groups(cvw: bool = True) -> frozenset[int]:
    """PGNs that a `Publisher` sends, with or without CVW."""
    names = (_STATUS, _ROAD, *_VALUES, *((_CVW,) if cvw else ()))
    return frozenset((output_database().get_message_by_name(name).frame_id & _PGN_MASK) >> 8 for name in names)


class Schedule:
    """Schedule of the times ``anchor + k * period`` [s]; missed times are skipped."""

    def __init__(self, period: float) -> None:
        self._period = period
        self.restart(0.0)

    def restart(self, t: float) -> None:
        """Make ``t`` [s] the first time of the schedule."""
        self._anchor = t
        self._last = -1

    def due(self, t: float) -> float | None:
        """Latest scheduled time [s] up to ``t`` [s], which is then marked as used; None if it already was."""
        count = floor((t - self._anchor) / self._period)
        if count <= self._last:
            return None
        self._last = count
        return min(t, self._anchor + count * self._period)


class Publisher:
    """Encodes the current estimate as frames, at times given by the caller.

    ``source_address`` may be changed between polls, e.g. if another node took the address.
    """

    def __init__(self, publish: Publish) -> None:
        self.source_address = publish.source_address
        self._priority = publish.priority
        self._slack = publish.status_period_s  # steps back up to this much are taken for jitter of the time stamps
        self._stale_after = publish.stale_after_s
        database = output_database()
        values = (*_VALUES, _CVW) if publish.cvw else _VALUES
        self._groups = [
            (Schedule(publish.status_period_s), [database.get_message_by_name(name) for name in (_STATUS, _ROAD)]),
            (Schedule(publish.value_period_s), [database.get_message_by_name(name) for name in values]),
        ]
        self._counters: dict[str, int] = {}
        self._status: str | None = None  # as last sent
        self._now = -inf  # [s]
        self._lost = 0.0  # [s] by which the clock was set back since the current estimate
        self._estimate_t: float | None = None  # [s]

    def poll(self, t: float, estimate: Estimate | None, slope: Slope | None = None) -> list[can.Message]:
        """Return the frames due at message time ``t`` [s], in order of time and stamped with the time they were due.

        ``slope`` is that of the road under the vehicle at that time.

        Call it at least once per ``status_period_s``: after a longer gap each frame is sent once. The first call, a
        new conclusion, a change of status and a clock set back send everything at once and start the periods anew.
        A step back within one status period sends nothing twice.
        """
        renewed = estimate is not None and estimate.t != self._estimate_t
        stepped_back = self._advance(t, estimate)
        age = self._age(self._now, estimate)
        status = self._status_of(estimate, age)
        if stepped_back or renewed or status != self._status:
            self._status = status
            for schedule, _ in self._groups:
                schedule.restart(self._now)
        instants = [(schedule.due(self._now), messages) for schedule, messages in self._groups]
        due = [(instant, messages) for instant, messages in instants if instant is not None]
        contents = _contents(estimate, slope, status, age) if due else {}
        frames = [self._frame(message, instant, contents) for instant, messages in due for message in messages]
        return sorted(frames, key=lambda frame: frame.timestamp)

    def answer(self, pgn: int, t: float, estimate: Estimate | None, slope: Slope | None = None) -> can.Message | None:
        """Return one frame on request at message time ``t`` [s]; None for a group that is not sent.

        The last poll may be long ago, because a sleeping bus is not polled.
        """
        now = max(self._now, t)
        age = self._age(now, estimate)
        contents = _contents(estimate, slope, self._status_of(estimate, age), age)
        for message in (message for _, messages in self._groups for message in messages):
            if message.frame_id & _PGN_MASK == pgn << 8:
                return self._frame(message, now, contents)
        return None

    def _age(self, now: float, estimate: Estimate | None) -> float:
        age = nan if estimate is None else now + self._lost - estimate.t
        # From a time to come, e.g. restored from before the clock was set: its age is unknown.
        return nan if age < -self._slack else age

    def _advance(self, t: float, estimate: Estimate | None) -> bool:
        """Move to ``t``; returns whether the clock was set back."""
        stepped_back = t < self._now - self._slack
        if stepped_back:
            self._lost += self._now - t
        self._now = t if stepped_back else max(t, self._now)
        if estimate is not None and estimate.t != self._estimate_t:
            self._estimate_t, self._lost = estimate.t, 0.0
        return stepped_back

    def _status_of(self, estimate: Estimate | None, age: float) -> str:
        if estimate is None:
            return Status.UNESTIMATED.value
        return estimate.status.value if age <= self._stale_after else STALE

    def _frame(self, message: Message, due: float, contents: dict[str, float | str]) -> can.Message:
        protected = message.name != _CVW
        if protected:
            contents = contents | {"AliveCounter": self._counters.get(message.name, 0), "Checksum": 0}
            self._counters[message.name] = (self._counters.get(message.name, 0) + 1) % COUNTS
        # A message about one parameter carries the status of that parameter.
        values = {s.name: contents.get(f"{message.name}.{s.name}", contents.get(s.name, nan)) for s in message.signals}
        raw: dict[str, int | float | str] = {s.name: _raw(s, values[s.name]) for s in message.signals}
        data = message.encode(raw, scaling=False, padding=True, strict=False)
        ident = self._priority << 26 | message.frame_id & _PGN_MASK | self.source_address
        if protected:
            data = data[:-1] + bytes([checksum(ident, data[:-1])])
        return can.Message(timestamp=due, arbitration_id=ident, data=data, is_extended_id=True, is_rx=False)


def _contents(estimate: Estimate | None, slope: Slope | None, status: str, age: float) -> dict[str, float | str]:
    """Physical value, or label, of every signal except counter and checksum; NaN is not available."""
    shown = None if status == STALE else estimate
    contents: dict[str, float | str] = {
        "EstimateStatus": status,
        "EstimateAge": age,
        "Coverage": 100 * shown.coverage.fraction if shown else nan,
        "SampleCount": shown.admitted if shown else nan,
        "RHat": shown.convergence.r_hat if shown and shown.convergence else nan,
    }
    withheld = _ERROR if status == Status.INVALID else _NOT_AVAILABLE
    usable = shown if shown and status == Status.ESTIMATED else None
    for name, marginal in {
        "Mass": usable and usable.mass,
        "A": usable and usable.A,
        "C": usable and usable.C,
    }.items():
        marginal = marginal if marginal and _fits(name, marginal) else None
        contents[f"{name}Mean"] = marginal.mean if marginal else withheld
        contents[f"{name}Q05"] = marginal.q05 if marginal else withheld
        contents[f"{name}Q95"] = marginal.q95 if marginal else withheld
        contents[f"{name}Deviation"] = marginal.sd if marginal else withheld
        parameter_status, _ = usable.status_of(_PARAMETER[name]) if usable else (status, "")
        is_lost = parameter_status is Status.ESTIMATED and marginal is None  # beyond what the signal can say
        contents[f"Roadload{name}.EstimateStatus"] = str(Status.UNESTIMATED if is_lost else parameter_status)
    contents["GrossCombinationVehicleWeight"] = contents["MassMean"]
    contents["PoweredVehicleWeight"] = _NOT_AVAILABLE
    return contents | _road_contents(slope if usable else None, status, withheld)


def _road_contents(slope: Slope | None, status: str, withheld: str) -> dict[str, float | str]:
    """Contents of the message of the road; a slope or height too uncertain for its signals is withheld."""
    if slope is None or abs(slope.sine) >= 1 or 100 * slope.grade_sd > _largest("RoadGradeDeviation"):
        status = Status.UNESTIMATED.value if status == Status.ESTIMATED else status
        names = ("RoadGrade", "RoadGradeDeviation", "RoadHeight", "RoadHeightDeviation")
        return {"RoadloadRoad.EstimateStatus": status, **dict.fromkeys(names, withheld)}
    is_known = abs(slope.height) <= _largest("RoadHeight") and slope.height_sd <= _largest("RoadHeightDeviation")
    return {
        "RoadloadRoad.EstimateStatus": status,
        "RoadGrade": 100 * slope.grade,
        "RoadGradeDeviation": 100 * slope.grade_sd,
        "RoadHeight": slope.height if is_known else nan,
        "RoadHeightDeviation": slope.height_sd if is_known else nan,
    }


@cache
def _largest(signal: str) -> float:
    """Largest value that a signal can encode."""
    signals = (s for message in output_database().messages for s in message.signals if s.name == signal)
    return min(inf if s.maximum is None else float(s.maximum) for s in signals)


def _fits(name: str, marginal: Marginal) -> bool:
    """True if the signals of a parameter can encode its values."""
    values = {"Mean": marginal.mean, "Q05": marginal.q05, "Q95": marginal.q95, "Deviation": marginal.sd}
    return not any(value > _largest(f"{name}{part}") for part, value in values.items())


def _raw(signal: Signal, value: float | str) -> int:
    """Raw value: numbers are clamped to the signal's limits, labels looked up, NaN not available."""
    if isinstance(value, str) or isnan(value):
        label = value if isinstance(value, str) else _NOT_AVAILABLE
        return next(raw for raw, name in (signal.choices or {}).items() if str(name) == label)
    low, high = signal.minimum or 0.0, signal.maximum
    return int(signal.scaled_to_raw(max(low, value if high is None else min(high, value))))
