"""Blocks of an ASAM MDF 4 file; a block has a head with kind and size, links to other blocks, then values.

Kinds and layouts as in the standard ASAM MDF 4.2; all numbers are little-endian.
"""

import os
import struct
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

HEAD = struct.Struct("<4s4xQQ")  # kind, size, number of links
MAX_BODY = 1 << 24  # bytes of a block that is read whole; a larger one is taken for damage
MAX_BLOCKS = 500_000  # in one chain; no writer makes as many
MAX_NAME = 1024  # bytes


class BadMdfError(ValueError):
    """Raised if the file violates the standard, at ``offset`` [bytes]."""

    def __init__(self, offset: int, reason: str) -> None:
        super().__init__(reason)
        self.offset = offset


class UnreadMdfError(BadMdfError):
    """Raised for a possibly valid file with a feature that is not supported; ``remedy`` says what to do."""

    def __init__(self, offset: int, reason: str, remedy: str = "export the log as .blf or .asc") -> None:
        super().__init__(offset, reason)
        self.remedy = remedy


class Head(NamedTuple):
    """Head of a block; ``size`` [bytes] is that of the whole block."""

    kind: bytes
    size: int
    links: int


class Block(NamedTuple):
    """Block that was read whole; a link is the address of another block, 0 for none."""

    kind: bytes
    address: int
    size: int
    links: tuple[int, ...]
    body: bytes

    def values(self, form: str, at: int = 0) -> tuple[int, ...]:
        """Read integers of the body, from the byte ``at`` on.

        Raises
        ------
        BadMdfError
            The body is too short.
        """
        layout = struct.Struct("<" + form)
        if len(self.body) < at + layout.size:
            raise BadMdfError(self.address, f"a block {shown(self.kind)} of {self.size} bytes")
        return layout.unpack_from(self.body, at)

    def reals(self, at: int, count: int) -> tuple[float, ...]:
        """Read floating-point numbers of the body; raises the error of `values`."""
        return self.values(f"{count}d", at)

    def link(self, index: int) -> int:
        """Link with this number; 0 if the block has fewer."""
        return self.links[index] if index < len(self.links) else 0


class MdfFile:
    """Reading access to the blocks of an open file.

    ``known`` are the addresses of the blocks read so far; ``consumed`` is the number of bytes read.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.size = os.fstat(file.fileno()).st_size
        self.known: set[int] = set()
        self.consumed = 0

    def bytes_at(self, address: int, count: int) -> bytes:
        """Read ``count`` bytes, or fewer at the end of the file."""
        self._file.seek(min(address, self.size))
        data = self._file.read(max(min(count, self.size - address), 0))
        self.consumed += len(data)
        return data

    def head(self, address: int, *kinds: bytes) -> Head:
        """Read the head of a block of one of the given kinds.

        Raises
        ------
        BadMdfError
            There is no such block.
        """
        raw = self.bytes_at(address, HEAD.size)
        if len(raw) < HEAD.size:
            raise BadMdfError(address, f"the file ends before a block {' or '.join(map(shown, kinds))}")
        head = Head(*HEAD.unpack(raw))
        if head.kind not in kinds:
            raise BadMdfError(address, f"no block {' or '.join(map(shown, kinds))} where one should be")
        self.known.add(address)
        return head

    def block(self, address: int, *kinds: bytes) -> Block:
        """Read a block of one of the given kinds whole.

        Raises
        ------
        BadMdfError
            There is no such block, it is cut, or its sizes are impossible.
        """
        head = self.head(address, *kinds)
        if not HEAD.size + 8 * head.links <= head.size <= MAX_BODY:
            raise BadMdfError(address, f"a block {shown(head.kind)} of {head.size} bytes with {head.links} links")
        raw = self.bytes_at(address + HEAD.size, head.size - HEAD.size)
        if len(raw) < head.size - HEAD.size:
            raise BadMdfError(address, f"the file ends inside a block {shown(head.kind)}")
        links = struct.unpack_from(f"<{head.links}Q", raw)
        return Block(head.kind, address, head.size, links, raw[8 * head.links :])

    def chain(self, address: int, *kinds: bytes) -> Iterator[Block]:
        """Yield the blocks of given kinds in a chain, where the first link of each leads to the next.

        Raises
        ------
        BadMdfError
            A block is invalid, or the chain has no end.
        """
        met: set[int] = set()
        while address:
            if address in met or len(met) == MAX_BLOCKS:
                raise BadMdfError(address, f"blocks {shown(kinds[0])} without end")
            met.add(address)
            block = self.block(address, *kinds)
            yield block
            address = block.link(0)

    def text(self, address: int) -> str:
        """Text of a block ``##TX``; empty for address 0."""
        if not address:
            return ""
        body = self.block(address, b"##TX", b"##MD").body[:MAX_NAME]
        return body.partition(b"\0")[0].decode(errors="replace")


def shown(kind: bytes) -> str:
    """Kind of a block, for an error message."""
    return kind.decode("ascii", "replace")
