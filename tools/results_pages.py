"""Pages of the manual made of the records in results/: ``python tools/results_pages.py``; ``--check`` only compares.

results/NAME.md shows results/NAME.json: what is measured, the command, version and options, and the tables of the
check. In README and docs ``<!-- results of NAME NAME -->`` stands above the most important figures of these records,
and ``<!-- end of results -->`` below; "all" stands for every record.
"""

import argparse
import re
import sys
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from os.path import relpath
from pathlib import Path
from typing import Any

from harness.check import RESULTS, ROOT, Check, Table, cell, read_record

from estimator.errors import InputError

DOCS = ROOT / "docs"
NIGHTLY = ROOT / "tests" / "nightly"
MAX_ROWS = 40  # of a table on a page: those that have more are in the record alone
BLOCK = re.compile(r"(<!-- results of ([\w ]+) -->\n)(.*?)(?=<!-- end of results -->)", re.DOTALL)
# Checks without a record of the present version, and why.
EXCEPTIONS: dict[str, str] = {
    "attacks_vm": "it needs a virtual machine, for half an hour",
    "blind_peers": "its methods need an environment of their own (tools/peers/naming.txt)",
    "bench_sampler": "the other libraries need an environment of their own (tools/peers/samplers.txt)",
}


@cache
def checks() -> dict[str, Check]:
    """All checks by name."""
    sys.path += [str(NIGHTLY), str(NIGHTLY.parent / "support")]
    paths = [path for kind in ("check", "bench") for path in sorted(Path(__file__).parent.glob(f"{kind}_*.py"))]
    modules = [import_module(path.stem) for path in (*paths, NIGHTLY / "attacks_vm.py")]
    found = [each for x in modules for each in (x.CHECKS.values() if hasattr(x, "CHECKS") else [x.CHECK])]
    return {check.name: check for check in found}


def records() -> dict[str, dict[str, Any]]:
    """All records by the names of their files."""
    return {path.stem: read_record(path) for path in sorted(RESULTS.glob("*.json"))}


def title(name: str, record: dict[str, Any]) -> str:
    """Title of the page of a record; a further record of a check is told apart by its name."""
    check = checks()[record["check"]]
    return ", ".join(filter(None, (check.title, name.removeprefix(check.name).strip("_").replace("_", " "))))


def page(name: str, record: dict[str, Any]) -> str:
    """Text of the page of a record."""
    check, options = checks()[record["check"]], record["options"]
    prose = [part for part in check.about.strip().split("\n\n") if not part.startswith("    ")]
    command = f"    {check.command(options)} --out{'' if name == check.name else f' results/{name}.json'}"
    said = "; ".join(
        f"{key} {', '.join(map(str, x)) if isinstance(x, list) else cell(x)}" for key, x in options.items()
    )
    made = f"Version {', '.join(filter(None, (record['version'], record.get('date'))))}. Options: {said or 'none'}."
    older = [f"No later version was measured: {EXCEPTIONS[name]}."] if name in EXCEPTIONS else []
    parts = [f"<!-- made of results/{name}.json by tools/results_pages.py -->", f"# {title(name, record)}", *prose]
    return "\n\n".join([*parts, command, made, *older, *map(shown, check.tables(record["figures"]))]).rstrip() + "\n"


def shown(table: Table) -> str:
    """A table, or how many rows it has."""
    if len(table.rows) <= MAX_ROWS:
        return table.markdown().rstrip()
    return f"## {table.title}\n\n{len(table.rows)} rows, which the record has."


def overview(names: list[str], folder: Path) -> str:
    """The most important figures of records that have some, with links from a page in ``folder``."""
    rows = []
    for name in records() if names == ["all"] else names:
        record = read_record(RESULTS / f"{name}.json")
        check, link = checks()[record["check"]], Path(relpath(RESULTS / f"{name}.md", folder)).as_posix()
        figures = check.headline.text(check.tables(record["figures"]))
        rows += [[f"[{title(name, record)}]({link})", figures]] if figures else []
    return f"\n{Table('', ('what', 'result'), rows).markdown()}\n"


def pages() -> Iterator[tuple[Path, str]]:
    """Each page that shows records, and the text that it should have."""
    for name, record in records().items():
        yield RESULTS / f"{name}.md", page(name, record)
    for path in (ROOT / "README.md", *sorted(DOCS.glob("*.md"))):
        text = path.read_text(encoding="utf-8")
        for head, names, old in BLOCK.findall(text):
            text = text.replace(head + old, head + overview(names.split(), path.parent))
        yield path, text


def stale() -> dict[Path, str]:
    """The pages that differ from their records, with the text that they should have; empty where a record is gone."""
    gone = {path: "" for path in RESULTS.glob("*.md") if path.stem not in records()}
    return gone | {
        path: text for path, text in pages() if not path.exists() or path.read_text(encoding="utf-8") != text
    }


def main() -> int:
    """Renew the pages, or name those that differ."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; exit status 1 if a page differs")
    options = parser.parse_args()
    try:
        found = stale()
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_status
    for path, text in found.items():
        print(path.relative_to(ROOT))
        if not options.check:
            path.write_text(text, encoding="utf-8") if text else path.unlink()
    return int(options.check and bool(found))


if __name__ == "__main__":
    sys.exit(main())
