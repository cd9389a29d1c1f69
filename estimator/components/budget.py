"""Compute the gap budget: the residual of the plain model split into the power of every term, the road and the sensors.

The equation of motion, times -m v, is an identity in power:

    P = A v + C v^3 + m v a + lag and drag + sum of effects + m g theta v + errors

Least squares fits the columns of the plain road load to P. With M the projection orthogonal to these columns

    r = M P = sum of M effects + M (m g theta v) + M errors.

For every draw from the posterior of amplitudes, road and errors the parts sum to r exactly. The share of a part is
mean(r part) / mean(r^2), over means of 2 s; the shares sum to one. What the model has of a given cause is taken off r
and off the part, which is then its error. Effects that are possible but not chosen (such as a weak wind) are drawn too,
each with its prior. They widen the interval of the road.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from estimator.components.drive_state import DriveState
from estimator.components.folds import left_out
from estimator.components.likelihood import JointLikelihood
from estimator.components.plain_model import PlainModel
from estimator.components.term import Frame, Term
from estimator.model.road_scales import DISTURBANCE
from estimator.signals import Floats
from estimator.units import STANDARD_GRAVITY

UNKNOWN = "unknown: "  # before the name of a nameless process
ROAD, NOISE, WHITE, OTHERS = "road", "sensor noise", f"{UNKNOWN}white force", "other effects"
DRAWS = 200
TOGETHER = 20  # draws of all unknowns that are made at once: bounds the memory
MAX_TRIES = 50  # draws of the amplitudes per draw kept: those with the largest sign violations are rejected
MIN_SYSTEMATIC = 1e-6  # lower bound of a share that divides another one
FORM_DOUBT = 0.5  # sd of a share s by errors of the model's form, over s (1 - s): measured on simulated drives
SDS_OF_90_PERCENT = 1.645  # standard deviations to either side that hold 90 % of a Gaussian
MIN_SHARE = 0.01  # of the gap: effects that were not chosen and are smaller are summed to one part
FOLDS, STRETCH = 3, 60  # and strides per stretch: longer than the memory of noise and road, shorter than most episodes


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """Contribution of one cause to the gap; of one that ``is_given``, what the model has wrong of it.

    ``share`` of the mean square of the residual with the given causes, with its 90 % interval; ``rms`` [W] of the
    contribution. ``held_out_rms`` [W]: held-out residual rms of the model with the given causes and this one; None of a
    given one, and without that fit. ``expected`` [W]: residual rms if this cause were known exactly, as by a signal of
    its own, beside the given ones. ``closed``: its share in all that was found (chosen effects, nameless processes,
    road), with a 90 % interval that allows for effects not found.
    """

    cause: str
    is_given: bool
    share: float
    q05: float
    q95: float
    rms: float
    held_out_rms: float | None
    expected: float
    closed: tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Residuals:
    """Residuals [W] (k,) of one drive over means of 2 s: measured power minus modelled power.

    ``plain``: of the road load on a level road; ``given``: with the given effects; ``held_out``: with all chosen terms,
    on stretches left out of the fit. ``road_known``: as ``held_out``, but with the slopes of the road's state instead
    of those that the road signals show on these stretches. ``causes``: power of each chosen term and the road there.
    """

    plain: Floats
    given: Floats
    held_out: Floats
    road_known: Floats
    causes: Mapping[str, Floats]


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """Gap of all drives: root mean squares [W] of `Residuals`, the parts, and the residuals of each drive."""

    base: float  # plain road load, with the given effects
    held_out_rms: float  # with all chosen terms, on stretches left out of the fit
    parts: tuple[Part, ...]
    residuals: tuple[Residuals, ...] = field(default=(), repr=False)

    def part(self, cause: str) -> Part | None:
        """Part of one cause, None if it has none."""
        return next((part for part in self.parts if part.cause == cause), None)

    def residual_with(self, causes: Collection[str]) -> float:
        """Residual rms [W] with several ``causes`` in the model, on stretches left out of the fit."""
        return _rms(np.concatenate([_without(drive.given, drive.causes, causes) for drive in self.residuals]))

    def renamed(self, cause: str, to: str) -> "Budget":
        """Copy of the budget with another name for a cause."""
        return replace(self, parts=tuple(replace(p, cause=to) if p.cause == cause else p for p in self.parts))

    @property
    def floor(self) -> float:
        """Root mean square [W] of sensor noise and white forces together."""
        return float(np.sqrt(sum(part.rms**2 for part in self.parts if part.cause in (NOISE, WHITE))))


@dataclass(frozen=True)
class _Powers:
    """Powers [W] of one drive, means over 2 s: residual (n,), draws (n, d) of each cause, held-out estimates (n,)."""

    residual: Floats
    draws: dict[str, Floats]
    held_out: dict[str, Floats]


def budget(
    drives: Sequence[DriveState],
    possible: Sequence[Sequence[Term]],
    unnamed: Sequence[Sequence[Term]],
    rng: np.random.Generator,
    given: Collection[str] = (),
) -> Budget:
    """Gap budget of one drive, or of several together.

    For each drive ``possible`` holds effects that were not chosen, and ``unnamed`` the nameless processes to include.
    Causes that are ``given`` are in the model whose residual is split; their errors are part of the gap.
    """
    powers = [
        _powers(drive, others, process, rng) for drive, others, process in zip(drives, possible, unnamed, strict=True)
    ]
    residuals = tuple(_residuals(drive_powers, given) for drive_powers in powers)
    residual = np.concatenate([residual_of_drive.given for residual_of_drive in residuals])
    drawn = _concatenated(
        [drive_powers.draws for drive_powers in powers],
        [np.zeros((len(drive_powers.residual), DRAWS)) for drive_powers in powers],
    )
    held_out = _concatenated(
        [drive_powers.held_out for drive_powers in powers],
        [np.zeros(len(drive_powers.residual)) for drive_powers in powers],
    )
    for cause in [cause for cause in held_out if cause in given]:
        drawn[cause] = drawn[cause] - held_out.pop(cause)[:, None]
    chosen = {term.name for drive in drives for term in drive.chosen}
    not_chosen = dict.fromkeys(term.name for terms in possible for term in terms if term.name not in chosen)
    _pool_small(drawn, residual, not_chosen)
    shares = {cause: residual @ draws / (residual @ residual) for cause, draws in drawn.items()}
    all_but_noise = 1 - sum(share for cause, share in shares.items() if cause in (NOISE, WHITE))
    found_share = all_but_noise - sum(
        (shares[cause] for cause in (*not_chosen, OTHERS) if cause in shares), np.zeros(DRAWS)
    )
    parts = [_part(cause, cause in given, residual, drawn, held_out, (found_share, all_but_noise)) for cause in drawn]
    base, held_out_rms = _rms(residual), _rms(_without(residual, held_out, held_out))
    return Budget(
        base=base,
        held_out_rms=held_out_rms,
        parts=tuple(sorted(parts, key=lambda part: -part.share)),
        residuals=residuals,
    )


def _pool_small(drawn: dict[str, Floats], residual: Floats, causes: Collection[str]) -> None:
    """Sum the draws of those ``causes`` that take less than MIN_SHARE of the residual to one part, OTHERS."""
    least = MIN_SHARE * residual @ residual
    small = [cause for cause in causes if np.quantile(np.abs(residual @ drawn[cause]), 0.95) < least]
    if small:
        drawn[OTHERS] = np.sum([drawn.pop(cause) for cause in small], axis=0)


def _concatenated(drives: Sequence[dict[str, Floats]], blank: Sequence[Floats]) -> dict[str, Floats]:
    """Powers of all drives by cause, concatenated; ``blank`` on a drive without the cause.

    The arrays are removed from ``drives``, so that none is in memory twice.
    """
    causes = dict.fromkeys(cause for drive in drives for cause in drive)
    return {
        cause: np.concatenate([drive.pop(cause, b) for drive, b in zip(drives, blank, strict=True)]) for cause in causes
    }


def _residuals(drive: _Powers, given: Collection[str]) -> Residuals:
    """Residuals of one drive, with the causes ``given``."""
    with_road = dict(drive.held_out)
    if ROAD in drive.draws:
        with_road[ROAD] = drive.draws[ROAD].mean(axis=1)
    return Residuals(
        plain=drive.residual,
        given=_without(drive.residual, drive.held_out, given),
        held_out=_without(drive.residual, drive.held_out, drive.held_out),
        road_known=_without(drive.residual, with_road, with_road),
        causes=dict(drive.held_out),
    )


def _without(residual: Floats, powers: Mapping[str, Floats], causes: Collection[str]) -> Floats:
    """Residual (n,) minus the powers (n,) or (n, d) of ``causes``, where present: (n,) or (n, d)."""
    rest = residual
    for cause, power in powers.items():  # order of the mapping: floating-point sums must not depend on set order
        if cause in causes:
            rest = (rest if rest.ndim == power.ndim else rest[:, None]) - power
    return rest


def _rms(values: Floats) -> float:
    """Root mean square of all values."""
    return float(np.sqrt(np.mean(values**2)))


def _part(
    cause: str,
    is_given: bool,
    residual: Floats,
    drawn: Mapping[str, Floats],
    held_out: Mapping[str, Floats],
    systematic: tuple[Floats, Floats],
) -> Part:
    """Part of a cause; ``systematic`` (d,), (d,): total share of the causes found, and of everything but noise."""
    draws = drawn[cause]
    shares = residual @ draws / (residual @ residual)
    mean = float(shares.mean())
    low, high = (mean - np.quantile(shares, [0.05, 0.95])).tolist()
    form = SDS_OF_90_PERCENT * FORM_DOUBT * abs(mean * (1 - mean))
    closed, doubted = (np.clip(shares / np.maximum(whole, MIN_SYSTEMATIC), 0.0, 1.0) for whole in systematic)
    ends = np.quantile(np.concatenate([closed, doubted]), [0.05, 0.95])
    return Part(
        cause=cause,
        is_given=is_given,
        closed=(float(closed.mean()), float(ends[0]), float(ends[1])),
        share=mean,
        q05=mean - float(np.hypot(low, form)),
        q95=mean + float(np.hypot(high, form)),
        rms=_rms(draws),
        held_out_rms=_rms(_without(residual, held_out, {cause})) if cause in held_out else None,
        expected=_rms(_without(residual, drawn, {cause})),
    )


def _powers(drive: DriveState, others: Sequence[Term], unnamed: Sequence[Term], rng: np.random.Generator) -> _Powers:
    plain, mass = PlainModel(drive.fit), 1 / drive.fit.beta[:1]
    held_out = _held_out(drive, [_name(term) for term in drive.chosen])
    added = (*others, *unnamed)
    joint, terms = drive.joint_with(added), [*drive.chosen, *added]
    amplitudes = _amplitudes(joint, terms, rng)
    masses = joint.unit[0] / amplitudes[0]
    draws = {
        _name(term): _power(plain, joint.acceleration(joint.term_columns[i], amplitudes[joint.term_columns[i]]), masses)
        for i, term in enumerate(terms)
    }
    for cause, part in _road_and_noise(drive, joint, amplitudes, rng):
        draws[cause] = _power(plain, part, masses)
    return _Powers(
        plain.residual(plain.power),
        draws,
        {cause: _power(plain, part[:, None], mass)[:, 0] for cause, part in held_out.items()},
    )


def _power(plain: PlainModel, acceleration: Floats, masses: Floats) -> Floats:
    """Power [W] (k, d), means over 2 s, off the plain road load, of draws (n, d) of an ``acceleration`` [m/s^2]."""
    power = np.empty((len(plain.second), len(masses)))
    for at in range(0, len(masses), TOGETHER):
        some = slice(at, at + TOGETHER)
        power[:, some] = plain.residual(plain.as_power(acceleration[:, some], masses[some]))
    return power


def _road_and_noise(
    drive: DriveState, joint: JointLikelihood, amplitudes: Floats, rng: np.random.Generator
) -> Iterator[tuple[str, Floats]]:
    """Draws of the acceleration (n, d) [m/s^2] by the road, white forces and sensor noise, with their causes."""
    n = len(joint.frame.strides)
    errors, white, slopes = np.empty((n, DRAWS)), np.empty((n, DRAWS)), np.zeros((n, 0 if drive.is_level else DRAWS))
    for at in range(0, DRAWS, TOGETHER):
        some = slice(at, at + TOGETHER)
        residuals = joint.residual(amplitudes[:, some])
        unknowns = joint.conditioned.draws(residuals, rng)
        errors[:, some] = joint.model.sensor_errors(unknowns)
        white[:, some] = residuals[:n] - errors[:, some]
        if not drive.is_level:
            slopes[:, some] = -STANDARD_GRAVITY * joint.model.slope_under(joint.frame.strides, unknowns)
            white[:, some] -= slopes[:, some]
    if not drive.is_level:
        slopes += joint.acceleration(joint.stretches, amplitudes[joint.stretches])
        yield ROAD, slopes
    del slopes  # on a long drive each of these arrays takes as much memory as all columns
    scales = drive.fit.scales.values
    remaining, disturbance = joint.model.noise_variance(scales), scales[DISTURBANCE]
    share = (disturbance**2 / (disturbance**2 + remaining))[:, None]
    doubt = np.sqrt(share * (1 - share) * (remaining + disturbance**2)[:, None])
    gusts = rng.standard_normal(white.shape)
    gusts *= doubt
    gusts += share * white
    yield WHITE, gusts
    errors += white
    errors -= gusts
    yield NOISE, errors


def _amplitudes(joint: JointLikelihood, terms: Sequence[Term], rng: np.random.Generator) -> Floats:
    """Posterior draws (p, DRAWS) of all amplitudes, in the scaled units of `SetLikelihood`.

    The draws that violate the sign constraints least are kept, of MAX_TRIES times as many; the rest is clipped at zero.
    """
    posterior = joint.posterior(range(len(terms)))
    root = np.linalg.cholesky(posterior.covariance * np.outer(joint.unit, joint.unit))
    mean = (posterior.mean * joint.unit)[:, None]
    draws = mean + root @ rng.standard_normal((len(root), DRAWS * MAX_TRIES))
    positive = [joint.term_columns[i][0] for i, term in enumerate(terms) if term.positive]
    wrong = np.sum(np.minimum(draws[positive] / np.sqrt(np.diag(root @ root.T))[positive, None], 0.0) ** 2, axis=0)
    kept: Floats = draws[:, np.argsort(wrong, kind="stable")[:DRAWS]]
    kept[positive] = np.maximum(kept[positive], 0.0)
    return kept


def _name(term: Term) -> str:
    return term.name if term.effect_term is not None else f"{UNKNOWN}{term.name}"


def _held_out(drive: DriveState, names: Sequence[str]) -> dict[str, Floats]:
    """Acceleration (n,) [m/s^2] by each effect and the road on stretches left out of the fit."""
    strides = drive.strides
    driven = np.flatnonzero(strides.known)
    accelerations: dict[str, Floats] = {
        name: np.zeros(len(driven)) for name in (*names, *([] if drive.is_level else [ROAD]))
    }
    for out in left_out(len(driven), FOLDS, STRETCH):
        is_kept = strides.known.copy()
        is_kept[driven[out]] = False
        rest = replace(strides, known=is_kept)
        state = replace(drive, strides=rest, fit=replace(drive.fit, strides=rest[is_kept]))
        joint = state.joint
        posterior = joint.posterior(range(len(drive.chosen)))
        held_out = strides[driven[out]]
        frame = Frame.of(replace(drive.fit, strides=held_out))
        for i, term in enumerate(drive.chosen):
            amplitude = posterior.mean[joint.term_columns[i]]
            accelerations[names[i]][out] = term.columns(frame) @ amplitude
        if drive.is_level:
            continue
        unknowns = joint.conditioned.unknowns(joint.residual(posterior.mean * joint.unit))
        accelerations[ROAD][out] = -STANDARD_GRAVITY * joint.model.slope_under(held_out, unknowns)
        if drive.stretches is not None:
            accelerations[ROAD][out] += drive.stretches.columns(frame) @ posterior.mean[joint.stretches]
    return accelerations
