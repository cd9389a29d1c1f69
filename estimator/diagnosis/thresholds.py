"""Thresholds by which a diagnosis is read from the table of models; docs/how_it_decides.md says where each is used."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Thresholds:
    """Limits of probabilities and of log Bayes factors (log BF); a test or a sweep gives its own to `diagnose`."""

    min_probability: float = 0.9  # of an effect that is named
    min_probability_no_gap: float = 0.5  # that nothing acts, for the verdict "no gap"
    min_log_bf_unknown: float = 10.0  # of a process: an unknown effect acts
    min_log_bf_left: float = 20.0  # of a process beside effects that are named
    min_log_bf_slopes: float = 15.0  # of a road with slopes over a level one
    min_log_bf_slopes_tried: float = 5.0  # of slopes on a plain drive, which are then looked at
    min_log_bf_signals: float = 5.0  # of signals of the road that confirm slopes; below its negative they deny them
    min_log_bf_alike: float = 5.0  # of an effect that is listed beside one of the same course
    min_class_correlation: float = 0.95  # |correlation| of columns above which two effects are one class
    min_grade_sd: float = 0.002  # of hills [1]: level ones without other effects come out at 0.0001 .. 0.0009
    min_expected_log_bf: float = 5.0  # of an effect of usual size: the drive would show it
