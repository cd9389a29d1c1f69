"""From python-can messages to batches of frames."""

from collections.abc import Iterable, Iterator

import can
from can.util import dlc2len

from estimator.can_io.frames import CLASSIC_BYTES, FD_BYTES, Frames
from estimator.can_io.logs.log import ERROR_FRAME, REMOTE_FRAME, Log

CHUNK = 8192  # messages packed at once
MAX_STANDARD_ID = 0x7FF
MAX_EXTENDED_ID = 0x1FFFFFFF


class MessageLog(Log):
    """A log whose frames come as python-can messages."""

    def _pack(self, messages: Iterable[can.Message]) -> Iterator[Frames]:
        """Count error and remote frames, check the others, and yield them in batches.

        Raises
        ------
        ValueError
            At a message that no bus can carry.
        """
        held: list[can.Message] = []
        for message in messages:
            if kind := kind_of(message):
                self.skipped[kind] += 1
            else:
                check_message(message)
                held.append(message)
            if len(held) == CHUNK:
                yield Frames.from_messages(held)
                held.clear()
        yield Frames.from_messages(held)


def kind_of(message: can.Message) -> str:
    """What kind of frame without data a message is, empty for a data frame."""
    if message.is_error_frame:
        return ERROR_FRAME
    is_empty = message.is_fd and message.dlc == 0  # which the reader of .asc calls remote
    return REMOTE_FRAME if message.is_remote_frame and not is_empty else ""


def check_message(message: can.Message) -> None:
    """Raise ValueError if a data message is none that a bus can carry, e.g. because its line was cut short."""
    if not 0 <= message.arbitration_id <= (MAX_EXTENDED_ID if message.is_extended_id else MAX_STANDARD_ID):
        raise ValueError(f"expected a CAN id, found {message.arbitration_id:X}")
    found, expected = len(message.data), message.dlc
    if message.is_fd and found != expected:
        expected = dlc2len(expected)  # .trc gives the code, others the length
    elif found == CLASSIC_BYTES:
        expected = min(expected, CLASSIC_BYTES)  # codes 9 to 15 mean 8 bytes too
    if found != expected or found > FD_BYTES:
        raise ValueError(f"expected {min(expected, FD_BYTES)} data bytes, found {found}")
