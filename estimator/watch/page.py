"""The view as a page at a port of this machine: one file, with nothing from a network, whose events keep it fresh."""

import base64
import hashlib
import re
from collections.abc import Callable
from contextlib import AbstractContextManager
from importlib import resources
from types import TracebackType
from typing import Self

from estimator.answers.answer import encode
from estimator.answers.watch import WatchAnswer
from estimator.watch.server import ADDRESS, Document, Server

FAMILY = "/* page.css */"  # where the style of all pages stands
SCRIPT = re.compile("<script>(.*?)</script>", re.DOTALL)


class WatchPage(AbstractContextManager["WatchPage"]):
    """Serves the page while it is open: ``/``, ``/view.json`` and the events.

    Parameters
    ----------
    newest
        Returns the newest view; called in the server's thread.
    port
        Of 127.0.0.1; 0: any that is free.
    """

    def __init__(self, newest: Callable[[], WatchAnswer], port: int) -> None:
        page = document()
        documents = {
            "/": lambda: page,
            "/view.json": lambda: Document("application/json", encode(newest())),
        }
        self.server = Server(port, documents, lambda: encode(newest()))

    @property
    def address(self) -> str:
        """Where a browser finds it."""
        return f"http://{ADDRESS}:{self.server.port}/"

    def __enter__(self) -> Self:
        """Open the port.

        Raises
        ------
        RoadloadError
            The port cannot be used.
        """
        self.server.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Close all connections and the port."""
        self.server.__exit__(kind, error, traceback)


def document() -> Document:
    """The page, which may run its own script and no other, and may ask this server alone."""
    style = resources.files("estimator.report.page").joinpath("page.css").read_text(encoding="utf-8")
    text = resources.files("estimator.watch").joinpath("page.html").read_text(encoding="utf-8").replace(FAMILY, style)
    script = SCRIPT.search(text)
    digest = hashlib.sha256(script[1].encode() if script else b"").digest()
    policy = (
        f"default-src 'none'; script-src 'sha256-{base64.b64encode(digest).decode()}'; style-src 'unsafe-inline'; "
        "img-src data:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return Document("text/html", text.encode(), {"Content-Security-Policy": policy})
