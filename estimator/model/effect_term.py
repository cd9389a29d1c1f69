"""Term of the model: an effect with its shape, its times and the prior of its magnitude."""

from collections.abc import Set
from dataclasses import KW_ONLY, dataclass

from estimator.model.effects import Effect, Shape, View
from estimator.model.effects.effect import AtRest
from estimator.model.spans import Spans, covered
from estimator.signals import Floats, Quantity

USUAL_SDS = 3.0  # prior sd of the magnitude of an effect that is given, in usual magnitudes


@dataclass(frozen=True)
class EffectTerm:
    """Effect in the model, with its shape and the ``spans`` [s] in which it acts; None: always.

    ``usual_sds`` is the prior sd of its magnitude, in usual magnitudes.
    """

    effect: Effect
    shape: Shape = None
    spans: Spans | None = None
    _: KW_ONLY
    usual_sds: float = USUAL_SDS

    def column(self, view: View) -> Floats:
        """Power [W] (n,) per unit of magnitude."""
        power = self.effect.power(view, self.shape)
        return power if self.spans is None else power * covered(view.t, view.duration, self.spans)

    def prior_sd(self, road_load: Floats) -> float:
        """Prior sd of its magnitude, for a vehicle with ``road_load`` = [A, C, m] (3,)."""
        return self.usual_sds * self.effect.usual_magnitude(road_load)

    def at_rest(self, rest: AtRest) -> float:
        """Power [W] per unit of magnitude during a standstill."""
        return 0.0 if self.effect.at_rest is None else self.effect.at_rest(rest, self.shape)


def wanted_by(effects: tuple[Effect, ...], known: Set[Quantity]) -> frozenset[Quantity]:
    """Quantities, of those ``known``, that these effects are computed from."""
    if not effects:
        return frozenset()
    shapes = {
        shape for effect in effects for shape in effect.streaming_shapes(known)[:1] if isinstance(shape, Quantity)
    }
    needs = {need for effect in effects for need in effect.needs}
    return frozenset(shapes | needs) & known
