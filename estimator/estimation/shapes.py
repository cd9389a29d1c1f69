"""The shapes of the effects in a fit that no signal tells: a time constant, or the direction and the speed of a wind.

The first shape is the one of a grid with most evidence beside the plain road load, the next ones are near the present
one, given the magnitude that it was found with. Near shapes are compared at the magnitudes at which they are exact. The
scales of road and noise that a fit finds beside a poor shape hold some of the effect, so fits and shapes alternate.

A time constant or a wind is known only roughly. With the posterior probabilities w_i of the shapes of an effect, and
beta_i the coefficients with each,

    mean = sum w_i beta_i,   covariance = that of one shape + sum w_i (beta_i - mean) (beta_i - mean)'

(the law of total variance). The shapes of each effect vary by themselves, with those of the others as they are.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.estimation.mixture import between
from estimator.estimation.road_fit import RoadFit
from estimator.estimation.road_likelihood import LAG, Likelihood
from estimator.estimation.savage_dickey import log_bayes_factor
from estimator.estimation.scales import RoadScales
from estimator.model.conditioned import Conditioned
from estimator.model.effect_term import EffectTerm
from estimator.model.effects import Effect
from estimator.signals import Floats, Quantity
from estimator.strides import Strides

MAX_FITS = 5  # each beside finer shapes than the one before; 2 or 3 are usual
MAX_ROUNDS = 10  # of shapes at the same scales: each takes the magnitudes of the one before
MIN_GAIN = 0.1  # of log evidence, for another shape
AT_ONCE = 32  # shapes judged with common products: none needs the products with the others
FitBeside = Callable[[tuple[EffectTerm, ...], RoadScales | None], RoadFit | None]  # of terms, with scales to start from
Refit = Callable[[RoadFit, tuple[EffectTerm, ...]], RoadFit | None]  # of a fit with other terms


def fitted_with_shapes(strides: Strides, terms: tuple[EffectTerm, ...], fitted: FitBeside) -> RoadFit | None:
    """The fit of ``strides`` beside ``terms`` with shapes near theirs that add evidence; None where there is no fit."""
    found = fitted(terms, None)
    if found is None:
        return None
    return with_nearer_shapes(strides, found, lambda found, terms: fitted(terms, found.scales))


def with_nearer_shapes(strides: Strides, found: RoadFit, fitted: Refit, given: int = 0) -> RoadFit:
    """The fit ``found``, or one that is ``fitted`` from it with shapes near those of its terms that add evidence.

    The first ``given`` terms keep their shapes.
    """
    for _ in range(MAX_FITS if any(is_free(term) for term in found.terms[given:]) else 0):
        terms = (*found.terms[:given], *nearer_shapes(strides, found)[given:])
        again = None if terms == found.terms else fitted(found, terms)
        if again is None or again.log_evidence < found.log_evidence + MIN_GAIN:
            break
        found = again
    return found


def terms_of(
    strides: Strides, effects: Sequence[Effect], plain: Callable[[], RoadFit | None]
) -> tuple[EffectTerm, ...]:
    """Each effect with the shape of most evidence beside the ``plain`` fit, which is made where there is a choice.

    Of several signals of one quantity the first one is taken.
    """
    known = frozenset(strides.context)
    shapes = [[EffectTerm(effect, shape) for shape in effect.streaming_shapes(known)] for effect in effects]
    shapes = [terms[:1] if isinstance(terms[0].shape, Quantity) else terms for terms in shapes if terms]
    if all(len(terms) == 1 for terms in shapes):
        return tuple(terms[0] for terms in shapes)
    fit = plain()
    return () if fit is None else best_shapes(strides, fit, shapes)


def is_free(term: EffectTerm) -> bool:
    """Whether its shape is a number that no signal tells."""
    return term.effect.finer_shapes is not None and not isinstance(term.shape, Quantity)


def near(term: EffectTerm, size: float) -> list[EffectTerm]:
    """The term, and the same with shapes near its own for the magnitude ``size``; alone where a signal tells it."""
    finer = term.effect.finer_shapes
    shapes = () if finer is None or isinstance(term.shape, Quantity) else finer(term.shape, size)
    return [replace(term, shape=shape) for shape in dict.fromkeys((term.shape, *shapes))]


def best_shapes(strides: Strides, found: RoadFit, shapes: Sequence[Sequence[EffectTerm]]) -> tuple[EffectTerm, ...]:
    """Term of each effect, among its ``shapes``, that adds most to the evidence of a fit; its sign is checked."""
    likelihood = ShapeLikelihood(strides, found)
    return tuple(each[int(np.argmax(likelihood.judged((), each).gains))] for each in shapes if each)


def nearer_shapes(strides: Strides, found: RoadFit) -> tuple[EffectTerm, ...]:
    """The terms of a fit with the shapes near theirs that add most to the evidence, at its scales."""
    likelihood, terms, sizes = ShapeLikelihood(strides, found), list(found.terms), found.theta[LAG + 1 :].tolist()
    for _ in range(MAX_ROUNDS):
        before = list(terms)
        for i, term in enumerate(before):
            if not is_free(term):
                continue
            each = near(term, sizes[i])
            judged = likelihood.judged((*terms[:i], *terms[i + 1 :]), each)
            gains = judged.exact_gains
            best = int(np.argmax(gains))
            if gains[best] > gains[0] + MIN_GAIN:
                terms[i], sizes[i] = each[best], float(judged.magnitudes[best])
        if terms == before:
            break
    return tuple(terms)


def averaged(strides: Strides, found: RoadFit) -> RoadFit:
    """The fit with coefficients and covariance averaged over the shapes of its terms, near ones and those of a grid."""
    if not any(is_free(term) for term in found.terms):
        return found
    likelihood, beta, covariance = ShapeLikelihood(strides, found), found.beta.copy(), found.covariance.copy()
    effects, sizes = len(found.terms), found.theta[LAG + 1 :].tolist()
    for i, term in enumerate(found.terms):
        if not is_free(term):
            continue
        grid = (replace(term, shape=shape) for shape in term.effect.shapes if not isinstance(shape, Quantity))
        shapes = list(dict.fromkeys((*near(term, sizes[i]), *grid)))
        judged = likelihood.judged((*found.terms[:i], *found.terms[i + 1 :]), shapes)
        weights = np.exp(judged.exact_gains - judged.exact_gains.max())
        weights /= weights.sum()
        others, own = judged.coefficients[:, :-1], judged.coefficients[:, -1]
        coefficients = np.insert(others, len(beta) - effects + i, own, axis=1)
        shifts = coefficients - coefficients[0]  # of these: the fit itself is corrected for noise
        shift, spread = between(weights, shifts)
        beta += shift
        covariance += spread
    return replace(found, beta=beta, covariance=covariance)


@dataclass(frozen=True)
class Judged:
    """Terms with different ``shapes`` (k,), each alone beside other terms.

    ``gains`` (k,) in log evidence; ``coefficients`` (k, p), the last one that of the shape; its ``precision`` (k,).
    """

    shapes: tuple[EffectTerm, ...]
    gains: Floats
    coefficients: Floats
    precision: Floats

    @property
    def magnitudes(self) -> Floats:
        """Magnitude (k,) of the effect with each shape."""
        return -self.coefficients[:, -1] / self.coefficients[:, 0]

    @property
    def exact_gains(self) -> Floats:
        """Gains (k,) with the magnitude at which a shape is exact."""
        exact = self.shapes[0].effect.exact_at
        if exact is None:
            return self.gains
        off = self.magnitudes - [exact(term.shape) for term in self.shapes]
        return self.gains - 0.5 * self.precision * (off * self.coefficients[:, 0]) ** 2


class ShapeLikelihood:
    """The likelihood of the strides of a fit, at its scales, for other shapes of its terms."""

    def __init__(self, strides: Strides, found: RoadFit) -> None:
        self._found = found
        self._model = found.scales.model_of(strides)
        self._conditioned = Conditioned.of(self._model, found.scales.values)

    def judged(self, beside: tuple[EffectTerm, ...], shapes: Sequence[EffectTerm]) -> Judged:
        """Each of ``shapes`` (k,) alone ``beside`` other terms."""
        batches = (shapes[start : start + AT_ONCE] for start in range(0, len(shapes), AT_ONCE))
        parts = zip(*(self._judged(beside, batch) for batch in batches), strict=True)
        return Judged(tuple(shapes), *map(np.concatenate, parts))

    def _judged(self, beside: tuple[EffectTerm, ...], shapes: Sequence[EffectTerm]) -> tuple[Floats, Floats, Floats]:
        found, terms = self._found, (*beside, *shapes)
        likelihood = Likelihood(self._model, terms, found.road_load, found.scales.lag, found.departures, found.taken)
        gram = self._conditioned.gram(likelihood.data)
        _, information, _ = likelihood.solve(gram)
        base = len(information) - len(shapes)
        weights = np.linalg.solve(
            information[:base, :base], np.column_stack([information[:base, base:], gram[1:, :1][:base]])
        )
        strength = np.diag(information)[base:] - np.sum(information[:base, base:] * weights[:, :-1], axis=0)
        score = gram[1 + base :, 0] - information[base:, :base] @ weights[:, -1]
        believed = np.diag(likelihood.prior)[base:]
        wrong = np.array([term.effect.positive for term in shapes]) & (score > 0)  # a coefficient is -b / m
        own = score / strength
        gain = log_bayes_factor(np.where(wrong, 0.0, own), strength**-0.5, believed**-0.5)
        others = (weights[:, -1:] - weights[:, :-1] * own) / likelihood.unit[:base, None]
        unit = likelihood.unit[base:]
        return gain, np.column_stack([others.T, own / unit]), strength * unit**2
