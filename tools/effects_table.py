"""The catalogue of effects as a Markdown page, generated from the effect objects.

python tools/effects_table.py > docs/effects.md
"""

from collections.abc import Iterable

import numpy as np

from estimator.model.effects import CATALOGUE, SOURCES, Effect, Timing
from estimator.signals import Floats, Quantity

TRUCK: Floats = np.array([1740.0, 3.74, 27_000.0])  # A [N], C [N s^2/m^2], m [kg] of a loaded tractor and semi-trailer
PAGE = """\
# Effects

`roadload diagnose` tests these effects, which the plain road load `P = A v + C v³ + m v dv/dt` leaves out. `estimate`
adds those of `effects = ["grade"]` or `--effect grade` to its model. `tools/effects_table.py` writes this page from the
objects in `estimator/model/effects/`.

## Power of each effect

`v` speed, `a` acceleration, `w` engine speed, `F = P / v`, `t` time, `u(t)` 0 or 1 at unknown times; SI units. "Usual"
is the standard deviation of the size's prior in the diagnosis, for a truck of 27 t (A 1,740 N, C 3.74 N s²/m²). In
`estimate` it is three times that. The diagnosis names no effect above its largest size, often four times the usual.

{equations}

## Causes, signals, evidence

An effect is tested only if its signals are on the bus. "Evidence" is the signal or manoeuvre that identifies it.

{causes}

* **Equivalent** effects have the same trace in power and speed on any drive: {equivalent}.
* **Diagnosed only**, because their times are unknown: {timed}. In `estimate`, {switched} needs its signal.
* **Diagnosed only**, because A, C and m or the alignment of power and speed absorb them: {absorbed}.
* With `warm_up` in the model, A is that of tyres as warm as at a steady 80 km/h (ISO 28580); without it, the mean of
  the drive. `v_tau` is the speed through a low-pass of the time constant tau.
* With `air_density` in the model, C is that of the air at the start; without it, of the mean air.

## How to add an effect

An effect is one object, added to `CATALOGUE`:

```python
Effect(
    name="shimmy",
    equation="F v exp(-((v - 14) / 2)^2)",
    source="a wheel out of balance, at its resonance",
    symbol="force",
    unit="N",
    power=lambda view, shape: view.v * np.exp(-(((view.v - 14) / 2) ** 2)),
    usual_magnitude=lambda road_load: 500.0,
    shown_by="driving through 14 m/s again and again",
)
```

[The class](python_api.md#docstrings) describes all fields. A program passes an effect of its own instead:
`examples/own_effect.py`.
"""


def signals(effect: Effect) -> str:
    """Names of the roles that an effect needs beyond speed and power."""
    needed = [_roles(quantity) for quantity in effect.needs if quantity in SOURCES]
    sources = [_roles(shape) for shape in effect.shapes if isinstance(shape, Quantity)]
    if sources and None in effect.shapes:
        sources.append("none")
    return ", ".join([*needed, *([" or ".join(sources)] if sources else [])]) or "none"


def _roles(quantity: Quantity) -> str:
    return " or ".join(f"`{role.value}`" for role in SOURCES[quantity])


def sized(effect: Effect, value: float) -> str:
    """A size of an effect, for TRUCK, with its unit."""
    unit = effect.unit
    if effect.is_gravity:
        return "the mass"
    if unit == "1":
        return f"{100 * value:.3g} %"
    if unit == "1/h":
        return f"{100 * value:.3g} % an hour"
    return f"{value:.3g} {unit}" if value < 1e3 else f"{value:,.0f} {unit}"


def table(*rows: tuple[str, ...]) -> str:
    """Markdown; the first row is the heading."""
    heading, *lines = (f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in rows)
    return "\n".join([heading, f"|{'---|' * len(rows[0])}", *lines])


def page() -> str:
    """The whole page."""
    equations = [
        (
            *(f"`{e.name}`", f"`{e.equation}`", f"{e.symbol} [{e.unit}]"),
            sized(e, e.usual_magnitude(TRUCK)),
        )
        for e in CATALOGUE
    ]
    causes = [(f"`{e.name}`", e.source, signals(e), e.shown_by) for e in CATALOGUE]
    pairs = {" and ".join(f"`{name}`" for name in sorted({e.name, *e.equivalent})) for e in CATALOGUE if e.equivalent}
    return PAGE.format(
        equations=table(("effect", "power added [W]", "size", "usual"), *equations),
        causes=table(("effect", "cause", "signals", "evidence"), *causes),
        equivalent="; ".join(sorted(pairs)),
        timed=_names(e for e in CATALOGUE if not (e.is_absorbed or e.is_streaming)),
        switched=_names(e for e in CATALOGUE if e.is_streaming and e.timing is not Timing.ALWAYS),
        absorbed=_names(e for e in CATALOGUE if e.is_absorbed),
    )


def _names(effects: Iterable[Effect]) -> str:
    return ", ".join(f"`{effect.name}`" for effect in effects)


if __name__ == "__main__":
    print(page(), end="")
