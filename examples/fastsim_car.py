"""Diagnose the residual of a simulator: a car in fastsim, driven with a load that its model does not have.

python examples/fastsim_car.py [SEED]        (pip install "fastsim>=3.1,<4")

The measured power of the engine is that of the same car, with 1.5 kW taken by the air conditioning and noise. A
candidate's column is the difference of two runs of the simulator, and so is that of the mass, which would be fitted
anew.
"""

import sys
from typing import Any

import fastsim
import numpy as np

from estimator import Axis, Candidate, diagnose_residual
from estimator.signals import Floats

AIR_CONDITIONING, NOISE = 1500.0, 300.0  # W
MASS, AUXILIARIES, DRAG, ROLLING = "mass_kilograms", "pwr_aux_base_watts", "drag_coef", "wheel_rr_coef"


def history(changes: dict[str, float]) -> tuple[Floats, Floats, Floats]:
    """Time [s], speed [m/s] and power of the engine [W] (n,) over the UDDS cycle, some values of the car changed."""
    car: dict[str, Any] = fastsim.Vehicle.from_resource("2012_Ford_Fusion.yaml").to_dict()
    car["chassis"] |= {"glider_mass_kilograms": None, "cargo_mass_kilograms": None}
    for name, change in changes.items():
        part = car if name in car else car["chassis"]
        part[name] += change
    drive = fastsim.SimDrive(fastsim.Vehicle.from_dict(car), fastsim.Cycle.from_resource("udds.csv"))
    drive.run()
    vehicle = drive.to_dict()["veh"]
    engine = vehicle["pt_type"]["Conv"]["fc"]["history"]
    power = np.add(engine["pwr_prop_watts"], engine["pwr_aux_watts"])
    columns = (vehicle["history"]["time_seconds"], vehicle["history"]["speed_ach_meters_per_second"], power)
    t, v, P = (np.array(column, dtype=float)[1:] for column in columns)
    return t, v, P


def main(arguments: list[str]) -> None:
    """Print the verdict, the candidates and the budget."""
    rng = np.random.default_rng(int(arguments[0]) if arguments else 1)
    t, v, predicted = history({})
    measured = history({AUXILIARIES: AIR_CONDITIONING})[2] + rng.normal(0.0, NOISE, len(t))

    def column(name: str, step: float) -> Floats:
        """Change of the power (n,) per unit of a value of the car."""
        changed: Floats = (history({name: step})[2] - predicted) / step
        return changed

    candidates = {
        "auxiliaries": Candidate(column(AUXILIARIES, 500.0), sd=1000.0, unit="W"),
        "rolling resistance": Candidate(column(ROLLING, 1e-3), sd=1e-3),
        "drag": Candidate(column(DRAG, 0.03), sd=0.05),
    }
    mass = column(MASS, 50.0)[:, None]
    axes = {"speed": Axis(v, "m/s")}
    found = diagnose_residual(measured - predicted, candidates, t, rng=rng, base=mass, along=axes, unit="W")
    print(f"{found.verdict.value}: {', '.join(found.named)}")
    for suspect in found.suspects:
        print(f"{suspect.name}: P = {suspect.probability:.3f}, {suspect.value:.4g} ± {suspect.sd:.2g} {suspect.unit}")
    for part in (part for part in found.budget if part.share > 0.005):
        print(f"{100 * part.share:.0f} % ({100 * part.q05:.0f} .. {100 * part.q95:.0f}) {part.cause}")
    rms, held_out, noise = (f"{value:.0f} W" for value in (found.rms, found.held_out_rms, found.noise))
    print(f"residual {rms}, on left-out stretches {held_out} once named, noise {noise}")


if __name__ == "__main__":
    main(sys.argv[1:])
