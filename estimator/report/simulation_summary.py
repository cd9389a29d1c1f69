"""The answer of `roadload simulate`."""

from estimator.answers.simulation import ActiveEffect, SimulationAnswer, Truth
from estimator.simulation.effects.catalogue import kind_of
from estimator.simulation.recording import Recording


def of_recording(recording: Recording, log: str, frames: int, duration: float) -> SimulationAnswer:
    """The log that was written, of ``duration`` [s]; the truck, the effects asked for, the power of all others."""
    truth, truck = recording.truth, recording.truth.truck
    asked = {effect.name for effect in truth.effects}
    return SimulationAnswer(
        log=log,
        frames=frames,
        duration_s=duration,
        truth=Truth(mass_kg=truck.mass, A_N=truck.A, C_N_s2_m2=truck.C),
        effects=tuple(
            ActiveEffect(
                name=effect.name,
                known_as=kind_of(effect.name).known_as,
                magnitude=effect.magnitude,
                unit=kind_of(effect.name).unit,
                rms_kW=truth.rms_power(effect.name) / 1e3,
                active_s=tuple(truth.active.get(effect.name, ())),
            )
            for effect in truth.effects
        ),
        also_acting_kW={name: truth.rms_power(name) / 1e3 for name in truth.effect_power if name not in asked},
    )
