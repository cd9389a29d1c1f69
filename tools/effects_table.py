"""The catalogue of effects as a Markdown page, generated from the effect objects.

python tools/effects_table.py > docs/effects.md
"""

import numpy as np

from estimator.model.effects import CATALOGUE, SOURCES, Effect, Timing
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

Effects that the plain road load `P = A v + C v³ + m v dv/dt` leaves out and that `roadload diagnose` tests.
`tools/effects_table.py` prints this page from the objects in `estimator/model/effects/`. The same objects are the
candidates of the diagnosis and the terms of the streaming model (`effects = ["grade"]`, `--effect grade`).

## Power of each effect

`v` speed, `a` acceleration, `w` engine speed, `F = P / v`, `t` time, `u(t)` 0 or 1; SI units. "Usual" is the sd of the
size's prior in the diagnosis, for a truck of 27 t (A 1,740 N, C 3.74 N s²/m²). In `estimate` it is three times that.
A size above "largest" is something else to the diagnosis.

{equations}

## Signals and identifiability

* "Signals": the effect is tested only if these are on the bus. "Equivalent": both effects have the same trace in power
  and speed on any drive. "Evidence": what identifies the effect.
* "Streams": the effect can be a term of the streaming model. Effects with unknown times are diagnosed only. Others are
  absorbed by A, C and m, or by the alignment of power and speed.
* With `warm_up` in the model, A is that of tyres as warm as at a steady 80 km/h (ISO 28580). Without it, A is the mean
  of the drive. The speed v_tau is that through a low-pass of the time constant tau.
* With `air_density` in the model, C is that of the air at the start; without it, of the air in the mean.

{signals}

## Sources

{sources}

## How to add an effect

An effect is one object. Add it to `CATALOGUE`:

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

`power` must read all quantities from its `View`. Required quantities are declared in `needs`, or in `shapes` where one
of several sources is enough. Set `is_noisy=True` where `power` uses `view.P` or `view.a`. `positive=False` allows
either sign, `max_size` bounds the size, `timing` and `dwell_times` say when an effect acts that no signal shows.
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
            *(sized(e, e.usual_magnitude(TRUCK)), sized(e, e.limit(TRUCK))),
            WHEN[e.timing],
        )
        for e in CATALOGUE
    ]
    shown = [
        (f"`{e.name}`", signals(e), ", ".join(f"`{n}`" for n in e.equivalent) or "-", e.shown_by, _streams(e))
        for e in CATALOGUE
    ]
    return PAGE.format(
        equations=table(("effect", "power added [W]", "size", "usual", "largest", "when"), *equations),
        signals=table(("effect", "signals", "equivalent", "evidence", "streams"), *shown),
        sources="\n".join(f"* `{e.name}`: {e.source}" for e in CATALOGUE),
    )


def _streams(effect: Effect) -> str:
    if effect.is_absorbed:
        return "no: absorbed by the fit"
    if not effect.is_streaming:
        return "no: its times are unknown"
    return "yes" if effect.timing is Timing.ALWAYS else "with its signal"


if __name__ == "__main__":
    print(page(), end="")
