"""CPU time, memory, delays and lost frames of the daemon on a full bus, beside a plain python-can program.

    python tools/bench_daemon.py [--seconds 60] [--loss-seconds 600] [--output-seconds 60]
                                 [--gateway-seconds 60] [--warm-minutes 60]

A second process sends simulated driving, padded with unknown messages to the load of a full bus, at the pace of the
bus, over a stand-in for SocketCAN (`full_bus/loopback.py`). "Filtered": only frames that pass the daemon's kernel
filters are sent. The daemon starts with the state of an hour's driving, so its window is full and the sampler has its
full work. Its gate is checked every ten seconds instead of every minute. CPU is that of one core while traffic flows,
start not counted; "peak" is the memory of the whole process, as installed without extras. Delays are those until a
frame is handed to the pipeline, which decodes in blocks of five seconds of traffic.

A further table has the daemon on a full bus of 500 kbit/s without outputs, with an MQTT broker (mosquitto), with a
Kuksa databroker (`kuksa_stand_in.py`), and with both. Each gets a new conclusion every ten seconds, and the same one
again after five.

The last table has it on a slow gateway, behind the filters of a full bus, with a share of one core of this machine
(`full_bus/quota.py`). "Conclusion" is the longest time that one estimate took.
"""

import argparse
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from full_bus import traffic
from full_bus.loopback import HOST
from full_bus.quota import Quota
from harness.check import Cells, Check, Figures, Table

from estimator import config as configuration
from estimator.can_io.binding import bind, load_database
from estimator.checkpoint.store import StateStore
from estimator.config import Config, state_key
from estimator.daemon.reception.filters import input_filters
from estimator.daemon.service.worker import Worker
from estimator.streaming.pipeline import Pipeline

TOOLS = Path(__file__).parent
KUKSA = TOOLS.parent / "tests" / "support" / "kuksa_stand_in.py"
SETTINGS = "[gate]\ninterval_s = 10.0\n[service]\nstate_directory = '{folder}'\nruntime_directory = '{folder}'\n"
BY_HAND, ROADLOAD = "by hand", "roadload"
PROGRAMS = {BY_HAND: "full_bus.by_hand", ROADLOAD: "full_bus.ours"}
START = 60.0  # s in which a program has to open its socket
SHARES = (1.0, 0.25, 0.1)  # of a core
TICKS = os.sysconf("SC_CLK_TCK")  # per second, of CPU times in /proc


def child_environment() -> dict[str, str]:
    """One thread for linear algebra, as in the service file."""
    return {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(TOOLS)}


def cpu_seconds(pid: int) -> float:
    """CPU time of a process and all its threads so far [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def peak_memory(pid: int) -> float:
    """Largest resident memory of a process so far [MiB]."""
    lines = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return int(lines["VmHWM"].split()[0]) / 1024


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    """A free port, of UDP or TCP."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def is_bound(port: int) -> bool:
    """Whether a program listens on the port."""
    sockets = Path("/proc/net/udp").read_text().splitlines()[1:]
    return any(int(line.split()[1].split(":")[1], 16) == port for line in sockets)


def write_state(folder: Path, minutes: float, outputs: str) -> None:
    """Write the settings, and a state file of so many minutes of driving that ended just now."""
    settings = folder / "roadload.toml"
    settings.write_text(SETTINGS.format(folder=folder) + outputs)
    config = configuration.load(settings)
    if minutes:
        frames = traffic.drive(60 * minutes, seed=1)
        worker = Worker(Pipeline(config, is_live=True), len(frames), StateStore(folder), state_key(config))
        worker.offer(replace(frames, t=frames.t - frames.t[-1] + time.time()))
        worker.close()


def run_one(
    name: str,
    rate: float,
    filtered: bool,
    seconds: float,
    warm_minutes: float,
    outputs: str = "",
    share: float = 1.0,
) -> dict[str, Any]:
    """Run one program under one load with a share of a core; CPU share, memory, delays and losses."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        load = traffic.padded(traffic.drive(seconds, seed=2), rate, np.random.default_rng(3))
        if filtered:
            load = traffic.passed(load, input_filters(bind(Config(), load_database([]))))
        np.savez(folder / "load.npz", t=load.t, ident=load.ident, length=load.length, data=load.data)
        options = []
        if name == ROADLOAD:
            write_state(folder, warm_minutes, outputs)
            options = ["--config", str(folder / "roadload.toml")]
        port = free_port()
        command = [sys.executable, "-m", PROGRAMS[name], str(port), str(folder), *options]
        environment = child_environment()
        with (
            (folder / "log").open("w") as log,
            subprocess.Popen(command, env=environment, stderr=log) as subject,
            Quota(subject.pid, share) if share < 1.0 else nullcontext(),
        ):
            try:
                wait_until_bound(port, subject, folder)
                before = cpu_seconds(subject.pid)
                sender = [sys.executable, "-m", "full_bus.traffic", str(folder / "load.npz"), str(port)]
                done = subprocess.run(sender, env=environment, check=True, capture_output=True, text=True)
                sent = json.loads(done.stdout)
                used = cpu_seconds(subject.pid) - before
                time.sleep(2.0)  # for the last status
                peak = peak_memory(subject.pid)
            finally:
                subject.send_signal(signal.SIGTERM)
                subject.wait()
        result = json.loads((folder / "result.json").read_text())
    rates = {"cpu": used / sent["seconds"], "rate": sent["frames"] / sent["seconds"]}
    return {**result, **rates, "sent": sent["frames"], "peak_MiB": peak}


def wait_until_bound(port: int, subject: subprocess.Popen[bytes], folder: Path) -> None:
    """Wait until a program has opened its socket and is idle."""
    deadline = time.monotonic() + START
    while not is_bound(port):
        if subject.poll() is not None or time.monotonic() > deadline:
            raise SystemExit(f"the program did not start:\n{(folder / 'log').read_text()}")
        time.sleep(0.1)
    time.sleep(1.0)


def loads(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Cells of each load and program."""
    runs = {(kbits, filtered): options.seconds for kbits in traffic.BUS_LOAD for filtered in (True, False)}
    rows = []
    for (kbits, filtered), seconds in (runs | {(500, False): options.loss_seconds or options.seconds}).items():
        if not seconds:
            continue
        found = {
            name: run_one(name, traffic.BUS_LOAD[kbits], filtered, seconds, options.warm_minutes) for name in PROGRAMS
        }
        for name, row in found.items():
            load = {"": f"{name}, {kbits} kbit/s, {'filtered' if filtered else 'all'}", "s": seconds}
            rows.append(load | {"frames/s": row["rate"]} | cells(row, found[BY_HAND]["cpu"]))
    return rows


def outputs(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Cells of the daemon with other programs beside the bus."""
    if not options.output_seconds:
        return []
    mqtt, kuksa = free_port(socket.SOCK_STREAM), free_port(socket.SOCK_STREAM)
    tables = {
        "mqtt": f"[mqtt]\nhost = '{HOST}'\nport = {mqtt}\nperiod_s = 5.0\n",
        "kuksa": f"[kuksa]\nhost = '{HOST}'\nport = {kuksa}\nperiod_s = 5.0\n",
    }
    runs = {"none": "", **tables, "mqtt and kuksa": "".join(tables.values())}
    programs = [["mosquitto", "-p", str(mqtt)], [sys.executable, str(KUKSA), str(kuksa)]]
    with ExitStack() as others:
        for command in programs:
            process = others.enter_context(subprocess.Popen(command, stderr=subprocess.DEVNULL))
            others.callback(process.terminate)
        rate = traffic.BUS_LOAD[500]
        rows = {
            name: run_one(ROADLOAD, rate, False, options.output_seconds, options.warm_minutes, each)
            for name, each in runs.items()
        }
    return [
        {"outputs": name} | cells(row, rows["none"]["cpu"]) | {"reports sent": sum(row["reports"].values())}
        for name, row in rows.items()
    ]


def gateway(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Cells of the daemon with shares of a core."""
    if not options.gateway_seconds:
        return []
    rate, seconds, minutes = traffic.BUS_LOAD[500], options.gateway_seconds, options.warm_minutes
    rows = {share: run_one(ROADLOAD, rate, True, seconds, minutes, share=share) for share in SHARES}
    return [
        {"share of a core [%]": 100 * share, "conclusion s": row["conclusion_s"]} | cells(row, rows[1.0]["cpu"])
        for share, row in rows.items()
    ]


def cells(row: dict[str, Any], base: float) -> dict[str, Any]:
    """Figures of a run; ``base`` is the CPU share that its own is compared with."""
    delays = {f"{name} ms": row["processed"][f"{name}_ms"] for name in ("p50", "p99", "max")}
    costs = {"CPU [%]": 100 * row["cpu"], "ratio": row["cpu"] / base, "peak MiB": row["peak_MiB"]}
    return costs | delays | {"sent": row["sent"], "lost": row["sent"] - row["frames"]}


def measure(options: argparse.Namespace) -> Figures:
    """Every load, every output, and every share of a core."""
    return {"loads": loads(options), "outputs": outputs(options), "gateway": gateway(options)}


def tables(figures: Figures) -> list[Table]:
    """A row for each run."""
    titles = {
        "loads": "Loads of the bus",
        "outputs": "The daemon on a full bus of 500 kbit/s, by its outputs",
        "gateway": "The daemon on a slow gateway",
    }
    return [Table.of(title, figures[name]) for name, title in titles.items() if figures.get(name)]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the lengths."""
    parser.add_argument("--seconds", type=float, default=60.0, help="of each load; 0: none (default 60)")
    parser.add_argument("--loss-seconds", type=float, default=600.0, help="of full load; 0: none (default 600)")
    parser.add_argument("--output-seconds", type=float, default=60.0, help="of each output; 0: none (default 60)")
    parser.add_argument("--gateway-seconds", type=float, default=60.0, help="of each share; 0: none (default 60)")
    parser.add_argument("--warm-minutes", type=float, default=60.0, help="of driving known at the start (default 60)")


CHECK = Check(
    title="The daemon on a full bus",
    measure=measure,
    tables=tables,
    headline=Cells(
        rows=(f"{ROADLOAD}, 500 kbit/s, all",), columns=("s", "CPU [%]", "peak MiB", "p99 ms", "sent", "lost")
    ),
    options=add_options,
)

if __name__ == "__main__":
    sys.exit(CHECK.main())
