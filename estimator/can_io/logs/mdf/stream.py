"""The bytes behind a data link of an ASAM MDF 4 file, whichever blocks they are spread over.

The link leads to a block of plain or packed bytes, or to a list of such blocks, which are followed one by one. As none
belongs to a stream twice, together they are no larger than the file.
"""

import struct
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from estimator.can_io.logs.mdf.blocks import HEAD, BadMdfError, Head, MdfFile, UnreadMdfError
from estimator.can_io.logs.mdf.unpacking import METHODS, TRANSPOSED, MissingPackageError, unpack

PLAIN = (b"##DT", b"##DV", b"##SD", b"##RD")  # records, columns of values, values of variable length
PACKED = b"##DZ"
LISTS = (b"##DL", b"##LD")
HEADER_LIST = b"##HL"
PACKED_HEAD = struct.Struct("<2sBxLQQ")  # kind of the original block, method, columns; bytes unpacked and packed
INVALIDATION = 1 << 31  # flag of ##LD: it also lists blocks of invalidation bits
PIECE = 1 << 20  # bytes of a plain block that are read at once


class Chunk(NamedTuple):
    """Some bytes of a stream, in order, or ``columns`` > 0 of a table one after the other; and where they lie."""

    raw: bytes | bytearray
    columns: int
    offset: int

    @property
    def rows(self) -> int:
        """Rows of the table whose columns are stored."""
        return len(self.raw) // self.columns

    def data(self) -> bytes | bytearray:
        """The bytes in order; what a table leaves over is stored behind it, in order."""
        if not self.columns:
            return self.raw
        whole = self.rows * self.columns
        table = np.frombuffer(self.raw, np.uint8, whole).reshape(self.columns, self.rows)
        return table.T.tobytes() + self.raw[whole:]


class Tail(NamedTuple):
    """What a logger that lost power may have left open: the last block's size, and the last list's links."""

    size: bool = False
    links: bool = False


def chunks(file: MdfFile, address: int, tail: Tail, largest: int) -> Iterator[Chunk]:
    """Bytes of the stream at a data link, in order.

    Parameters
    ----------
    file : MdfFile
        The file.
    address : int
        The link, 0 where there are none.
    tail : Tail
        What its writer left open.
    largest : int
        A packed block that holds more is refused [bytes].

    Raises
    ------
    BadMdfError
        A block is damaged or cut, after what could be read of it.
    """
    passed = 0
    blocks = _blocks(file, address, tail)
    following = next(blocks, 0)
    while here := following:
        head = file.head(here, *PLAIN, PACKED)
        try:
            following = next(blocks, 0)
            damage = None
        except BadMdfError as error:
            following, damage = 0, error
        passed += max(head.size, HEAD.size)
        if passed > file.size and not tail.size:
            raise BadMdfError(here, "blocks of data that are listed again and again")
        if head.kind == PACKED:
            yield from _unpacked(file, here, head, largest)
        else:
            yield from _plain(file, here, _end(file, here) if tail.size and not following else here + head.size)
        if damage is not None:
            raise damage


def _blocks(file: MdfFile, address: int, tail: Tail) -> Iterator[int]:
    """Addresses of the blocks with data."""
    if not address:
        return
    head = file.head(address, *PLAIN, PACKED, *LISTS, HEADER_LIST)
    if head.kind == HEADER_LIST:
        address = file.block(address, HEADER_LIST).link(0)
    elif head.kind not in LISTS:
        yield address
        return
    last = 0
    for block in file.chain(address, *LISTS):
        links = block.links[1:]
        if block.kind == b"##LD" and block.values("L")[0] & INVALIDATION:
            links = links[: len(links) // 2]
        for last in filter(None, links):
            yield last
        last = last or block.address
    if tail.links:
        yield from _unlisted(file, last)


def _unlisted(file: MdfFile, last: int) -> Iterator[int]:
    """Blocks that follow the last one that is listed, or the list if it is empty."""
    while True:
        size = file.head(last, *PLAIN, PACKED, *LISTS).size
        last += max(size, HEAD.size) + -size % 8
        try:
            file.head(last, *PLAIN, PACKED)
        except BadMdfError:
            return
        yield last


def _end(file: MdfFile, address: int) -> int:
    """Where a block of unknown size ends: at the next block, or with the file."""
    return min((known for known in file.known if known > address), default=file.size)


def _plain(file: MdfFile, address: int, end: int) -> Iterator[Chunk]:
    at = address + HEAD.size
    while at < end:
        data = file.bytes_at(at, min(PIECE, end - at))
        if not data:
            raise BadMdfError(file.size, f"the file ends inside a block of data that begins at byte {address}")
        yield Chunk(data, 0, at)
        at += len(data)


def _unpacked(file: MdfFile, address: int, head: Head, largest: int) -> Iterator[Chunk]:
    raw = file.bytes_at(address + HEAD.size, PACKED_HEAD.size)
    if len(raw) < PACKED_HEAD.size:
        raise BadMdfError(address, "the file ends inside the head of a packed block")
    _, method, columns, size, packed = PACKED_HEAD.unpack(raw)
    if method not in METHODS:
        raise UnreadMdfError(address, f"a block packed by the unknown method {method}")
    if size > largest:
        raise UnreadMdfError(address, f"a packed block of {size} bytes, of which {largest} can be read at once")
    is_transposed = bool(method & TRANSPOSED)
    if packed > head.size or (is_transposed and columns == 0):
        raise BadMdfError(address, f"a packed block of {packed} bytes in {head.size}, with {columns} columns")
    data = file.bytes_at(address + HEAD.size + PACKED_HEAD.size, packed)
    try:
        found, fault = unpack(method & ~TRANSPOSED, data, size, largest)
    except MissingPackageError as error:
        raise UnreadMdfError(address, f"a block packed with {error}", "pip install 'roadload[mf4]'") from error
    if not fault and len(found) != size:
        fault = f"hold {len(found)} bytes instead of {size}"
    if fault and is_transposed:
        found = b""
    if found:
        yield Chunk(found, columns if is_transposed else 0, address)
    if fault:
        raise BadMdfError(address, f"a packed block whose data {fault}")
