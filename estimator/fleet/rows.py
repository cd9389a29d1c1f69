"""Rows of the tables of a fleet."""

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np

from estimator.columns import Row, statistics
from estimator.estimates import Marginal, Status, drag_area
from estimator.fleet.drive_result import DriveResult, Segment
from estimator.fleet.grouping import Drive
from estimator.fleet.road import LearnedRoad
from estimator.fleet.run import Fleet
from estimator.fleet.vehicles import DRAG, ROLLING, Normal, VehicleResult
from estimator.road_map import COURSES, centre_of, place_of
from estimator.signals import Floats
from estimator.units import STANDARD_GRAVITY

MINUTE = 60.0  # s
DEGREE_DIGITS = 6  # 0.1 m


def drive_rows(fleet: Fleet) -> list[Row]:
    """Rows of `DRIVES`: one for each load of a drive, for each drive without a load, and for each rejected log."""
    masses = {vehicle.vehicle: iter(vehicle.masses) for vehicle in fleet.vehicles}
    rows: list[Row] = []
    for drive, result in zip(fleet.grouped.drives, fleet.results, strict=True):
        common = {
            "source": drive.sources[0],
            "files": len(drive.sources),
            "vehicle": drive.vehicle,
            "note": fleet.grouped.notes.get(drive.sources[0], ""),
            "verdict": result.verdict,
        }
        if not result.segments:
            status = "failed" if result.fault else Status.UNESTIMATED.value
            reason = result.fault or "no usable samples"
            minutes = (drive.end - drive.start) / MINUTE
            rows.append(common | {"status": status, "reason": reason, "start": drive.start, "minutes": minutes})
        for number, segment in enumerate(result.segments):
            joint = next(masses[drive.vehicle], None) if segment.mean else None
            rows.append(common | {"segment": number} | _segment_cells(segment, joint))
    for log in fleet.grouped.rejected:
        cells = {"source": log.source, "files": 1, "vehicle": log.vehicle, "start": log.start}
        rows.append(cells | {"status": log.status, "reason": log.reason})
    return sorted(rows, key=lambda row: (row["vehicle"], row["start"], row["source"], row.get("segment", 0)))


def _segment_cells(segment: Segment, joint: Marginal | None) -> dict[str, Any]:
    m, A, C = (segment.parameters[name] for name in ("m", "A", "C"))
    return {
        "start": segment.start,
        "minutes": segment.minutes,
        "status": segment.status,
        "reason": segment.reason,
        **statistics("mass_kg", m.posterior),
        **statistics("A_N", A.posterior),
        **statistics("C_N_s2_m2", C.posterior),
        "A_reason": A.reason,
        "C_reason": C.reason,
        **statistics("c_rr", segment.c_rr),
        **_drag_area(C.posterior, segment.air_density),
        **statistics("joint_mass_kg", joint),
    }


def vehicle_rows(fleet: Fleet, rate: float) -> list[Row]:
    """Rows of `VEHICLES`; a parameter is an outlier if its false-discovery rate is at most ``rate``."""
    rows: list[Row] = []
    by_vehicle: dict[str, list[tuple[Drive, DriveResult]]] = defaultdict(list)
    for drive, result in zip(fleet.grouped.drives, fleet.results, strict=True):
        by_vehicle[drive.vehicle].append((drive, result))
    for vehicle, q in zip(fleet.vehicles, fleet.q_values, strict=True):
        drives = by_vehicle[vehicle.vehicle]
        row: dict[str, Any] = {
            "vehicle": vehicle.vehicle,
            "drives": len(drives),
            "loads": sum(bool(segment.mean) for _, result in drives for segment in result.segments),
            "minutes": sum(segment.minutes for _, result in drives for segment in result.segments),
            "start": min(drive.start for drive, _ in drives),
            "end": max(drive.end for drive, _ in drives),
            "status": vehicle.status,
            **statistics("A_per_mass_N_kg", vehicle.rolling),
            "A_per_mass_reason": vehicle.reasons[ROLLING],
            "A_per_mass_q_value": float(q[ROLLING]),
            **statistics("C_N_s2_m2", vehicle.drag),
            "C_reason": vehicle.reasons[DRAG],
            "C_q_value": float(q[DRAG]),
            **statistics("c_rr", None if vehicle.rolling is None else vehicle.rolling.times(1 / STANDARD_GRAVITY)),
            **_drag_area(vehicle.drag, _newest_density(drives)),
            "outlier": ", ".join(_out_of_line(fleet, vehicle, q, rate)),
        }
        if vehicle.load is not None:
            row |= {"mass_kg_mean": vehicle.load[0], "mass_kg_sd": vehicle.load[1]}
            row |= {"A_per_mass_scatter_N_kg": vehicle.scatter[ROLLING], "C_scatter_N_s2_m2": vehicle.scatter[DRAG]}
        row |= _changes("trend", vehicle.trend) | _changes("winter", vehicle.winter)
        rows.append(row)
    return rows


def _drag_area(C: Marginal | None, density: float | None) -> dict[str, float]:
    """Columns of the drag area and of the density [kg/m^3] that was measured."""
    air = {} if density is None else {"air_density_kg_m3": density}
    return air | statistics("c_d_A_m2", None if C is None else drag_area(C, density))


def _newest_density(drives: Sequence[tuple[Drive, DriveResult]]) -> float | None:
    """Density of the air [kg/m^3] on the newest drive that measured it."""
    known = [(one.start, one.air_density) for _, result in drives for one in result.segments if one.air_density]
    return max(known)[1] if known else None


def _changes(kind: str, change: tuple[Normal, Normal] | None) -> dict[str, float]:
    """Columns of a change of A/m and C; none if no clock was set."""
    if change is None:
        return {}
    (rolling, rolling_sd), (drag, drag_sd) = change
    return {
        f"A_per_mass_{kind}_N_kg_mean": rolling,
        f"A_per_mass_{kind}_N_kg_sd": rolling_sd,
        f"C_{kind}_N_s2_m2_mean": drag,
        f"C_{kind}_N_s2_m2_sd": drag_sd,
    }


def _out_of_line(fleet: Fleet, vehicle: VehicleResult, q: Floats, rate: float) -> list[str]:
    words = []
    for i, (name, marginal) in enumerate(zip(("A/m", "C"), vehicle.compared, strict=True)):
        if marginal is not None and q[i] <= rate:
            middle = float(np.median([each.mean for v in fleet.vehicles if (each := v.compared[i]) is not None]))
            words.append(f"{name} {100 * (marginal.mean / middle - 1):+.0f} %")
    return words


def season_rows(fleet: Fleet) -> list[Row]:
    """Rows of `SEASONS`: one for each season of a vehicle."""
    return [
        {
            "vehicle": vehicle.vehicle,
            "season": season.season,
            "loads": season.loads,
            **statistics("A_per_mass_N_kg", season.rolling),
            **statistics("C_N_s2_m2", season.drag),
        }
        for vehicle, seasons in zip(fleet.vehicles, fleet.seasons, strict=True)
        for season in seasons
    ]


def effect_rows(fleet: Fleet) -> list[Row]:
    """Rows of `EFFECTS`: one for each effect that the diagnosis of a drive names."""
    return [
        {
            "source": drive.sources[0],
            "vehicle": drive.vehicle,
            "effect": effect.name,
            "probability": effect.probability,
            "log_bayes_factor": effect.log_bayes_factor,
            "magnitude": effect.quantity,
            "value": effect.magnitude,
            "sd": effect.sd,
            "unit": effect.unit,
        }
        for drive, result in zip(fleet.grouped.drives, fleet.results, strict=True)
        for effect in result.effects
    ]


def road_rows(road: LearnedRoad) -> list[Row]:
    """Rows of `ROAD`: one for each place."""
    row, column, octant = place_of(road.key)
    latitude, longitude = (np.round(np.degrees(angle), DEGREE_DIGITS) for angle in centre_of(row, column))
    columns = {
        "latitude": latitude,
        "longitude": longitude,
        "course": octant * (360.0 / COURSES),
        "slope_mean": road.slope,
        "slope_sd": road.sd,
        "slope_scatter": road.scatter,
        "passes": road.passes,
        "vehicles": road.vehicles,
    }
    return [
        dict(zip(columns, cells, strict=True)) for cells in zip(*(c.tolist() for c in columns.values()), strict=True)
    ]
