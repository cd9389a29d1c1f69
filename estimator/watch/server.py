"""A server of one page and of the events that keep it fresh, on the loopback of this machine, in a thread of its own.

It only reads. A page of another site can neither ask for it, for its name is in ``Origin``, nor have its own name lead
here (DNS rebinding), for that name is in ``Host``: only the names of the loopback are answered. A watcher that does not
read is dropped, so none can hold up another, nor the program.
"""

import asyncio
import contextlib
import os
import threading
from collections.abc import Callable, Mapping
from http import HTTPStatus
from types import TracebackType
from typing import NamedTuple, Self

from estimator.errors import RoadloadError

ADDRESS = "127.0.0.1"
NAMES = ("127.0.0.1", "localhost")
PERIOD = 1.0  # s between events
MAX_WATCHERS = 100
MAX_CONNECTIONS = 128  # watchers, and those that are still asking
MAX_REQUEST = 8192  # bytes of a request
PATIENCE = 5.0  # s in which a request must be there, and its answer taken
MAX_UNREAD = 1 << 18  # bytes that wait for a watcher, beyond those in the kernel's buffers: it is dropped
HEADERS = {
    "Cache-Control": "no-store",
    "Connection": "close",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
EVENTS = "/events"


class Document(NamedTuple):
    """An answer to a request for its path."""

    kind: str  # media type
    body: bytes
    headers: Mapping[str, str] = {}


class Server:
    """Serves ``documents`` by path, and ``event`` every PERIOD to those who watch; a context manager.

    Parameters
    ----------
    port
        Of ADDRESS; 0: any that is free.
    documents
        Functions that make what is answered at a path, called in the server's thread.
    event
        Makes the data of the next event, one line; called only while somebody watches.

    Raises
    ------
    RoadloadError
        On entering: the port cannot be used.
    """

    def __init__(self, port: int, documents: Mapping[str, Callable[[], Document]], event: Callable[[], bytes]) -> None:
        self.dropped = 0  # watchers that did not read
        self._port, self._documents, self._event = port, documents, event
        self._watchers: set[asyncio.StreamWriter] = set()
        self._connections: set[asyncio.StreamWriter] = set()

    @property
    def port(self) -> int:
        """The port that is used."""
        return self._port

    @property
    def watchers(self) -> int:
        """Connections that get events."""
        return len(self._watchers)

    def __enter__(self) -> Self:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="page", daemon=True)
        self._thread.start()
        try:
            asyncio.run_coroutine_threadsafe(self._begin(), self._loop).result()
        except OSError as error:
            self._stop()
            reason = os.strerror(error.errno) if error.errno else str(error)
            raise RoadloadError(f"--web {self._port}: {reason}; choose another port") from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        asyncio.run_coroutine_threadsafe(self._end(), self._loop).result()
        self._stop()

    def _stop(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _begin(self) -> None:
        """Open the port."""
        self._server = await asyncio.start_server(self._serve, ADDRESS, self._port, limit=MAX_REQUEST)
        self._port = self._server.sockets[0].getsockname()[1]
        self._ticking = asyncio.create_task(self._tick())

    async def _end(self) -> None:
        """Close the port and all connections, whose ends end what is under way."""
        self._server.close()
        self._ticking.cancel()
        for connection in self._connections:
            connection.transport.abort()
        if under_way := asyncio.all_tasks() - {asyncio.current_task()}:
            await asyncio.wait(under_way, timeout=PATIENCE)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One connection: a request, and its answer."""
        self._connections.add(writer)
        try:
            if len(self._connections) > MAX_CONNECTIONS:
                writer.transport.abort()
                return
            async with asyncio.timeout(PATIENCE):
                is_watching = await self._answer(await _request(reader), writer)
            if is_watching:
                await self._watch(reader, writer)
        except (OSError, TimeoutError, asyncio.IncompleteReadError):
            writer.transport.abort()
        finally:
            self._connections.discard(writer)
            self._watchers.discard(writer)
            writer.close()
            with contextlib.suppress(OSError, TimeoutError):
                await asyncio.wait_for(writer.wait_closed(), PATIENCE)

    async def _answer(self, request: "Request | HTTPStatus", writer: asyncio.StreamWriter) -> bool:
        """Answer, and return whether events are to follow."""
        refusal = request if isinstance(request, HTTPStatus) else request.refusal()
        if not refusal and isinstance(request, Request):
            if request.path == EVENTS and request.method == "GET":
                if len(self._watchers) < MAX_WATCHERS:
                    await _send(writer, HTTPStatus.OK, Document("text/event-stream", self._as_event()), length=False)
                    return True
                refusal = HTTPStatus.SERVICE_UNAVAILABLE
            elif request.path in self._documents:
                await _send(writer, HTTPStatus.OK, self._documents[request.path](), request.method == "GET")
                return False
        refused = refusal or HTTPStatus.NOT_FOUND
        text = f"{refused.value} {refused.phrase}\n".encode()
        await _send(writer, refused, Document("text/plain", text))
        return False

    async def _watch(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Keep the connection until its other end closes it, or `_tick` drops it."""
        writer.transport.set_write_buffer_limits(MAX_UNREAD)
        self._watchers.add(writer)
        while await reader.read(MAX_REQUEST):  # nothing more is to be said
            pass

    async def _tick(self) -> None:
        """Send an event to all who watch, every PERIOD; drop who has not read those before."""
        while True:
            await asyncio.sleep(PERIOD)
            if not self._watchers:
                continue
            event = self._as_event()
            for watcher in list(self._watchers):
                if watcher.transport.get_write_buffer_size() > MAX_UNREAD:
                    self.dropped += 1
                    self._watchers.discard(watcher)
                    watcher.transport.abort()
                else:
                    watcher.write(event)

    def _as_event(self) -> bytes:
        return b"data: " + self._event() + b"\n\n"


class Request(NamedTuple):
    """A request; the names of ``headers`` are in small letters."""

    method: str
    path: str
    headers: dict[str, list[str]]

    def refusal(self) -> HTTPStatus | None:
        """Why it is not answered: asked by or for another name, or asking for more than to read."""
        hosts, origins = self.headers.get("host", []), self.headers.get("origin", [])
        if len(hosts) != 1 or _name(hosts[0]) not in NAMES:
            return HTTPStatus.FORBIDDEN
        if any(origin.lower() != f"http://{hosts[0].lower()}" for origin in origins):
            return HTTPStatus.FORBIDDEN
        return None if self.method in ("GET", "HEAD") else HTTPStatus.METHOD_NOT_ALLOWED


def _name(host: str) -> str:
    """The name in a ``Host``, whose port may be that of a tunnel; empty where it is none."""
    name, colon, port = host.partition(":")
    return "" if colon and not port.isdigit() else name.lower()


async def _request(reader: asyncio.StreamReader) -> Request | HTTPStatus:
    """The next request, or why it is none."""
    try:
        head = await reader.readuntil(b"\r\n\r\n")
    except asyncio.LimitOverrunError:
        return HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE
    first, *lines = head.decode("latin-1").split("\r\n")[:-2]
    words = first.split(" ")
    if len(words) != 3 or not words[2].startswith("HTTP/1."):
        return HTTPStatus.BAD_REQUEST
    headers: dict[str, list[str]] = {}
    for line in lines:
        name, colon, value = line.partition(":")
        if not colon or name != name.strip():
            return HTTPStatus.BAD_REQUEST
        headers.setdefault(name.lower(), []).append(value.strip())
    return Request(words[0], words[1].partition("?")[0], headers)


async def _send(
    writer: asyncio.StreamWriter, status: HTTPStatus, document: Document, body: bool = True, length: bool = True
) -> None:
    """Send an answer; without its ``length`` more is to follow."""
    headers = {"Content-Type": f"{document.kind}; charset=utf-8", **HEADERS, **document.headers}
    if length:
        headers["Content-Length"] = str(len(document.body))
    head = "".join(f"{name}: {value}\r\n" for name, value in headers.items())
    writer.write(f"HTTP/1.1 {status.value} {status.phrase}\r\n{head}\r\n".encode() + (document.body if body else b""))
    await writer.drain()
