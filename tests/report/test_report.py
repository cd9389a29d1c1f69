"""Draws and pictures of an estimate, as files."""

import csv
import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import xarray
from made_outputs import made_evidence, made_view
from simulated_logs import ask

from estimator.answers.run import Road
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.commands.main import main
from estimator.estimates import Marginal
from estimator.report import parameter_text
from estimator.report.effect_sizes import effect_size
from estimator.report.export import write_draws
from estimator.report.plots import draw, write_plot
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A configuration with one conclusion, at the end of the log."""
    path = tmp_path_factory.mktemp("report") / "once.toml"
    path.write_text("[gate]\ninterval_s = 3600.0\n")
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rng = np.random.default_rng(4)
    truck = Truck(mass=20_000.0, A=1300.0, C=3.5)
    path = tmp_path_factory.mktemp("report") / "drive.blf"
    write_log(frames_of(record(truck, generate_route("mixed", 50e3, rng), 600.0, rng).signals), path)
    return path


@pytest.fixture(scope="module")
def outputs(log: Path, once: Path) -> dict[str, Path]:
    """Every file that `roadload estimate` writes, by suffix."""
    paths = {suffix: log.with_name(f"out.{suffix}") for suffix in ("csv", "png", "json", "svg", "nc", "html")}
    for draws, plot in (("csv", "png"), ("json", "svg"), ("nc", "html")):
        answer = ask("estimate", log, "--config", once, "--draws", paths[draws], "--plot", paths[plot])
        log.with_name("answer.json").write_text(json.dumps(answer))
    return paths


def test_draws_in_every_format_agree(log: Path, outputs: dict[str, Path]) -> None:
    mean = json.loads(log.with_name("answer.json").read_text())["parameters"]["mass_kg"]["mean"]
    with outputs["csv"].open() as file:
        rows = list(csv.DictReader(file))
    content = json.loads(outputs["json"].read_text())
    with xarray.open_datatree(outputs["nc"]) as data:  # which is `from_netcdf` of ArviZ 1
        exported = data["posterior"]["mass_kg"].load()
    draws = np.array(content["posterior"]["mass_kg"])
    assert draws.mean() == pytest.approx(mean, rel=1e-9)
    assert np.mean([float(row["mass_kg"]) for row in rows]) == pytest.approx(mean, rel=1e-9)
    assert exported.dims == ("chain", "draw")
    assert np.array_equal(exported, draws)
    assert not list(log.parent.glob(".*"))
    summary = content["summary"]["mass_kg"]
    assert summary["q05"] < summary["q50"] < summary["q95"]
    assert summary["r_hat"] < 1.05
    assert summary["ess_tail"] > 400
    assert np.diag(content["correlation"]) == pytest.approx(1)
    assert 1.0 < content["air"]["density_kg_m3"] < 1.4
    assert len(content["eigen_metrics"]["scaled"]["log10_eigenvalues"]) == 3


def test_the_same_log_gives_the_same_netcdf_bytes(
    log: Path, once: Path, outputs: dict[str, Path], tmp_path: Path
) -> None:
    again = tmp_path / "again.nc"
    ask("estimate", log, "--config", once, "--draws", again)
    assert again.read_bytes() == outputs["nc"].read_bytes()


def test_draws_of_a_parameter_that_is_withheld_are_marked(tmp_path: Path) -> None:
    evidence = made_evidence()
    for suffix in ("csv", "json", "nc"):
        write_draws(evidence, tmp_path / f"a.{suffix}", {"C": "sd of C is 55 % of its value"})
    with (tmp_path / "a.csv").open() as file:
        assert next(csv.reader(file)) == ["chain", "draw", "A_N", "C_N_s2_m2 (withheld)", "mass_kg"]
    content = json.loads((tmp_path / "a.json").read_text())
    assert content["withheld"] == {"C_N_s2_m2": "sd of C is 55 % of its value"}
    with xarray.open_datatree(tmp_path / "a.nc") as data:
        assert data["posterior"]["C_N_s2_m2"].attrs == {"withheld": "sd of C is 55 % of its value"}
        assert data["posterior"]["A_N"].attrs == {}


def test_a_picture_shows_no_draws_of_a_parameter_that_is_withheld() -> None:
    """The first update knows the mass alone."""
    assert [axes.get_ylabel() for axes in draw(made_view(1)).axes[-1:]] == ["mass [kg]"]
    assert len(draw(made_view()).axes) - len(draw(made_view(1)).axes) == 5
    assert "A unestimated, C unestimated" in draw(made_view(1)).get_suptitle()


def test_a_picture_names_the_effects_in_the_model() -> None:
    view = made_view()
    wind = Marginal(mean=5.74, sd=0.19, q05=5.44, q50=5.74, q95=6.05)
    *others, last = view.updates
    view = dataclasses.replace(view, updates=(*others, dataclasses.replace(last, effects={"headwind": wind})))
    assert f"with headwind {effect_size('headwind', wind)}" in draw(view).get_suptitle()
    assert "headwind" not in draw(made_view()).get_suptitle()


@pytest.mark.parametrize(("suffix", "start"), [("png", b"\x89PNG"), ("svg", b"<?xml"), ("html", b"<!doctype html>")])
def test_pictures(outputs: dict[str, Path], suffix: str, start: bytes) -> None:
    path = outputs[suffix]
    content = path.read_bytes()
    assert content.startswith(start)
    assert len(content) > 20_000
    assert b"http://" not in content.replace(b"http://www.w3.org", b"").replace(b"http://purl.org", b"").replace(
        b"http://creativecommons.org", b""
    )


@pytest.mark.parametrize("suffix", ["svg", "pdf"])
def test_a_picture_has_any_name(tmp_path: Path, suffix: str) -> None:
    write_plot(made_view(title="a$b_$ $\\frac$ \udcff"), tmp_path / f"any.{suffix}")
    assert (tmp_path / f"any.{suffix}").stat().st_size > 20_000


@pytest.mark.parametrize("option", ["--plot", "--draws"])
def test_unknown_format_is_refused_before_the_work(
    log: Path, tmp_path: Path, option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["estimate", str(log), option, str(tmp_path / "out.xyz")]) == 2
    assert "out.xyz" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("shown_by", "said"),
    [
        (("altitude",), "flat (slopes below 0.1 %), shown by altitude"),
        ((), "flat (slopes below 0.1 %), shown by no signal; a mean slope would be part of A"),
    ],
)
def test_a_road_that_no_signal_shows_is_not_said_to_have_no_mean_slope(shown_by: tuple[str, ...], said: str) -> None:
    assert parameter_text.road(Road(slope_sd=4e-4, length_m=900.0, shown_by=shown_by, climbed_m=None)) == said
