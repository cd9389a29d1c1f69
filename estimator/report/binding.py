"""Signals that a configuration binds, for `roadload check` without a log."""

from collections.abc import Iterable

from estimator.answers.binding import BindingAnswer, BoundInput
from estimator.can_io.binding import BoundMessage, BoundSignal
from estimator.can_io.frames import EXTENDED
from estimator.config import Config
from estimator.signals import Role


def of_binding(config: Config, messages: Iterable[BoundMessage], remarks: Iterable[str], reason: str) -> BindingAnswer:
    """Bound signals by role, numbered where a role has several, in the order of the configuration.

    ``reason`` why the model cannot be fed, or empty.
    """
    bound = {
        (signal.role, signal.place): _input(message, signal, config)
        for message in messages
        for signal in message.signals
    }
    several = {role for role, place in bound if place}
    order = [Role(role) for role in config.binding]
    keys = sorted(bound, key=lambda key: (order.index(key[0]), key[1]))
    return BindingAnswer(
        inputs={f"{role} {place + 1}" if role in several else role.value: bound[role, place] for role, place in keys},
        reason=reason,
        remarks=tuple(remarks),
    )


def _input(message: BoundMessage, bound: BoundSignal, config: Config) -> BoundInput:
    signal = bound.signal
    path = f"{message.name}.{signal.name}"
    if message.by_pgn:
        ident = f"PGN {message.key:04X}"
    else:
        ident = f"id {message.key & ~EXTENDED:0{8 if message.key & EXTENDED else 3}X}"
    return BoundInput(
        signal=path,
        message=ident,
        unit=config.bus.units.get(path, signal.unit),
        range="" if signal.minimum is None or signal.maximum is None else f"{signal.minimum:g} .. {signal.maximum:g}",
        on=None if bound.states is None else bound.states.on,
    )
