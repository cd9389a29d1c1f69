"""The estimate for a Kuksa databroker: VSS signals by gRPC, kuksa.val.v2."""

from pathlib import Path

import grpc
from kuksa.val.v2 import types_pb2, val_pb2
from kuksa.val.v2.val_pb2_grpc import VALStub

from estimator.answers.published import PublishedAnswer
from estimator.daemon.outputs.credentials import read_secret
from estimator.daemon.outputs.output import OutputError, Trouble
from estimator.daemon.outputs.vss import BRANCH, Signal, signals
from estimator.errors import ConfigError
from estimator.settings import Kuksa

TIMEOUT = 3.0  # s for a call
MAX_ANSWER = 64 << 10  # bytes of an answer; ours are empty
OPTIONS = (("grpc.max_receive_message_length", MAX_ANSWER), ("grpc.enable_retries", 0))
TROUBLES = {
    grpc.StatusCode.UNAVAILABLE: Trouble.UNREACHABLE,
    grpc.StatusCode.DEADLINE_EXCEEDED: Trouble.TIMED_OUT,
    grpc.StatusCode.UNAUTHENTICATED: Trouble.REFUSED,
    grpc.StatusCode.PERMISSION_DENIED: Trouble.REFUSED,
    grpc.StatusCode.NOT_FOUND: Trouble.REFUSED,
    grpc.StatusCode.INVALID_ARGUMENT: Trouble.REFUSED,
    grpc.StatusCode.UNIMPLEMENTED: Trouble.REFUSED,
}
REMEDIES = {
    grpc.StatusCode.NOT_FOUND: f"; load roadload.vspec into the broker for {BRANCH}, or set kuksa.overlay = false",
    grpc.StatusCode.UNIMPLEMENTED: "; the broker needs the protocol kuksa.val.v2",
}


class KuksaChannel:
    """A connection to a databroker; each signal is a call, which the broker confirms."""

    def __init__(self, settings: Kuksa) -> None:
        self.address = f"kuksa {settings.host}:{settings.port}"
        self._settings = settings
        self._channel: grpc.Channel | None = None
        self._header: list[tuple[str, str]] = []

    def open(self) -> None:
        """Connect, and ask who is there."""
        target = f"{self._settings.host}:{self._settings.port}"
        authority, token = self._settings.ca_file, self._settings.token_file
        try:
            self._header = [("authorization", f"Bearer {read_secret(token, 'kuksa.token_file')}")] if token else []
            believed = None if authority is None else grpc.ssl_channel_credentials(Path(authority).read_bytes())
        except (OSError, ConfigError) as error:
            raise OutputError(Trouble.UNREACHABLE, str(error)) from error
        if believed is None:
            self._channel = grpc.insecure_channel(target, OPTIONS)
        else:
            self._channel = grpc.secure_channel(target, believed, OPTIONS)
        self._call("GetServerInfo", val_pb2.GetServerInfoRequest(), "the connection")

    def attend(self) -> None:
        """Do nothing: gRPC has threads of its own that keep the connection."""

    def send(self, report: PublishedAnswer) -> bool:
        """Publish all signals, with the time of the conclusion."""
        concluded = report.written_s - (0.0 if report.estimate is None else report.estimate.age_s)
        for signal in signals(report, self._settings.overlay):
            self._publish(signal, concluded, TIMEOUT)
        return True

    def withdraw(self, timeout: float) -> None:
        """Publish "not available"; each call has its part of the time."""
        listed = signals(None, self._settings.overlay)
        for signal in listed:
            self._publish(signal, None, timeout / len(listed))

    def close(self) -> None:
        """Close the connection."""
        channel, self._channel = self._channel, None
        if channel is not None:
            channel.close()

    def _publish(self, signal: Signal, t: float | None, timeout: float) -> None:
        """Publish a signal of time ``t`` [s since 1970], or of now; a point without a value is "not available"."""
        point = types_pb2.Datapoint()
        if t is not None:
            point.timestamp.FromMilliseconds(round(1e3 * t))
        if signal.value is not None:
            point.value.CopyFrom(types_pb2.Value(**{signal.kind: signal.value}))
        identity = types_pb2.SignalID(path=signal.path)
        self._call(
            "PublishValue", val_pb2.PublishValueRequest(signal_id=identity, data_point=point), signal.path, timeout
        )

    def _call(self, method: str, request: object, about: str, timeout: float = TIMEOUT) -> None:
        try:
            getattr(VALStub(self._channel), method)(request, timeout=timeout, metadata=self._header)
        except grpc.RpcError as error:
            code = error.code()
            trouble = TROUBLES.get(code, Trouble.GARBAGE)
            details = f"{about}: {code.name}: {error.details()}{REMEDIES.get(code, '')}"
            raise OutputError(
                trouble, f"the broker refuses {details}" if trouble is Trouble.REFUSED else details
            ) from error
