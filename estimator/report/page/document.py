"""The frame of a page that opens offline: no script, nothing from a network, light or dark as the reader likes."""

import html
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import NamedTuple

from estimator.output_files import check_suffix, whole

FORMATS = (".html",)
POLICY = "default-src 'none'; style-src 'unsafe-inline'"  # the page may not load anything, whatever a log is called


class Section(NamedTuple):
    """A section, left out where its ``body`` is empty; name and title are plain text, the body is HTML."""

    name: str
    title: str
    body: str


def document(title: str, header: str, sections: Sequence[Section]) -> str:
    """The whole document; ``title`` is plain text, ``header`` is HTML."""
    there = [section for section in sections if section.body]
    links = "".join(f'<a href="#{one.name}">{one.title}</a>' for one in there)
    content = "".join(f'<section id="{one.name}"><h2>{one.title}</h2>{one.body}</section>' for one in there)
    style = resources.files("estimator.report.page").joinpath("page.css").read_text(encoding="utf-8")
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><meta name="color-scheme" '
        f'content="light dark"><title>{html.escape(title)}</title><style>{style}</style></head>'
        f"<body><main>{header}<nav aria-label='Sections'>{links}</nav>{content}</main></body></html>\n"
    )


def write_document(text: str, path: Path) -> None:
    """Write a document to ``path``, whole or not at all.

    Raises
    ------
    ConfigError
        The name does not end in ``.html``, or its folder is missing.
    RoadloadError
        The file cannot be written.
    """
    check_suffix(path, FORMATS)
    with whole(path) as file:
        # File names may hold bytes that are no text; they become question marks.
        file.write(text.encode("utf-8", "replace"))
