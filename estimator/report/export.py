"""Draws of the posterior in a file: CSV and JSON always, NetCDF in ArviZ's layout where arviz-base is installed.

The JSON also has quantiles, correlation, the convergence of each parameter, the paper's eigen-metrics raw and scaled by
the posterior, and the drag coefficient in reference air.
"""

import csv
import importlib.util
from collections.abc import Mapping
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
from estimator.estimates import PARAMETERS
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


def write_draws(evidence: Evidence, path: Path, withheld: Mapping[str, str]) -> None:
    """Write the draws of A, C and m behind an estimate to ``path``; the suffix gives the format.

    Parameters that are ``withheld``, each with its reason, are marked: in the heading of their column, as attribute of
    their variable, or by the key ``withheld``.

    Raises
    ------
    RoadloadError
        The file cannot be written.
    """
    check_suffix(path, FORMATS)
    marked = _marked(withheld)
    contents = {
        ".json": lambda: encode(_draws(evidence, marked)),
        ".csv": lambda: _csv(evidence.posterior, marked),
        ".nc": lambda: _netcdf(evidence.posterior, withheld),
    }
    with whole(path) as file:
        file.write(contents[path.suffix.lower()]())


def _marked(withheld: Mapping[str, str]) -> dict[str, str]:
    """Reasons by the names of the draws."""
    return {name: withheld[key] for key, name in zip(PARAMETERS, NAMES, strict=True) if key in withheld}


def _csv(posterior: Posterior, withheld: Mapping[str, str]) -> bytes:
    text = StringIO(newline="")
    table = csv.writer(text)
    table.writerow(["chain", "draw", *(f"{name} (withheld)" if name in withheld else name for name in NAMES)])
    for i, chain in enumerate(posterior.draws[:, :, : len(NAMES)].tolist()):
        table.writerows([i, j, *draw] for j, draw in enumerate(chain))
    return text.getvalue().encode()


def _draws(evidence: Evidence, withheld: dict[str, str]) -> DrawsAnswer:
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
        withheld=withheld,
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


def arviz_tree(posterior: Posterior, withheld: Mapping[str, str]) -> Any:
    """The draws as a tree of ArviZ; variables of parameters that are ``withheld`` have the reason as an attribute.

    Raises
    ------
    ConfigError
        The package arviz-base is not installed.
    """
    require_arviz()
    import arviz_base  # heavy, and an extra

    tree = arviz_base.from_dict({"posterior": {name: posterior.draws[:, :, i] for i, name in enumerate(NAMES)}})
    del tree["posterior"].attrs["created_at"]  # the clock's: the same log gives the same bytes
    for name, reason in _marked(withheld).items():
        tree["posterior"][name].attrs["withheld"] = reason
    return tree


def _netcdf(posterior: Posterior, withheld: Mapping[str, str]) -> bytes:
    with TemporaryDirectory() as folder:  # it writes to a name only
        file = Path(folder) / "draws.nc"
        arviz_tree(posterior, withheld).to_netcdf(file, engine="h5netcdf")
        return file.read_bytes()
