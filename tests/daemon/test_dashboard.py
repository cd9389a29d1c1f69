"""Grafana's dashboard: it asks for metrics that the daemon writes, and draws no value that may not be used."""

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from daemon_bench import EPOCH, Bench, frame
from made_estimates import made_estimate
from project_paths import ROOT

from estimator import config
from estimator.answers.published import PublishedAnswer
from estimator.daemon.outputs.output import Output, OutputError, Trouble
from estimator.daemon.service.worker import Knowledge

DASHBOARD = ROOT / "deploy" / "prometheus" / "roadload.dashboard.json"
OF_NODE_EXPORTER = {"node_textfile_mtime_seconds"}
FILE = '{instance="a",file="/run/roadload/roadload.prom"}'


def described() -> dict[str, Any]:
    content = json.loads(DASHBOARD.read_text(encoding="utf-8"))
    assert isinstance(content, dict)
    return content


def expressions() -> Iterator[tuple[str, str]]:
    """Title of the panel and query, for every vehicle."""
    for panel in described()["panels"]:
        for target in panel["targets"]:
            yield panel["title"], target["expr"].replace("$vehicle", ".*")


class Refusing:
    """A channel of a program that refuses."""

    address = "test"

    def open(self) -> None:
        raise OutputError(Trouble.REFUSED, "no entry")

    def attend(self) -> None: ...

    def send(self, report: PublishedAnswer) -> bool:
        return False

    def withdraw(self, timeout: float) -> None: ...

    def close(self) -> None: ...


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The metrics file of a daemon that has an estimate, faults of all kinds, and an output that fails."""
    folder = tmp_path_factory.mktemp("run")
    output = Output(Refusing(), 10.0, np.random.default_rng(1))
    settings = config.from_dict({"transmit": {"enabled": True}})
    bench = Bench(folder, config=settings, transmit=True, outputs={"mqtt": output})
    bench.turn()
    bench.traffic(20.0, frame(0x18FEF100))
    bench.traffic(5.0, frame(0x18FEF100), frame(0x18FF61FB))  # a group of ours, from our address
    output.step(0.0)
    bench.worker.saves["saved"] += 1
    bench.worker.knowledge = Knowledge(
        t=EPOCH + bench.now,
        estimate=made_estimate(EPOCH + bench.now - 20),
        refused={"unknown": 2},
        rejected={"standing": 3},
        contested={"CCVS1.WheelBasedVehicleSpeed": "senders disagree"},
        readings={"speed": 3},
        newest={"speed": EPOCH + bench.now},
    )
    bench.daemon._report(bench.now)
    return (folder / "metrics.prom").read_text()


def test_every_metric_of_the_dashboard_is_in_the_file_that_the_daemon_writes(written: str) -> None:
    there = set(re.findall(r"^# TYPE (\w+) ", written, re.MULTILINE)) | OF_NODE_EXPORTER
    for title, expression in expressions():
        asked = set(re.findall(r"\b(?:roadload|node)_\w+", expression))
        assert asked, title
        assert asked <= there, title
    variables = {variable["name"]: variable for variable in described()["templating"]["list"]}
    assert variables["vehicle"]["query"] == "label_values(roadload_state, instance)"


def test_every_label_that_is_shown_or_chosen_is_one_of_its_metric(written: str) -> None:
    labels = {
        name: set(re.findall(r'(\w+)="', rest)) | {"instance"}
        for name, rest in re.findall(r"^(\w+)(\{.*\})? ", written, re.MULTILINE)
    }
    for panel in described()["panels"]:
        for target in panel["targets"]:
            first = re.findall(r"\b(?:roadload|node)_\w+", target["expr"])[0]
            if first in labels:
                shown = set(re.findall(r"\{\{(\w+)\}\}", target["legendFormat"]))
                assert shown <= labels[first], (panel["title"], first)
            for name, chosen in re.findall(r"\b(roadload_\w+)\{([^}]*)\}", target["expr"]):
                assert set(re.findall(r"(\w+)=~?\"", chosen)) <= labels[name], (panel["title"], name)


def test_panels_have_places_of_their_own_and_one_source() -> None:
    taken: set[tuple[int, int]] = set()
    panels = described()["panels"]
    for panel in panels:
        place = panel["gridPos"]
        cells = {(x + place["x"], y + place["y"]) for x in range(place["w"]) for y in range(place["h"])}
        assert max(x for x, _ in cells) < 24, panel["title"]
        assert not cells & taken, panel["title"]
        taken |= cells
        assert panel["datasource"]["uid"] == "${source}"
        assert panel["description"]
    assert len({panel["id"] for panel in panels}) == len(panels)


def test_grafanas_own_types_know_every_key_of_the_dashboard() -> None:
    """The dashboard is read into the types that Grafana generates from its schemas, and comes out as it went in."""
    models = pytest.importorskip("grafana_foundation_sdk.models.dashboard")
    from grafana_foundation_sdk.cog.encoder import JSONEncoder
    from grafana_foundation_sdk.cog.plugins import register_default_plugins

    register_default_plugins()
    content = described()
    again = json.loads(json.dumps(models.Dashboard.from_json(content), cls=JSONEncoder))

    def assert_within(given: Any, found: Any, place: str) -> None:
        if isinstance(given, dict):
            for key, value in given.items():
                assert key in found, f"{place}.{key}"
                assert_within(value, found[key], f"{place}.{key}")
        elif isinstance(given, list):
            assert len(given) == len(found), place
            for i, value in enumerate(given):
                assert_within(value, found[i], f"{place}[{i}]")
        else:
            assert given == found, place

    assert_within(content, again, "dashboard")


# Prometheus


def promtool(folder: Path, what: str, rules: dict[str, Any]) -> subprocess.CompletedProcess[str]:
    if shutil.which("promtool") is None:
        pytest.skip("no promtool here")
    path = folder / f"{what}.yml"
    path.write_text(json.dumps(rules))  # JSON is YAML
    return subprocess.run(["promtool", what, "rules", str(path)], capture_output=True, text=True, timeout=120)


def test_prometheus_understands_every_query(tmp_path: Path) -> None:
    rules = [{"record": f"panel:{i}", "expr": expression} for i, (_, expression) in enumerate(expressions())]
    done = promtool(tmp_path, "check", {"groups": [{"name": "panels", "rules": rules}]})
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{len(rules)} rules found" in done.stdout


def test_a_mass_is_drawn_only_while_it_may_be_used(tmp_path: Path) -> None:
    """Minutes 0 to 9 estimated, 10 to 19 invalid, 20 to 29 too old, 30 to 39 written by nobody."""
    mean = next(expression for title, expression in expressions() if title == "Mass" and '"mean"' in expression)
    series = {
        'roadload_mass_kg{instance="a",moment="mean"}': "27190x39",
        'roadload_estimate_status{instance="a",status="estimated"}': "1x9 _x10 1x19",
        'roadload_estimate_status{instance="a",status="invalid"}': "_x10 1x9 _x20",
        'roadload_estimate_age_seconds{instance="a"}': "60x19 3700x9 60x9",
        f"node_textfile_mtime_seconds{FILE}": "0+60x30 1800x9",
    }
    drawn = [{"labels": 'roadload_mass_kg{instance="a",moment="mean"}', "value": 27190}]
    expected = {5: drawn, 15: [], 25: [], 38: []}
    test = {
        "interval": "1m",
        "input_series": [{"series": name, "values": values} for name, values in series.items()],
        "promql_expr_test": [
            {"expr": mean, "eval_time": f"{minute}m", "exp_samples": samples} for minute, samples in expected.items()
        ],
    }
    done = promtool(tmp_path, "test", {"tests": [test]})
    assert done.returncode == 0, done.stdout + done.stderr
