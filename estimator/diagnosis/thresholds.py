"""Define the thresholds that turn the table of models into a diagnosis; docs/how_it_decides.md lists their uses."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Thresholds:
    """Limits of probabilities and of log Bayes factors (log BF); a test or a sweep passes others to `diagnose`."""

    min_probability: float = 0.9  # of an effect, to name it
    min_probability_no_gap: float = 0.5  # of no effect and no process, for the verdict "no gap"
    min_log_bf_unknown: float = 10.0  # of a nameless process, for the verdict "unknown effect"
    min_log_bf_left: float = 20.0  # of a nameless process beside named effects, to report it
    min_log_bf_slopes: float = 15.0  # of a sloping road over a level one
    min_log_bf_slopes_tried: float = 5.0  # of slopes on the plain drive, to fit the road as a state
    min_log_bf_signals: float = 5.0  # of signals of the road that confirm slopes; below its negative they contradict
    min_log_bf_alike: float = 5.0  # of an effect, to list it as equivalent to one of the same course
    min_class_correlation: float = 0.95  # |correlation| of traces above which two effects are equivalent
    min_grade_sd: float = 0.002  # of hills [1]: level roads without effects give 0.0001 .. 0.0009
    min_expected_log_bf: float = 5.0  # of an effect of usual magnitude; below it the drive cannot show the effect
