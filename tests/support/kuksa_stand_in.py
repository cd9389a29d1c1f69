"""A stand-in for a Kuksa databroker: kuksa.val.v2 for some signals, with the newest value of each and nothing else.

python tests/support/kuksa_stand_in.py PORT
"""

import sys
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import grpc
from kuksa.val.v2 import val_pb2, val_pb2_grpc

from estimator.daemon.outputs.vss import signals


class Databroker(val_pb2_grpc.VALServicer):  # type: ignore[misc]
    """A server on the loopback, which is started by its construction.

    Parameters
    ----------
    paths
        Signals that it knows.
    port
        0 for a free one.
    token
        That callers must have; empty for none.

    Attributes
    ----------
    values, times
        Newest value and its time [s since 1970] by path; None is "not available".
    calls
        Values published.
    """

    def __init__(self, paths: set[str], port: int = 0, token: str = "") -> None:
        self.values: dict[str, object] = {}
        self.times: dict[str, float] = {}
        self.calls = 0
        self._paths, self._token = paths, token
        self._server = grpc.server(ThreadPoolExecutor(2))
        val_pb2_grpc.add_VALServicer_to_server(self, self._server)
        self.port = self._server.add_insecure_port(f"127.0.0.1:{port}")
        self._server.start()

    def stop(self) -> None:
        """End all calls and the server."""
        self._server.stop(None).wait()

    def wait(self) -> None:
        """Serve until the process ends."""
        self._server.wait_for_termination()

    def GetServerInfo(self, request: Any, context: Any) -> Any:
        """Answer who is there."""
        self._authorize(context)
        return val_pb2.GetServerInfoResponse(name="stand-in", version="1")

    def PublishValue(self, request: Any, context: Any) -> Any:
        """Take a value."""
        self._authorize(context)
        self.calls += 1
        path, point = request.signal_id.path, request.data_point
        if path not in self._paths:
            context.abort(grpc.StatusCode.NOT_FOUND, "Path not found")
        kind = point.value.WhichOneof("typed_value")
        self.values[path] = None if kind is None else getattr(point.value, kind)
        self.times[path] = point.timestamp.ToMilliseconds() / 1e3
        return val_pb2.PublishValueResponse()

    def _authorize(self, context: Any) -> None:
        given = dict(context.invocation_metadata()).get("authorization", "")
        if self._token and given != f"Bearer {self._token}":
            context.abort(grpc.StatusCode.UNAUTHENTICATED, "no valid token")


if __name__ == "__main__":
    Databroker({signal.path for signal in signals(None, overlay=True)}, int(sys.argv[1])).wait()
