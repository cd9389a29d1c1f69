"""Estimate from recorded traffic, as a library.

python examples/offline_estimate.py LOG [LOG ...]
"""

import sys
from pathlib import Path

from estimator import estimate_logs, load_config


def main(logs: list[str]) -> None:
    """Print every update and the final parameters."""
    run = estimate_logs([Path(log) for log in logs], load_config())
    for update in run.updates:
        mass = "not yet" if update.mass is None else f"{update.mass.mean:.0f} ± {update.mass.sd:.0f} kg"
        print(f"{update.t - run.start:7.0f} s  {update.status.value}: {mass}")
    final = run.final
    if final.mass is None or final.A is None or final.C is None:
        print(f"no estimate: {final.reason}")
        return
    print(f"mass {final.mass.mean:.0f} ± {final.mass.sd:.0f} kg")
    print(f"A {final.A.mean:.0f} ± {final.A.sd:.0f} N")
    print(f"C {final.C.mean:.2f} ± {final.C.sd:.2f} N s²/m²")


if __name__ == "__main__":
    main(sys.argv[1:])
