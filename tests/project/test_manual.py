"""The manual: short, in short sentences, its tutorials print what they show, and it builds as a site."""

import ast
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
from printed_text import NUMBER, assert_same
from project_paths import ROOT

DOCS = ROOT / "docs"
PAGES = {path.relative_to(DOCS).as_posix(): path.read_text(encoding="utf-8") for path in sorted(DOCS.rglob("*.md"))}
RESULTS = {f"results/{path.name}": path.read_text(encoding="utf-8") for path in sorted((ROOT / "results").glob("*.md"))}
TUTORIALS = [
    "tutorials/first_estimate.md",
    *(
        pytest.param(name, marks=pytest.mark.nightly)
        for name in ("tutorials/residual.md", "tutorials/fleet.md", "how_it_decides.md")
    ),
]
MAX_WORDS, MAX_WORDS_OF_A_SENTENCE = 20_000, 30
SAMPLED = 0.02  # relative difference of sampled numbers between machines
EXAMPLE = re.compile(r"```(sh|python)\n(.*?)```(?:\n\n```\n(.*?)```)?", re.DOTALL)  # language, code, printed text
PROSE_ENDS = re.compile(r"(?<=[.!?])[)\"*]*\s+(?=[^a-z])")
Shell = Callable[[str, str], str]


def sentences(page: str) -> list[str]:
    """Sentences of the paragraphs and list items of a page, without addresses of links."""
    text = re.sub(r"```.*?```|<!--.*?-->", "\n\n", page, flags=re.DOTALL)
    text = re.sub(r"^([|#]|:::|!\[|    ).*$", "", text, flags=re.MULTILINE)
    text = re.sub(r"\]\([^)]*\)", "]", text)
    paragraphs = re.split(r"\n\s*\n|\n(?=[*-] |\d+\. )", text)
    return [sentence for paragraph in paragraphs for sentence in PROSE_ENDS.split(paragraph)]


def assert_shown(printed: str, output: str) -> None:
    """Require the lines of ``printed`` in the output, in order; lines of three dots stand for others or none."""
    words, at = output.split(), 0
    names = [NUMBER.sub("0", word) for word in words]
    for part in re.split(r"^\.\.\.\n", printed, flags=re.MULTILINE):
        shown = [NUMBER.sub("0", word) for word in part.split()]
        found = next((i for i in range(at, len(words)) if names[i : i + len(shown)] == shown), None)
        assert found is not None, part
        at = found + len(shown)
        assert_same(" ".join(words[found:at]), part, rtol=SAMPLED)


@pytest.fixture(scope="module")
def shell(tmp_path_factory: pytest.TempPathFactory) -> Shell:
    """What the code of an example prints in a clone; the same code runs once."""
    clone = tmp_path_factory.mktemp("clone")
    (clone / "out").mkdir()
    program = clone / ".venv/bin/roadload"
    program.parent.mkdir(parents=True)
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m estimator "$@"\n')
    program.chmod(0o755)

    @cache
    def run(language: str, code: str) -> str:
        command = ["bash", "-ec", code] if language == "sh" else [sys.executable, "-c", code]
        environment = {**os.environ, "COLUMNS": "400", "PYTHONPATH": str(ROOT)}
        done = subprocess.run(command, cwd=clone, env=environment, check=True, stdout=subprocess.PIPE, text=True)
        return done.stdout

    return run


def test_the_manual_is_short() -> None:
    """Whatever stands between blanks counts."""
    assert sum(len(page.split()) for page in PAGES.values()) <= MAX_WORDS


@pytest.mark.parametrize("name", [*PAGES, *RESULTS])
def test_sentences_are_short(name: str) -> None:
    too_long = [text for text in sentences((PAGES | RESULTS)[name]) if len(text.split()) > MAX_WORDS_OF_A_SENTENCE]
    assert too_long == []


@pytest.mark.slow
@pytest.mark.parametrize("name", TUTORIALS)
def test_examples_print_what_the_page_shows(name: str, shell: Shell) -> None:
    examples = EXAMPLE.findall(PAGES[name])
    assert examples
    for language, code, printed in examples:
        assert_shown(printed, shell(language, code))


def test_examples_in_python_are_whole() -> None:
    """Test_readme parses the commands of all pages."""
    examples = [code for page in PAGES.values() for language, code, _ in EXAMPLE.findall(page) if language == "python"]
    assert len(examples) > 5
    for code in examples:
        ast.parse(code)


def test_a_changed_word_or_number_is_noticed() -> None:
    output = "estimated\nmass 14,156 kg\nA 791 N\nC 3.84\n"
    assert_shown("estimated\n...\nA 791 N\n...\n", output)
    for wrong in ("invalid\n...\n", "mass 14,956 kg\n", "...\nA 791 N\nmass 14,156 kg\n", "estimated\nA 791 N\n"):
        with pytest.raises(AssertionError):
            assert_shown(wrong, output)


def test_links_that_leave_the_site_are_text() -> None:
    import docs_site

    page = "[a](../tools/run.py#x) [b](road.md#how-well) [c](schema) [d](https://example.org) ![e](paper/e.png)"
    kept = "a [b](road.md#how-well) c [d](https://example.org) ![e](paper/e.png)"
    assert docs_site.within_site(page, "logs.md") == kept
    assert docs_site.within_site("[f](../road.md) [g](../../README.md)", "tutorials/a.md") == "[f](../road.md) g"
    assert docs_site.within_site("[h](../results/obd.md#cars)", "obd.md") == "[h](results/obd.md#cars)"
    assert docs_site.within_site("[h](../../results/obd.md)", "tutorials/a.md") == "[h](../results/obd.md)"


@pytest.mark.slow
def test_the_site_builds_strictly_and_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    """The one page of the copy with a broken link is complained about, and no other."""
    pytest.importorskip("mkdocs", reason="mkdocs is not installed: pip install 'roadload[docs]'")
    shutil.copytree(DOCS, tmp_path / "docs")
    limits = tmp_path / "docs" / "limits.md"
    limits.write_text(f"{PAGES['limits.md']}\n[nowhere](nowhere.md)\n", encoding="utf-8")
    for name in ("tools", "estimator", "results", "mkdocs.yml"):
        (tmp_path / name).symlink_to(ROOT / name)
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(build, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 1
    (complaint,) = [line for line in done.stderr.splitlines() if line.startswith("WARNING")]
    assert "nowhere.md" in complaint
    pages = {path.relative_to(tmp_path / "site").as_posix() for path in (tmp_path / "site").rglob("*.html")}
    assert {name.replace("README.md", "index.html").replace(".md", ".html") for name in PAGES} <= pages
    for name in pages:
        page = (tmp_path / "site" / name).read_text(encoding="utf-8")
        assert not re.search(r"<(?:script|img|iframe)[^>]*src=\"?(?:https?:)?//|<link[^>]*stylesheet[^>]*https?:", page)
    api = (tmp_path / "site" / "python_api.html").read_text(encoding="utf-8")
    assert "1 to 100 rows a second" in api  # of the docstring of from_table
