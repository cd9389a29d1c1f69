"""Draws and pictures of an estimate, as files."""

import csv
import json
from pathlib import Path

import arviz
import numpy as np
import pytest

from estimator.can_io.recorder import frames_of, write_log
from estimator.cli import main
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rng = np.random.default_rng(4)
    truck = Truck(mass=20_000.0, A=1300.0, C=3.5)
    path = tmp_path_factory.mktemp("report") / "drive.blf"
    write_log(frames_of(record(truck, generate_route("mixed", 50e3, rng), 1200.0, rng).signals), path)
    return path


def test_draws_in_every_format_agree(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for suffix in ("csv", "json", "nc"):
        assert main(["estimate", str(log), "--json", "--draws", str(tmp_path / f"draws.{suffix}")]) == 0
    mean = json.loads(capsys.readouterr().out.split("\n}\n")[0] + "}")["parameters"]["mass_kg"]["mean"]
    with (tmp_path / "draws.csv").open() as file:
        rows = list(csv.DictReader(file))
    content = json.loads((tmp_path / "draws.json").read_text())
    data = arviz.from_netcdf(tmp_path / "draws.nc")
    draws = np.array(content["posterior"]["mass_kg"])
    assert draws.mean() == pytest.approx(mean, rel=1e-9)
    assert np.mean([float(row["mass_kg"]) for row in rows]) == pytest.approx(mean, rel=1e-9)
    assert float(data.posterior["mass_kg"].mean()) == pytest.approx(mean, rel=1e-9)
    assert data.posterior["mass_kg"].shape == draws.shape
    assert not list(tmp_path.glob(".*"))
    summary = content["summary"]["mass_kg"]
    assert summary["q05"] < summary["q50"] < summary["q95"]
    assert summary["r_hat"] < 1.05
    assert summary["ess_tail"] > 400
    assert np.diag(content["correlation"]) == pytest.approx(1)
    assert 1.0 < content["air"]["density_kg_m3"] < 1.4
    assert len(content["eigen_metrics"]["scaled"]["log10_eigenvalues"]) == 3


@pytest.mark.parametrize(("suffix", "start"), [("png", b"\x89PNG"), ("svg", b"<?xml"), ("html", b"<!doctype html>")])
def test_pictures(log: Path, tmp_path: Path, suffix: str, start: bytes) -> None:
    path = tmp_path / f"plot.{suffix}"
    assert main(["estimate", str(log), "--plot", str(path)]) == 0
    content = path.read_bytes()
    assert content.startswith(start)
    assert len(content) > 20_000
    assert b"http://" not in content.replace(b"http://www.w3.org", b"").replace(b"http://purl.org", b"").replace(
        b"http://creativecommons.org", b""
    )


@pytest.mark.parametrize("option", ["--plot", "--draws"])
def test_unknown_format_is_refused_before_the_work(
    log: Path, tmp_path: Path, option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["estimate", str(log), option, str(tmp_path / "out.xyz")]) == 2
    assert "out.xyz" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
