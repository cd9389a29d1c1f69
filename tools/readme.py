"""Compute the outputs that the README and that of examples/own_vehicle show, and write them there.

python tools/readme.py

``<!-- output of NAME -->`` stands above the block of an example.
"""

import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
README = ROOT / "README.md"
OWN_VEHICLE = ROOT / "examples" / "own_vehicle" / "README.md"
PROGRAM = re.compile(r"(?:\.venv/bin/)?roadload ")
BLOCK = re.compile(r"(?<=<!-- output of )(\w+)( -->\n+```\w*\n)(.*?)(?=```)", re.DOTALL)


def commands(page: str) -> list[list[str]]:
    """Arguments of every call of `roadload` in the shell blocks of ``page``, in order."""
    blocks = re.findall(r"```sh\n(.*?)```", page, re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines() if PROGRAM.match(line)]
    return [shlex.split(PROGRAM.sub("", line, count=1), comments=True) for line in lines]


def blocks(page: str) -> dict[str, str]:
    """The blocks of ``page`` that are outputs, by the name of their example."""
    return {name: text for name, _, text in BLOCK.findall(page)}


def output_of(command: list[str], folder: Path) -> list[str]:
    """Lines that a command with the present Python prints in ``folder``, without blank ones."""
    done = subprocess.run([sys.executable, *command], cwd=folder, check=True, stdout=subprocess.PIPE, text=True)
    return [line.rstrip() for line in done.stdout.splitlines() if line.strip()]


def demo(folder: Path) -> str:
    """The table of the demonstration, and the line that counts its frames."""
    return first_table("\n".join(output_of(["-m", "estimator", "demo"], folder)))


def first_table(printed: str) -> str:
    """What the demonstration prints to the end of its first table, without blank lines."""
    lines = [line.rstrip() for line in printed.splitlines() if line.strip()]
    last = next(i for i, line in enumerate(lines) if line.lstrip().startswith("C "))
    return "\n".join(lines[: last + 1])


def hills(folder: Path) -> str:
    """The diagnosis of the drive in hills: what is found, and the budget."""
    (folder / "out").mkdir(exist_ok=True)
    drive, diagnosis = (words for words in commands(README.read_text(encoding="utf-8")) if "out/hills.blf" in words)
    output_of(["-m", "estimator", *drive], folder)
    lines = output_of(["-m", "estimator", *diagnosis], folder)
    effect, budget, where = (
        next(i for i, line in enumerate(lines) if line.startswith(head)) for head in ("effect ", "residual  ", "where ")
    )
    return "\n".join([*lines[:effect], "...", *lines[budget:where]])


EXAMPLES: dict[str, Callable[[Path], str]] = {"demo": demo, "hills": hills}


def front_page(folder: Path) -> dict[str, str]:
    """The outputs that the README shows, by name."""
    return {name: output(folder) for name, output in EXAMPLES.items()}


def own_vehicle(folder: Path) -> dict[str, str]:
    """Outputs of the commands of examples/own_vehicle: what `init` writes, of `check`, of `estimate` to the road."""
    (folder / "out").mkdir()
    (folder / "examples").symlink_to(ROOT / "examples")
    page = OWN_VEHICLE.read_text(encoding="utf-8")
    found = {words[0]: "\n".join(output_of(["-m", "estimator", *words], folder)) for words in commands(page)}
    written = (folder / "out" / "van.toml").read_text(encoding="utf-8")
    return {
        "init": written[written.index("[signals]") :].strip(),
        "check": found["check"],
        "estimate": found["estimate"].partition("\nlag ")[0],
    }


PAGES: dict[Path, Callable[[Path], dict[str, str]]] = {README: front_page, OWN_VEHICLE: own_vehicle}


def main() -> int:
    """Rewrite the blocks."""
    for path, outputs in PAGES.items():
        with tempfile.TemporaryDirectory() as folder:
            found = outputs(Path(folder))

        def renewed(block: re.Match[str], found: dict[str, str] = found) -> str:
            return f"{block[1]}{block[2]}{found[block[1]]}\n"

        path.write_text(BLOCK.sub(renewed, path.read_text(encoding="utf-8")), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
