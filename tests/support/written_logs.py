"""Messages of all kinds, logs of them as python-can writes them, and logs that are refused."""

import re
from collections.abc import Iterable
from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import strategies as st

from estimator.can_io.frames import Frames
from estimator.can_io.logs import open_log
from estimator.errors import LogError

FD_LENGTHS = [*range(9), 12, 16, 20, 24, 32, 48, 64]


@st.composite
def _message(draw: st.DrawFn, fd: bool, others: bool) -> can.Message:
    extended = draw(st.booleans())
    kind = draw(st.sampled_from(["data"] * 8 + ["error", "remote"] * others + ["fd"] * 4 * fd))
    length = draw(st.sampled_from(FD_LENGTHS if kind == "fd" else range(9)))
    return can.Message(
        arbitration_id=draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF)),
        is_extended_id=extended,
        is_fd=kind == "fd",
        is_error_frame=kind == "error",
        is_remote_frame=kind == "remote",
        dlc=length,
        data=draw(st.binary(min_size=length, max_size=length)) if kind in ("data", "fd") else None,
    )


@st.composite
def recorded(draw: st.DrawFn, fd: bool = True, others: bool = True) -> list[can.Message]:
    """Messages of one recording, the first a data frame, at times of whole microseconds from 2023 on."""
    first = can.Message(arbitration_id=0x18FEF100, is_extended_id=True, data=bytes(range(8)))
    messages = [first, *draw(st.lists(_message(fd, others), max_size=30))]
    t = 1_700_000_000_000_000
    for message in messages:
        t += draw(st.integers(0, 1_000_000))
        message.timestamp = t / 1e6
    return messages


def write(path: Path, messages: Iterable[can.Message]) -> None:
    with can.Logger(str(path)) as logger:
        for message in messages:
            logger(message)


def message_of(path: Path) -> str:
    with pytest.raises(LogError) as caught:
        for _ in open_log(path):
            pass
    text = str(caught.value)
    assert str(path) in text
    assert "\n" not in text
    return text


def assert_read_or_refused(path: Path, raw: bytes, rng: np.random.Generator, rounds: int) -> None:
    for _ in range(rounds):
        mutant = bytearray(raw)
        if rng.random() < 0.3:
            del mutant[rng.integers(len(raw)) :]
        else:
            for _ in range(rng.choice([1, 2, 20])):
                mutant[rng.integers(len(raw))] = rng.integers(256)
        path.write_bytes(mutant)
        try:
            frames = Frames.concatenate(list(open_log(path)))
        except LogError as error:
            assert re.match(re.escape(str(path)), str(error))  # noqa: PT017
            assert "\n" not in str(error)  # noqa: PT017
        else:
            assert len(frames)
