"""Bytes of a data link of an ASAM MDF 4 file, which may be spread over several blocks.

The link leads to a block of plain or packed bytes, or to a list of such blocks, which are read one by one. As no block
belongs to a stream twice, together they are no larger than the file.
"""

import struct
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from estimator.can_io.logs.mdf.blocks import HEAD, BadMdfError, Head, MdfFile, UnreadMdfError
from estimator.can_io.logs.mdf.unpacking import METHODS, TRANSPOSED, MissingPackageError, unpack
from estimator.extras import how_to_install

PLAIN = (b"##DT", b"##DV", b"##SD", b"##RD")  # records, columns of values, values of variable length
PACKED = b"##DZ"
LISTS = (b"##DL", b"##LD")
HEADER_LIST = b"##HL"
PACKED_HEAD = struct.Struct("<2sBxLQQ")  # kind of the original block, method, columns; bytes unpacked and packed
INVALIDATION = 1 << 31  # flag of ##LD: it also lists blocks of invalidation bits
PIECE = 1 << 20  # bytes of a plain block that are read at once


class Chunk(NamedTuple):
    """Bytes of a stream and their offset in the file; if ``columns`` > 0, a table stored column by column."""

    raw: bytes | bytearray
    columns: int
    offset: int

    @property
    def rows(self) -> int:
        """Number of rows of the table."""
        return len(self.raw) // self.columns

    def data(self) -> bytes | bytearray:
        """Bytes in order; those beyond a whole table are stored after it, in order."""
        if not self.columns:
            return self.raw
        whole = self.rows * self.columns
        table = np.frombuffer(self.raw, np.uint8, whole).reshape(self.columns, self.rows)
        return table.T.tobytes() + self.raw[whole:]


class Tail(NamedTuple):
    """Parts that a logger without power may have left open: size of the last block, links of the last list."""

    size: bool = False
    links: bool = False


def chunks(file: MdfFile, address: int, tail: Tail, largest: int) -> Iterator[Chunk]:
    """Yield the bytes of the stream at a data link, in order.

    Parameters
    ----------
    file : MdfFile
        Open file.
    address : int
        Address of the link; 0 for an empty stream.
    tail : Tail
        Parts that the writer left open.
    largest : int
        Largest contents of a packed block that is accepted [bytes].

    Raises
    ------
    BadMdfError
        A block is damaged or cut; its readable bytes are yielded first.
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
    """Yield the addresses of the blocks with data."""
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
    """Yield the blocks after the last one that is listed, or after an empty list."""
    while True:
        size = file.head(last, *PLAIN, PACKED, *LISTS).size
        last += max(size, HEAD.size) + -size % 8
        try:
            file.head(last, *PLAIN, PACKED)
        except BadMdfError:
            return
        yield last


def _end(file: MdfFile, address: int) -> int:
    """End of a block of unknown size: the next block, or the end of the file."""
    return min((later for later in file.known if later > address), default=file.size)


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
        contents, fault = unpack(method & ~TRANSPOSED, data, size, largest)
    except MissingPackageError as error:
        raise UnreadMdfError(address, f"a block packed with {error}", how_to_install("mf4")) from error
    if not fault and len(contents) != size:
        fault = f"hold {len(contents)} bytes instead of {size}"
    if fault and is_transposed:
        contents = b""
    if contents:
        yield Chunk(contents, columns if is_transposed else 0, address)
    if fault:
        raise BadMdfError(address, f"a packed block whose data {fault}")
