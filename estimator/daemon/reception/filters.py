"""Kernel filters: of a full bus, only the wanted messages reach the process."""

from can.typechecking import CanFilter

from estimator.can_io.binding import BoundMessage, last_byte
from estimator.can_io.frames import CLASSIC_BYTES, EXTENDED
from estimator.can_io.j1939 import GLOBAL, PDU1_LIMIT, TP_CM, TP_DT
from estimator.can_io.j1939_node import ADDRESS_CLAIMED, FREE, REQUEST
from estimator.can_io.obd import EXTENDED_ANSWER, STANDARD
from estimator.can_io.publisher import output_groups

PDU1_MASK = 0x03FF0000  # of the id: without the destination address
PDU2_MASK = 0x03FFFF00
SOURCE_MASK = 0xFF
WHOLE_EXTENDED, WHOLE_STANDARD = 0x1FFFFFFF, 0x7FF


def input_filters(messages: list[BoundMessage]) -> list[CanFilter]:
    """Filters of the frames that are needed: bound messages, and packets that carry those of more than 8 bytes."""
    filters = [each for message in messages for each in _of_message(message)]
    if any(message.by_pgn and _length(message) > CLASSIC_BYTES for message in messages):
        filters += [of_group(pgn) for pgn in (TP_CM, TP_DT)]
    return filters


def node_filters(address: int) -> list[CanFilter]:
    """Filters of a node that wants ``address``: claims, requests, transport, and frames with its groups or its address.

    Its address may also be any of those that a node gives itself when it has lost the one it wants.
    """
    groups = [of_group(pgn) for pgn in (ADDRESS_CLAIMED, REQUEST, TP_CM, *sorted(output_groups()))]
    groups.append(_masked(TP_DT | GLOBAL, PDU2_MASK))  # with TP_CM: Commanded Address
    wanted: CanFilter = {"can_id": address, "can_mask": SOURCE_MASK, "extended": True}
    return [*groups, wanted, {"can_id": FREE.start, "can_mask": FREE.start, "extended": True}]


def of_group(pgn: int) -> CanFilter:
    """Any priority, source and, where there is one, destination."""
    return _masked(pgn, PDU1_MASK if pgn >> 8 & 0xFF < PDU1_LIMIT else PDU2_MASK)


def _of_message(message: BoundMessage) -> list[CanFilter]:
    if message.by_pgn:
        return [of_group(message.key)]
    if message.of_any_ecu:
        return [
            {"can_id": STANDARD, "can_mask": WHOLE_STANDARD & ~7, "extended": False},
            {"can_id": EXTENDED_ANSWER & ~EXTENDED, "can_mask": WHOLE_EXTENDED & ~0xFF, "extended": True},
        ]
    extended = bool(message.key & EXTENDED)
    mask = WHOLE_EXTENDED if extended else WHOLE_STANDARD
    return [{"can_id": message.key & ~EXTENDED, "can_mask": mask, "extended": extended}]


def _masked(pgn: int, mask: int) -> CanFilter:
    return {"can_id": pgn << 8, "can_mask": mask, "extended": True}


def _length(message: BoundMessage) -> int:
    """Bytes that it has: what is wanted of a broadcast may be in its first ones."""
    wanted = (last_byte(signal) for bound in message.signals for signal in (bound.signal, *bound.multiplexers))
    return max([message.length, *wanted])
