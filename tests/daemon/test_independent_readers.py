"""What the daemon sends and writes, as other programs read it: Wireshark's J1939 dissector, Prometheus' promtool."""

import re
import shutil
import struct
import subprocess
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
from daemon_bench import EPOCH, Bench, frame
from made_estimates import made_estimate
from project_paths import ROOT

from estimator import config
from estimator.can_io.j1939 import TP_CM, TP_DT
from estimator.can_io.j1939_node import ADDRESS_CLAIMED, REQUEST
from estimator.can_io.publisher import output_groups
from estimator.can_io.trouble_codes import DM1, codes_of
from estimator.daemon.service import metrics
from estimator.daemon.service.worker import Knowledge

PROMETHEUS = ROOT / "deploy" / "prometheus"
RULES, RULE_TESTS = PROMETHEUS / "roadload.rules.yml", PROMETHEUS / "roadload.rules.test.yml"
LINKTYPE_CAN_SOCKETCAN = 227
FIELDS = ("j1939.priority", "j1939.pgn", "j1939.src_addr", "j1939.dst_addr", "can.len", "j1939.data", "_ws.malformed")


def run(program: str, *arguments: str, text: str = "") -> subprocess.CompletedProcess[str]:
    if shutil.which(program) is None:
        pytest.skip(f"no {program} here")
    return subprocess.run([program, *arguments], input=text, capture_output=True, text=True, timeout=120)


@pytest.fixture(scope="module")
def bench() -> Bench:
    """A daemon that has broadcast everything: claims, the estimate, several trouble codes, an answer, a refusal."""
    settings = config.from_dict({"transmit": {"enabled": True}, "publish": {"cvw": True}})
    bench = Bench(config=settings, transmit=True)
    bench.turn()
    bench.traffic(20.0, frame(0x18FEF100, bytes([0xFF, 0, 80]) + b"\xff" * 5))
    bench.traffic(0.1, frame(0x18EAFBF9, b"\x61\xff\x00"), frame(0x18EAFBF9, b"\x6a\xff\x00"))
    return bench


def write_pcap(path: Path, messages: list[can.Message]) -> None:
    """A capture as SocketCAN hands out frames, with the id in network byte order (tcpdump.org, LINKTYPE 227)."""
    with path.open("wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, LINKTYPE_CAN_SOCKETCAN))
        for i, message in enumerate(messages):
            packed = struct.pack(">IB3x", message.arbitration_id | 1 << 31, len(message.data)) + bytes(message.data)
            file.write(struct.pack("<IIII", i // 20, i % 20 * 50_000, len(packed), len(packed)) + packed)


def dissected(path: Path) -> Iterator[dict[str, str]]:
    fields = [argument for field in FIELDS for argument in ("-e", field)]
    done = run("tshark", "-n", "-r", str(path), "-d", "can.subdissector,j1939", "-T", "fields", *fields)
    assert done.returncode == 0, done.stderr
    for line in done.stdout.splitlines():
        yield dict(zip(FIELDS, line.split("\t"), strict=True))


@pytest.mark.slow
def test_wireshark_reads_our_frames_as_the_groups_that_they_are(bench: Bench, tmp_path: Path) -> None:
    write_pcap(tmp_path / "sent.pcap", bench.bus.sent)
    read = list(dissected(tmp_path / "sent.pcap"))
    assert len(read) == len(bench.bus.sent) > 50
    for message, found in zip(bench.bus.sent, read, strict=True):
        ident = message.arbitration_id
        to_all = ident >> 16 & 0xFF >= 0xF0
        assert int(found["j1939.pgn"]) == ident >> 8 & (0x3FFFF if to_all else 0x3FF00)
        assert int(found["j1939.src_addr"]) == ident & 0xFF
        assert to_all or int(found["j1939.dst_addr"]) == ident >> 8 & 0xFF
        assert int(found["j1939.priority"]) == ident >> 26
        assert int(found["can.len"]) == len(message.data)
        assert bytes.fromhex(found["j1939.data"].replace(":", "")) == bytes(message.data)
        assert found["_ws.malformed"] == ""
    groups = {int(found["j1939.pgn"]) for found in read}
    assert groups == {*output_groups(), DM1, ADDRESS_CLAIMED, REQUEST, TP_CM, TP_DT, 0xE800}


@pytest.mark.slow
def test_what_wireshark_reads_of_a_broadcast_in_packets_is_our_trouble_codes(bench: Bench, tmp_path: Path) -> None:
    write_pcap(tmp_path / "sent.pcap", bench.bus.sent)
    read = list(dissected(tmp_path / "sent.pcap"))
    begin = max(i for i, found in enumerate(read[:-20]) if int(found["j1939.pgn"]) == TP_CM)
    announced = bytes.fromhex(read[begin]["j1939.data"].replace(":", ""))
    size, packets = int.from_bytes(announced[1:3], "little"), announced[3]
    following = [found for found in read[begin + 1 :] if int(found["j1939.pgn"]) == TP_DT][:packets]
    content = b"".join(bytes.fromhex(found["j1939.data"].replace(":", ""))[1:] for found in following)
    assert (announced[0], int.from_bytes(announced[5:8], "little")) == (0x20, DM1)
    assert {str(code) for code, _ in codes_of(content[:size])} == {
        *("SPN 190 FMI 9", "SPN 513 FMI 9", "SPN 514 FMI 9", "SPN 544 FMI 9")
    }


def test_promtool_finds_no_fault_with_the_metrics(bench: Bench) -> None:
    bench.worker.knowledge = Knowledge(
        t=EPOCH + bench.now,
        estimate=made_estimate(EPOCH + bench.now - 20),
        refused={'odd "name"\nwith \\': 2},
        rejected={"standing": 3},
        contested={"CCVS1.WheelBasedVehicleSpeed": "senders disagree"},
        readings={"speed": 3},
        newest={"speed": EPOCH + bench.now},
    )
    text = metrics.exposition(bench.daemon.status(bench.now))
    for name in ("mass_kg", "contested", "trouble_code", "address", "signal_age_seconds", "estimate_status"):
        assert f"# TYPE roadload_{name} gauge" in text
    done = run("promtool", "check", "metrics", text=text)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_the_alert_rules_do_what_their_tests_say() -> None:
    assert run("promtool", "check", "rules", str(RULES)).returncode == 0
    done = run("promtool", "test", "rules", str(RULE_TESTS))
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("expression", "broken"),
    [("> 120", "> 400"), ("== 1", "== 2"), ("> 3600", "> 3700"), ("for: 10m", "for: 40m")],
)
def test_the_tests_of_the_alert_rules_notice_a_broken_rule(tmp_path: Path, expression: str, broken: str) -> None:
    text = RULES.read_text()
    assert expression in text
    (tmp_path / RULES.name).write_text(text.replace(expression, broken))
    (tmp_path / RULE_TESTS.name).write_text(RULE_TESTS.read_text())
    assert run("promtool", "test", "rules", str(tmp_path / RULE_TESTS.name)).returncode != 0


def test_every_alert_is_tested_and_asks_for_metrics_that_there_are(bench: Bench) -> None:
    rules, tests = RULES.read_text(), RULE_TESTS.read_text()
    for alert in re.findall(r"alert: (\w+)", rules):
        assert re.search(rf"alertname: {alert}\s+exp_alerts:", tests), alert
    bench.worker.knowledge = Knowledge(
        t=EPOCH + bench.now, estimate=made_estimate(EPOCH + bench.now), contested={"EEC1.EngSpeed": "senders disagree"}
    )
    text = metrics.exposition(bench.daemon.status(bench.now))
    for name in set(re.findall(r"roadload_\w+", rules)):
        assert f"# TYPE {name} " in text, name
