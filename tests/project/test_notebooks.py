"""The notebooks of the examples: their cells run in order, find the truth, and are stored without outputs."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure
from project_paths import ROOT

from estimator.report.notebook_figure import NotebookFigure

NOTEBOOKS = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))
PNG = b"\x89PNG\r\n\x1a\n"
SHOWN = {  # what a notebook has found, as expressions over its names
    "first_estimate": {
        "mass": "answer.mass.mean / truth['mass_kg']",
        "A": "answer.A.mean / truth['A_N']",
        "C": "answer.C.mean / truth['C_N_s2_m2']",
        "chains": "draws.posterior.sizes['chain']",
    },
    "diagnosis": {
        "verdict": "found.verdict",
        "effects": "[effect.name for effect in found.effects]",
        "check": "check.verdict",
        "page": "(out / 'hills.html').stat().st_size",
    },
}


def cells(path: Path) -> list[dict[str, Any]]:
    """Cells of a notebook of the format 4.5."""
    notebook = json.loads(path.read_bytes())
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    stored: list[dict[str, Any]] = notebook["cells"]
    return stored


def run(path: Path, folder: Path) -> dict[str, Any]:
    """Values of SHOWN after the cells have run, in a process and a folder of their own."""
    code = ["".join(cell["source"]) for cell in cells(path) if cell["cell_type"] == "code"]
    asked = ", ".join(f"{name!r}: {expression}" for name, expression in SHOWN[path.stem].items())
    program = "\n".join([*code, "import json", f"print(json.dumps({{{asked}}}))"])
    command = [sys.executable, "-W", "error", "-c", program]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=folder, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    shown: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return shown


def test_every_notebook_has_its_truth() -> None:
    assert {path.stem for path in NOTEBOOKS} == SHOWN.keys()


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_stored_without_outputs(path: Path) -> None:
    stored = cells(path)
    assert len({cell["id"] for cell in stored}) == len(stored)
    assert stored[0]["cell_type"] == "markdown"
    for cell in stored:
        assert "".join(cell["source"]).strip()
        if cell["cell_type"] == "code":
            ast.parse("".join(cell["source"]))
            assert cell["outputs"] == []
            assert cell["execution_count"] is None


@pytest.mark.slow
def test_first_estimate_finds_the_truck(tmp_path: Path) -> None:
    pytest.importorskip("pandas")
    pytest.importorskip("arviz_base")
    shown = run(ROOT / "examples" / "notebooks" / "first_estimate.ipynb", tmp_path)
    assert shown["mass"] == pytest.approx(1, abs=0.02)
    assert shown["A"] == pytest.approx(1, abs=0.1)
    assert shown["C"] == pytest.approx(1, abs=0.15)
    assert shown["chains"] > 1


@pytest.mark.nightly
@pytest.mark.slow
def test_diagnosis_names_the_hills(tmp_path: Path) -> None:
    pytest.importorskip("pandas")
    shown = run(ROOT / "examples" / "notebooks" / "diagnosis.ipynb", tmp_path)
    assert shown["verdict"] == "effect"
    assert shown["effects"] == ["grade"]
    assert shown["check"] == "no gap"
    assert shown["page"] > 10_000


def test_a_notebook_shows_a_figure_as_a_picture() -> None:
    assert not hasattr(Figure(), "_repr_png_")
    assert NotebookFigure(figsize=(1, 1))._repr_png_().startswith(PNG)
