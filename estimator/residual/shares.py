"""Split the residual's mean square into its causes, and compute the residual on stretches left out of the fit.

Let M be the projection off the base's columns: M r = sum of M X b + M noise. Hypotheses are drawn from the table, and
amplitudes b from the posterior of each. The share of a cause is (M r)'(M X b) / (M r)'(M r); the noise has the rest.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from estimator.components.folds import cross_validation
from estimator.components.model_table import ModelTable, TermGroup
from estimator.components.set_likelihood import Posterior
from estimator.residual.answer import Part
from estimator.residual.inputs import NOISE, Record
from estimator.residual.noise import Noise, Scales
from estimator.residual.terms import ResidualLikelihood, ResidualTerm
from estimator.signals import Floats

DRAWS = 400
MAX_TRIES = 50  # draws for positive amplitudes; after them, negative ones are set to zero


def budget(
    record: Record,
    likelihood: ResidualLikelihood,
    table: ModelTable,
    groups: Sequence[TermGroup],
    named: Sequence[int],
    scales: Scales,
    rng: np.random.Generator,
) -> tuple[Part, ...]:
    """Parts of the noise and of all causes that are in any draw; ``named``: numbers of the named terms."""
    rest, columns = record.residual, likelihood.data[:, 1 + likelihood.base_size :]
    weights = columns.T @ rest / (rest @ rest)
    products = columns.T @ columns / len(rest)
    names = [group.name for group in groups]
    shares, squares = np.zeros((DRAWS, len(names))), np.zeros((DRAWS, len(names)))
    group_of = {term: number for number, group in enumerate(groups) for term in group.terms}
    for draw, (terms, amplitudes) in enumerate(_draws(likelihood, table, rng)):
        at = likelihood.base_size
        for term in terms:
            numbers = likelihood.term_columns[term] - likelihood.base_size
            b = amplitudes[at : at + len(numbers)]
            at += len(numbers)
            shares[draw, group_of[term]] = weights[numbers] @ b
            squares[draw, group_of[term]] = b @ products[np.ix_(numbers, numbers)] @ b
    square = float(rest @ rest) / len(rest)
    chosen = {group_of[term]: term for term in named}
    parts = []
    for k, name in enumerate(names):
        if not np.any(shares[:, k]):
            continue
        held_out_rms = held_out(record, [likelihood.terms[chosen[k]]], scales) if k in chosen else None
        expected_square = float(np.mean(square * (1 - 2 * shares[:, k]) + squares[:, k]))
        parts.append(_part(name, shares[:, k], held_out_rms, float(np.sqrt(max(expected_square, 0.0)))))
    noise = 1 - shares.sum(axis=1)
    explained_rms = float(np.sqrt(max(square * (1 - float(np.mean(noise))), 0.0)))
    parts.append(_part(NOISE, noise, None, explained_rms))
    return tuple(sorted(parts, key=lambda part: -part.share))


def _part(cause: str, shares: Floats, held_out_rms: float | None, expected: float) -> Part:
    low, high = np.quantile(shares, [0.05, 0.95]).tolist()
    return Part(
        cause=cause, share=float(shares.mean()), q05=low, q95=high, held_out_rms=held_out_rms, expected=expected
    )


def _draws(
    likelihood: ResidualLikelihood, table: ModelTable, rng: np.random.Generator
) -> Iterator[tuple[tuple[int, ...], Floats]]:
    """Draw hypotheses by their probability, each with amplitudes of base and terms from its posterior."""
    posteriors: dict[int, Posterior] = {}
    for drawn in rng.choice(len(table.hypotheses), size=DRAWS, p=table.probability).tolist():
        terms = table.hypotheses[drawn]
        if drawn not in posteriors:
            posteriors[drawn] = likelihood.posterior(terms)
        yield terms, _amplitudes(likelihood, terms, posteriors[drawn], rng)


def _amplitudes(
    likelihood: ResidualLikelihood, terms: Sequence[int], posterior: Posterior, rng: np.random.Generator
) -> Floats:
    """Draw amplitudes (p,) from a posterior; amplitudes with a positive prior are not negative."""
    starts = likelihood.base_size + np.cumsum([0, *(len(likelihood.term_columns[term]) for term in terms)])
    positive = [at for at, term in zip(starts[:-1], terms, strict=True) if likelihood.priors[term].positive]
    size = np.sqrt(np.diag(posterior.covariance))
    values, axes = np.linalg.eigh(posterior.covariance / np.outer(size, size))
    root = axes * np.sqrt(np.maximum(values, 0.0))  # finite also if two columns are collinear up to rounding
    for _ in range(MAX_TRIES):
        amplitudes: Floats = posterior.mean + size * (root @ rng.standard_normal(len(root)))
        if np.all(amplitudes[positive] >= 0):
            return amplitudes
    amplitudes[positive] = np.maximum(amplitudes[positive], 0.0)
    return amplitudes


def held_out(record: Record, terms: Sequence[ResidualTerm], scales: Scales) -> float:
    """Rms of the residual on stretches left out of the fit, with the base and ``terms`` in the model."""
    n = len(record.t)
    rest = np.empty(n)
    for out in cross_validation(n):
        kept = np.flatnonzero(~out)
        likelihood = ResidualLikelihood(record, terms, Noise(record.t[kept], scales), kept)
        mean = likelihood.posterior(range(len(terms))).mean
        columns = np.hstack([record.base[out], *(term.columns[out] for term in terms)])
        rest[out] = record.residual[out] - columns @ mean
    return float(np.sqrt(np.mean(rest**2)))
