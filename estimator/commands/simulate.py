"""The subcommand `simulate`: a drive whose truth is known, as a log."""

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import get_args

import numpy as np

from estimator.can_io import j1939_encoder, obd2_encoder
from estimator.can_io.log_writer import WRITABLE, write_log
from estimator.commands.arguments import MINUTES, add_output, moment, not_negative, number, whole_number
from estimator.commands.log_options import check_outputs
from estimator.commands.terminal import print_json
from estimator.errors import InputError
from estimator.printable import printable
from estimator.report.simulation_summary import of_recording
from estimator.signals import Role
from estimator.simulation.cycle import COLUMNS, cycle_route
from estimator.simulation.effects.catalogue import KINDS, parse_effect
from estimator.simulation.itinerary import METRES_PER_SECOND, Shape, shaped
from estimator.simulation.polling import polled
from estimator.simulation.recording import record
from estimator.simulation.route import RoadKind, generate_route
from estimator.simulation.sensors import OPTIONAL, Sensors
from estimator.simulation.truck import draw_car, draw_truck

TRUTHS = {"mass": ("kg", "mass", 1e6), "A": ("N", "rolling force", 1e6), "C": ("N s2/m2", "drag coefficient", 1e3)}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_output(parser)
    parser.add_argument("output", type=Path, metavar="OUT.blf", help=f"the log: {' '.join(WRITABLE)}")
    parser.add_argument("--minutes", type=MINUTES, default=40.0, help="length of the drive (default: 40)")
    parser.add_argument("--route", choices=get_args(RoadKind), default="mixed", help="kind of road (default: mixed)")
    parser.add_argument("--cycle", type=Path, metavar="FILE.csv", help=f"road of a driving cycle instead: {COLUMNS}")
    parser.add_argument("--shape", choices=get_args(Shape), default="one-way", help="how the road is driven")
    parser.add_argument("--seed", type=whole_number, default=1, help="draws truck, route and noise (default: 1)")
    for name, (unit, what, most) in TRUTHS.items():
        allowed = number(sys.float_info.min, most, f"a positive number up to {most:g}")
        parser.add_argument(f"--{name}", type=allowed, metavar=unit, help=f"{what}, instead of the drawn one")
    poll = "a car that answers a logger on its OBD-II socket, each PID once in this time, instead of a truck on J1939"
    parser.add_argument("--poll", type=number(0.05, 10.0, "a time from 0.05 to 10 s"), metavar="s", help=poll)
    start = "date and time of the first moment, as in 2026-03-01T06:00; UTC unless it names a zone"
    parser.add_argument("--start", type=moment, metavar="TIME", help=f"{start} (default: 2023-11-14T22:13:20)")
    noise = "sd of the wheel speed's noise (default: 0.01)"
    parser.add_argument("--speed-noise", type=not_negative, default=0.01, metavar="m/s", help=noise)
    steps = "of the reference torque, in which torque is sent: 0.125 (default) or 1"
    parser.add_argument("--torque-resolution", type=float, choices=[0.125, 1.0], default=0.125, help=f"%% {steps}")
    lag = "by which torque and engine speed are late (default: 0.03)"
    parser.add_argument("--torque-lag", type=not_negative, default=0.03, metavar="s", help=lag)
    parser.add_argument(
        "--effect",
        action="append",
        default=[],
        metavar="NAME[=SIZE][@START[-END]]",
        help=f"an effect of the drive; may be repeated; sizes in SI; those that come and go have times in s: "
        f"{', '.join(KINDS)}",
    )
    parser.add_argument(
        "--without",
        action="append",
        default=[],
        choices=[role.value for role in OPTIONAL],
        metavar="SIGNAL",
        help=f"leave a signal off the bus: {', '.join(OPTIONAL)}",
    )


def run(options: argparse.Namespace) -> int:
    """Simulate, write the log and print the truth."""
    check_outputs([options.cycle] if options.cycle else [], {options.output: WRITABLE})
    duration = options.minutes * 60
    effects = [parse_effect(text) for text in options.effect]
    if late := next((effect for effect in effects if effect.start is not None and effect.start >= duration), None):
        raise InputError(f"effect {late.name}: begins at {late.start:g} s, after a drive of {duration:g} s")
    rng = np.random.default_rng(options.seed)
    drawn = draw_truck(rng) if options.poll is None else draw_car(rng)
    chosen = {name: getattr(options, name) for name in ("mass", "A", "C") if getattr(options, name) is not None}
    truck = dataclasses.replace(drawn, **chosen)
    length = duration * METRES_PER_SECOND
    road = cycle_route(options.cycle, length, rng) if options.cycle else generate_route(options.route, length, rng)
    sensors = Sensors(
        speed_noise=options.speed_noise,
        torque_resolution=options.torque_resolution / 100,
        torque_lag=options.torque_lag,
        without=frozenset(Role(name) for name in options.without),
    )
    route = shaped(road, duration, options.shape)
    recording = record(truck, route, duration, rng, sensors=sensors, effects=effects)
    if options.poll is None:
        frames = j1939_encoder.frames_of(recording.signals)
    else:
        frames = obd2_encoder.frames_of(polled(recording.signals, options.poll, rng))
    if options.start is not None:
        frames = dataclasses.replace(frames, t=frames.t - j1939_encoder.EPOCH + options.start)
    write_log(frames, options.output)
    answer = of_recording(recording, str(options.output), len(frames), duration)
    if options.json:
        print_json(answer)
    else:
        road_name = options.cycle.name if options.cycle else options.route
        driving = f"{options.minutes:g} min of {printable(road_name)} driving"
        print(f"{printable(answer.log)}: {answer.frames:,} frames, {driving}")
        print(f"truth: mass {truck.mass:,.0f} kg, A {truck.A:,.0f} N, C {truck.C:.3f} N s²/m²")
        for effect in answer.effects:
            size = f"{effect.magnitude:g} {effect.unit}".removesuffix(" 1")
            print(f"effect: {effect.name} {size}, {effect.rms_kW:.1f} kW rms")
    return 0
