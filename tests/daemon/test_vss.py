"""The overlay of the Vehicle Signal Specification, as COVESA's tools read it."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest

from estimator.daemon.outputs.vss import signals

OVERLAY = files("estimator.daemon.outputs")
# The standard's signal as COVESA's repository has it, without the thousand others.
STANDARD = """
Vehicle:
  type: branch
  description: High-level vehicle data.
Vehicle.CurrentOverallWeight:
  datatype: uint16
  type: sensor
  unit: kg
  description: Current overall weight.
"""
QUANTITIES = "\n".join(f"{name}:\n  definition: {name}" for name in ("mass", "force", "mass-per-distance"))
UNITS = """
kg:
  definition: Mass measured in kilograms
  unit: kilogram
  quantity: mass
  allowed-datatypes: ['numeric']
N:
  definition: Force measured in newton
  unit: newton
  quantity: force
  allowed-datatypes: ['numeric']
"""


def leaves(tree: dict[str, Any], path: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    for name, node in tree.items():
        place = f"{path}.{name}" if path else name
        if "children" in node:
            yield from leaves(node["children"], place)
        else:
            yield place, node


def test_the_overlay_has_the_signals_that_are_sent_with_their_types(tmp_path: Path) -> None:
    program = shutil.which("vspec", path=f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    if program is None:
        pytest.skip("no vspec of vss-tools here")
    for name, text in (("base.vspec", STANDARD), ("quantities.yaml", QUANTITIES), ("units.yaml", UNITS)):
        (tmp_path / name).write_text(text)
    given = ["-s", "base.vspec", "-q", "quantities.yaml", "-u", "units.yaml"]
    ours = ["-u", str(OVERLAY / "roadload.units.yaml"), "-l", str(OVERLAY / "roadload.vspec")]
    command = [program, "export", "json", *given, *ours, "--strict", "-o", "all.json"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    described = dict(leaves(json.loads((tmp_path / "all.json").read_text())))
    sent = signals(None, overlay=True)
    assert {signal.path for signal in sent} == set(described)
    kinds = {"uint32": "uint16", "float": "float", "string": "string"}
    assert {signal.path: kinds[signal.kind] for signal in sent} == {
        path: node["datatype"] for path, node in described.items()
    }
    words = {"UNESTIMATED", "ESTIMATED", "INVALID", "STALE"}
    assert all(set(node["allowed"]) == words for node in described.values() if node["datatype"] == "string")
