"""The view at a moment, from a pipeline at work or from the status of a daemon: one answer for both."""

from estimator.answers import status as answer
from estimator.answers.status import StatusAnswer
from estimator.answers.watch import Sentences, WatchAnswer
from estimator.estimates import Status
from estimator.report import parameter_text, summary, wanted_driving
from estimator.report.history import History
from estimator.streaming.pipeline import Pipeline

MISSING_AFTER = 15.0  # s of traffic after which an input that never came counts as missing


def of_pipeline(
    pipeline: Pipeline,
    history: History,
    source: str,
    state: str,
    share: float | None = None,
    frames_per_s: float | None = None,
) -> WatchAnswer:
    """The view of a log that is being read: the ``share`` of it that is done, and ``frames_per_s`` of real time."""
    traffic = pipeline.traffic
    conclusion = summary.conclusion(pipeline.latest, traffic.until or 0.0, traffic.start)
    progress = summary.progress(pipeline, history.points)
    notes = [f"{path} is contested: {reason}" for path, reason in traffic.contested.items()]
    if traffic.missing and (progress.t_s or 0.0) > MISSING_AFTER:
        notes.append(f"missing: {', '.join(traffic.missing)}")
    return WatchAnswer(
        source=source,
        state=state,
        note="; ".join(notes),
        share=share,
        frames=traffic.frames,
        frames_per_s=frames_per_s,
        estimate=conclusion,
        progress=progress,
        unused=dict(pipeline.estimator.rejected.most_common()),
        sentences=sentences(conclusion, progress),
    )


def of_status(status: StatusAnswer, source: str) -> WatchAnswer:
    """The view of a bus, from the status of the daemon that hears it."""
    notes = [status.detail] if status.detail else []
    heard = 0.0 if status.progress is None or status.progress.t_s is None else status.progress.t_s
    if status.missing and heard > MISSING_AFTER:
        notes.append(f"missing: {', '.join(status.missing)}")
    return WatchAnswer(
        source=source,
        state=status.state.value,
        note="; ".join(notes),
        frames=status.input.frames,
        frames_per_s=status.frames_per_s,
        estimate=status.estimate,
        progress=status.progress,
        unused=dict(sorted(status.samples_rejected.items(), key=lambda item: -item[1])),
        sentences=sentences(status.estimate, status.progress),
    )


def without_news(source: str, state: str, note: str) -> WatchAnswer:
    """The view where nothing is known that is fresh, and why."""
    empty = Sentences(headline="", wanted="", road="")
    return WatchAnswer(source=source, state=state, note=note, unused={}, sentences=empty)


def sentences(conclusion: answer.Estimate | None, progress: answer.Progress | None) -> Sentences:
    """The headline, what the driving still lacks, and the road."""
    return Sentences(
        headline=_headline(conclusion, progress),
        wanted="" if progress is None else wanted_driving.wanted(progress.coverage_map),
        road="" if conclusion is None or conclusion.road is None else parameter_text.road(conclusion.road),
    )


def _headline(conclusion: answer.Estimate | None, progress: answer.Progress | None) -> str:
    if conclusion is not None and (mass := parameter_text.mass(conclusion.parameters)):
        return mass
    if conclusion is not None and conclusion.status is Status.INVALID:
        return f"invalid: {conclusion.reason}"
    if progress is None:
        return ""
    steps = wanted_driving.steps_to_estimate(progress, None if conclusion is None else conclusion.coverage)
    why = steps or ("" if conclusion is None else conclusion.reason)
    return f"no estimate yet{f': {why}' if why else ''}"
