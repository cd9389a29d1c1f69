"""What is in a log: inputs found and missing, their rates and gaps, and how much was not available."""

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from estimator.can_io.binding import bind, load_database
from estimator.can_io.decoder import Decoder
from estimator.can_io.frames import EXTENDED
from estimator.config import Config
from estimator.errors import MissingInputsError
from estimator.replay import Progress, estimate, read
from estimator.signals import Floats, Role

GAP_PERIODS = 10.0  # usual intervals without a reading that count as a gap
SHORTEST_GAP = 1.0  # s


@dataclass
class Input:
    """One bound signal as found in a log."""

    name: str
    times: list[Floats] = field(default_factory=list)
    values: list[Floats] = field(default_factory=list)

    def describe(self, end: float, start: float) -> dict[str, Any]:
        """Count, rate [Hz], share without a valid value, range in SI, and gaps as pairs of times [s]."""
        if not self.times:
            return {"signal": self.name, "readings": 0}
        t, value = np.concatenate(self.times), np.concatenate(self.values)
        period = float(np.median(np.diff(t))) if len(t) > 1 else float("inf")
        known = value[np.isfinite(value)]
        edges = np.append(t, end)
        long = np.diff(edges) > max(GAP_PERIODS * period, SHORTEST_GAP)
        gaps = [
            [round(float(edges[i] - start), 3), round(float(edges[i + 1] - start), 3)] for i in np.flatnonzero(long)
        ]
        return {
            "signal": self.name,
            "readings": len(t),
            "rate_Hz": round(1 / period, 3) if np.isfinite(period) and period > 0 else None,
            "not_available": round(1 - len(known) / len(t), 6),
            "minimum": float(known.min()) if len(known) else None,
            "maximum": float(known.max()) if len(known) else None,
            "gaps_s": gaps,
        }


def inspect(path: Path, config: Config, progress: Progress) -> dict[str, Any]:
    """Describe one log; never fails for what the log lacks, only for what cannot be read.

    Raises
    ------
    LogError
        The log cannot be read.
    """
    messages = bind(config, load_database(config.bus.dbc))
    bound = sorted((s.role, s.place, f"{m.name}.{s.signal.name}") for m in messages for s in m.signals)
    several = {role for role, place, _ in bound if place > 0}
    inputs = {(role, place): Input(name) for role, place, name in bound}

    def label(role: Role, place: int) -> str:
        return f"{role.value} {place + 1}" if role in several else role.value

    decoder, skipped = Decoder(messages), Counter[str]()
    idents: Counter[int] = Counter()
    start = end = 0.0
    for frames in read([path], progress, skipped):
        start = start if idents else float(frames.t[0])
        end = float(frames.t[-1])
        ids, counts = np.unique(frames.ident, return_counts=True)
        idents.update(dict(zip(ids.tolist(), counts.tolist(), strict=True)))
        for role, parts in decoder.decode(frames).items():
            for place, part in enumerate(parts):
                if len(part.t):
                    inputs[role, place].times.append(part.t)
                    inputs[role, place].values.append(part.value)
    try:
        final = estimate([path], config, progress).final
        verdict = {"status": final.status.value, "reason": final.reason, "coverage": final.coverage.fraction}
    except MissingInputsError as error:
        verdict = {"status": "unestimated", "reason": str(error), "coverage": 0.0}
    return {
        "log": str(path),
        "duration_s": round(end - start, 3),
        "frames": {
            "read": sum(idents.values()),
            "ids": len(idents),
            "used": decoder.used,
            "errors": dict(skipped + decoder.rejected + decoder.transport_rejected),
        },
        "sources": decoder.sources,
        "inputs": {label(*key): x.describe(end, start) for key, x in inputs.items() if x.times},
        "missing": {label(*key): x.name for key, x in inputs.items() if not x.times},
        "busiest": [
            {"id": f"{ident & ~EXTENDED:0{8 if ident & EXTENDED else 3}X}", "frames": count}
            for ident, count in idents.most_common(10)
        ],
        **verdict,
    }
