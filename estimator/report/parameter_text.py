"""An estimate in words and numbers for people; light, for `roadload status` imports no numerical package."""

from collections.abc import Iterator
from typing import NamedTuple

from estimator import estimates
from estimator.answers.reference import Reference, References
from estimator.answers.run import CoastDown, Coefficients, Coverage, Parameter, Parameters, Road
from estimator.estimates import Status, not_showing
from estimator.report.number_format import clock

OLD = 10.0  # s, from which the age of a reading is told
MIN_SLOPE_SD = 1e-3  # sd of slopes below which a road counts as flat


class Row(NamedTuple):
    """A parameter: its key in the answers, its name, unit and format; ``factor`` from the answers to the unit."""

    key: str
    name: str
    unit: str
    form: str
    factor: float = 1.0

    def text(self, x: float) -> str:
        """``27,161``."""
        return self.form.format(self.factor * x)

    def value(self, x: float) -> str:
        """``27,161 kg``."""
        return f"{self.text(x)} {self.unit}"

    def interval(self, low: float, high: float) -> str:
        """``27,012 .. 27,314``."""
        return f"{self.text(low)} .. {self.text(high)}"

    def of(self, answers: Parameters | Coefficients | CoastDown) -> Parameter:
        """Its marginal."""
        marginal: Parameter = getattr(answers, self.key)
        return marginal


ROWS = (
    Row("mass_kg", "mass", "kg", "{:,.0f}"),
    Row("A_N", "A", "N", "{:,.0f}"),
    Row("C_N_s2_m2", "C", "N s²/m²", "{:.3f}"),
)
COEFFICIENTS = (Row("c_rr", "c_rr", "%", "{:.3f}", 100.0), Row("c_d_A_m2", "c_d A", "m²", "{:.2f}"))
COAST_DOWN = (Row("F0_N", "F0", "N", "{:,.0f}"), Row("F2_N_h2_km2", "F2", "N/(km/h)²", "{:.4f}"))


BESIDE = dict(zip(("A_N", "C_N_s2_m2"), COEFFICIENTS, strict=True))  # what follows from a parameter, by its key


def beside(row: Row, coefficients: Coefficients | None) -> str:
    """``c_rr 0.652 %`` for A, ``c_d A 6.13 m²`` for C; empty where it is not estimated."""
    derived = BESIDE.get(row.key)
    mean = None if derived is None or coefficients is None else derived.of(coefficients).mean
    return "" if derived is None or mean is None else f"{derived.name} {derived.value(mean)}"


class Known(NamedTuple):
    """A parameter that is estimated, with its row."""

    row: Row
    mean: float
    sd: float
    q05: float
    q95: float


def known(parameters: Parameters, coefficients: Coefficients | None) -> list[Known]:
    """Mass, A, C, c_rr and c_d A, those that are estimated."""
    rows = [(row, row.of(parameters)) for row in ROWS]
    if coefficients is not None:
        rows += [(row, row.of(coefficients)) for row in COEFFICIENTS]
    return [
        Known(row, x.mean, x.sd, x.q05, x.q95)
        for row, x in rows
        if x.mean is not None and x.sd is not None and x.q05 is not None and x.q95 is not None
    ]


def mass(parameters: Parameters) -> str:
    """``27,161 kg (27,012 .. 27,314)``; empty where it is not estimated."""
    x = parameters.mass_kg
    if x.mean is None or x.q05 is None or x.q95 is None:
        return ""
    return f"{ROWS[0].value(x.mean)} ({ROWS[0].interval(x.q05, x.q95)})"


def coast_down(coefficients: Coefficients | None) -> str:
    """``F0 1,736 N, F1 0, F2 0.2900 N/(km/h)²``, those that are estimated; empty where none is."""
    if coefficients is None:
        return ""
    F0, F2 = (row.of(coefficients.coast_down).mean for row in COAST_DOWN)
    if F0 is None and F2 is None:
        return ""
    first, last = ("unestimated" if x is None else row.value(x) for row, x in zip(COAST_DOWN, (F0, F2), strict=True))
    return f"F0 {first}, F1 0, F2 {last}"


def air(coefficients: Coefficients) -> str:
    """Density of the air that c_d A is computed with, and where it comes from."""
    density = f"{coefficients.air_density_kg_m3:.3f} kg/m³"
    if coefficients.is_density_measured:
        return f"{density}; C holds for this density, and is proportional to it"
    return f"{density} of standard air, for no signal shows the density; c_d A holds for it"


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


def cells(coverage: Coverage | estimates.Coverage) -> str:
    """``82 % (41 of 50 reachable cells)``."""
    return f"{100 * coverage.fraction:.0f} % ({coverage.occupied} of {coverage.available} reachable cells)"


def road(slopes: Road) -> str:
    """The slopes in one line."""
    shown = f"shown by {', '.join(slopes.shown_by)}" if slopes.shown_by else "shown by no signal"
    shown += not_showing(slopes.contradicted)
    if slopes.slope_sd < MIN_SLOPE_SD:
        level = f"flat (slopes below {100 * MIN_SLOPE_SD:.1f} %), {shown}"
        return level if slopes.shown_by else f"{level}; a mean slope would be part of A"
    climbed = "" if slopes.climbed_m is None else f"; {slopes.climbed_m:,.0f} m climbed"
    words = f"slopes with a standard deviation of {100 * slopes.slope_sd:.1f} %"
    return f"{words} over {slopes.length_m:,.0f} m, {shown}{climbed}"


def references(found: References) -> Iterator[str]:
    """A line for each estimate of another control unit."""
    if (mass := found.mass_kg) is not None:
        where = "above" if (mass.difference or 0.0) > 0 else "below"
        beside = "" if mass.difference is None else f", {abs(mass.difference):,.0f} kg {where} ours"
        span = f"{mass.lowest:,.0f} .. {mass.highest:,.0f} kg in the last hour"
        yield f"mass {mass.newest:,.0f} kg by {mass.signal}{_heard(mass)}{beside}; {span}"
    if (grade := found.grade_percent) is not None:
        beside = ""
        if grade.difference is not None:
            beside = (
                f"; against our road {grade.difference:+.2f} % with a standard deviation of {grade.difference_sd:.2f} %"
            )
        yield f"grade {grade.newest:+.2f} % by {grade.signal}{_heard(grade)}{beside}"


def _heard(found: Reference) -> str:
    return f", heard {clock(found.age_s)} ago" if found.age_s > OLD else ""
