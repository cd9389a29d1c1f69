"""Standard output, for people and for programs; and progress."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import msgspec
from rich.console import Console
from rich.progress import Progress
from rich.text import Text

from estimator import toml_text
from estimator.answers.answer import Answer, as_text
from estimator.config import Config
from estimator.printable import printable
from estimator.settings import Section
from estimator.settings_comments import comments_of

WIDE = 140  # columns of tables that go to a file or a pipe


def standard_output() -> Console:
    """The terminal; a file or a pipe has no width to keep to."""
    console = Console()
    return console if console.is_terminal else Console(width=WIDE)


def say(console: Console, text: str) -> None:
    """Print a line as it is, brackets included."""
    console.print(Text(printable(text)), soft_wrap=True)


def print_json(answer: Answer) -> None:
    """Print one JSON object."""
    print(as_text(answer))


def print_config(settings: Config) -> None:
    """Print the settings in force as TOML, with paths that hold in any folder and what each key means."""
    tables = msgspec.to_builtins(settings)
    tables["signals"] = {str(role): bound for role, bound in settings.binding.items()}
    tables["bus"]["dbc"] = [os.path.abspath(path) for path in settings.bus.dbc]
    if settings.road.map is not None:
        tables["road"]["map"] = os.path.abspath(settings.road.map)
    comments = dict(comments_of(Config))
    for name in Config.__struct_fields__:
        if isinstance(table := getattr(settings, name), Section):
            comments |= {f"{name}.{key}": text for key, text in comments_of(type(table)).items()}
    print(toml_text.dump(tables, comments), end="")


@contextmanager
def progress_bar(label: str) -> Iterator[Callable[[float], None]]:
    """Show the share of the work that is done on standard error where that is a terminal, and nothing elsewhere."""
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(label, total=1.0)
        yield lambda share: bar.update(task, completed=share)
