"""Effective draws per CPU second of our samplers and of others, all from the same posterior.

    python tools/bench_sampler.py [--samples 1000 10000 100000]

The others are installed by ``tools/peers.txt``; those that are missing are named and left out. Counted is the CPU
time of this process on one thread, burn-in included, and the smallest bulk ESS (ArviZ) over A, C and m. Left out for
everybody is what is done once: fit, compilation, and for NUTS (to its advantage) the warm-up. Means and standard
deviations show that all rows sample the same thing.
"""

import argparse
import os
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import arviz
import numpy as np
from rich.console import Console
from rich.table import Table

from estimator.config import Config
from estimator.road_load import design, power
from estimator.sampling.clipped import ClippedGaussianTarget
from estimator.sampling.likelihood import factor, in_box
from estimator.sampling.metropolis import KERNELS
from estimator.sampling.run import overdispersed, run
from estimator.signals import Floats
from estimator.simulation.noise import smooth

TRUTH = np.array([1739.0, 3.74, 27_190.0])  # A [N], C [N s^2/m^2], m [kg]
NOISE = 12e3  # W
BOX = np.array([Config().prior.A_N, Config().prior.C_N_s2_m2, Config().prior.mass_kg]).T
PEER_WORK = 1e9  # evaluations of a single sample's residual, about, for each of the others
ONE_THREAD = {
    "OPENBLAS_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
}


def samples(n: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """``n`` samples of a drive at 10 Hz with measured power above zero."""
    v = np.clip(16 + smooth(2 * n, 7.0, 200, rng), 0.5, 30)
    a = np.gradient(v, 0.1)
    P = power(v, a, TRUTH) + NOISE * rng.standard_normal(2 * n)
    kept = np.flatnonzero(P > 0)[:n]
    return design(v[kept], a[kept]), P[kept]


@dataclass
class Problem:
    """What is sampled: ``X`` (n, 3), ``P`` (n,) [W], and everybody's tools on it."""

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
        """How often a peer may evaluate ``batch`` points."""
        return int(np.clip(PEER_WORK / (len(self.P) * batch), 300, 20_000))

    def log_density(self, theta: Floats) -> Floats:
        """By brute force (k,)."""
        residual = self.P - np.maximum(theta @ self.X.T, 0.0)
        density = -np.einsum("ij,ij->i", residual, residual) / (2 * self.target.variance)
        return np.where(in_box(theta, *BOX), density, -np.inf)

    def timed(self, work: Callable[[], Floats], repetitions: int = 1) -> Floats:
        """Draws of ``work``, whose median CPU time is noted."""
        times = [time.process_time()]
        for _ in range(repetitions):
            draws = work()
            times.append(time.process_time())
        self.seconds = float(np.median(np.diff(times)))
        return draws


def ours(q: Problem, kernel: str, burn_in: int, draws: int, repetitions: int) -> Floats:
    """One of our own kernels, 256 chains."""
    starts = overdispersed(q.target, 256, q.rng)
    return q.timed(lambda: KERNELS[kernel](q.target, starts, burn_in, draws, q.rng).draws, repetitions)


def floor(q: Problem) -> Floats:
    """The Gaussian approximation, cut by the box: independent draws, not exact."""
    root, (lower, upper) = q.root, BOX

    def work() -> Floats:
        theta = q.rng.standard_normal((25_600, 3)) @ root.T + q.target.centre
        return theta[in_box(theta, lower, upper)]

    draws = q.timed(work, 31)
    return draws[: len(draws) // 256 * 256].reshape(256, -1, 3)


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
    return sampler.get_chain()[n // 10 :].swapaxes(0, 1)


def pymcmcstat_dram(q: Problem) -> Floats:
    """Pymcmcstat, delayed rejection and adaptive Metropolis, two chains from the fitted point."""
    import scipy

    scipy.pi, scipy.sin, scipy.cos = np.pi, np.sin, np.cos  # names scipy has dropped, and it still imports
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
        return mcmc.simulation_results.results["chain"]

    return q.timed(lambda: np.stack([chain(), chain()]))


def blackjax_nuts(q: Problem) -> Floats:
    """Blackjax, NUTS, in coordinates that are well scaled: theta = centre + root z."""
    import blackjax
    import jax
    from jax import numpy as jnp

    jax.config.update("jax_enable_x64", True)
    w, u, P = jnp.asarray(q.X @ q.root), jnp.asarray(q.X @ q.target.centre), jnp.asarray(q.P)

    def density(z):
        theta = q.target.centre + q.root @ z
        inside = jnp.all((theta >= BOX[0]) & (theta <= BOX[1]))
        chi2 = jnp.sum((P - jnp.maximum(u + w @ z, 0.0)) ** 2)
        return jnp.where(inside, -chi2 / (2 * q.target.variance), -jnp.inf)

    (state, tuned), _ = blackjax.window_adaptation(blackjax.nuts, density).run(jax.random.PRNGKey(0), np.zeros(3), 300)
    step, n = blackjax.nuts(density, **tuned).step, q.iterations(8) // 2 * 2

    @jax.jit
    def draw(key):
        return jax.lax.scan(lambda s, k: (step(k, s)[0],) * 2, state, jax.random.split(key, n))[1].position

    draw(jax.random.PRNGKey(1)).block_until_ready()  # compiles
    return q.target.centre + q.timed(lambda: np.asarray(draw(jax.random.PRNGKey(2)))).reshape(2, -1, 3) @ q.root.T


FLOOR = "floor: cut Gaussian, not exact"
ROWS: dict[str, Callable[[Problem], Floats]] = {
    "roadload, independence": lambda q: ours(q, "independence", 5, 100, 31),
    "roadload, random walk": lambda q: ours(q, "random_walk", 300, 700, 1),
    "paper's algorithm, plain numpy": paper,
    "emcee": emcee_stretch,
    "pymcmcstat DRAM": pymcmcstat_dram,
    "blackjax NUTS": blackjax_nuts,
    FLOOR: floor,
}


def compare(n: int, table: Table) -> None:
    """Add the rows for ``n`` samples."""
    X, P = samples(n, np.random.default_rng(n))
    target = ClippedGaussianTarget(X, P, *BOX)
    rates, moments = {}, {}
    for name, work in ROWS.items():
        problem = Problem(X, P, target, np.random.default_rng(1))
        try:
            draws = work(problem)
        except ModuleNotFoundError as error:
            table.add_row(f"{n:,}", name, f"left out: {error}")
            continue
        rates[name] = min(float(arviz.ess(draws[:, :, i])) for i in range(3)) / problem.seconds
        moments[name] = [f"{x.mean():.5g} ± {x.std():.2g}" for x in draws.reshape(-1, 3).T]
    peers = [rate for name, rate in rates.items() if "roadload" not in name and name != FLOOR]
    for name, rate in rates.items():
        ratios = f"{rate / max(peers):,.2f}", f"{rate / rates[FLOOR]:.2g}"
        table.add_row(f"{n:,}", name, f"{rate:,.0f}", *ratios, *moments[name])
    table.add_section()


def whole_answer(n: int) -> str:
    """Fit, sampling and diagnosis from ``n`` samples, as configured by default."""
    X, P = samples(n, np.random.default_rng(0))
    settings, durations = Config().sampler, []
    for seed in range(31):
        rng, start = np.random.default_rng(seed), time.process_time()
        target = ClippedGaussianTarget(X, P, *BOX)
        result = run(target, settings.kernel, settings.chains, settings.burn_in, settings.draws, rng)
        durations.append(1e3 * (time.process_time() - start))
    r_hat, bulk, tail = np.transpose([(d.r_hat, d.ess_bulk, d.ess_tail) for d in result.diagnoses])
    return (
        f"Whole answer from {n:,} samples: {np.median(durations):.1f} ms CPU; R-hat {r_hat.max():.4f}, ESS "
        f"{bulk.min():,.0f} bulk, {tail.min():,.0f} tail; correlation of A and C {result.correlation[0, 1]:.2f}"
    )


def main() -> int:
    """Measure every row, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, nargs="+", default=[1_000, 10_000, 100_000])
    options = parser.parse_args()
    if not ONE_THREAD.items() <= os.environ.items():
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | ONE_THREAD)
    warnings.simplefilter("ignore")  # of the others
    table = Table("samples", "sampler", "ESS/s", "/ best peer", "/ floor", "A [N]", "C [N s²/m²]", "m [kg]")
    for n in options.samples:
        compare(n, table)
    Console(width=160).print(table, whole_answer(36_000))
    return 0


if __name__ == "__main__":
    sys.exit(main())
