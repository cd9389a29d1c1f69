"""The page of `watch`: who is answered, what is drawn in a browser, and watchers that do not read."""

import http.client
import json
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import pytest
from made_views import begun, estimated

from estimator.answers.answer import decode
from estimator.answers.watch import WatchAnswer
from estimator.errors import RoadloadError
from estimator.report.parameter_text import ROWS
from estimator.watch import server as serving
from estimator.watch import view
from estimator.watch.page import WatchPage
from estimator.watch.server import MAX_WATCHERS, Document, Server

PATIENCE = 20.0  # s


class Shown:
    """A page and the view that it shows, which a test exchanges."""

    def __init__(self, first: WatchAnswer) -> None:
        self.view = first
        self.page = WatchPage(lambda: self.view, 0)


@pytest.fixture
def shown() -> Iterator[Shown]:
    """A page of an estimate."""
    made = Shown(estimated())
    with made.page:
        yield made


def until(condition: Callable[[], bool]) -> None:
    """Wait for what the server's thread brings about."""
    waiting = threading.Event()
    for _ in range(int(PATIENCE / 0.02)):
        if condition():
            return
        waiting.wait(0.02)
    raise AssertionError("it never came to pass")


def answered(page: WatchPage, raw: bytes) -> bytes:
    """All that comes back for the bytes of a request."""
    with socket.create_connection(("127.0.0.1", page.server.port), PATIENCE) as connection:
        connection.sendall(raw)
        return b"".join(iter(lambda: connection.recv(65_536), b""))


def asked(page: WatchPage, path: str = "/", method: str = "GET", **headers: str) -> tuple[int, dict[str, str], bytes]:
    """Status, headers and body of an answer."""
    connection = http.client.HTTPConnection("127.0.0.1", page.server.port, timeout=PATIENCE)
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, dict(answer.getheaders()), body


def test_the_view_is_served_as_json(shown: Shown) -> None:
    status, headers, body = asked(shown.page, "/view.json")
    assert (status, headers["Content-Type"]) == (200, "application/json; charset=utf-8")
    assert decode(body, WatchAnswer) == shown.view
    shown.view = begun()
    assert decode(asked(shown.page, "/view.json")[2], WatchAnswer) == begun()


def test_the_page_needs_nothing_else(shown: Shown) -> None:
    status, headers, body = asked(shown.page)
    assert status == 200
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert b"http://" not in body.replace(b"http://www.w3.org/2000/svg", b"")
    assert b"https://" not in body
    assert b"--paper" in body  # the style of the other pages
    assert asked(shown.page, "/", "HEAD") == (200, headers, b"")


@pytest.mark.parametrize("host", ["127.0.0.1:{port}", "localhost:{port}", "LOCALHOST:9000", "localhost"])
def test_the_names_of_this_machine_are_answered(shown: Shown, host: str) -> None:
    host = host.format(port=shown.page.server.port)
    assert asked(shown.page, Host=host)[0] == 200
    assert asked(shown.page, Host=host, Origin=f"http://{host}")[0] == 200


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("evil.example", None),
        ("localhost.evil.example", None),
        ("127.0.0.1.evil.example:8000", None),
        ("127.0.0.1:80:80", None),
        ("", None),
        ("localhost", "http://evil.example"),
        ("localhost", "https://localhost"),
        ("localhost:1", "http://localhost:2"),
        ("localhost", "null"),
    ],
)
@pytest.mark.parametrize("path", ["/", "/view.json", "/events"])
def test_other_names_and_origins_are_refused(shown: Shown, path: str, host: str, origin: str | None) -> None:
    headers = {"Host": host} | ({} if origin is None else {"Origin": origin})
    status, _, body = asked(shown.page, path, **headers)
    assert status == 403
    assert b"27,190" not in body


@pytest.mark.parametrize(
    ("raw", "status"),
    [
        (b"POST / HTTP/1.1\r\nHost: localhost\r\n\r\n", 405),
        (b"GET /../etc/passwd HTTP/1.1\r\nHost: localhost\r\n\r\n", 404),
        (b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: evil.example\r\n\r\n", 403),
        (b"GET / HTTP/1.1\r\n\r\n", 403),
        (b"GET /\r\n\r\n", 400),
        (b"\x16\x03\x01\x02\x00\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost : localhost\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nX: " + b"a" * 20_000 + b"\r\n\r\n", 431),
    ],
)
def test_what_is_no_request_for_the_page_is_refused(shown: Shown, raw: bytes, status: int) -> None:
    assert answered(shown.page, raw).startswith(f"HTTP/1.1 {status} ".encode())
    assert asked(shown.page)[0] == 200  # and others are answered as before


def test_other_addresses_of_this_machine_are_not_listened_on(shown: Shown) -> None:
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", shown.page.server.port), PATIENCE)


def test_a_port_that_is_taken_is_one_line(shown: Shown) -> None:
    port = shown.page.server.port
    with pytest.raises(RoadloadError, match=f"--web {port}: Address already in use"), WatchPage(estimated, port):
        pass


def watch(port: int) -> tuple[socket.socket, Any]:
    """A connection that asks for events, and a file of what comes."""
    connection = socket.create_connection(("127.0.0.1", port), PATIENCE)
    connection.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
    return connection, connection.makefile("rb")


def next_event(file: Any) -> dict[str, Any]:
    while not (line := file.readline()).startswith(b"data: "):
        assert line, "the connection was closed"
    content: dict[str, Any] = json.loads(line.removeprefix(b"data: "))
    return content


@pytest.mark.slow
def test_a_hundred_watch_and_no_more(shown: Shown, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serving, "PERIOD", 0.05)
    watchers = [watch(shown.page.server.port) for _ in range(MAX_WATCHERS)]
    assert all(next_event(file)["source"] == "drive.blf" for _, file in watchers)
    until(lambda: shown.page.server.watchers == MAX_WATCHERS)
    assert asked(shown.page, "/events")[0] == 503
    assert asked(shown.page, "/view.json")[0] == 200
    shown.view = begun()
    for connection, file in watchers:
        while next_event(file)["source"] != "socketcan can0":
            pass
        file.close()
        connection.close()
    until(lambda: shown.page.server.watchers == 0)


@pytest.mark.slow
def test_who_never_reads_is_dropped_and_holds_up_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serving, "PERIOD", 0.01)
    events = iter(range(1_000_000))
    with Server(
        0, {"/": lambda: Document("text/plain", b"x")}, lambda: b"%d " % next(events) + b"x" * 100_000
    ) as server:
        idle, _ = watch(server.port)
        reading, file = watch(server.port)
        while not server.dropped:
            assert file.readline()  # PATIENCE bounds it
        assert server.watchers == 1
        file.close()
        reading.close()
        idle.close()


# in a browser


@pytest.fixture
def tab(browser: Any, request: pytest.FixtureRequest) -> Iterator[Any]:
    """A tab of the width and scheme of the test's parameters, and what its console said."""
    width, scheme = getattr(request, "param", (1280, "light"))
    context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
    page = context.new_page()
    page.said = []
    page.on("console", lambda message: page.said.append(message.text))
    page.on("pageerror", lambda error: page.said.append(str(error)))
    yield page
    context.close()


def drawn(tab: Any) -> dict[str, str]:
    """Class of each cell that is drawn, by its place."""
    cells: dict[str, str] = tab.evaluate(
        "Object.fromEntries([...document.querySelectorAll('#map .cell')].map(e => [e.dataset.cell, e.classList[1]]))"
    )
    return cells


@pytest.mark.slow
@pytest.mark.parametrize("tab", [(w, s) for w in (400, 1280) for s in ("light", "dark")], indirect=True)
def test_what_is_drawn_is_what_the_json_says(tab: Any, shown: Shown) -> None:
    tab.goto(shown.page.address)
    tab.wait_for_selector("#map .cell")
    said = decode(asked(shown.page, "/view.json")[2], WatchAnswer)
    assert said.estimate is not None
    assert said.progress is not None
    cells = said.progress.coverage_map
    expected = {f"{i},{j}": "wanted" for i, j in cells.wanted}
    expected |= {f"{i},{j}": "occupied" if n >= cells.needed else "begun" for i, j, n in cells.rows}
    assert drawn(tab) == expected
    for row in ROWS:
        x = row.of(said.estimate.parameters)
        text = tab.inner_text(f"#figures [data-key={row.key}]")
        assert row.value(x.mean or 0) in text
        assert row.interval(x.q05 or 0, x.q95 or 0) in text
        points = [point for point in said.progress.history if getattr(point, row.key) is not None]
        line = tab.get_attribute(f"#figures [data-key={row.key}] .line", "d")
        assert line.count("L") == len(points) - 1
    assert tab.inner_text("h1") == said.sentences.headline
    assert said.sentences.wanted in tab.inner_text("#wanted")
    assert tab.inner_text("#slopes") == said.sentences.road
    assert tab.inner_text("#shares").split("\n") == ["used", "90 %", "braking", "7 %", "standing", "3 %"]
    width = tab.viewport_size["width"]
    assert tab.evaluate("document.documentElement.scrollWidth") == width
    tiny = "[...document.querySelectorAll('p, li, .area span')].filter(e => e.innerText && "
    assert tab.evaluate(tiny + "parseFloat(getComputedStyle(e).fontSize) < 11).map(e => e.innerText)") == []
    assert tab.said == []


@pytest.mark.slow
def test_the_page_follows_and_says_when_it_is_no_longer_fresh(
    tab: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(serving, "PERIOD", 0.05)
    shown = Shown(begun())
    with shown.page:
        tab.goto(shown.page.address)
        tab.wait_for_selector("h1:has-text('No estimate yet: 450 of 600 usable samples')")
        assert tab.get_attribute("#head", "class") == "unestimated"
        shown.view = estimated(source="<img src=x onerror=alert(1)>.blf")
        tab.wait_for_selector("h1:has-text('27,190 kg')")
        assert tab.get_attribute("#head", "class") == "estimated"
        assert tab.inner_text("#source") == "<img src=x onerror=alert(1)>.blf"
        shown.view = view.without_news("status.json", "no daemon is running", "there is no file status.json")
        tab.wait_for_selector("h1:has-text('No daemon is running')")
        assert "27,190" not in tab.inner_text("body")
        assert tab.inner_text("#note") == "there is no file status.json"
        shown.view = msgspec.structs.replace(estimated(), note="missing: CCVS1.Speed")
        tab.wait_for_selector("#note:has-text('missing: CCVS1.Speed')")
        assert tab.said == []
    tab.wait_for_selector("body.stale #status:has-text('connection lost')")
    assert caplog.records == []
