"""A hook of MkDocs: the pages of results are part of the site, and links to files that are not become plain text.

A page links to source files, to the README and to results as ``[text](../results/obd.md)``, which a reader of the
repository can follow.
"""

import re
from pathlib import Path
from posixpath import dirname, normpath, relpath
from typing import Any

RESULTS = Path(__file__).parents[1] / "results"
LINK = re.compile(r"(?<!!)\[([^\]]*)\]\((?!https?:)([^)\s#]+)(#[^)\s]*)?\)")  # text, path, anchor; not of an image
OF_RESULT = re.compile(r"\.\./(results/\w+\.md)")


def on_files(files: Any, *, config: Any) -> Any:
    """Files of the site, as MkDocs asks for them: with the pages of results, which stand beside their records."""
    from mkdocs.structure.files import File

    for path in sorted(RESULTS.glob("*.md")):
        files.append(File.generated(config, f"results/{path.name}", abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Text of a page, as MkDocs asks for it."""
    return within_site(markdown, page.file.src_uri)


def within_site(markdown: str, name: str) -> str:
    """Text of the page ``name`` without links to folders, and to files that the site does not hold."""
    folder = dirname(name) or "."

    def shown(link: re.Match[str]) -> str:
        target = normpath(f"{folder}/{link[2]}")
        if result := OF_RESULT.fullmatch(target):
            return f"[{link[1]}]({relpath(result[1], folder)}{link[3] or ''})"
        is_folder = "." not in target.rpartition("/")[2]
        return link[1] if target.startswith("..") or is_folder else link[0]

    return LINK.sub(shown, markdown)
