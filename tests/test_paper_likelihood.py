"""The likelihood that follows the window, against the sum over all samples that the window holds."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.checkpoint.store import pack, unpack
from estimator.config import from_dict
from estimator.errors import StateError
from estimator.estimation.paper_likelihood import PaperLikelihood
from estimator.estimation.window import Window
from estimator.model.road_load import design, power
from estimator.samples import Samples
from estimator.sampling.condensed import Region
from estimator.sampling.likelihood import factor

TRUTH = np.array([1800.0, 3.7, 27_000.0])
LOWER, UPPER = np.zeros(3), np.array([10_000.0, 20.0, 100_000.0])
AIR = ("none", "all", "some", "other")


def block(n, t, noise, air, theta, rng):
    """``n`` samples from ``t`` [s] on, some of them coasting, some with power that is not positive."""
    v, a = rng.uniform(3, 30, n), rng.normal(0.0, 0.15, n)
    density = {
        "none": np.full(n, np.nan),
        "all": np.full(n, rng.normal(1.2, 0.005)),
        "some": np.where(rng.random(n) < 0.5, 1.2, np.nan),
        "other": np.full(n, 0.9),
    }[air]
    P = power(v, a, theta) + noise * rng.standard_normal(n)
    one = np.ones(n)
    return Samples(t=t + 0.1 * np.arange(n), v=v, a=a, P=P, dP=one, zv=v, za=a, zdP=one, density=density)


def brute_force(window, theta):
    """Chi2 (k,) in extended precision, and how many samples it is of."""
    positive = window.samples[window.samples.P > 0]
    X = design(positive.v, positive.a, positive.relative_density).astype(np.longdouble)
    P = positive.P.astype(np.longdouble)
    return np.array([((P - np.maximum(X @ row, 0)) ** 2).sum() for row in theta.astype(np.longdouble)]), len(P)


def check(target, window, rng):
    """Exact near the mode, and in the corners of the box."""
    least, n = brute_force(window, target.centre[None])
    assert target.variance == pytest.approx(float(least[0]) / max(n - 3, 1), rel=1e-9)
    direction = rng.standard_normal((16, 3))
    z = rng.uniform(0, 8, (16, 1)) * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    root = factor(target.curvature(target.centre[None])[0])
    near, farther = (np.clip(target.centre + by * z @ root.T, LOWER, UPPER) for by in (1, 4))
    far = np.vstack([farther, rng.uniform(LOWER, UPPER, (4, 3)), LOWER, UPPER])
    for theta, tolerance in (near, 1e-9), (far, 1e-6):
        exact = (brute_force(window, theta)[0] - least) / np.longdouble(target.variance)
        # A double has 16 digits: where chi2 is 1e10 sigma^2, not even its rounding is below 1e-6.
        assert (np.abs(-2 * target.log_density(theta) - exact) <= np.maximum(tolerance, 1e-12 * np.abs(exact))).all()


def stored(state):
    return unpack(pack(state, "k"), "k")


def new_window(samples, hours):
    return Window(from_dict({"window": {"samples": samples, "hours": hours}}), Samples)


steps = st.lists(
    st.tuples(
        st.sampled_from(["drive"] * 8 + ["other load", "clear", "restore", "away"]),
        st.integers(20, 200),
        st.sampled_from(AIR),
    ),
    min_size=3,
    max_size=30,
)


@pytest.mark.slow
@settings(deadline=None, max_examples=60)
@given(steps, st.integers(600, 2000), st.floats(0.02, 1.0), st.floats(1, 4.5), st.integers(0, 2**32))
def test_chi2_is_exact_whatever_the_window_does(steps, capacity, hours, noise, seed):
    rng, t, theta = np.random.default_rng(seed), 0.0, TRUTH
    window, likelihood = new_window(capacity, hours), PaperLikelihood()
    for what, n, air in steps:
        if what == "clear":
            window.clear()
        elif what == "other load":
            theta = theta * [1, 1, rng.uniform(0.5, 1.5)]
        elif what == "away":
            t += 3600 * hours
        elif what == "restore":
            states = stored({"window": window.state(), "likelihood": likelihood.state()})
            window, likelihood = new_window(capacity, hours), PaperLikelihood()
            window.restore(states["window"])
            likelihood.restore(states["likelihood"])
        window.add(block(n, t, 10.0**noise, air, theta, rng))
        t += 0.1 * n
        check(likelihood.target(window.blocks, LOWER, UPPER), window, rng)


def full_window(capacity, rng, noise=3000.0, air="all"):
    window, t = new_window(capacity, 1000.0), 0.0
    while window.evicted == 0:
        window.add(block(200, t, noise, air, TRUTH, rng))
        t += 20.0
    return window, t


def looks(monkeypatch):
    """How many samples each condensing looks at, from now on."""
    sizes, condense = [], Region.condense
    monkeypatch.setattr(Region, "condense", lambda self, X, P: sizes.append(len(P)) or condense(self, X, P))
    return sizes


@pytest.mark.parametrize("noise", [30.0, 3000.0])
@pytest.mark.parametrize("air", AIR)
def test_an_update_looks_at_new_samples_only(monkeypatch, noise, air):
    rng = np.random.default_rng(1)
    window, t = full_window(6000, rng, noise, air)
    likelihood = PaperLikelihood()
    for _ in range(2):
        likelihood.target(window.blocks, LOWER, UPPER)
    sizes = looks(monkeypatch)
    for i in range(200):
        added = block(200, t + 20.0 * i, noise, air, TRUTH, rng)
        window.add(added)
        target = likelihood.target(window.blocks, LOWER, UPPER)
        stayed = added.t[0] in window.samples.t  # the fullest block may be the new one
        assert sizes == ([np.count_nonzero(added.P > 0)] if stayed else [])
        sizes.clear()
    check(target, window, rng)


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_another_load_is_found_far_away(share):
    rng = np.random.default_rng(4)
    window, t = full_window(6000, rng, 30.0, "none")
    likelihood = PaperLikelihood()
    for _ in range(2):
        likelihood.target(window.blocks, LOWER, UPPER)
    window.clear()
    for i in range(30):
        window.add(block(200, t + 20.0 * i, 30.0, "none", TRUTH * [1, 1, share], rng))
    target = likelihood.target(window.blocks, LOWER, UPPER)
    assert target.centre[2] == pytest.approx(share * TRUTH[2], rel=1e-3)
    check(target, window, rng)


@pytest.mark.slow
def test_the_sums_of_days_are_those_of_what_is_left():
    """After 1,000 windows nothing is left of the rounding of what went."""
    rng = np.random.default_rng(2)
    window, likelihood = new_window(600, 0.05), PaperLikelihood()
    for i in range(3000):
        window.add(block(200, 20.0 * i, 3000.0, "all", TRUTH, rng))
        target = likelihood.target(window.blocks, LOWER, UPPER)
    check(target, window, rng)
    assert len(window) <= 600


def test_a_restored_likelihood_goes_on_to_the_bit():
    rng = np.random.default_rng(3)
    window, t = full_window(4000, rng)
    first, second = PaperLikelihood(), PaperLikelihood()
    for _ in range(3):
        first.target(window.blocks, LOWER, UPPER)
    again = new_window(4000, 1000.0)
    other = full_window(1000, rng)[0]
    second.target(other.blocks, LOWER, UPPER)
    again.restore(stored(window.state()))
    second.restore(stored(first.state()))
    theta = TRUTH * (1 + 0.01 * rng.standard_normal((50, 3)))
    for i in range(3):
        added = block(200, t + 20.0 * i, 3000.0, "some", TRUTH, rng)
        window.add(added)
        again.add(added)
        one, two = (x.target(w.blocks, LOWER, UPPER) for x, w in ((first, window), (second, again)))
        assert np.array_equal(one.centre, two.centre)
        assert np.array_equal(one.log_density(theta), two.log_density(theta))


@pytest.mark.parametrize(
    "region", [{"origin": np.ones(4), "whiten": np.zeros((4, 4))}, {"origin": np.ones(3), "whiten": np.eye(4)}, {}]
)
def test_a_region_that_is_none_is_refused(region):
    with pytest.raises(StateError):
        PaperLikelihood().restore({"region": region})


def test_no_samples_leave_the_box():
    target = PaperLikelihood().target({}, LOWER, UPPER)
    assert np.isfinite(target.log_density(np.array([LOWER, UPPER, TRUTH]))).all()
