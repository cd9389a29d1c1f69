"""Diagnose with an effect of your own among the candidates.

python examples/own_effect.py LOG [LOG ...]

A hydraulic pump that is always coupled to the engine takes a torque in proportion to the engine speed w, and so a power
k w^2. The effect states that power for a magnitude of 1; the diagnosis finds k, its sd, and whether the drives show it.
"""

import sys
from pathlib import Path

from estimator import Effect, diagnose_logs, load_config
from estimator.model.effects import View
from estimator.signals import Floats, Quantity


def pump_power(view: View, shape: object) -> Floats:
    """Power (n,) per unit of k: w^2 [rad^2/s^2]."""
    return view.context[Quantity.ENGINE_SPEED] ** 2


PUMP = Effect(
    name="hydraulic_pump",
    equation="k w^2",
    source="a pump that is always coupled to the engine",
    symbol="k",
    unit="N m s",
    power=pump_power,
    usual_magnitude=lambda road_load: 1.0,  # 22 kW at 1400 rpm
    needs=(Quantity.ENGINE_SPEED,),
    shown_by="the pressure of the hydraulic circuit on the bus",
)


def main(logs: list[str]) -> None:
    """Print the verdict and the effects found."""
    diagnosis = diagnose_logs([Path(log) for log in logs], load_config(), further=[PUMP])
    print(diagnosis.verdict.value)
    for found in diagnosis.effects:
        size = found.magnitude
        print(f"{found.name}: {size.name} = {size.value:.3g} ± {size.sd:.2g} {size.unit}")


if __name__ == "__main__":
    main(sys.argv[1:])
