"""The frame of a page that opens offline: no script, nothing from a network, light or dark as the reader likes."""

import html
from collections.abc import Sequence
from importlib import resources
from typing import NamedTuple

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
