"""Estimate on a live bus from a program of your own, and broadcast the result on it.

    python examples/live_listener.py --interface socketcan --channel can0 [--config truck.toml] [--period 10]

`roadload run` does the same as a service: with a watchdog, a saved state and an address claim.
"""

import argparse
import time

import can

from estimator import Listener, load_config


def main(arguments: list[str] | None = None) -> None:
    """Print the newest estimate every period until the bus fails or the user interrupts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--interface", default="socketcan")
    parser.add_argument("--channel", default="can0")
    parser.add_argument("--config", metavar="FILE.toml")
    parser.add_argument("--period", type=float, default=10.0, metavar="s")
    options = parser.parse_args(arguments)
    with (
        can.Bus(interface=options.interface, channel=options.channel) as bus,
        Listener.of(load_config(options.config), send=bus.send) as listener,
        can.Notifier(bus, [listener]),
    ):
        while listener.failure is None:
            time.sleep(options.period)
            estimate = listener.latest
            if estimate is None or estimate.mass is None:
                print("no estimate yet", "" if estimate is None else estimate.reason)
            else:
                print(f"mass {estimate.mass.mean:.0f} kg, 90 % from {estimate.mass.q05:.0f} to {estimate.mass.q95:.0f}")


if __name__ == "__main__":
    main()
