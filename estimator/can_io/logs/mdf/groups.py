"""Groups of records of an ASAM MDF 4 file: CAN frames among them, and the layout of their values.

Names and meanings of the channels follow the standard ASAM MDF bus logging. Values are raw; only the conversion of
times is applied.
"""

from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from typing import NamedTuple

from estimator.can_io.logs.log import ERROR_FRAME, REMOTE_FRAME
from estimator.can_io.logs.mdf.blocks import BadMdfError, Block, MdfFile, UnreadMdfError

HEADER_AT = 64  # bytes, behind the identification
LOCAL_TIME = 1  # flag of the header: the start is a local time
VARIABLE, REMOTE_MASTER = 1, 8  # flags of a group: values of variable length; its times are in another group
FIXED, VARIABLE_LENGTH, MASTER, LIMITED_LENGTH, VIRTUAL = 0, 1, 2, 5, 6  # types of channels
ALL_INVALID, HAS_INVALIDATION = 1, 2  # flags of a channel
LINEAR, IDENTICAL = 1, 0  # conversions
UNSIGNED, REAL, BYTE_ARRAY = (0, 1), (4, 5), 10  # types of data; the second of two is big-endian
MAX_BYTE, MAX_ID_VALUE = 0xFF, 0xFFFE  # of a record's id
MAX_RECORD = 1 << 16  # bytes
FRAME = "CAN_DataFrame"
NEEDED, OPTIONAL = ("ID", "DataLength", "DataBytes"), ("IDE", "BusChannel")  # parts of a frame
OTHERS = {"CAN_ErrorFrame": ERROR_FRAME, "CAN_RemoteFrame": REMOTE_FRAME, "CAN_OverloadFrame": "overload frame"}


class Field(NamedTuple):
    """Position of a value in a record: its first byte, and its lowest bit in that byte; ``kind`` is its data type.

    ``values`` is the address of values of variable length, in which the field is an offset; 0 if the field is the
    value. A value that is equal in all records has no bits, and is given as ``constant``.
    """

    byte: int
    bit: int
    bits: int
    kind: int
    values: int = 0
    constant: int | None = None

    @property
    def end(self) -> int:
        """Byte after the value."""
        return self.byte + -(-(self.bit + self.bits) // 8)


class Times(NamedTuple):
    """Times of a group: their field, and the conversion t = raw * factor + offset [s]."""

    field: Field
    factor: float
    offset: float


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameGroup:
    """Group of records that are CAN frames.

    ``extended`` and the bus ``channel`` may be missing. ``times_at`` is the group with the times, usually this one.
    Each of the bits ``invalid``, if set, marks a value of the frame as invalid.
    """

    address: int
    times: Times
    times_at: int
    ident: Field
    extended: Field | None
    length: Field
    data: Field
    channel: Field | None = None
    invalid: tuple[Field, ...] = ()

    @property
    def needed(self) -> int:
        """Smallest size of a record with all values [bytes]."""
        fields = (self.ident, self.extended, self.length, self.data, self.channel, *self.invalid)
        own_times = self.times.field.end if self.times_at == self.address else 0
        return max(own_times, *(field.end for field in fields if field is not None))


@dataclass(frozen=True, slots=True, kw_only=True)
class Group:
    """Records of one kind: their id, size [bytes] and number according to the file, and their meaning.

    ``has_variable_size`` is True if each record states its size; ``skipped`` names the kind of frames without data.
    """

    address: int
    record_id: int
    record_bytes: int
    count: int
    has_variable_size: bool
    frames: FrameGroup | None
    skipped: str


class DataGroup(NamedTuple):
    """Groups whose records share a stream, distinguished by an id of ``id_bytes`` before each record."""

    address: int
    id_bytes: int
    data: int
    groups: tuple[Group, ...]


def start_time(file: MdfFile) -> float:
    """Start of the measurement [s since 1970], from which times count; a local time is read in this machine's zone.

    Raises
    ------
    BadMdfError
        There is no header, or the time is invalid.
    """
    nanoseconds, zone, summer, flags = file.block(HEADER_AT, b"##HD").values("QhhB")
    if flags & LOCAL_TIME:
        zone = summer = 0
    try:
        start = datetime.fromtimestamp(nanoseconds / 10**9, timezone(timedelta(minutes=zone + summer)))
        return start.replace(tzinfo=None).timestamp() if flags & LOCAL_TIME else start.timestamp()
    except (OverflowError, ValueError, OSError) as error:
        raise BadMdfError(HEADER_AT, f"a start time of {nanoseconds} ns") from error


def data_groups(file: MdfFile) -> list[DataGroup]:
    """Read all groups of records.

    Raises
    ------
    BadMdfError
        A block is damaged, or CAN frames are stored in an unknown way.
    """
    first = file.block(HEADER_AT, b"##HD").link(0)
    groups_of_data = []
    for block in file.chain(first, b"##DG"):
        groups = tuple(_group(file, group_block) for group_block in file.chain(block.link(1), b"##CG"))
        (id_bytes,) = block.values("B")
        if id_bytes not in (0, 1, 2, 4, 8):
            raise BadMdfError(block.address, f"record ids of {id_bytes} bytes")
        if id_bytes == 1 and any(group.record_id > MAX_BYTE for group in groups):
            raise BadMdfError(block.address, "a record id of more than a byte")
        if id_bytes == 0 and len(groups) > 1:
            raise BadMdfError(block.address, "records of several groups without ids")
        groups_of_data.append(DataGroup(block.address, id_bytes, block.link(2), groups))
    return groups_of_data


def _group(file: MdfFile, block: Block) -> Group:
    record_id, count, flags, _, data_bytes, invalidation = block.values("QQHH4xLL")
    if record_id > MAX_ID_VALUE:
        raise UnreadMdfError(block.address, f"the record id {record_id} is over the {MAX_ID_VALUE} that can be read")
    size = data_bytes + invalidation
    variable = bool(flags & VARIABLE)
    names = {} if variable else _channels(file, block)
    frames = _frame_group(file, block, flags, names, data_bytes) if FRAME in names else None
    if frames is not None and not frames.needed <= size <= MAX_RECORD:
        raise BadMdfError(block.address, f"CAN frames in records of {size} bytes; their values end at {frames.needed}")
    return Group(
        address=block.address,
        record_id=record_id,
        record_bytes=size,
        count=count,
        has_variable_size=variable,
        frames=frames,
        skipped=next((reason for name, reason in OTHERS.items() if name in names), ""),
    )


def _channels(file: MdfFile, group: Block) -> dict[str, Block]:
    """Channels of a group by name, and the parts of its frames."""
    channels = {}
    for channel in file.chain(group.link(1), b"##CN"):
        name = file.text(channel.link(2))
        if channel.values("B")[0] == MASTER:
            channels[""] = channel
        channels[name] = channel
        if name == FRAME and channel.link(1):
            channels |= {file.text(part.link(2)): part for part in file.chain(channel.link(1), b"##CN")}
    return channels


def _frame_group(file: MdfFile, group: Block, flags: int, names: dict[str, Block], data_bytes: int) -> FrameGroup:
    times_at, masters = group.address, names
    if flags & REMOTE_MASTER and "" not in names:
        other = file.block(group.link(6), b"##CG")
        times_at, masters = other.address, _channels(file, other)
    parts = {name.removeprefix(f"{FRAME}."): channel for name, channel in names.items()}
    for name, where in (("", masters), *((name, parts) for name in NEEDED)):
        if name not in where:
            raise UnreadMdfError(group.address, f"CAN frames without {f'{FRAME}.{name}' if name else 'times'}")
    data = _field(parts["DataBytes"], FIXED, LIMITED_LENGTH, VARIABLE_LENGTH)
    if data.values == 0 and (data.kind != BYTE_ARRAY or data.bit or data.bits % 8):
        raise UnreadMdfError(group.address, f"{FRAME}.DataBytes of {data.bits} bits, data type {data.kind}")
    used = (names[FRAME], *(parts[name] for name in (*NEEDED, *OPTIONAL) if name in parts))
    return FrameGroup(
        address=group.address,
        times=_times(file, masters[""]),
        times_at=times_at,
        ident=_unsigned(file, parts["ID"]),
        extended=_unsigned(file, parts["IDE"]) if "IDE" in parts else None,
        length=_unsigned(file, parts["DataLength"]),
        data=data,
        channel=_unsigned(file, parts["BusChannel"]) if "BusChannel" in parts else None,
        invalid=tuple(dict.fromkeys(bit for channel in used for bit in _invalidation(channel, data_bytes))),
    )


def _field(channel: Block, *types: int) -> Field:
    kind, _, data, bit, byte, bits = channel.values("BBBBLL")
    if kind not in types or (kind == VARIABLE_LENGTH and not channel.link(5)):
        raise UnreadMdfError(channel.address, f"a value in a channel of type {kind}")
    if kind == VARIABLE_LENGTH:
        return Field(byte, 0, 64, UNSIGNED[0], channel.link(5))
    return Field(byte, bit, bits, data)


def _invalidation(channel: Block, data_bytes: int) -> list[Field]:
    """Bit of a record that marks the value of a channel as invalid; None if there is none."""
    flags, bit = channel.values("LL", 12)
    if flags & ALL_INVALID:
        return [Field(0, 0, 0, UNSIGNED[0], constant=1)]
    return [Field(data_bytes + bit // 8, bit % 8, 1, UNSIGNED[0])] if flags & HAS_INVALIDATION else []


def _unsigned(file: MdfFile, channel: Block) -> Field:
    if channel.values("B")[0] == VIRTUAL:
        return Field(0, 0, 0, UNSIGNED[0], constant=_constant(file, channel))
    field = _field(channel, FIXED)
    if field.kind not in UNSIGNED or not 0 < field.bits <= 64 - field.bit:
        raise UnreadMdfError(channel.address, f"an unsigned number of {field.bits} bits, data type {field.kind}")
    return field


def _constant(file: MdfFile, channel: Block) -> int:
    """Value of a virtual channel: the number of the record, converted to an equal value for all records."""
    conversion = file.block(channel.link(4), b"##CC") if channel.link(4) else None
    if conversion is not None and conversion.values("B") == (LINEAR,):
        value, factor = conversion.reals(24, 2)
        if factor == 0 and value in range(1 << 32):
            return int(value)
    raise UnreadMdfError(channel.address, "a virtual channel whose value is no constant")


def _times(file: MdfFile, channel: Block) -> Times:
    field = _field(channel, MASTER)
    real = field.kind in REAL and field.bits in (32, 64) and not field.bit
    if not real and (field.kind not in UNSIGNED or not 0 < field.bits <= 64 - field.bit):
        raise UnreadMdfError(channel.address, f"times of {field.bits} bits, data type {field.kind}")
    factor, offset = 1.0, 0.0
    if channel.link(4):
        conversion = file.block(channel.link(4), b"##CC")
        (kind,) = conversion.values("B")
        if kind == LINEAR:
            offset, factor = conversion.reals(24, 2)
        elif kind != IDENTICAL:
            raise UnreadMdfError(conversion.address, f"times with a conversion of type {kind}")
    return Times(field, factor, offset)
