"""An estimate as lines of text: each parameter with its interval, or the reason why it is not known."""

from collections.abc import Iterator, Mapping

from estimator.estimates import Estimate, drag_area
from estimator.report.number_format import with_interval
from estimator.report.parameter_text import cells

PARAMETERS = (("m", "mass", "kg"), ("A", "A", "N"), ("C", "C", "N s²/m²"))  # key, name, unit
MOST = 4  # reasons of unused rows that are listed


def lines_of(estimate: Estimate, rejected: Mapping[str, int]) -> Iterator[str]:
    """The status, the parameters with 90 % intervals, the coverage, and why rows were not used."""
    yield estimate.status.value + (f": {estimate.reason}" if estimate.reason else "")
    for key, name, unit in PARAMETERS:
        marginal, (status, reason) = estimate.marginals[key], estimate.status_of(key)
        if marginal is not None:
            yield f"{name:9} {with_interval(marginal.mean, marginal.q05, marginal.q95, unit)}"
        elif estimate.mass is not None:
            yield f"{name:9} {status.value}: {reason}"
    if estimate.c_rr is not None:
        c_rr = estimate.c_rr.times(100.0)
        yield f"c_rr      {with_interval(c_rr.mean, c_rr.q05, c_rr.q95, '%')}"
    if estimate.C is not None:
        area = drag_area(estimate.C, estimate.air_density)
        yield f"c_d A     {with_interval(area.mean, area.q05, area.q95, 'm²')}"
    if estimate.coverage.available:
        yield f"coverage  {cells(estimate.coverage)}"
    total = estimate.admitted + sum(rejected.values())
    reasons = sorted(rejected.items(), key=lambda pair: -pair[1])[:MOST]
    unused = ", ".join(f"{reason} {100 * count / total:.0f} %" for reason, count in reasons if count)
    yield f"used      {estimate.admitted / 600:.0f} min; not used: {unused or 'nothing'}"
