"""Draws of the posterior in a file: CSV and JSON always, NetCDF in ArviZ's layout where arviz-base is installed.

The JSON also has quantiles, correlation, the convergence of each parameter, the paper's eigen-metrics raw and scaled by
the posterior, and the drag coefficient in reference air.
"""

import csv
import importlib.util
from dataclasses import asdict
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from msgspec import UNSET, UnsetType

from estimator.answers import draws as answer
from estimator.answers.answer import encode
from estimator.answers.draws import DrawsAnswer
from estimator.errors import ConfigError
from estimator.estimation.evidence import Evidence
from estimator.estimation.posterior import Posterior
from estimator.extras import how_to_install
from estimator.model.road_load import design
from estimator.output_files import check_suffix, whole
from estimator.sampling.convergence import diagnose
from estimator.sampling.identifiability import EigenMetrics, eigen_metrics
from estimator.signals import Floats
from estimator.units import STANDARD_DENSITY

NAMES = ("A_N", "C_N_s2_m2", "mass_kg")  # order of the draws' last axis
FORMATS = (".csv", ".json", ".nc")


def require_arviz() -> None:
    """Complain early where NetCDF cannot be written.

    Raises
    ------
    ConfigError
        The package arviz-base is not installed.
    """
    if importlib.util.find_spec("arviz_base") is None:
        raise ConfigError(f"this needs arviz-base: {how_to_install('arviz')}")


def write_draws(evidence: Evidence, path: Path) -> None:
    """Write the draws of A, C and m behind an estimate to ``path``; the suffix gives the format.

    Raises
    ------
    RoadloadError
        The file cannot be written.
    """
    check_suffix(path, FORMATS)
    contents = {
        ".json": lambda: encode(_draws(evidence)),
        ".csv": lambda: _csv(evidence.posterior),
        ".nc": lambda: _netcdf(evidence.posterior),
    }
    with whole(path) as file:
        file.write(contents[path.suffix.lower()]())


def _csv(posterior: Posterior) -> bytes:
    text = StringIO(newline="")
    table = csv.writer(text)
    table.writerow(["chain", "draw", *NAMES])
    for i, chain in enumerate(posterior.draws[:, :, : len(NAMES)].tolist()):
        table.writerows([i, j, *draw] for j, draw in enumerate(chain))
    return text.getvalue().encode()


def _draws(evidence: Evidence) -> DrawsAnswer:
    draws = evidence.posterior.draws[:, :, : len(NAMES)]
    flat = draws.reshape(-1, len(NAMES))
    used = evidence.trace
    J = design(used.v, used.a, used.relative_density)
    information = J.T @ J
    scale = flat.std(axis=0) / evidence.rms
    return DrawsAnswer(
        dims=("chain", "draw"),
        posterior={name: draws[:, :, i].tolist() for i, name in enumerate(NAMES)},
        summary={name: _summary(evidence.posterior, i) for i, name in enumerate(NAMES)},
        correlation=np.atleast_2d(np.corrcoef(flat.T)).tolist(),
        effective_samples=evidence.effective,
        eigen_metrics=answer.EigenMetricsPair(
            raw=_metrics(eigen_metrics(information)), scaled=_metrics(eigen_metrics(information, scale))
        ),
        air=_air(used.mean_density, flat[:, 1]),
    )


def _air(density: float | None, C: Floats) -> answer.Air | UnsetType:
    if density is None:
        return UNSET
    factor = STANDARD_DENSITY / density
    return answer.Air(
        density_kg_m3=density,
        reference_kg_m3=STANDARD_DENSITY,
        C_at_reference_N_s2_m2=answer.Drag(mean=factor * float(C.mean()), sd=factor * float(C.std())),
    )


def _summary(posterior: Posterior, i: int) -> answer.Summary:
    marginal, diagnosis = posterior.marginal(i), diagnose(posterior.draws[:, :, i])
    return answer.Summary(
        **asdict(marginal), r_hat=diagnosis.r_hat, ess_bulk=diagnosis.ess_bulk, ess_tail=diagnosis.ess_tail
    )


def _metrics(metrics: EigenMetrics) -> answer.EigenMetrics:
    return answer.EigenMetrics(log10_eigenvalues=metrics.log10_eigenvalues.tolist(), angles_deg=metrics.angles.tolist())


def arviz_tree(posterior: Posterior) -> Any:
    """The draws as a tree of ArviZ.

    Raises
    ------
    ConfigError
        The package arviz-base is not installed.
    """
    require_arviz()
    import arviz_base  # heavy, and an extra

    tree = arviz_base.from_dict({"posterior": {name: posterior.draws[:, :, i] for i, name in enumerate(NAMES)}})
    del tree["posterior"].attrs["created_at"]  # the clock's: the same log gives the same bytes
    return tree


def _netcdf(posterior: Posterior) -> bytes:
    with TemporaryDirectory() as folder:  # it writes to a name only
        file = Path(folder) / "draws.nc"
        arviz_tree(posterior).to_netcdf(file, engine="h5netcdf")
        return file.read_bytes()
