"""Answers to OBD-II requests: the identifiers of ISO 15765-4, for eight ECUs (11 bits) or 256 (29 bits)."""

import numpy as np
from numpy.typing import NDArray

from estimator.can_io.frames import EXTENDED, Frames
from estimator.signals import Mask

STANDARD = 0x7E8  # of 11 bits: the first of eight
EXTENDED_ANSWER = EXTENDED | 0x18DAF100  # of 29 bits: from the address in the last byte to the tester, 0xF1
CURRENT_DATA = 0x41  # service 1, and 0x40 in an answer (ISO 15031-5)


def is_answer(ident: NDArray[np.uint32]) -> Mask:
    """Mask (n,) of the ids of answers."""
    answers: Mask = (ident & np.uint32(0xFFFFFFF8) == STANDARD) | (ident & np.uint32(0xFFFFFF00) == EXTENDED_ANSWER)
    return answers


def current_data(frames: Frames) -> int:
    """Number of frames that are single answers with current data, such as speed or torque."""
    answers = is_answer(frames.ident) & (frames.length > 2)
    answers &= (frames.data[:, 0] >> 4 == 0) & (frames.data[:, 1] == CURRENT_DATA)
    return int(np.count_nonzero(answers))
