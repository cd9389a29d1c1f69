"""Spoilt files and spoilt traffic, for a nightly run: tests/nightly/fuzz.py [--files 10000] [--frames 1000000].

Sound files of each format are spoilt at random and read. Each is read, or refused in one line, within 10 s and 500 MB;
whatever else happens is a fault. Files are read in processes of their own, so that a crash or a hang ends one of them
only. The corpus, tests/fuzz_corpus, keeps every file that was a fault, and small ones of up to 30 different refusals:
a run spoils these too, and the tests read them. Traffic is spoilt driving, transport sessions, claims, requests and
noise, through the daemon's loop. Exit status 1 if there was a fault.
"""

import argparse
import logging
import sys
import tempfile
from pathlib import Path

from fuzzing.bus import spoilt_traffic
from fuzzing.files import Found, fuzz_format
from fuzzing.formats import FORMATS

CORPUS = Path(__file__).resolve().parents[1] / "fuzz_corpus"


def main() -> int:
    """Fuzz, print what was found, return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", type=int, default=10_000, help="of each format (default: 10000), fewer of slow ones")
    parser.add_argument("--frames", type=int, default=1_000_000, help="on the bus (default: 1000000)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", choices=FORMATS, default=list(FORMATS), help="these formats")
    parser.add_argument("--corpus", type=Path, default=CORPUS)
    options = parser.parse_args()
    faults = 0
    with tempfile.TemporaryDirectory() as scratch:
        for name in options.only if options.files else ():
            found = fuzz_format(
                name, -(-options.files // FORMATS[name].cost), options.seed, options.corpus / name, Path(scratch)
            )
            faults += len(found.faults)
            print(_line(name, found), flush=True)
            for fault in found.faults:
                print(f"  fault: {fault}", flush=True)
    if options.frames:
        logging.disable()  # of thousands of refusals
        print(spoilt_traffic(options.frames, options.seed), flush=True)
    return int(faults > 0)


def _line(name: str, found: Found) -> str:
    slowest = f"slowest {found.slowest_s:.1f} s, most memory {found.memory_MB:.0f} MB"
    return f"{name}: {found.files:,} files, {found.read:,} read, {found.refused:,} refused; {slowest}"


if __name__ == "__main__":
    sys.exit(main())
