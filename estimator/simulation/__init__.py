"""Simulation of a truck on a road, and of the signals that its control units send.

A drive obeys ``P = A v + C v^3 + m v a`` exactly, except for the requested effects::

    from estimator.simulation.recording import simulate
    from estimator.simulation.sensors import Sensors
    from estimator.simulation.truck import draw_truck

    recording = simulate(
        draw_truck(rng), "highway", 4500.0, rng,                        # kind of road, duration [s]
        shape="out-and-back",                                           # or "one-way", "loop"
        effects={"grade": 0.012, "auxiliary_cycling": None},            # None: the usual magnitude
        sensors=Sensors(speed_noise=0.008, torque_resolution=0.01, without=frozenset({Role.HEADING})),
    )
    frames = frames_of(recording.signals)                               # of estimator.can_io.j1939_encoder
    recording.truth.effect_power["grade"]                               # [W], on recording.truth.t

`effects.catalogue.KINDS` lists the effects with unit, usual magnitude, plausible range, and their names in the
diagnosis (``known_as``; None: in no catalogue). An `effects.effect.Effect` can also have a span or a direction.
`truth.Truth` holds the true quantities, and the power of each effect. `sensors.Sensors` holds the nuisances, and
`sensors.OPTIONAL` the signals a bus may lack. Nothing here uses the formulas of the model under test.
"""
