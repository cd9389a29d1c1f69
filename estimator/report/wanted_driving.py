"""The driving that is still wanted, in words: cells of the coverage map by speed and acceleration."""

from collections import Counter

from estimator.answers.run import Coverage, CoverageMap
from estimator.answers.status import Progress
from estimator.units import KMH

BAND = 20.0  # km/h of speed that are named together
STEADY, BRISK = 0.1, 0.5  # m/s^2 where accelerating begins, and where it is brisk
EMPTY, WANTED, BEGUN, OCCUPIED = range(4)  # states of a cell, in rising order
NAMED = 2  # kinds of driving in the sentence: those with most cells


def kind_of(acceleration: float) -> str:
    """Manner of driving at an acceleration [m/s^2]."""
    if acceleration < -STEADY:
        return "slowing down gently under power"
    if acceleration <= STEADY:
        return "steady"
    return "accelerating gently" if acceleration <= BRISK else "accelerating briskly"


def cell_states(cells: CoverageMap) -> dict[tuple[int, int], int]:
    """OCCUPIED, BEGUN or WANTED of each cell that was driven or is wanted."""
    states = dict.fromkeys(open_cells(cells), WANTED)
    for i, j, count in cells.rows:
        states[i, j] = OCCUPIED if count >= cells.needed else BEGUN
    return states


def open_cells(cells: CoverageMap) -> list[tuple[int, int]]:
    """The cells that are wanted and have not been filled since they were found."""
    filled = {(i, j) for i, j, count in cells.rows if count >= cells.needed}
    return [cell for cell in cells.wanted if cell not in filled]


def wanted(cells: CoverageMap) -> str:
    """``accelerating gently at 40 to 60 km/h (6 cells), steady at 60 to 80 km/h (3)``; empty where none is wanted."""
    counts: Counter[tuple[str, int]] = Counter()
    for i, j in open_cells(cells):
        speed = KMH * (i + 0.5) * cells.speed_step_m_s
        acceleration = cells.lowest_acceleration_m_s2 + (j + 0.5) * cells.acceleration_step_m_s2
        counts[kind_of(acceleration), int(speed // BAND)] += 1
    parts: list[str] = []
    for (kind, band), count in counts.most_common(NAMED):
        unit = "" if parts else " cell" if count == 1 else " cells"
        parts.append(f"{kind} at {band * BAND:.0f} to {(band + 1) * BAND:.0f} km/h ({count}{unit})")
    return ", ".join(parts)


def steps_to_estimate(progress: Progress, coverage: Coverage | None) -> str:
    """Samples, cells or coverage that the first estimate waits for; empty where there is enough of each."""
    needed = progress.needed
    if progress.samples < needed.samples:
        return f"{progress.samples:,} of {needed.samples:,} usable samples"
    if coverage is None or not coverage.available:
        return ""
    if coverage.occupied < needed.cells:
        return f"{coverage.occupied} of {needed.cells} cells of speed and acceleration"
    if coverage.fraction < needed.coverage:
        return f"coverage {100 * coverage.fraction:.0f} % of the {100 * needed.coverage:.0f} % needed"
    return ""
