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

from estimator.components.drawn_powers import DrawnPowers
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
    its own, beside the given ones, and effects that were not chosen did not act. ``closed``: its share in all that was
    found (chosen effects, nameless processes, road), with a 90 % interval that allows for effects not found.
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
    on stretches left out of the fit. ``road_known``: ``given`` less a road that the force allows; its rms is
    `Part.expected` of the road. ``causes``: power of each chosen term and the road on the stretches left out.
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


@dataclass(frozen=True, kw_only=True)
class _Drive:
    """Residuals and drawn powers of one drive.

    ``held_out`` [W] (k,): power of the causes that are not given, estimated on stretches left out of the fit.
    """

    residuals: Residuals
    held_out: dict[str, Floats]
    drawn: DrawnPowers


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
    chosen = {term.name for drive in drives for term in drive.chosen}
    not_chosen = dict.fromkeys(term.name for terms in possible for term in terms if term.name not in chosen)
    found = [
        _of_drive(drive, others, process, rng, given, not_chosen)
        for drive, others, process in zip(drives, possible, unnamed, strict=True)
    ]
    residual = np.concatenate([drive.residuals.given for drive in found])
    held_out = {
        cause: np.concatenate([drive.held_out.get(cause, np.zeros(len(drive.residuals.given))) for drive in found])
        for cause in dict.fromkeys(cause for drive in found for cause in drive.held_out)
    }
    drawn = _with_small_pooled(DrawnPowers.of_drives([drive.drawn for drive in found]), not_chosen)
    shares = {cause: drawn.share(cause) for cause in drawn.causes}
    unfound = [cause for cause in shares if cause == OTHERS or cause in not_chosen]
    causes = [cause for cause in shares if cause not in (*unfound, NOISE, WHITE)]
    found_share, unfound_share = (sum((shares[c] for c in group), np.zeros(DRAWS)) for group in (causes, unfound))
    held_out_rms = {cause: _rms(_without(residual, held_out, {cause})) for cause in held_out}
    parts = [
        _part(
            cause, cause in given, drawn, held_out_rms.get(cause), (found_share, found_share + unfound_share), unfound
        )
        for cause in shares
    ]
    return Budget(
        base=_rms(residual),
        held_out_rms=_rms(_without(residual, held_out, held_out)),
        parts=tuple(sorted(parts, key=lambda part: -part.share)),
        residuals=tuple(drive.residuals for drive in found),
    )


def _with_small_pooled(drawn: DrawnPowers, not_chosen: Collection[str]) -> DrawnPowers:
    """Drawn powers with one part, OTHERS, for those ``not_chosen`` that take less than MIN_SHARE of the gap."""
    possible = [cause for cause in drawn.causes if cause in not_chosen]
    small = [cause for cause in possible if np.quantile(np.abs(drawn.share(cause)), 0.95) < MIN_SHARE]
    return drawn.pooled(small, OTHERS) if small else drawn


def _without(residual: Floats, powers: Mapping[str, Floats], causes: Collection[str]) -> Floats:
    """Residual (n,) minus the powers (n,) of ``causes``, where present."""
    rest = residual
    for cause, power in powers.items():  # order of the mapping: floating-point sums must not depend on set order
        if cause in causes:
            rest = rest - power
    return rest


def _rms(values: Floats) -> float:
    """Root mean square of all values."""
    return float(np.sqrt(np.mean(values**2)))


def _part(
    cause: str,
    is_given: bool,
    drawn: DrawnPowers,
    held_out_rms: float | None,
    systematic: tuple[Floats, Floats],
    unfound: Sequence[str],
) -> Part:
    """Part of a cause; ``systematic`` (d,), (d,): total share of the causes found, and of everything but noise.

    Where a cause that was found is known, the effects ``unfound`` do not act.
    """
    shares = drawn.share(cause)
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
        rms=drawn.rms(cause),
        held_out_rms=held_out_rms,
        expected=drawn.rms_without(cause, *(() if cause in (*unfound, NOISE, WHITE) else unfound)),
    )


def _of_drive(
    drive: DriveState,
    others: Sequence[Term],
    unnamed: Sequence[Term],
    rng: np.random.Generator,
    given: Collection[str],
    not_chosen: Collection[str],
) -> _Drive:
    plain, mass = PlainModel(drive.fit), 1 / drive.fit.beta[:1]
    held_out = {
        cause: _power(plain, part[:, None], mass)[:, 0]
        for cause, part in _held_out(drive, [_name(term) for term in drive.chosen]).items()
    }
    residual = plain.residual(plain.power)
    of_given = _without(residual, held_out, given)
    added = (*others, *unnamed)
    joint, terms = drive.joint_with(added), [*drive.chosen, *added]
    amplitudes = _amplitudes(joint, terms, rng)
    known = [*(term.name for term in others if term.name in not_chosen), *([] if drive.is_level else [ROAD])]
    batches, roads = list[DrawnPowers](), np.zeros((2, len(residual)))  # mean of all draws, and the last
    for at in range(0, DRAWS, TOGETHER):
        powers = dict(_drawn(drive, joint, terms, plain, amplitudes[:, at : at + TOGETHER], rng))
        for cause in [cause for cause in powers if cause in given and cause in held_out]:
            powers[cause] -= held_out[cause][:, None]
        road = sum((powers[cause] for cause in known), np.zeros((len(residual), TOGETHER)))
        roads += road.sum(axis=1) / DRAWS, road[:, -1] - roads[1]
        batches.append(DrawnPowers.of(of_given, powers))
    drawn = DrawnPowers.of_draws(batches)
    return _Drive(
        residuals=Residuals(
            plain=residual,
            given=of_given,
            held_out=_without(residual, held_out, held_out),
            road_known=_with_true_road(of_given, roads, drawn.rms_without(*known)),
            causes=held_out,
        ),
        held_out={cause: power for cause, power in held_out.items() if cause not in given},
        drawn=drawn,
    )


def _with_true_road(residual: Floats, roads: Floats, expected: float) -> Floats:
    """Residual (k,) less the power of a road near a draw from the posterior, so that its rms is the ``expected`` one.

    ``roads`` (2, k): the posterior's mean, which leaves less than the true road as it follows noise, and the draw.
    """
    mean, draw = roads
    left, step = residual - mean, draw - mean
    along, length = float(left @ step), max(float(step @ step), np.finfo(float).tiny)
    missing = max(len(left) * expected**2 - float(left @ left), 0.0)
    true: Floats = left - (along + float(np.sqrt(along**2 + length * missing))) / length * step
    return true


def _power(plain: PlainModel, acceleration: Floats, masses: Floats) -> Floats:
    """Power [W] (k, d), means over 2 s, off the plain road load, of draws (n, d) of an ``acceleration`` [m/s^2]."""
    return plain.residual(plain.as_power(acceleration, masses))


def _drawn(
    drive: DriveState,
    joint: JointLikelihood,
    terms: Sequence[Term],
    plain: PlainModel,
    amplitudes: Floats,
    rng: np.random.Generator,
) -> Iterator[tuple[str, Floats]]:
    """Draws of the power (k, d) [W] of each cause, with its name, for draws of the ``amplitudes`` (p, d)."""
    masses = joint.unit[0] / amplitudes[0]
    for i, term in enumerate(terms):
        columns = joint.term_columns[i]
        yield _name(term), _power(plain, joint.acceleration(columns, amplitudes[columns]), masses)
    for cause, acceleration in _road_and_noise(drive, joint, amplitudes, rng):
        yield cause, _power(plain, acceleration, masses)


def _road_and_noise(
    drive: DriveState, joint: JointLikelihood, amplitudes: Floats, rng: np.random.Generator
) -> Iterator[tuple[str, Floats]]:
    """Draws of the acceleration (n, d) [m/s^2] by the road, white forces and sensor noise, with their causes."""
    n, residuals = len(joint.frame.strides), joint.residual(amplitudes)
    unknowns = joint.conditioned.draws(residuals, rng)
    errors = joint.model.sensor_errors(unknowns)
    white = residuals[:n] - errors
    if not drive.is_level:
        slopes = -STANDARD_GRAVITY * joint.model.slope_under(joint.frame.strides, unknowns)
        white -= slopes
        yield ROAD, slopes + joint.acceleration(joint.stretches, amplitudes[joint.stretches])
    scales = drive.fit.scales.values
    remaining, disturbance = joint.model.noise_variance(scales), scales[DISTURBANCE]
    share = (disturbance**2 / (disturbance**2 + remaining))[:, None]
    doubt = np.sqrt(share * (1 - share) * (remaining + disturbance**2)[:, None])
    gusts = share * white + doubt * rng.standard_normal(white.shape)
    yield WHITE, gusts
    yield NOISE, errors + white - gusts


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
