"""The status of a running daemon in Prometheus' text format (version 0.0.4), for the node exporter's text files."""

from collections.abc import Iterable

import msgspec

from estimator.answers.status import Link, State, StatusAnswer

PREFIX = "roadload_"
GAUGE, COUNTER = "gauge", "counter"
OF_LINKS = {  # help, by the name of a count of a bus
    "frames": "Data frames received.",
    "errors": "Error frames received.",
    "remote": "Remote frames received.",
    "malformed": "Frames received that no bus can carry.",
    "bus_off": "Error frames that report bus off.",
    "kernel_drops": "Frames that the kernel dropped because the receive buffer was full.",
    "queue_drops": "Frames that the queue of the receiving thread had no room for.",
    "reopened": "Times the bus was opened after the first time.",
}
PARAMETERS = {  # help, by the name of a parameter of the estimate
    "mass_kg": "Moving mass [kg].",
    "A_N": "Constant resistance A [N].",
    "C_N_s2_m2": "Aerodynamic coefficient C [N s^2/m^2].",
}
MOMENTS = ("mean", "sd", "q05", "q95")

Value = float | int | bool | None
Sample = tuple[dict[str, str], Value]


class Exposition:
    """Lines of metrics; values that are not known are left out, and metrics without a value."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def give(self, name: str, kind: str, meaning: str, samples: Iterable[Sample] | Value) -> None:
        """Add a metric: one value, or values with labels."""
        listed = [({}, samples)] if samples is None or isinstance(samples, bool | int | float) else list(samples)
        known = [(labels, float(value)) for labels, value in listed if value is not None]
        if not known:
            return
        self.lines.append(f"# HELP {PREFIX}{name} {meaning}")
        self.lines.append(f"# TYPE {PREFIX}{name} {kind}")
        self.lines.extend(f"{PREFIX}{name}{_labels(labels)} {value:.17g}" for labels, value in known)

    def of_label(self, name: str, kind: str, meaning: str, label: str, values: Iterable[tuple[str, Value]]) -> None:
        """Add a metric with one label."""
        self.give(name, kind, meaning, [({label: key}, value) for key, value in values])


def exposition(status: StatusAnswer) -> str:
    """The status as the content of a text file."""
    out = Exposition()
    _give_traffic(out, status)
    _give_estimator(out, status)
    _give_estimate(out, status)
    _give_road(out, status)
    _give_transmission(out, status)
    _give_outputs(out, status)
    return "\n".join(out.lines) + "\n"


def _give_traffic(out: Exposition, status: StatusAnswer) -> None:
    states = [(state.value, status.state == state) for state in State]
    out.of_label("state", GAUGE, "1 for what the daemon is doing, 0 for the other states.", "state", states)
    links: list[Link] = [status.input, *([status.output] if status.output is not None else [])]
    for key, meaning in OF_LINKS.items():
        out.of_label(f"{key}_total", COUNTER, meaning, "bus", [(link.bus, getattr(link, key)) for link in links])
    sizes = [(link.bus, link.receive_buffer_bytes) for link in links]
    out.of_label("receive_buffer_bytes", GAUGE, "Receive buffer of the socket.", "bus", sizes)
    out.give("frames_per_second", GAUGE, "Data frames received per second.", status.frames_per_s)
    out.give("clock_steps_total", COUNTER, "Steps of the wall clock that were taken out.", status.clock_steps)
    ages = [(role, signal.age_s) for role, signal in status.signals.items()]
    out.of_label("signal_age_seconds", GAUGE, "Age of the newest valid reading.", "signal", ages)
    counts = [(role, signal.readings) for role, signal in status.signals.items()]
    out.of_label("readings_total", COUNTER, "Readings, valid or not.", "signal", counts)
    out.of_label("refused_total", COUNTER, "Frames and values not used.", "reason", status.refused.items())
    contested: list[Sample] = [({"signal": path, "reason": why}, 1) for path, why in status.contested.items()]
    out.give("contested", GAUGE, "1 for a signal whose readings contradict each other.", contested)
    out.give("senders_replaced_total", COUNTER, "Senders given up for others.", status.senders_replaced)


def _give_estimator(out: Exposition, status: StatusAnswer) -> None:
    worker, rejected = status.estimator, status.samples_rejected.items()
    out.of_label("samples_rejected_total", COUNTER, "Samples kept out of the window.", "reason", rejected)
    out.give("estimator_queue_drops_total", COUNTER, "Frames that the estimator had no room for.", worker.queue_drops)
    out.give("failed_updates_total", COUNTER, "Updates that failed numerically.", status.failed_updates)
    out.give("conclusion_seconds", GAUGE, "Duration of the latest update.", worker.conclusion_s)
    out.give("longest_conclusion_seconds", GAUGE, "Duration of the longest update.", worker.longest_conclusion_s)
    out.of_label("state_saves_total", COUNTER, "Attempts to save the state.", "result", worker.state_saves.items())
    out.give("state_not_saved", GAUGE, "1 if the latest attempt to save failed.", bool(worker.state_problem))


def _give_estimate(out: Exposition, status: StatusAnswer) -> None:
    estimate = status.estimate
    if estimate is None:
        return
    out.of_label("estimate_status", GAUGE, "1 for the verdict.", "status", [(estimate.status.value, 1)])
    out.give("estimate_age_seconds", GAUGE, "Age of the latest conclusion.", estimate.age_s)
    out.give("coverage_ratio", GAUGE, "Share of the speed-acceleration cells seen.", estimate.coverage.fraction)
    for name, marginal in msgspec.structs.asdict(estimate.parameters).items():
        values = [(key, getattr(marginal, key)) for key in MOMENTS]
        out.of_label(name, GAUGE, PARAMETERS[name], "moment", values)


def _give_road(out: Exposition, status: StatusAnswer) -> None:
    road = status.road_now
    if road is None:
        return
    out.give("road_grade_percent", GAUGE, "Grade of the road under the vehicle.", road.grade_percent)
    out.give("road_grade_sd_percent", GAUGE, "Standard deviation of the grade.", road.sd_percent)
    out.give("road_height_metres", GAUGE, "Height above the start of the drive.", road.height_m)


def _give_transmission(out: Exposition, status: StatusAnswer) -> None:
    transmit = status.transmit
    if not transmit.enabled:
        return
    out.give("address", GAUGE, "J1939 source address.", transmit.address)
    out.give("address_lost", GAUGE, "1 while another node has the address.", transmit.address_lost)
    out.give("published_total", COUNTER, "Frames broadcast.", transmit.published)
    out.give("sending_failed_total", COUNTER, "Frames that could not be sent.", transmit.failed)
    out.of_label("withheld_total", COUNTER, "Frames not broadcast.", "reason", transmit.withheld.items())
    codes: list[tuple[str, Value]] = [(code, 1) for code in transmit.trouble_codes]
    out.of_label("trouble_code", GAUGE, "1 for an active trouble code (J1939-73).", "code", codes)


def _give_outputs(out: Exposition, status: StatusAnswer) -> None:
    outputs = status.outputs.items()
    connected = [(name, output.connected) for name, output in outputs]
    out.of_label("output_connected", GAUGE, "1 while another program can be sent to.", "output", connected)
    sent = [(name, output.sent) for name, output in outputs]
    out.of_label("output_sent_total", COUNTER, "Reports sent to another program.", "output", sent)
    failed = [
        ({"output": name, "reason": kind}, count) for name, output in outputs for kind, count in output.failed.items()
    ]
    out.give("output_failed_total", COUNTER, "Failures of the connection to another program.", failed)


def _labels(labels: dict[str, str]) -> str:
    if not labels:
        return ""

    def escaped(text: str) -> str:
        return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")

    return "{" + ",".join(f'{key}="{escaped(value)}"' for key, value in labels.items()) + "}"
