"""CPU time, memory, delays and lost frames of the daemon on a full bus, beside a plain python-can program.

    python tools/bench_daemon.py [--seconds 60] [--loss-seconds 600] [--output-seconds 60]
                                 [--warm-minutes 60]

A second process sends simulated driving, padded with unknown messages to the load of a full bus, at the pace of the
bus, over a stand-in for SocketCAN (`full_bus/loopback.py`). "Filtered": only frames that pass the daemon's kernel
filters are sent. The daemon starts with the state of an hour's driving, so its window is full and the sampler has its
full work; its gate is checked every ten seconds instead of every minute. CPU is that of one core while traffic flows,
start not counted; "peak" is the memory of the whole process, as installed without extras. Delays are those until a
frame is handed to the pipeline, which decodes in blocks of five seconds of traffic.

A further table has the daemon on a full bus of 500 kbit/s without outputs, with an MQTT broker (mosquitto), with a
Kuksa databroker (`kuksa_stand_in.py`), and with both. Each gets a new conclusion every ten seconds, and the same one
again after five.
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
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from full_bus import traffic
from full_bus.loopback import HOST
from rich.console import Console
from rich.table import Table

from estimator import config as configuration
from estimator.can_io.binding import bind, load_database
from estimator.checkpoint.store import StateStore
from estimator.config import Config, estimation_key
from estimator.daemon.reception.filters import input_filters
from estimator.daemon.service.worker import Worker
from estimator.streaming.pipeline import Pipeline

TOOLS = Path(__file__).parent
KUKSA = TOOLS.parent / "tests" / "support" / "kuksa_stand_in.py"
SETTINGS = "[gate]\ninterval_s = 10.0\n[service]\nstate_directory = '{folder}'\nruntime_directory = '{folder}'\n"
PROGRAMS = {"by hand": "full_bus.by_hand", "roadload": "full_bus.ours"}
WIDE = 140  # columns where standard output is no terminal
START = 60.0  # s in which a program has to open its socket
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
        worker = Worker(Pipeline(config, is_live=True), len(frames), StateStore(folder), estimation_key(config))
        worker.offer(replace(frames, t=frames.t - frames.t[-1] + time.time()))
        worker.close()


def measure(
    name: str, rate: float, filtered: bool, seconds: float, warm_minutes: float, outputs: str = ""
) -> dict[str, Any]:
    """Run one program under one load; CPU share, memory, delays and losses."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        load = traffic.padded(traffic.drive(seconds, seed=2), rate, np.random.default_rng(3))
        if filtered:
            load = traffic.passed(load, input_filters(bind(Config(), load_database([]))))
        np.savez(folder / "load.npz", t=load.t, ident=load.ident, length=load.length, data=load.data)
        options = []
        if name == "roadload":
            write_state(folder, warm_minutes, outputs)
            options = ["--config", str(folder / "roadload.toml")]
        port = free_port()
        command = [sys.executable, "-m", PROGRAMS[name], str(port), str(folder), *options]
        environment = child_environment()
        with (folder / "log").open("w") as log, subprocess.Popen(command, env=environment, stderr=log) as subject:
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


def show(console: Console, options: argparse.Namespace) -> None:
    """The table of loads."""
    table = Table("bus", "", "program", "frames/s", "CPU", "ratio", "peak MiB", "p50 ms", "p99 ms", "max ms", "lost")
    runs = [(kbits, filtered, options.seconds) for kbits in traffic.BUS_LOAD for filtered in (True, False)]
    runs = [run for run in [*runs, (500, False, options.loss_seconds)] if run[2]]
    for kbits, filtered, seconds in runs:
        rows = {}
        for name in PROGRAMS:
            rows[name] = measure(name, traffic.BUS_LOAD[kbits], filtered, seconds, options.warm_minutes)
        for name, row in rows.items():
            delays = [f"{row['processed'][key]:.1f}" for key in ("p50_ms", "p99_ms", "max_ms")]
            ratio = row["cpu"] / rows["by hand"]["cpu"]
            what = f"{'filtered' if filtered else 'all'}, {seconds:g} s"
            cells = [f"{kbits} kbit/s", what, name, f"{row['rate']:.0f}", f"{row['cpu']:.1%}", f"{ratio:.2f}"]
            table.add_row(*cells, f"{row['peak_MiB']:.0f}", *delays, f"{row['sent'] - row['frames']}")
        ours = rows["roadload"]
        drained = ", ".join(f"{key[:3]} {value:.1f}" for key, value in ours["drained"].items())
        console.print(f"{kbits} kbit/s {what}: taken from the socket after {drained} ms;", end=" ")
        console.print(f"dropped by the kernel {ours['kernel_drops']}, by queues {ours['queue_drops']};", end=" ")
        console.print(f"longest conclusion {ours['conclusion_s']:.2f} s")
    console.print(table)


def show_outputs(console: Console, seconds: float, warm_minutes: float) -> None:
    """The table of the daemon with other programs beside the bus."""
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
        rows = {
            name: measure("roadload", traffic.BUS_LOAD[500], False, seconds, warm_minutes, outputs)
            for name, outputs in runs.items()
        }
    table = Table("500 kbit/s, all", "CPU", "ratio", "peak MiB", "p99 ms", "max ms", "lost", "reports sent")
    for name, row in rows.items():
        ratio, delays = (
            row["cpu"] / rows["none"]["cpu"],
            [f"{row['processed'][key]:.1f}" for key in ("p99_ms", "max_ms")],
        )
        sent = ", ".join(f"{count}" for count in row["reports"].values()) or "-"
        cells = [f"{row['cpu']:.1%}", f"{ratio:.2f}", f"{row['peak_MiB']:.0f}", *delays]
        table.add_row(name, *cells, f"{row['sent'] - row['frames']}", sent)
    console.print(table)


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="of each load; 0: none (default 60)")
    parser.add_argument("--loss-seconds", type=float, default=600.0, help="of full load; 0: none (default 600)")
    parser.add_argument("--output-seconds", type=float, default=60.0, help="of each output; 0: none (default 60)")
    parser.add_argument("--warm-minutes", type=float, default=60.0, help="of driving known at the start (default 60)")
    options = parser.parse_args()
    console = Console() if sys.stdout.isatty() else Console(width=WIDE)
    if options.seconds or options.loss_seconds:
        show(console, options)
    if options.output_seconds:
        show_outputs(console, options.output_seconds, options.warm_minutes)
    return 0


if __name__ == "__main__":
    sys.exit(main())
