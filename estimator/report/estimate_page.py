"""An estimate as one page that opens offline: the answer, how it formed, coverage, power, joint posterior, chains."""

import html
from itertools import combinations
from pathlib import Path

import numpy as np

from estimator.estimates import Status
from estimator.report import parameter_text, summary, wanted_driving
from estimator.report.effect_sizes import effect_size
from estimator.report.estimate_view import Curve, EstimateView, PowerTrace
from estimator.report.number_format import MINUS, clock, signed
from estimator.report.page.document import Section, document, write_document
from estimator.report.page.plot import Axis, axis, band, bar, cell, clock_axis, dots, line, plot
from estimator.report.page.series import BLOCKS, binned
from estimator.report.page.tables import table
from estimator.report.parameter_text import ROWS, Row
from estimator.report.wanted_driving import BEGUN, OCCUPIED, WANTED
from estimator.report.wording import label
from estimator.units import KMH

ACROSS = 5  # ticks of one of three plots side by side
NBSP = "\N{NO-BREAK SPACE}"
CHAINS = 4  # that are drawn
KINDS = {OCCUPIED: "occupied", BEGUN: "begun", WANTED: "wanted"}
PILLS = {Status.ESTIMATED: "no-gap", Status.UNESTIMATED: "cannot-tell", Status.INVALID: "effect"}
TERMS = (
    ("interval", "holds the value with a probability of 90 %, by the noise of the signals and the hidden road"),
    ("mass", "moving mass, rotating parts included"),
    ("A", "force that does not change with speed: rolling, and friction behind the place where power is measured"),
    ("C", "drag over the square of the speed: half the density of the air times the drag area"),
    ("c_rr", "A over the weight of the moving mass"),
    ("c_d A", "drag coefficient times frontal area, 2 C over the density of the air"),
    ("F0, F1, F2", "coefficients of a coast-down sheet, F = F0 + F1 v + F2 v² with v in km/h; the model has no F1"),
    ("residual", "measured power minus that of the fit, with the road; means over 1 s"),
    ("occupied", "a cell of speed and acceleration with enough driving in it"),
)


def write_page(view: EstimateView, path: Path) -> None:
    """Write the page to ``path``; errors as of `write_document`."""
    write_document(page(view), path)


def page(view: EstimateView) -> str:
    """The whole document."""
    power = view.power
    return document(
        f"{view.headline} \N{EN DASH} roadload",
        _header(view),
        [
            Section("answer", "The answer", _answer(view)),
            Section("time", "How it formed", _history(view)),
            Section("coverage", "What was driven", _coverage(view)),
            Section("power", "Power, measured and fitted", "" if power is None else _power(view, power)),
            Section("joint", "Joint posterior", _joint(view)),
            Section("chains", "Chains", _chains(view)),
            Section(
                "terms", "Terms", "<dl>" + "".join(f"<dt>{name}</dt><dd>{text}</dd>" for name, text in TERMS) + "</dl>"
            ),
        ],
    )


def _header(view: EstimateView) -> str:
    final = view.final
    duration = clock(final.t - view.start)
    facts = [html.escape(fact) for fact in (view.title, view.date, f"{duration} of traffic") if fact]
    is_known = final.status is Status.ESTIMATED
    lines = [f'<p class="reason">{html.escape(_words(view))}</p>'] if is_known else []
    lines += [f'<p class="note">{html.escape(warning)}</p>' for warning in view.warnings]
    headline = f"Mass {view.headline}" if is_known else view.headline[:1].upper() + view.headline[1:]
    listed = "</span> <span>".join(facts)
    return (
        f'<header class="{PILLS[final.status]}"><p class="logs">Estimate <span>{listed}</span></p>'
        f'<p class="verdict">{final.status.value}</p><h1>{html.escape(headline)}</h1>{"".join(lines)}</header>'
    )


def _words(view: EstimateView) -> str:
    """Rolling resistance and drag in one sentence."""
    parameters, coefficients = summary.parameters(view.final), summary.coefficients(view.final)
    by_name = {
        x.row.name: x.row.value(x.mean).replace(" ", NBSP) for x in parameter_text.known(parameters, coefficients)
    }
    parts = [
        f"{what} {', '.join(f'{name}{NBSP}{by_name[name]}' for name in names)}"
        if names[0] in by_name
        else f"{what} unestimated"
        for what, names in (("rolling resistance", ("A", "c_rr")), ("drag", ("C", "c_d A")))
    ]
    text = "; ".join(parts)
    return f"{text[:1].upper()}{text[1:]}."


def _answer(view: EstimateView) -> str:
    """The values with their intervals, the reasons where there are none, and what they hold for."""
    final = view.final
    parameters, coefficients = summary.parameters(final), summary.coefficients(final)
    rows = [
        (x.row.name, x.row.value(x.mean), x.row.interval(x.q05, x.q95), f"{100 * x.sd / x.mean:.2f} %")
        for x in parameter_text.known(parameters, coefficients)
    ]
    for row in parameter_text.COAST_DOWN:
        x = row.of(coefficients.coast_down)
        if x.mean is not None and x.sd is not None and x.q05 is not None and x.q95 is not None:
            rows.append((row.name, row.value(x.mean), row.interval(x.q05, x.q95), f"{100 * x.sd / x.mean:.2f} %"))
    content = table(("", "mean", "90 % interval", "sd"), rows, "answer")
    withheld = "".join(f"<li>{name} unestimated: {html.escape(reason)}</li>" for name, reason in final.withheld.items())
    notes = [f"Effect in the model: {label(name)}, {effect_size(name, size)}." for name, size in final.effects.items()]
    notes += [f"Air: {parameter_text.air(coefficients)}."] if final.C is not None else []
    if (road := summary.road(final)) is not None:
        notes.append(f"Road: {parameter_text.road(road)}.")
    return content + (f'<ul class="advice">{withheld}</ul>' if withheld else "") + _soft(*notes)


def _history(view: EstimateView) -> str:
    """Mean and interval of each parameter at every update."""
    figures = "".join(_formed(view, row) for row in ROWS)
    if not figures:
        return ""
    note = f"Every update ({len(view.updates)}); lines are means, bands 90 % intervals, the dot is the answer."
    return (
        f'<div class="columns figures">{figures}</div>{_soft(note, "The first bands may be wider than the drawing.")}'
    )


def _formed(view: EstimateView, row: Row) -> str:
    curve = view.curve(row)
    known = np.isfinite(curve.mean)
    if not known.any():
        return ""
    x, y = clock_axis(np.array([0.0, 1.02 * curve.t[-1]])), axis(curve.range, row.unit, margin=0.06)
    answer = curve.answer
    shapes = band(x, y, curve.t, curve.low, curve.high, "band after") + line(x, y, curve.t, curve.mean, "line after")
    shapes += dots(x, y, curve.t[answer], curve.mean[answer], "answer")
    told = "".join(row.value(mean) for mean in curve.mean[answer].tolist()) or "unestimated"
    return plot(shapes, x, y, f"{row.name} over time: {_ends(curve, row)}", f"{row.name} {told}", "strip", ACROSS)


def _ends(curve: Curve, row: Row) -> str:
    known = np.flatnonzero(np.isfinite(curve.mean))[[0, -1]].tolist()
    told = (f"{row.interval(float(curve.low[i]), float(curve.high[i]))} at {clock(float(curve.t[i]))}" for i in known)
    return f"interval {', '.join(told)}"


def _coverage(view: EstimateView) -> str:
    """The grid of speed and acceleration, and what is still wanted."""
    cells, coverage = view.cells, view.final.coverage
    states = wanted_driving.cell_states(cells)
    if not states:
        return ""
    speeds, accelerations = np.array(sorted(states)).T
    dv, da, lowest = KMH * cells.speed_step_m_s, cells.acceleration_step_m_s2, cells.lowest_acceleration_m_s2
    x = axis([0.0, dv * (speeds.max() + 1)], "speed [km/h]")
    y = axis([lowest + da * accelerations.min(), lowest + da * (accelerations.max() + 1)], "acceleration [m/s²]")
    rows = {(i, j): count for i, j, count in cells.rows}
    shapes = []
    for (i, j), state in sorted(states.items()):
        corners = (i * dv, (i + 1) * dv, lowest + j * da, lowest + (j + 1) * da)
        content = "wanted" if state == WANTED else f"{rows[i, j]:,} samples"
        where = f"{corners[0]:.0f} to {corners[1]:.0f} km/h, {corners[2]:.2f} to {corners[3]:.2f} m/s²"
        shapes.append(cell(x, y, corners, KINDS[state], 1.0, signed(f"{where}: {content}")))
    counts = {kind: sum(state == k for state in states.values()) for k, kind in KINDS.items()}
    legend = "".join(f'<li><b class="{kind}"></b>{kind} <span>{count}</span></li>' for kind, count in counts.items())
    occupied, available = coverage.occupied, coverage.available
    beyond = counts[KINDS[OCCUPIED]] - occupied
    more = f"; so are {beyond} beyond it" if beyond > 0 else ""
    share = f"{occupied} of the {available} cells within reach are occupied, {100 * coverage.fraction:.0f} %{more}."
    sentences = [share] if available else []
    if wanted := wanted_driving.wanted(cells):
        sentences.append(f"Still wanted: {wanted}.")
    words = f"Coverage: {', '.join(f'{count} cells {kind}' for kind, count in counts.items())}"
    text = html.escape(" ".join(sentences))
    return f"<p>{text}</p>" + plot("".join(shapes), x, y, words, kind="map") + f'<ul class="legend">{legend}</ul>'


def _power(view: EstimateView, power: PowerTrace) -> str:
    """Power and residual in the minutes that the fit misses most, and the residual of all."""
    part, rms = power.telling, view.final.rms
    x = clock_axis(part.t)
    curves = {"measured": part.measured, "after": part.fitted}
    y = axis(np.concatenate(list(curves.values())).tolist(), "power [kW]", zero=True, margin=0.04)
    shapes = "".join(line(x, y, part.t, values, f"line {kind}") for kind, values in curves.items())
    span = " to ".join(clock(float(end)) for end in (np.nanmin(part.t), np.nanmax(part.t)))
    key = '<p class="key"><span class="measured">measured</span><span class="after">fitted</span></p>'
    stated = "" if rms is None else f", root mean square {rms / 1e3:.1f} kW over {int(np.isfinite(power.t).sum()):,} s"
    return (
        f"<p>The five minutes in which the fit misses most, {span}; gaps are moments that are not used.</p>{key}"
        + plot(shapes, x, y, f"Power from {span}: measured, fitted", kind="trace")
        + _residual(part, x, "", 0)
        + f"<h3>Residual of the whole fit{stated}</h3>"
        + _residual(power, clock_axis(power.t), "whole", BLOCKS)
    )


def _residual(power: PowerTrace, x: Axis, kind: str, blocks: int) -> str:
    """A strip of the residual; with ``blocks``, the line of their means too."""
    residual = power.residual
    y = axis(residual.tolist(), f"measured {MINUS} fitted [kW]", zero=True, margin=0.06)
    shapes = line(x, y, power.t, residual, "line residual")
    if blocks:
        centres, _, _, mean = binned(x, power.t, residual, blocks)
        shapes += line(x, y, centres, mean, "line mean")
    words = f"Residual from {np.nanmin(residual):.1f} to {np.nanmax(residual):.1f} kW"
    return plot(shapes, x, y, words, kind=f"strip {kind}".strip())


def _joint(view: EstimateView) -> str:
    """Pairs of the draws, with the 90 % interval of the abscissa shaded."""
    if view.evidence is None or len(view.rows) < 2:
        return ""
    plots = []
    for across, up in combinations(view.rows, 2):
        u, v = view.draws(across), view.draws(up)
        x, y = (axis(w.tolist(), f"{row.name} [{row.unit}]", margin=0.03) for row, w in ((across, u), (up, v)))
        low, high = np.quantile(view.chains(across), [0.05, 0.95]).tolist()
        r = signed(f"{np.corrcoef(view.chains(across).ravel(), view.chains(up).ravel())[0, 1]:.2f}")
        title = f"{up.name} over {across.name}, correlation {r}"
        shapes = bar(x, low, high, "span") + dots(x, y, u, v, "cloud")
        plots.append(plot(shapes, x, y, f"{len(u)} draws: {title}", title, "map", ACROSS))
    note = f"{len(u):,} of the draws; shaded is the 90 % interval of the quantity across."
    return f'<div class="columns figures">{"".join(plots)}</div>{_soft(note, *_not_drawn(view))}'


def _chains(view: EstimateView) -> str:
    """The first chains, and how well all of them agree."""
    found = view.final.convergence
    if view.evidence is None or found is None:
        return ""
    plots = []
    for row in view.rows:
        chains = view.chains(row)[:CHAINS]
        at = np.arange(chains.shape[1], dtype=float)
        x, y = axis(at.tolist(), "draw"), axis(chains.ravel().tolist(), row.unit, margin=0.04)
        shapes = "".join(line(x, y, at, chain, f"line chain-{k}") for k, chain in enumerate(chains))
        plots.append(plot(shapes, x, y, f"{row.name} along {len(chains)} chains", row.name, "strip", ACROSS))
    words = f"{found.chains} chains of {found.draws} draws; the first {len(chains)} are drawn. "
    words += f"R-hat {found.r_hat:.3f}, {found.ess_bulk:,.0f} effective draws, {100 * found.acceptance:.0f} % accepted."
    return f'<p>{words}</p><div class="columns figures">{"".join(plots)}</div>{_soft(*_not_drawn(view))}'


def _not_drawn(view: EstimateView) -> list[str]:
    return [f"{row.name} is unestimated, so its draws are not shown." for row in ROWS if row not in view.rows]


def _soft(*sentences: str) -> str:
    return f'<p class="soft">{html.escape(" ".join(sentences))}</p>' if sentences else ""
