"""A written page in a browser: it loads nothing, says nothing on the console, and can be read at any width."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
TEXTS = "[...document.querySelectorAll('p, td, li, dd, .area span')]"
SMALL = f"{TEXTS}.filter(e => e.innerText && parseFloat(getComputedStyle(e).fontSize) < 10.5).map(e => e.innerText)"
OUTSIDE = """width => [...document.querySelectorAll('main *')].filter(e => !e.closest('.scroll, thead, svg')
    && e.getBoundingClientRect().right > width).map(e => e.className)"""


@contextmanager
def running() -> Iterator[Any]:
    """A Chromium; skips the test where there is none."""
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("no Chromium: apt-get install chromium")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--disable-background-networking"]
        )
        yield browser
        browser.close()


@contextmanager
def opened(browser: Any, path: Path, width: int, scheme: str = "light") -> Iterator[Any]:
    """A tab with the page at ``path``, of which all that any page owes is checked."""
    said: list[str] = []
    asked: list[str] = []
    tab = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
    tab.on("console", lambda message: said.append(message.text))
    tab.on("pageerror", lambda error: said.append(str(error)))
    tab.on("request", lambda request: asked.append(request.url))
    tab.goto(path.as_uri())
    assert (said, asked) == ([], [path.as_uri()])
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    assert tab.evaluate(SMALL) == []
    assert tab.evaluate(OUTSIDE, width) == []
    yield tab
    tab.close()
