"""An estimate in words and numbers for people; light, for `roadload status` imports no numerical package."""

from typing import NamedTuple

from estimator.answers.run import Coverage, Parameter, Parameters, Road
from estimator.estimates import Status

MIN_SLOPE_SD = 1e-3  # sd of slopes below which a road counts as flat


class Row(NamedTuple):
    """A parameter: its key in `Parameters`, its name, unit and format."""

    key: str
    name: str
    unit: str
    form: str

    def value(self, x: float) -> str:
        """``27,161 kg``."""
        return f"{self.form.format(x)} {self.unit}"

    def interval(self, low: float, high: float) -> str:
        """``27,012 .. 27,314``."""
        return f"{self.form.format(low)} .. {self.form.format(high)}"

    def of(self, parameters: Parameters) -> Parameter:
        """Its marginal."""
        marginal: Parameter = getattr(parameters, self.key)
        return marginal


ROWS = (
    Row("mass_kg", "mass", "kg", "{:,.0f}"),
    Row("A_N", "A", "N", "{:,.0f}"),
    Row("C_N_s2_m2", "C", "N s²/m²", "{:.3f}"),
)


def line(status: Status, reason: str, parameters: Parameters, coverage: Coverage) -> str:
    """``27,161 kg (27,012 .. 27,314), A 1,736 N (1,705 .. 1,768), C .., coverage 60 %``, or why there is none."""
    parts = [f"{status.value}{f': {reason}' if reason else ''}"] if status is not Status.ESTIMATED else []
    for row in ROWS:
        x = row.of(parameters)
        if x.mean is not None and x.q05 is not None and x.q95 is not None:
            name = "" if row.name == "mass" else f"{row.name} "
            parts.append(f"{name}{row.value(x.mean)} ({row.interval(x.q05, x.q95)})")
    if "coverage" not in reason and coverage.available:
        parts.append(f"coverage {100 * coverage.fraction:.0f} %")
    return ", ".join(parts)


def road(slopes: Road) -> str:
    """The slopes in one line."""
    shown = f"shown by {', '.join(slopes.shown_by)}" if slopes.shown_by else "shown by no signal"
    if slopes.slope_sd < MIN_SLOPE_SD:
        return f"flat (slopes below {100 * MIN_SLOPE_SD:.1f} %), {shown}"
    climbed = "" if slopes.climbed_m is None else f"; {slopes.climbed_m:,.0f} m climbed"
    words = f"slopes with a standard deviation of {100 * slopes.slope_sd:.1f} %"
    return f"{words} over {slopes.length_m:,.0f} m, {shown}{climbed}"


def clock(seconds: float) -> str:
    """``1:02:05``, hours, minutes and seconds."""
    whole = max(round(seconds), 0)
    return f"{whole // 3600}:{whole // 60 % 60:02}:{whole % 60:02}"
