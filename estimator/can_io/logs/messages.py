"""Selection of python-can messages that are data frames which a bus can carry."""

import can
from can.util import dlc2len

from estimator.can_io.frames import CLASSIC_BYTES, FD_BYTES
from estimator.can_io.logs.log import ERROR_FRAME, REMOTE_FRAME

MAX_STANDARD_ID = 0x7FF
MAX_EXTENDED_ID = 0x1FFFFFFF


def kind_of(message: can.Message) -> str:
    """Kind of a message that is a frame without data; empty for a data frame."""
    if message.is_error_frame:
        return ERROR_FRAME
    is_empty = message.is_fd and message.dlc == 0  # which the reader of .asc calls remote
    return REMOTE_FRAME if message.is_remote_frame and not is_empty else ""


def check_message(message: can.Message) -> None:
    """Raise ValueError if no bus can carry a data message, e.g. because its line was cut."""
    if not 0 <= message.arbitration_id <= (MAX_EXTENDED_ID if message.is_extended_id else MAX_STANDARD_ID):
        raise ValueError(f"expected a CAN id, found {message.arbitration_id:X}")
    length, expected = len(message.data), message.dlc
    if message.is_fd and length != expected:
        expected = dlc2len(expected)  # .trc gives the code, others the length
    elif length == CLASSIC_BYTES:
        expected = min(expected, CLASSIC_BYTES)  # codes 9 to 15 mean 8 bytes too
    if length != expected or length > FD_BYTES:
        raise ValueError(f"expected {min(expected, FD_BYTES)} data bytes, found {length}")
