"""Samples condensed to a few sums, as far as it is sure which of them the model clips.

The model is P = max(x . phi, 0), with phi the coefficients of the columns of x. Inside an ellipsoid of phi most samples
are surely active, and count by the sums of linear least squares; those that are surely clipped count by the square of
their power, whatever phi is; only the undecided ones have to be looked at one by one. Samples of different blocks
simply add up, so a window that slides needs no pass over the samples that stay.

Sums are of the residual at the ellipsoid's centre, so that hardly anything cancels.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from estimator.sampling.likelihood import factor
from estimator.signals import Floats


@dataclass(frozen=True)
class Sums:
    """Sufficient statistics of least squares of ``y`` (n,) on ``X`` (n, p): G = X' X, b = X' y, s = y' y, and n."""

    G: Floats
    b: Floats
    s: float
    n: int

    @classmethod
    def of(cls, X: Floats, y: Floats) -> "Sums":
        """Of samples ``X`` (n, p), ``y`` (n,)."""
        return cls(X.T @ X, X.T @ y, float(y @ y), len(y))

    @classmethod
    def empty(cls, p: int) -> "Sums":
        """Of no samples."""
        return cls(np.zeros((p, p)), np.zeros(p), 0.0, 0)

    @classmethod
    def total(cls, parts: "Sequence[Sums]") -> "Sums":
        """Of the samples of all parts, of which there is at least one."""
        G, b = np.sum([part.G for part in parts], axis=0), np.sum([part.b for part in parts], axis=0)
        return cls(G, b, sum(part.s for part in parts), sum(part.n for part in parts))

    def __add__(self, other: "Sums") -> "Sums":
        return Sums(self.G + other.G, self.b + other.b, self.s + other.s, self.n + other.n)

    def __sub__(self, other: "Sums") -> "Sums":
        return Sums(self.G - other.G, self.b - other.b, self.s - other.s, self.n - other.n)

    def about(self, theta: Floats) -> "Sums":
        """With y - X theta in place of y, for ``theta`` (p,)."""
        b = self.b - self.G @ theta
        return Sums(self.G, b, float(self.s - theta @ (self.b + b)), self.n)

    def through(self, M: Floats, unit: float = 1.0) -> "Sums":
        """With X M in place of X, for ``M`` (p, q), and y in another unit."""
        return Sums(M.T @ self.G @ M, M.T @ self.b / unit, self.s / unit**2, self.n)

    @cached_property
    def _form(self) -> Floats:
        return np.block([[self.G, -self.b[:, None]], [-self.b, np.zeros(1)]])

    def excess(self, theta: Floats) -> Floats:
        """What the columns [theta, 1] (p + 1, k) add to the sum of squares that zero has (k,)."""
        total: Floats = np.einsum("ij,ij->j", self._form @ theta, theta)
        return total


@dataclass(frozen=True)
class Region:
    """The ellipsoid |whiten (phi - origin)| <= 1 of coefficients phi (q,); a ``whiten`` (q, q) of zeros is no bound."""

    origin: Floats
    whiten: Floats

    @classmethod
    def everywhere(cls, q: int) -> "Region":
        """Without bound."""
        return cls(np.zeros(q), np.zeros((q, q)))

    @classmethod
    def around(cls, origin: Floats, covariance: Floats) -> "Region":
        """One sd of a Gaussian of mean ``origin`` (q,) and ``covariance`` (q, q)."""
        return cls(origin, np.tril(np.linalg.inv(factor(covariance))))

    @cached_property
    def _spread(self) -> Floats:
        return np.linalg.inv(self.whiten)

    def condense(self, X: Floats, P: Floats) -> "Condensed":
        """Samples ``X`` (n, q), ``P`` (n,), for coefficients in here."""
        u = X @ self.origin
        turn = np.sqrt(np.square(X @ self._spread).sum(axis=1))  # by how much u changes at most
        active, clipped = u > turn, u < -turn
        undecided = ~(active | clipped)
        sums, cut = Sums.of(X[active], (P - u)[active]), P[clipped]
        return Condensed(
            region=self,
            active=sums,
            clipped=float(cut @ cut),
            X=X[undecided],
            P=P[undecided],
            n=len(P),
            squares=float(P @ P),
        )

    def reach(self, centre: Floats, root: Floats) -> float:
        """Radius up to which every centre + root z (q,), z (p,), lies in here; negative where the centre does not."""
        outside = float(np.linalg.norm(self.whiten @ (centre - self.origin)))
        width = float(np.linalg.norm(self.whiten @ root, 2))
        return (1.0 - outside) / width if width else np.inf


@dataclass(frozen=True, kw_only=True)
class Condensed:
    """Samples, for coefficients in a region."""

    region: Region
    active: Sums  # of P - x . origin, over the samples that are active in all of it
    clipped: float  # sum of squares of the power of those that are clipped in all of it
    X: Floats  # of the undecided (m, q)
    P: Floats  # (m,)
    n: int  # samples in all
    squares: float  # sum of squares of their power

    @classmethod
    def of(cls, X: Floats, P: Floats) -> "Condensed":
        """Samples ``X`` (n, q), ``P`` (n,) [W], all undecided, for all coefficients."""
        q = X.shape[1]
        return cls(
            region=Region.everywhere(q), active=Sums.empty(q), clipped=0.0, X=X, P=P, n=len(P), squares=float(P @ P)
        )

    @classmethod
    def total(cls, parts: "Sequence[Condensed]") -> "Condensed":
        """All the samples of blocks condensed for the same region; at least one."""
        return cls(
            region=parts[0].region,
            active=Sums.total([part.active for part in parts]),
            clipped=sum(part.clipped for part in parts),
            X=np.concatenate([part.X for part in parts]),
            P=np.concatenate([part.P for part in parts]),
            n=sum(part.n for part in parts),
            squares=sum(part.squares for part in parts),
        )
