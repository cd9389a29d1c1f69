"""Where `watch` shows its view: a screen that lives on a terminal, a line an update elsewhere, and a page."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.live import Live

from estimator.answers.watch import WatchAnswer
from estimator.commands.terminal import say
from estimator.report import parameter_text
from estimator.report.number_format import clock
from estimator.watch.page import WatchPage
from estimator.watch.screen import Screen

REFRESHES = 4.0  # of the screen, per second

Show = Callable[[WatchAnswer], None]


class Lines:
    """A line for each conclusion, and for each change of the state or of what is wrong."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._state = ("", "")
        self._concluded: float | None = None

    def show(self, view: WatchAnswer) -> None:
        """Print what is new in a view."""
        if (view.state, view.note) != self._state:
            self._state = (view.state, view.note)
            say(self._console, f"{view.state}{f': {view.note}' if view.note else ''}")
        conclusion = view.estimate
        if conclusion is not None and conclusion.t_s is not None and conclusion.t_s != self._concluded:
            self._concluded = conclusion.t_s
            text = parameter_text.line(conclusion.status, conclusion.reason, conclusion.parameters, conclusion.coverage)
            say(self._console, f"{clock(conclusion.t_s)} estimate: {text}")


@contextmanager
def display(console: Console, first: WatchAnswer, port: int | None) -> Iterator[Show]:
    """Show views until the end, beginning with the ``first``; with a ``port`` of this machine, as a page there, too.

    Raises
    ------
    RoadloadError
        The port cannot be used.
    """
    newest = first

    def keep(view: WatchAnswer) -> None:
        nonlocal newest
        newest = view

    with _page(port, lambda: newest) as address:
        if console.is_dumb_terminal or not (console.is_terminal and console.is_interactive):
            lines = Lines(console)
            if address:
                say(console, f"page: {address}")

            def print_and_keep(view: WatchAnswer) -> None:
                keep(view)
                lines.show(view)

            print_and_keep(first)
            yield print_and_keep
            return
        screen = Live(
            get_renderable=lambda: Screen(newest, address),
            console=console,
            screen=True,
            refresh_per_second=REFRESHES,
        )
        with screen:
            screen.refresh()  # its own first view comes after a quarter of a second, when a short log has ended
            yield keep


@contextmanager
def _page(port: int | None, newest: Callable[[], WatchAnswer]) -> Iterator[str]:
    """Serve the page, and yield its address; empty where no ``port`` is given."""
    if port is None:
        yield ""
        return
    with WatchPage(newest, port) as page:
        yield page.address
