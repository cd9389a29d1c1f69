"""The catalogue of effects as a page, from the objects themselves.

python tools/effects_table.py > docs/effects.md
"""

import numpy as np

from estimator.effects import CATALOGUE, SOURCES, Effect, Timing
from estimator.signals import Floats, Quantity

TRUCK: Floats = np.array([1740.0, 3.74, 27_000.0])  # A [N], C [N s^2/m^2], m [kg] of a loaded tractor and semi-trailer
WHEN = {
    Timing.ALWAYS: "always",
    Timing.WINDOW: "once, for a while",
    Timing.SWITCHING: "on and off",
    Timing.STEP: "from a standstill on",
}
PAGE = """\
# Effects

What the plain road load `P = A v + C v³ + m v dv/dt` leaves out, and `roadload diagnose` looks for. The tables are
printed by `tools/effects_table.py` from the objects in `estimator/effects/`: the same objects are the
candidates of the diagnosis, the terms of the streaming model (`effects = ["grade"]`, `--effect grade`) and this page.

## What it adds to the power

`v` speed, `a` acceleration, `w` engine speed, `F = P / v`, `t` time, `u(t)` 0 or 1; SI units. The usual size is that
for a truck of 27 t (A 1,740 N, C 3.74 N s²/m²): sizes like it are expected beforehand, others are not excluded.

{equations}

## What shows it

Not told apart: to first order the two leave the same trace in power and speed on any drive. Others may do so on a
given drive; the diagnosis says which. Streams: it can be part of the model that estimates. What does not stream is
diagnosed only, because its times have to be found afterwards; or the fit takes it up: A, C and m do, whatever its
size, and the alignment of power and speed does with a lag, which the diagnosis reports.

{signals}

## Sources

{sources}

## One more

An effect is one object. With this added to `CATALOGUE` the diagnosis ranks it, the configuration knows it and it
appears above:

```python
Effect(
    "shimmy",
    "F v exp(-((v - 14) / 2)^2)",
    "a wheel out of balance, at its resonance",
    "force",
    "N",
    lambda view, shape: view.v * np.exp(-(((view.v - 14) / 2) ** 2)),
    usual=lambda road_load: 500.0,
    breaks="driving through 14 m/s again and again",
)
```

`power` gets a `View`: the samples as measured, and once more as their instruments see them (the same quantities from
readings around each sample), so it must take all it needs from there. What it is computed from is declared in `needs`,
or in `shapes` where one of several sources will do; an effect whose signals are missing is reported as not testable.
"""


def signals(effect: Effect) -> str:
    """Names of the roles it is computed from beyond speed and power."""
    needed = [_roles(quantity) for quantity in effect.needs if quantity in SOURCES]
    sources = [_roles(shape) for shape in effect.shapes if isinstance(shape, Quantity)]
    if sources and None in effect.shapes:
        sources.append("none")
    return ", ".join([*needed, *([" or ".join(sources)] if sources else [])]) or "none"


def _roles(quantity: Quantity) -> str:
    return " or ".join(f"`{role.value}`" for role in SOURCES[quantity])


def usual(effect: Effect) -> str:
    """Its usual size for TRUCK."""
    if effect.is_gravity:
        return "the mass"
    value, unit = effect.usual(TRUCK), effect.unit
    if unit == "1":
        return f"{100 * value:.3g} %"
    if unit == "1/h":
        return f"{100 * value:.3g} % an hour"
    return f"{value:.3g} {unit}" if value < 1e3 else f"{value:,.0f} {unit}"


def table(*rows: tuple[str, ...]) -> str:
    """Markdown; the first row is the heading."""
    heading, *rest = rows
    lines = [heading, ("---",) * len(heading), *rest]
    return "\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines)


def page() -> str:
    """The whole page."""
    equations = [
        (f"`{e.name}`", f"`{e.equation}`", f"{e.symbol} [{e.unit}]", usual(e), WHEN[e.timing]) for e in CATALOGUE
    ]
    shown = [
        (f"`{e.name}`", signals(e), ", ".join(f"`{n}`" for n in e.equivalent) or "-", e.breaks, _streams(e))
        for e in CATALOGUE
    ]
    return PAGE.format(
        equations=table(("effect", "power added [W]", "size", "usual", "when"), *equations),
        signals=table(("effect", "signals", "not told apart from", "what would tell", "streams"), *shown),
        sources="\n".join(f"* `{e.name}`: {e.source}" for e in CATALOGUE),
    )


def _streams(effect: Effect) -> str:
    if effect.absorbed:
        return "no: the fit takes it up"
    if not effect.streams:
        return "no: its times are found afterwards"
    return "yes" if effect.timing is Timing.ALWAYS else "with its signal"


if __name__ == "__main__":
    print(page(), end="")
