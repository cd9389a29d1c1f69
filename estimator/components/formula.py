"""Find the product of one or two powers of known quantities that describes a nameless residual with most evidence.

A factor is x, |x|, x^2, x |x|, x^3, max(x, 0) or x^-1; a formula is a factor, or the product of two of different
quantities. Its column is scaled to the rms of the residual; the prior of its amplitude is N(0, 1). All formulas have
equal prior probability.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from estimator.estimation.savage_dickey import log_bayes_factor, posterior_of
from estimator.signals import Floats

BATCH = 64  # columns judged at once: bounds the memory
MIN_RELATIVE_DISTANCE = 1e-3  # of a denominator from zero, over the range of the quantity

Judge = Callable[[Floats], tuple[Floats, Floats, Floats]]  # log Bayes factor, value, sd (c,) of columns (n, c)


@dataclass(frozen=True)
class Variable:
    """Values of a quantity (n,), and its unit as a product of powers such as "m/s^2"."""

    values: Floats
    unit: str


@dataclass(frozen=True)
class Factor:
    """A power of a quantity: text such as "v^2", values (n,), exponents by unit."""

    text: str
    values: Floats
    unit: Mapping[str, int]


@dataclass(frozen=True, kw_only=True)
class Formula:
    """``value`` +- ``sd`` times ``text``; ``unit`` of the value; ``gain``: log Bayes factor less log(number).

    The number is that of all formulas tried, which have equal prior probability.
    """

    text: str
    value: float
    sd: float
    unit: str
    gain: float
    column: Floats  # (n,) at a value of 1


def best_formula(variables: Mapping[str, Variable], unit: str, rms: float, judge: Judge) -> Formula | None:
    """Formula with most evidence; None if no quantity varies.

    Parameters
    ----------
    variables
        Quantities by name.
    unit
        Unit of the residual.
    rms
        Root mean square of the residual.
    judge
        Returns log Bayes factor, value and sd (c,) of columns (n, c) that have the rms of the residual. Each is judged
        alone beside everything else in the model, with the prior N(0, 1) of its amplitude.
    """
    best_of_batches: list[tuple[float, float, float, Sequence[Factor]]] = []
    formulas = list(_formulas(variables))
    for start in range(0, len(formulas), BATCH):
        batch = formulas[start : start + BATCH]
        columns = np.column_stack([_column(factors) for factors in batch])
        nonzero = np.flatnonzero(columns.any(axis=0)).tolist()  # a product of two positive parts may be zero everywhere
        if not nonzero:
            continue
        columns, batch = columns[:, nonzero], [batch[k] for k in nonzero]
        size = np.sqrt(np.mean(columns**2, axis=0)) / rms
        gains, values, sds = judge(columns / size)
        k = int(np.argmax(gains))
        best_of_batches.append((float(gains[k]), float(values[k] / size[k]), float(sds[k] / size[k]), batch[k]))
    if not best_of_batches:
        return None
    gain, value, sd, factors = max(best_of_batches, key=lambda row: row[0])
    return Formula(
        text=" ".join(factor.text for factor in factors),
        value=value,
        sd=sd,
        unit=_quotient(unit, factors),
        gain=gain - float(np.log(len(formulas))),
        column=_column(factors),
    )


def judged(products: Floats, score: Floats) -> tuple[Floats, Floats, Floats]:
    """Log Bayes factor, value and sd (c,) of columns with ``products`` (c, c) and ``score`` (c,); prior N(0, 1)."""
    value, sd = posterior_of(score, np.diag(products), prior_sd=1.0)
    return log_bayes_factor(value, sd, prior_sd=1.0), value, sd


def _formulas(variables: Mapping[str, Variable]) -> Iterator[tuple[Factor, ...]]:
    factors = {name: list(_factors(name, variable)) for name, variable in variables.items()}
    for group in factors.values():
        yield from ((factor,) for factor in group)
    for first, other in combinations(factors.values(), 2):
        yield from ((a, b) for a in first for b in other)


def _column(factors: Sequence[Factor]) -> Floats:
    product: Floats = np.prod([factor.values for factor in factors], axis=0)
    return product


def _factors(name: str, variable: Variable) -> Iterator[Factor]:
    x, unit = variable.values, units_of(variable.unit)
    if not np.ptp(x) > 0:
        return

    def powered(exponent: int) -> dict[str, int]:
        return {symbol: exponent * power for symbol, power in unit.items()}

    yield Factor(name, x, powered(1))
    yield Factor(f"{name}^2", x**2, powered(2))
    yield Factor(f"{name}^3", x**3, powered(3))
    if x.min() < 0 < x.max():
        yield Factor(f"|{name}|", np.abs(x), powered(1))
        yield Factor(f"{name} |{name}|", x * np.abs(x), powered(2))
        yield Factor(f"max({name}, 0)", np.maximum(x, 0.0), powered(1))
    elif np.abs(x).min() > MIN_RELATIVE_DISTANCE * np.ptp(x):
        yield Factor(f"{name}^-1", 1 / x, powered(-1))


def units_of(text: str) -> dict[str, int]:
    """Exponents by unit of a product of powers: "m/s^2" gives m 1, s -2; a second "/" divides again.

    A blank, "*" or "·" multiplies. "1" is no unit.

    Raises
    ------
    ValueError
        A bracket, a power without a unit, or an exponent that is not a whole number.
    """
    exponents: dict[str, int] = {}
    for position, part in enumerate(text.replace("*", " ").replace("·", " ").split("/")):
        for symbol in part.split():
            power = re.fullmatch(r"([^()^]+)(?:\^([+-]?\d+))?", symbol)
            if power is None:
                raise ValueError(f'the unit "{text}" is no product of whole powers such as "kg m/s^2"')
            if power[1] != "1":
                exponents[power[1]] = exponents.get(power[1], 0) + int(power[2] or 1) * (-1 if position else 1)
    return exponents


def _quotient(unit: str, factors: Sequence[Factor]) -> str:
    """Unit of a coefficient: unit of the residual divided by those of the factors."""
    powers = units_of(unit)
    for factor in factors:
        for symbol, power in factor.unit.items():
            powers[symbol] = powers.get(symbol, 0) - power
    above = [symbol if power == 1 else f"{symbol}^{power}" for symbol, power in powers.items() if power > 0]
    below = [symbol if power == -1 else f"{symbol}^{-power}" for symbol, power in powers.items() if power < 0]
    return "/".join([" ".join(above) or "1", *below])
