"""Page of a fleet that opens offline: outliers, A/m and C, masses by day, seasons, gaps, the road."""

import html
import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np

from estimator.columns import Row
from estimator.diagnosis.result import HIDDEN_GRADE, SHOWN_SLOPE, Magnitude
from estimator.fleet.population import MIN_VEHICLES
from estimator.fleet.road import LearnedRoad
from estimator.fleet.road_page import road_figures
from estimator.fleet.seasons import SEASONS
from estimator.fleet.tables import UNUSED, doubts
from estimator.report import wording
from estimator.report.number_format import NOTHING, counted, rounded, signed, with_sd
from estimator.report.page.document import Section, document
from estimator.report.page.plot import DAY, DateAxis, axis, dots, plot, rods
from estimator.report.page.tables import table
from estimator.report.parameter_text import COEFFICIENTS
from estimator.signals import Floats
from estimator.streaming.row_stream import MIN_SET_CLOCK
from estimator.units import STANDARD_DENSITY

MAX_ROWS = 40  # of a list; the others are folded away
MAX_NAMED = 3  # deviations in the headline
HOUR = 60.0  # min
SHORT = 10  # h of driving, given in minutes below
STRONG_CHANGE = 10.0  # %, shown in the full colour
PARAMETERS = (("A_per_mass_N_kg", "A/m", "N/kg"), ("C_N_s2_m2", "C", "N s²/m²"))
DERIVED = dict(zip((name for name, _, _ in PARAMETERS), COEFFICIENTS, strict=True))  # what follows from each
HOW_SHOWN = {SHOWN_SLOPE: ", shown by signals", HIDDEN_GRADE: ", shown by no signal"}  # by the magnitude of a road
NUMBERS = re.compile(r"[+-]?\d[\d.,]*")
TERMS = (
    ("A/m", "rolling and friction force over the moving mass, rotating parts included"),
    ("c_rr", "A/m over the standard gravity; it has all friction behind the place where power is measured"),
    ("C", "aerodynamic force over the square of the speed; it holds for the density of the air on the drive"),
    (
        "c_d A",
        f"2 C over the density of the air, that of the newest drive that has it, else {STANDARD_DENSITY} kg/m³",
    ),
    (
        "interval",
        "90 %, of the vehicle as at its newest drive; single drives scatter around it, with the wind for one",
    ),
    (
        "out of line",
        "beyond what the other vehicles predict, with its difference from the median of all; the q value is the share "
        "of false ones to be expected",
    ),
)


@dataclass(frozen=True, kw_only=True)
class Tables:
    """Rows of the tables of a fleet, its road, and the false-discovery ``rate`` for outliers."""

    drives: Sequence[Row]
    vehicles: Sequence[Row]
    seasons: Sequence[Row]
    effects: Sequence[Row]
    road: LearnedRoad
    rate: float


def page(of: Tables) -> str:
    """HTML document of the page."""
    sections = [
        Section("outliers", "Which vehicles are out of line?", _outliers(of)),
        Section("vehicles", "A/m and C by vehicle", _vehicles(of.vehicles)),
        Section("masses", "Masses by day", _masses(of.drives)),
        Section("seasons", "A/m and C by season", _seasons(of)),
        Section("gaps", "Gaps by cause", _gaps(of)),
        Section("road", "The learned road", road_figures(of.road)),
        Section("unused", "What was not estimated", _unestimated(of)),
        Section("terms", "Terms", _terms()),
    ]
    return document(_headline(of), _header(of), sections)


def _headline(of: Tables) -> str:
    """The vehicles that are out of line; the extent of the fleet where there are none."""
    deviations = sorted(_deviations(of), key=lambda deviation: -abs(deviation.share))
    if not deviations:
        return _extent(of)
    told = ", ".join(f"{one.row['vehicle']} {one.words}" for one in deviations[:MAX_NAMED])
    rest = len(deviations) - MAX_NAMED
    return told + (f"; and {rest} more" if rest > 0 else "")


def _extent(of: Tables) -> str:
    drives = len({row["source"] for row in of.drives if row["status"] not in UNUSED})
    minutes = sum(row["minutes"] for row in of.vehicles)
    driven = f"{minutes / HOUR:,.0f} h" if minutes >= SHORT * HOUR else f"{minutes:.0f} min"
    return f"{counted(len(of.vehicles), 'vehicle')}, {counted(drives, 'drive')}, {driven}"


def _header(of: Tables) -> str:
    named = [row["vehicle"] for row in of.vehicles if row["outlier"]]
    none = "none out of line" if _is_compared(of.vehicles) else "not compared"
    pill = f"{counted(len(named), 'vehicle')} out of line" if named else none
    estimated = sum(row["status"] == "estimated" for row in of.drives)
    with_drag = sum("C_N_s2_m2_mean" in row for row in of.vehicles)
    words = f"{_extent(of)}. " if named else ""
    words += f"The mass is known of {counted(estimated, 'load')}, C of {_of_all(with_drag, len(of.vehicles))}. "
    others = Counter(row["status"] for row in of.drives if row["status"] != "estimated")
    words += "; ".join(f"{count:,} {status}" for status, count in others.most_common()) + ("." if others else "")
    kind = "unknown-effect" if named else "no-gap"
    return (
        f'<header class="{kind}"><p class="logs">Fleet <span>{_days(of.drives)}</span></p>'
        f'<p class="verdict">{pill}</p><h1>{html.escape(_headline(of))}</h1>'
        f'<p class="reason">{html.escape(words)}</p></header>'
    )


def _of_all(count: int, vehicles: int) -> str:
    """``5 of 6 vehicles``; ``6 vehicles`` and ``no vehicle`` for all and none."""
    if count == 0:
        return "no vehicle"
    return f"{count:,} of {counted(vehicles, 'vehicle')}" if count < vehicles else counted(count, "vehicle")


def _days(rows: Sequence[Row]) -> str:
    times = [row["start"] for row in rows if row["start"] >= MIN_SET_CLOCK]
    if not times:
        return "no clock was set"
    first, last = (datetime.fromtimestamp(t, UTC) for t in (min(times), max(times)))
    return f"{first:%Y-%m-%d} to {last:%Y-%m-%d}"


@dataclass(frozen=True, kw_only=True)
class _Deviation:
    """A parameter, by its column and short name, of the vehicle in a ``row`` that is out of line by a ``share``."""

    row: Row
    name: str
    short: str
    unit: str
    share: float  # of the median of all vehicles
    q: float

    @property
    def words(self) -> str:
        """``rolls 28 % harder`` or ``has 23 % more drag``."""
        size = f"{100 * abs(self.share):.0f} %"
        if self.short == "C":
            return f"has {size} {'more' if self.share > 0 else 'less'} drag"
        return f"rolls {size} {'harder' if self.share > 0 else 'more easily'}"


def _deviations(of: Tables) -> list[_Deviation]:
    return [
        _Deviation(row=row, name=name, short=short, unit=unit, share=row[f"{name}_mean"] / middle - 1, q=row[q])
        for (name, short, unit), q in zip(PARAMETERS, ("A_per_mass_q_value", "C_q_value"), strict=True)
        for middle in [_median(of.vehicles, name)]
        for row in of.vehicles
        if f"{name}_mean" in row and row[q] <= of.rate
    ]


def _outliers(of: Tables) -> str:
    rows = [
        (
            html.escape(one.row["vehicle"]),
            one.short,
            with_sd(one.row[f"{one.name}_mean"], one.row[f"{one.name}_sd"], one.unit),
            signed(f"{100 * one.share:+.0f} %"),
            f"{one.q:.2g}",
        )
        for one in _deviations(of)
    ]
    if rows:
        headings = ("vehicle", "parameter", "value", "against the median", "q value")
        return table(headings, rows, "outliers")
    reason = f"No vehicle differs from the others at a false-discovery rate of {100 * of.rate:.2g} %."
    few = f"Too few vehicles have A/m or C to compare them: {MIN_VEHICLES} are needed."
    return f"<p>{reason if _is_compared(of.vehicles) else few}</p>"


def _is_compared(rows: Sequence[Row]) -> bool:
    return any(np.isfinite([row["C_q_value"], row["A_per_mass_q_value"]]).any() for row in rows)


def _median(rows: Sequence[Row], name: str) -> float:
    means = [row[f"{name}_mean"] for row in rows if f"{name}_mean" in row]
    return float(np.median(means)) if means else np.nan


def _vehicles(rows: Sequence[Row]) -> str:
    lists = []
    for name, short, unit in PARAMETERS:
        estimated = sorted((row for row in rows if f"{name}_mean" in row), key=lambda row: -row[f"{name}_mean"])
        if estimated:
            heading = f"{short} [{unit}], {DERIVED[name].name}"
            lists.append(f"<div><h3>{heading}</h3>{_folded(_intervals(estimated, name, short))}</div>")
    if not lists:
        reasons = Counter(row["C_reason"] for row in rows if row["C_reason"])
        why = "".join(f": {html.escape(reason)}" for reason, _ in reasons.most_common(1))
        return f"<p>No vehicle has A/m or C estimated yet{why}.</p>"
    note = "Each as at its newest drive, with 90 % intervals, largest first; the line is the median of the vehicles."
    return f'<p class="soft">{note}</p><div class="columns">{"".join(lists)}</div>'


def _intervals(rows: Sequence[Row], name: str, short: str) -> list[str]:
    """One entry for each vehicle: a dot and its interval, on a common scale."""
    scale = axis([row[f"{name}_{end}"] for row in rows for end in ("q05", "q95")], "", margin=0.03)
    middle = _share(scale.at(np.array([_median(rows, name)])))
    entries = []
    for row in rows:
        low, at, high = (_share(scale.at(np.array([row[f"{name}_{part}"]]))) for part in ("q05", "mean", "q95"))
        kind = "out" if f"{short} " in row["outlier"] else "in"
        value = html.escape(with_sd(row[f"{name}_mean"], row[f"{name}_sd"], ""))
        derived = html.escape(DERIVED[name].value(row[f"{DERIVED[name].key}_mean"]))
        entries.append(
            f'<li class="{kind}"><span>{html.escape(row["vehicle"])}</span><b class="track">'
            f'<s style="left:{middle:.1f}%"></s>'
            f'<i class="range" style="left:{low:.1f}%;width:{max(high - low, 0.5):.1f}%"></i>'
            f'<i class="point" style="left:{at:.1f}%"></i></b><span>{value} <small>{derived}</small></span></li>'
        )
    return entries


def _share(position: Floats) -> float:
    return float(position[0]) / 10


def _folded(entries: Sequence[str]) -> str:
    first, rest = "".join(entries[:MAX_ROWS]), "".join(entries[MAX_ROWS:])
    more = f'<details><summary>{len(entries) - MAX_ROWS} more</summary><ul class="bars intervals">{rest}</ul></details>'
    return f'<ul class="bars intervals">{first}</ul>' + (more if rest else "")


def _masses(rows: Sequence[Row]) -> str:
    timed = [row for row in rows if "mass_kg_mean" in row and row["start"] >= MIN_SET_CLOCK]
    if not timed:
        return ""
    day = np.array([row["start"] for row in timed]) / DAY
    mean, low, high = (np.array([_tonnes(row, part) for row in timed]) for part in ("mean", "q05", "q95"))
    days = axis([day.min() - 0.5, day.max() + 0.5], "")
    x = DateAxis(days.low, days.high, "day, UTC")
    y = axis([*low.tolist(), *high.tolist()], "mass [t]", zero=True, margin=0.04)
    words = f"Masses of {len(timed)} loads from {mean.min():.1f} to {mean.max():.1f} t by day"
    shapes = rods(x, y, day, low, high, "after") + dots(x, y, day, mean, "after")
    note = f"A dot is a load, {len(timed):,} in all, given all drives of its vehicle where they are joined; "
    note += "bars are 90 % intervals. Loads without a set clock are left out."
    return f'<p class="soft">{note}</p>' + plot(shapes, x, y, words, kind="trace") + _loads_by_vehicle(timed)


def _tonnes(row: Row, part: str) -> float:
    """Mass of a load [t] given all drives of its vehicle, else given its drive alone."""
    return float(row.get(f"joint_mass_kg_{part}", row[f"mass_kg_{part}"])) / 1e3


def _loads_by_vehicle(timed: Sequence[Row]) -> str:
    masses: dict[str, list[float]] = defaultdict(list)
    for row in timed:
        masses[row["vehicle"]].append(_tonnes(row, "mean"))
    rows = [
        (html.escape(vehicle), f"{len(loads):,}", *(rounded(float(np.quantile(loads, q)), 1) for q in (0.0, 0.5, 1.0)))
        for vehicle, loads in sorted(masses.items())
    ]
    content = table(("vehicle", "loads", "lightest [t]", "median [t]", "heaviest [t]"), rows, "loads")
    return f"<details><summary>Masses by vehicle</summary>{content}</details>"


def _seasons(of: Tables) -> str:
    shown = [season for season in SEASONS if any(row["season"] == season for row in of.seasons)]
    if len(shown) < 2:
        return f"<p>All drives are in one season, {shown[0]}.</p>" if shown else ""
    parts = []
    for name, short, _ in PARAMETERS:
        by_season: dict[str, dict[str, tuple[float, float]]] = defaultdict(dict)
        for row in of.seasons:
            if f"{name}_mean" in row:
                by_season[row["vehicle"]][row["season"]] = row[f"{name}_mean"], row[f"{name}_sd"]
        if by_vehicle := {vehicle: _in_per_cent(seasons) for vehicle, seasons in by_season.items() if len(seasons) > 1}:
            parts.append(f"<div><h3>{short}</h3>{_changes(by_vehicle, shown)}</div>")
    note = (
        "Change [%] and its sd in these months of any year, against the mean of the vehicle's seasons, of two or more."
    )
    note += " The values are in seasons.parquet."
    return f'<p class="soft">{note}</p><div class="columns">{"".join(parts)}</div>'


def _in_per_cent(by_season: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
    """Changes [%] and sds by season from the mean of a vehicle's k seasons; each season is part of that mean."""
    values, sds = np.array(list(by_season.values())).T
    middle, k = values.mean() / 100, len(values)
    variances = ((1 - 1 / k) ** 2 - 1 / k**2) * sds**2 + (sds**2).sum() / k**2
    changes = zip((values / middle - 100).tolist(), (np.sqrt(variances) / middle).tolist(), strict=True)
    return dict(zip(by_season, changes, strict=True))


def _changes(by_vehicle: Mapping[str, Mapping[str, tuple[float, float]]], shown: Sequence[str]) -> str:
    """Table of the changes [%] of vehicles by season; first row: median over vehicles with the most common seasons."""
    usual, _ = Counter(tuple(sorted(changes)) for changes in by_vehicle.values()).most_common(1)[0]
    alike = [changes for changes in by_vehicle.values() if tuple(sorted(changes)) == usual]
    medians = {season: (float(np.median([changes[season][0] for changes in alike])), 0.0) for season in usual}
    rows = [_change_row("all, median", medians, shown)]
    rows += [_change_row(html.escape(name), changes, shown) for name, changes in list(by_vehicle.items())[:MAX_ROWS]]
    head = "".join(f'<th scope="col">{season}</th>' for season in shown)
    left_out = len(by_vehicle) - MAX_ROWS
    rest = f'<p class="soft">{left_out} more vehicles are in seasons.parquet.</p>' if left_out > 0 else ""
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="Changes by season"><table class="matrix changes">'
        f"<thead><tr><td></td>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>{rest}"
    )


def _change_row(name: str, changes: Mapping[str, tuple[float, float]], shown: Sequence[str]) -> str:
    cells = []
    for season in shown:
        if season not in changes:
            cells.append("<td></td>")
            continue
        change, sd = changes[season]
        kind, strength = ("high" if change > 0 else "low"), 60 * min(abs(change) / STRONG_CHANGE, 1)
        spread = f" ± {sd:.1f}" if sd else ""
        cells.append(f'<td class="{kind}" style="--r:{strength:.0f}%">{signed(f"{change:+.1f}")}{spread}</td>')
    return f'<tr><th scope="row">{name}</th>{"".join(cells)}</tr>'


def _gaps(of: Tables) -> str:
    verdicts = Counter(row["verdict"] for row in of.drives if row.get("verdict") and not row.get("segment"))
    if not verdicts:
        return "<p>The drives were not diagnosed; <code class='whole'>--diagnose</code> does it.</p>"
    diagnosed = sum(verdicts.values())
    by_effect: dict[tuple[str, str, str], list[Row]] = defaultdict(list)
    for row in of.effects:
        by_effect[row["effect"], row["magnitude"], row["unit"]].append(row)
    rows: list[tuple[Any, ...]] = []
    for (effect, quantity, unit), effects in sorted(by_effect.items(), key=lambda item: -len(item[1])):
        middle = float(np.median([abs(row["value"]) for row in effects]))
        size = wording.size(Magnitude(quantity, middle, np.nan, unit))
        share = 100 * len(effects) / diagnosed
        bar = f'<b class="bar"><i class="after" style="width:{min(share, 100):.1f}%"></i></b>'
        vehicles = len({row["vehicle"] for row in effects})
        cause = wording.label(effect) + HOW_SHOWN.get(quantity, "")
        meter = f'<span class="meter">{bar}{share:.0f} %</span>'
        rows.append((html.escape(cause), f"{len(effects):,}", meter, f"{vehicles:,}", html.escape(size)))
    said = ", ".join(f"{verdict} {count:,}" for verdict, count in verdicts.most_common())
    headings = ("cause", "drives", "of the diagnosed", "vehicles", "usual size, absolute")
    return f"<p>{counted(diagnosed, 'drive')} diagnosed: {html.escape(said)}.</p>{table(headings, rows, 'gaps')}"


def _unestimated(of: Tables) -> str:
    """Numbers of rows by status and reason, where reasons that differ in numbers only count as one, and doubts."""
    alike: dict[tuple[str, str], list[Row]] = defaultdict(list)
    for row in of.drives:
        if row["status"] != "estimated":
            alike[row["status"], NUMBERS.sub("…", row["reason"].removeprefix(f"{row['source']}: "))].append(row)
    cells = []
    for (status, reason), rows in sorted(alike.items(), key=lambda item: -len(item[1]))[:MAX_ROWS]:
        source = rows[0]["source"]
        text = reason if len(rows) > 1 else rows[0]["reason"].removeprefix(f"{source}: ")
        cells.append(tuple(map(html.escape, (status, f"{len(rows):,}", text or NOTHING, source))))
    notes = [f"<li>{html.escape(doubt)}</li>" for doubt in doubts(of.drives, of.vehicles)]
    listed = f'<h3>Doubts</h3><ul class="advice">{"".join(notes[:MAX_ROWS])}</ul>' if notes else ""
    return table(("status", "rows", "reason", "for example"), cells, "reasons") + listed


def _terms() -> str:
    return "<dl>" + "".join(f"<dt>{term}</dt><dd>{html.escape(meaning)}</dd>" for term, meaning in TERMS) + "</dl>"
