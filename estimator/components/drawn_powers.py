"""Sums over a drive that the shares of its causes follow from, for each draw of their powers.

The power of a cause has a value for every two seconds and every draw: 20 MB for a cause of a drive of 8 h. Shares and
root mean squares need the products of the residual and of all powers alone, which batches of draws leave behind.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from estimator.signals import Floats


@dataclass(frozen=True, kw_only=True)
class DrawnPowers:
    """Products of a residual and of d draws of the powers of its ``causes`` (c,), summed over ``count`` values.

    ``products`` (d, 1 + c, 1 + c) [W^2] have the residual first.
    """

    causes: tuple[str, ...]
    products: Floats
    count: int

    @classmethod
    def of(cls, residual: Floats, powers: Mapping[str, Floats]) -> "DrawnPowers":
        """Products of a ``residual`` (k,) [W] and the ``powers`` (k, d) [W] of its causes."""
        draws = next(iter(powers.values())).shape[1]
        all_powers = np.empty((draws, 1 + len(powers), len(residual)))
        all_powers[:, 0] = residual
        for place, power in enumerate(powers.values(), start=1):
            all_powers[:, place] = power.T
        return cls(causes=tuple(powers), products=all_powers @ all_powers.transpose(0, 2, 1), count=len(residual))

    @classmethod
    def of_draws(cls, batches: Sequence["DrawnPowers"]) -> "DrawnPowers":
        """All draws of ``batches`` of one drive."""
        first = batches[0]
        products = np.concatenate([batch.products for batch in batches])
        return cls(causes=first.causes, products=products, count=first.count)

    @classmethod
    def of_drives(cls, drives: Sequence["DrawnPowers"]) -> "DrawnPowers":
        """Sums over all ``drives``; where a drive lacks a cause, this has no power."""
        causes = tuple(dict.fromkeys(cause for drive in drives for cause in drive.causes))
        products = np.zeros((len(drives[0].products), 1 + len(causes), 1 + len(causes)))
        for drive in drives:
            places = np.array([0, *(1 + causes.index(cause) for cause in drive.causes)])
            products[:, places[:, None], places] += drive.products
        return cls(causes=causes, products=products, count=sum(drive.count for drive in drives))

    def share(self, cause: str) -> Floats:
        """Share (d,) of a cause in the square of the residual."""
        share: Floats = self.products[:, 0, self._place(cause)] / self.products[:, 0, 0]
        return share

    def rms(self, cause: str) -> float:
        """Root mean square [W] of the power of a cause, over all draws."""
        place = self._place(cause)
        return self._root_mean(self.products[:, place, place])

    def rms_without(self, *causes: str) -> float:
        """Root mean square [W] of the residual less the power of ``causes``, over all draws."""
        signs = np.zeros(1 + len(self.causes))
        signs[0], signs[[self._place(cause) for cause in causes]] = 1.0, -1.0
        return self._root_mean(self.products @ signs @ signs)

    def pooled(self, small: Collection[str], name: str) -> "DrawnPowers":
        """These powers with those of the causes ``small`` summed to one, which has the ``name`` and is the last."""
        kept = tuple(cause for cause in self.causes if cause not in small)
        sums = np.zeros((2 + len(kept), 1 + len(self.causes)))
        sums[np.arange(1 + len(kept)), [0, *map(self._place, kept)]] = 1.0
        sums[-1, [self._place(cause) for cause in self.causes if cause in small]] = 1.0
        return DrawnPowers(causes=(*kept, name), products=sums @ self.products @ sums.T, count=self.count)

    def _place(self, cause: str) -> int:
        return 1 + self.causes.index(cause)

    def _root_mean(self, squares: Floats) -> float:
        return float(np.sqrt(max(float(np.mean(squares)), 0.0) / self.count))
