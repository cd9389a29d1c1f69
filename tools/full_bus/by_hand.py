"""A plain program with python-can and cantools, without estimate, reconnection and status."""

import json
import signal
import sys
import threading
import time
from pathlib import Path

import full_bus.small_install  # noqa: F401  # isort: skip  (before python-can)
import can
from cantools.database.can import Database

from full_bus.latency import Delays
from full_bus.loopback import LoopbackBus

DATABASE = Path(__file__).parents[2] / "dbc" / "j1939.dbc"
CHUNK = 4096  # delays collected between two additions to the histogram


def main(port: str, folder: str) -> None:
    """Decode known messages until SIGTERM; write counts and delays to the folder."""
    database = Database()
    database.add_dbc_file(DATABASE)
    layouts = {message.frame_id >> 8 & 0x3FFFF: message for message in database.messages}
    delays, waiting, count = Delays(), [], 0

    def decode(message: can.Message) -> None:
        nonlocal count
        count += 1
        waiting.append(time.time() - message.timestamp)
        if len(waiting) >= CHUNK:
            delays.add(waiting)
            waiting.clear()
        layout = layouts.get(message.arbitration_id >> 8 & 0x3FFFF)
        if layout is not None and layout.length <= len(message.data):
            layout.decode(bytes(message.data), decode_choices=False)

    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    with LoopbackBus(port) as bus:
        notifier = can.Notifier(bus, [decode])
        stop.wait()
        notifier.stop()
    delays.add(waiting)
    (Path(folder) / "result.json").write_text(json.dumps({"frames": count, "processed": delays.summary()}))


if __name__ == "__main__":
    main(*sys.argv[1:])
