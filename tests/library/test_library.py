"""The library as a notebook uses it: drives, estimates and diagnoses, against what the commands print."""

from pathlib import Path

import numpy as np
import pytest
from simulated_logs import ask, drive, written

from estimator import diagnose, estimate, from_table, read, read_drives
from estimator.config import from_dict
from estimator.errors import InputError, RoadloadError
from estimator.library.diagnosis import DriveDiagnosis
from estimator.simulation.effects.effect import Effect

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    recording = drive("highway", 8, 3, Effect(name="auxiliary_load", magnitude=12e3))
    return written(recording, tmp_path_factory.mktemp("drive") / "drive.blf")


def test_an_estimate_is_that_of_the_command(log: Path, tmp_path: Path) -> None:
    made = read(log)
    assert repr(made).startswith("8 min, ")
    est = estimate(made)
    answer = ask("estimate", log)["parameters"]
    assert est.mass is not None
    assert est.mass.mean == answer["mass_kg"]["mean"]
    summary = est.summary()
    assert summary["mean"] == [answer[key]["mean"] for key in ("A_N", "C_N_s2_m2", "mass_kg")]
    assert "mass" in repr(est)
    assert est._repr_html_().startswith("<pre>estimated")
    assert est.to_arviz()["posterior"]["mass_kg"].mean() == pytest.approx(est.mass.mean)
    assert len(est.plot().axes) > 3
    est.report(tmp_path / "page.html", "my <drive>")
    text = (tmp_path / "page.html").read_text()
    assert f"<h1>Mass {est.mass.mean:,.0f} kg" in text
    assert "my &lt;drive&gt;" in text


@pytest.fixture(scope="module")
def dia(log: Path) -> DriveDiagnosis:
    return diagnose(read(log))


def test_a_diagnosis_is_that_of_the_command(log: Path, dia: DriveDiagnosis, tmp_path: Path) -> None:
    answer = ask("diagnose", log)
    assert (dia.verdict.value, dia.answer.reason) == (answer["verdict"], answer["reason"])
    assert [part.share for part in dia.budget.parts] == [part["share"] for part in answer["budget"]]
    assert dia.summary().endswith(answer["reason"])
    assert dia.table["effect"][0] == dia.effects[0].name == "auxiliary_load"
    dia.report(tmp_path / "page.html")
    assert "<h1>" in (tmp_path / "page.html").read_text()
    with pytest.raises(InputError, match="kind: 'pie' is none of power, gap, budget"):
        dia.plot("pie")


def test_a_figure_draws_the_residual_that_is_stated(dia: DriveDiagnosis) -> None:
    figure = dia.plot("gap")
    for axes, rms in zip(figure.axes, (dia.rms_base, dia.rms_final), strict=True):
        drawn = axes.lines[0].get_ydata()
        assert float(np.sqrt(np.mean(np.square(drawn)))) == pytest.approx(rms / 1e3, rel=1e-9)
        assert f"{rms / 1e3:.1f} kW" in axes.get_title(loc="left")
    bars = dia.plot("budget").axes[0].patches
    assert [bar.get_width() for bar in bars] == pytest.approx([100 * part.share for part in dia.budget.parts[::-1]])
    power = dia.plot("power").axes[0].lines
    assert power[0].get_ydata() == pytest.approx(dia.traces.measured / 1e3)


def test_what_cannot_be_estimated_says_why(tmp_path: Path) -> None:
    n = 100
    made = from_table(
        {"t": np.arange(n) / 10, "v": np.full(n, 20.0), "P": np.full(n, 1e5)}, speed="v [m/s]", power="P [W]"
    )
    est = estimate(made)
    assert est.mass is None
    assert "usable samples" in est.reason
    with pytest.raises(RoadloadError, match="there is no estimate: "):
        est.plot()
    dia = diagnose(made)
    assert dia.verdict.value == "cannot tell"
    with pytest.raises(RoadloadError, match="there is no fit: "):
        dia.plot()


def test_several_drives_of_a_log_are_a_list(log: Path, tmp_path: Path) -> None:
    n = 1200
    t = np.concatenate([np.arange(n) / 10, 5000 + np.arange(n) / 10])
    table = tmp_path / "two.csv"
    np.savetxt(
        table,
        np.column_stack([t, np.full(2 * n, 20.0), np.full(2 * n, 1e5)]),
        delimiter=",",
        header="t,v,P",
        comments="",
    )
    columns = {"speed": "v [m/s]", "power": "P [W]"}
    with pytest.raises(InputError, match="holds 2 drives; read_drives gives a list of them"):
        read(table, columns=columns)
    assert len(read_drives(table, columns=columns)) == 2
    config = from_dict({"table": {"columns": columns}})
    assert [drive.start for drive in read_drives(table, config)] == pytest.approx([0.1, 5000.1], abs=0.2)
