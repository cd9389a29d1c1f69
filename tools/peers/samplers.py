"""The posterior of bench_sampler.py, and the samplers of other libraries.

Each sampler adds its CPU time to the problem and returns its draws (chains, draws, 3).
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from estimator.config import Config
from estimator.model.road_load import design, power
from estimator.sampling.clipped import ClippedGaussianTarget
from estimator.sampling.likelihood import factor, in_box
from estimator.signals import Floats
from estimator.simulation.noise import smooth

TRUTH = np.array([1739.0, 3.74, 27_190.0])  # A [N], C [N s^2/m^2], m [kg]
NOISE = 12e3  # W
BOX = np.array([Config().prior.A_N, Config().prior.C_N_s2_m2, Config().prior.mass_kg]).T
PEER_WORK = 1e9  # evaluations of a single sample's residual, about, for each of the others


def drive(n: int, rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
    """Speed [m/s], acceleration [m/s^2] and power [W] (n,) of a drive at 10 Hz with measured power above zero."""
    v = np.clip(16 + smooth(2 * n, 7.0, 200, rng), 0.5, 30)
    a = np.gradient(v, 0.1)
    P = power(v, a, TRUTH) + NOISE * rng.standard_normal(2 * n)
    kept = np.flatnonzero(P > 0)[:n]
    return v[kept], a[kept], P[kept]


def samples(n: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """The same as columns (n, 3) of the model, and power (n,) [W]."""
    v, a, P = drive(n, rng)
    return design(v, a), P


@dataclass(kw_only=True)
class Problem:
    """The problem: ``X`` (n, 3), ``P`` (n,) [W], and functions shared by the samplers."""

    X: Floats
    P: Floats
    target: ClippedGaussianTarget
    rng: np.random.Generator
    seconds: float = 0.0  # CPU time of the draws

    @property
    def root(self) -> Floats:
        """Factor (3, 3) of the local Gaussian's covariance."""
        return factor(self.target.curvature(self.target.centre[None])[0])

    def iterations(self, batch: int) -> int:
        """Number of evaluations of ``batch`` points allowed to a peer."""
        return int(np.clip(PEER_WORK / (len(self.P) * batch), 300, 20_000))

    def log_density(self, theta: Floats) -> Floats:
        """By brute force (k,)."""
        residual = self.P - np.maximum(theta @ self.X.T, 0.0)
        density = -np.einsum("ij,ij->i", residual, residual) / (2 * self.target.variance)
        return np.where(in_box(theta, *BOX), density, -np.inf)

    def timed(self, work: Callable[[], Floats], repetitions: int = 1) -> Floats:
        """Draws (chains, draws, 3) of ``work``; its median CPU time is recorded."""
        times = [time.process_time()]
        for _ in range(repetitions):
            draws = work()
            times.append(time.process_time())
        self.seconds = float(np.median(np.diff(times)))
        return draws


def paper(q: Problem) -> Floats:
    """Random walk J = R z of three chains one after the other, chi2 summed over all samples."""

    def work() -> Floats:
        draws = np.empty((3, q.iterations(3), 3))
        for chain in draws:
            theta, density = q.target.centre, q.log_density(q.target.centre[None])[0]
            for i in range(len(chain)):
                if i % 100 == 0:
                    J = q.X[q.X @ theta > 0]
                    R = np.linalg.cholesky(q.target.variance * np.linalg.inv(J.T @ J))
                proposal = theta + R @ q.rng.standard_normal(3)
                proposed = q.log_density(proposal[None])[0]
                if np.log(q.rng.random()) < proposed - density:
                    theta, density = proposal, proposed
                chain[i] = theta
        return draws

    return q.timed(work)


def emcee_stretch(q: Problem) -> Floats:
    """Emcee, 32 walkers evaluated at once."""
    import emcee

    sampler = emcee.EnsembleSampler(32, 3, q.log_density, vectorize=True)
    starts, n = q.target.centre + q.rng.standard_normal((32, 3)) @ q.root.T, q.iterations(32)
    q.timed(lambda: sampler.run_mcmc(starts, n))
    draws: Floats = sampler.get_chain()[n // 10 :].swapaxes(0, 1)
    return draws


def pymcmcstat_dram(q: Problem) -> Floats:
    """Pymcmcstat, delayed rejection and adaptive Metropolis, two chains from the fitted point."""
    import scipy

    vars(scipy).update(pi=np.pi, sin=np.sin, cos=np.cos)  # names removed from scipy that pymcmcstat imports
    from pymcmcstat.MCMC import MCMC

    def chain() -> Floats:
        mcmc = MCMC()
        mcmc.data.add_data_set(x=np.arange(len(q.P)), y=q.P)
        for name, value, low, high in zip("ACm", q.target.centre, *BOX, strict=True):
            mcmc.parameters.add_model_parameter(name=name, theta0=value, minimum=low, maximum=high)
        options = {"method": "dram", "updatesigma": False, "verbosity": 0, "waitbar": False, "qcov": q.root @ q.root.T}
        mcmc.simulation_options.define_simulation_options(nsimu=q.iterations(3), **options)
        mcmc.model_settings.define_model_settings(
            sos_function=lambda theta, _: np.sum((q.P - np.maximum(q.X @ theta, 0)) ** 2), sigma2=q.target.variance
        )
        mcmc.run_simulation()
        draws: Floats = mcmc.simulation_results.results["chain"]
        return draws

    return q.timed(lambda: np.stack([chain(), chain()]))


def blackjax_nuts(q: Problem) -> Floats:
    """Blackjax, NUTS, in coordinates that are well scaled: theta = centre + root z."""
    import blackjax
    import jax
    from jax import numpy as jnp

    jax.config.update("jax_enable_x64", True)
    w, u, P = jnp.asarray(q.X @ q.root), jnp.asarray(q.X @ q.target.centre), jnp.asarray(q.P)

    def density(z: Any) -> Any:
        theta = q.target.centre + q.root @ z
        inside = jnp.all((theta >= BOX[0]) & (theta <= BOX[1]))
        chi2 = jnp.sum((P - jnp.maximum(u + w @ z, 0.0)) ** 2)
        return jnp.where(inside, -chi2 / (2 * q.target.variance), -jnp.inf)

    (state, tuned), _ = blackjax.window_adaptation(blackjax.nuts, density).run(jax.random.PRNGKey(0), np.zeros(3), 300)
    step, n = blackjax.nuts(density, **tuned).step, q.iterations(8) // 2 * 2

    def positions(key: Any) -> Any:
        return jax.lax.scan(lambda s, k: (step(k, s)[0],) * 2, state, jax.random.split(key, n))[1].position

    draw = jax.jit(positions)
    draw(jax.random.PRNGKey(1)).block_until_ready()  # compiles
    return q.target.centre + q.timed(lambda: np.asarray(draw(jax.random.PRNGKey(2)))).reshape(2, -1, 3) @ q.root.T
