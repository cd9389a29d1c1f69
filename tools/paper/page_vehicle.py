"""The page's hierarchical fit over the printed runs."""

import numpy as np

from estimator.signals import Floats
from paper.cycles import Cycle
from paper.printed import PRINTED
from paper.results import PARAMETERS, listed, printed_values, table
from paper.vehicle_posterior import BETWEEN_PRIORS, CRUISE, OFFSET_PRIOR, VehiclePosterior, offset_response
from paper.vehicles import NAMES, NOMINAL, TO_SI


def _interval(draws: Floats, digits: int) -> str:
    low, middle, high = np.quantile(draws, [0.05, 0.5, 0.95])
    return f"{middle:.{digits}f} ({low:.{digits}f} .. {high:.{digits}f})"


def vehicle(posteriors: dict[float, VehiclePosterior], cycles: dict[str, Cycle]) -> str:
    """The section on the hierarchical fit."""
    chosen = posteriors[BETWEEN_PRIORS[0]]
    return "\n\n".join([vehicle_table(chosen, list(cycles)), between_runs(chosen, cycles), _between_cycles(posteriors)])


def vehicle_table(chosen: VehiclePosterior, names: list[str]) -> str:
    """The model, and the parameters of the vehicle and of the cycles."""
    pooled = np.concatenate([p.estimates for p in PRINTED.values()])
    nominal = NOMINAL / TO_SI
    rows = [
        ["nominal", *printed_values(nominal)],
        [f"all {len(pooled)} runs pooled, mean ± sd / √n", *printed_values(pooled.mean(0), _standard_error(pooled))],
        ["vehicle, μ", *printed_values(chosen.vehicle.mean(0), chosen.vehicle.std(0))],
    ]
    for i, name in enumerate(names):
        rows.append([f"θ of {name}", *printed_values(chosen.by_cycle[:, i].mean(0), chosen.by_cycle[:, i].std(0))])
    low, high = np.quantile(chosen.vehicle, [0.05, 0.95], axis=0)
    outside = [name for name, x, a, b in zip(NAMES, nominal, low, high, strict=True) if not a <= x <= b]
    force, drag = chosen.cruise_force, chosen.vehicle[:, 0]
    return f"""## Hierarchical fit over the printed runs

The paper's conclusion asks for a hierarchical model. This one (`tools/paper/hierarchy.py`) has three levels. An
estimate scatters around the parameters θ of its cycle with the covariance of white power noise of the run's own rms
(from Table 5), times κ² for its cycle, and with an error of the zero of the power measurement that is constant in a
run and has sd τ [hp] between runs. Rounding to the printed digits is a third part. The θ of the cycles scatter around
the vehicle's μ with sd β. Priors: log κ normal with sd 1, τ half-normal with scale {OFFSET_PRIOR:.0f} hp, β half-normal
with scale {100 * BETWEEN_PRIORS[0]:.0f} % of the nominal value, μ flat. θ and μ are integrated in closed form; κ, τ and
β are sampled with the program's random walk. The tests hold the closed form against a dense Gaussian and the sampler
against a grid.

{table(["", *PARAMETERS], rows)}

The last four rows are posterior mean ± sd. The total resistance A + C v² at {CRUISE:.0f} mph is
{force.mean():.1f} ± {force.std():.1f} lbf ({100 * force.std() / force.mean():.1f} %), while A alone is known to
{100 * drag.std() / drag.mean():.1f} %. The 90 % intervals of μ leave out the nominal value of {listed(outside)}.

![Hierarchical fit](paper/hierarchical_fit.png)"""


def between_runs(chosen: VehiclePosterior, cycles: dict[str, Cycle]) -> str:
    """Spread of the estimates between runs."""
    scales = [[name, _interval(chosen.noise_scale[:, i], 2)] for i, name in enumerate(cycles)]
    responses = [[name, *_signed(offset_response(cycle))] for name, cycle in cycles.items()]
    return f"""**Spread between runs.** κ with its 90 % interval; 1 means that white noise of the printed rms explains
the scatter.

{table(["cycle", "κ"], scales)}

τ is {_interval(chosen.offset, 2)} hp. Change of the estimates for 1 hp too much power in all samples of a run:

{table(["cycle", *PARAMETERS], responses)}

So the scatter of A and C on HWFET and HHDDTNC, without a scatter of m, is that of a power measurement whose zero moves
by half a horsepower between runs. A change of the tyres' friction alone would move A and leave C, but the printed A
and C move against each other. Slow disturbances of the power have the same pattern; the printed numbers cannot
separate the two."""


def _between_cycles(posteriors: dict[float, VehiclePosterior]) -> str:
    chosen = posteriors[BETWEEN_PRIORS[0]]
    spread = [_interval(chosen.between[:, i], digits) for i, digits in enumerate((1, 4, 1))]
    rows = [
        [f"{100 * scale:g} %", *printed_values(p.vehicle.mean(0), p.vehicle.std(0))] for scale, p in posteriors.items()
    ]
    return f"""**Spread between cycles.** β with its 90 % interval is {spread[0]} lbf for A, {spread[1]} lbf/mph² for C
and {spread[2]} slug for m. Three cycles hardly determine the spread between cycles, so its prior matters. μ for three
scales of the prior of β:

{table(["prior scale of β", *PARAMETERS], rows)}

Estimates of COMMUT lie near the ends of the box of C (0.1 to 0.2), where a Gaussian for their scatter is an
approximation; they have little weight in μ. Over {len(chosen.vehicle):,} draws the largest R-hat of the
hyperparameters is {chosen.r_hat:.2f}."""


def _standard_error(runs: Floats) -> Floats:
    error: Floats = runs.std(axis=0, ddof=1) / np.sqrt(len(runs))
    return error


def _signed(theta: Floats) -> list[str]:
    return [f"{theta[0]:+.1f}", f"{theta[1]:+.4f}", f"{theta[2]:+.1f}"]
