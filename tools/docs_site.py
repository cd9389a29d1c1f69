"""A hook of MkDocs: links to files of the repository that are no pages of the site become plain text.

A page links to source files and to the README as ``[text](../README.md)``, which a reader of the repository can follow.
The site does not hold these files.
"""

import re
from posixpath import dirname, normpath
from typing import Any

LINK = re.compile(r"(?<!!)\[([^\]]*)\]\((?!https?:)([^)\s#]+)(?:#[^)\s]*)?\)")  # text, path; not of an image


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Text of a page, as MkDocs asks for it."""
    return within_site(markdown, page.file.src_uri)


def within_site(markdown: str, name: str) -> str:
    """Text of the page ``name`` without links to folders, and to files outside of the folder of pages."""

    def shown(link: re.Match[str]) -> str:
        target = normpath(f"{dirname(name) or '.'}/{link[2]}")
        is_folder = "." not in target.rpartition("/")[2]
        return link[1] if target.startswith("..") or is_folder else link[0]

    return LINK.sub(shown, markdown)
