"""Check the diagnosis of any residual on drawn records whose causes are known.

    python tools/check_residual.py [--records 400] [--seed 1]

Each record has noise with a memory, five candidate columns, two axes, and a base that is fitted anew. A third of the
records is clean, a third has one candidate, a sixth two, a sixth something that is no candidate: the square of an axis.
"""

import argparse
import sys
from collections import Counter
from dataclasses import dataclass

import numpy as np
from harness.check import Cells, Check, Figures, Table, percent, progress

from estimator import Axis, Candidate, diagnose_residual
from estimator.residual.answer import ResidualDiagnosis
from estimator.residual.noise import Noise, Scales
from estimator.signals import Floats

SAMPLES, STEP = 1500, 0.5  # s
USUAL = 0.6  # magnitude of a candidate: standard deviation of those drawn, and of its prior
MIN_CLEAR = 5.0  # standard deviations, by the true noise, from which a cause is counted as visible
SDS_OF_90_PERCENT = 1.645
OUTSIDE = "no candidate"


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """A record: residual (n,), candidates, axes, base; sizes of what acts, and how clear each is [sd]."""

    t: Floats
    residual: Floats
    candidates: dict[str, Candidate]
    axes: dict[str, Axis]
    base: Floats
    sizes: dict[str, float]
    clarity: dict[str, float]


def drawn(rng: np.random.Generator) -> Drawn:
    """One record."""
    t = np.arange(SAMPLES) * STEP
    noise = Noise(t, Scales(1.0, float(rng.uniform(0.1, 1.5)), float(rng.uniform(1.0, 12.0))))
    x, z = (Noise(t, Scales(1e-3, 1.0, memory)).draw(rng) for memory in rng.uniform(5.0, 60.0, 2).tolist())
    columns = {"slide": x, "drag": np.abs(x) * x, "step": (t > rng.uniform(200, 600)) * 1.0, "product": x * z}
    columns["late"] = np.gradient(z, STEP)
    candidates = {name: Candidate(column, USUAL, positive=name == "drag") for name, column in columns.items()}
    base = np.column_stack([np.ones(SAMPLES), np.sin(t / 25)])
    kind = rng.choice(4, p=[1 / 3, 1 / 3, 1 / 6, 1 / 6])
    acting = rng.choice(sorted(columns), size=min(int(kind), 2), replace=False).tolist() if kind < 3 else [OUTSIDE]
    sizes = {name: float(rng.normal(0, USUAL)) for name in acting}
    sizes = {name: abs(size) if name == "drag" else size for name, size in sizes.items()}
    true = columns | {OUTSIDE: z**2}
    clarity = {name: abs(size) * clear(noise, base, true[name]) for name, size in sizes.items()}
    residual = noise.draw(rng) + base @ rng.normal(0, 5, 2)
    for name, size in sizes.items():
        residual = residual + size * true[name]
    axes = {"x": Axis(x, "m"), "z": Axis(z, "s")}
    return Drawn(t=t, residual=residual, candidates=candidates, axes=axes, base=base, sizes=sizes, clarity=clarity)


def clear(noise: Noise, base: Floats, column: Floats) -> float:
    """Standard deviations by which a magnitude of 1 is seen beside the base."""
    gram = noise.gram(np.column_stack([column, base]))
    left = gram[0, 0] - gram[0, 1:] @ np.linalg.solve(gram[1:, 1:], gram[1:, 0])
    return float(np.sqrt(left))


def counted(record: Drawn, found: ResidualDiagnosis, tally: Counter[str]) -> None:
    """Add a record's outcome to the ``tally``."""
    wrong = set(found.named) - set(record.sizes)
    if not record.sizes:
        tally["clean"] += 1
        tally["clean: a name or unknown"] += found.verdict.value in {"effect", "unknown effect"}
        tally["clean: cannot tell"] += found.verdict.value == "cannot tell"
    for name, size in record.sizes.items():
        visible = record.clarity[name] > MIN_CLEAR
        if name == OUTSIDE:
            tally["outside, visible"] += visible
            tally["outside, visible: unknown"] += visible and found.verdict.value == "unknown effect"
            tally["outside: a name"] += bool(wrong)
            tally["outside"] += 1
            tally["outside, visible: its formula"] += (
                visible and found.formula is not None and found.formula.text == "z^2"
            )
            continue
        tally["acting, visible"] += visible
        tally["acting, visible: named"] += visible and name in found.named
        suspect = next(suspect for suspect in found.suspects if suspect.name == name)
        tally["acting"] += 1
        tally["acting: interval holds"] += abs(suspect.value - size) < SDS_OF_90_PERCENT * suspect.sd
    if record.sizes and OUTSIDE not in record.sizes:
        tally["with candidates"] += 1
        tally["with candidates: a wrong name"] += bool(wrong)


def measure(options: argparse.Namespace) -> Figures:
    """Counts of outcomes, and the bound on false alarms that is promised."""
    tally: Counter[str] = Counter()
    bound = 0.0
    for number in progress(range(options.records), "diagnosing"):
        record = drawn(np.random.default_rng([options.seed, number]))
        found = diagnose_residual(
            record.residual,
            record.candidates,
            record.t,
            rng=np.random.default_rng([options.seed, number, 1]),
            base=record.base,
            along=record.axes,
        )
        counted(record, found, tally)
        bound = found.max_false_alarms
    return {"counts": {name: int(tally[name]) for name in sorted(tally)}, "bound_on_false_alarms": bound}


def tables(figures: Figures) -> list[Table]:
    """Counts and shares."""
    tally, rows = figures["counts"], []
    for name, count in tally.items():
        whole = name.split(":")[0]
        rows.append([name, str(count), "" if whole == name else percent(count / max(tally[whole], 1))])
    bound = ["bound on false alarms", "", percent(figures["bound_on_false_alarms"])]
    return [Table("", ("", "records", "share"), [*rows, bound])]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the records."""
    parser.add_argument("--records", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)


CHECK = Check(
    title="The residual of any model",
    measure=measure,
    tables=tables,
    headline=Cells(rows=("acting, visible: named", "clean: a name"), columns=("records", "share")),
    options=add_options,
)

if __name__ == "__main__":
    sys.exit(CHECK.main())
