"""State on disk that survives a loss of power at any instant: files are complete or missing, the one before is kept.

A file is a header, the key and compressed MessagePack; arrays are extensions of type, shape and bytes, the first byte
of every element first, because those are similar and compress well. A state contains no code. A file that another user
can write is refused.
"""

import os
import struct
import zlib
from collections.abc import Mapping
from contextlib import suppress
from hashlib import blake2b
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from estimator.errors import RoadloadError, StateError
from estimator.input_files import check_owner, read_own
from estimator.output_files import create

MAGIC = b"roadload"
SCHEMA = 14  # of the content; raise it when older states must not be read
MAX_BYTES = 256 * 2**20  # bytes of a file: a window of a million samples, and room
COMPRESSION_LEVEL = 1  # of zlib: a third smaller, in 50 ms for an hour of driving
HEADER = struct.Struct("<8sHHI16s")  # magic, schema, bytes of the key, bytes of the payload, checksum of all the rest
ARRAY = 1  # MessagePack extension
DTYPES = {np.dtype(code).str for code in "?bBhHiIqQefd"}  # of arrays: booleans, integers, floating-point numbers
MAX_NAME_CHARACTERS = 20  # characters of an unknown type that are shown
CURRENT, PREVIOUS = "state", "state.previous"
PART = ".part"


class StateStore:
    """Keeps the newest state and the one before in ``directory``, which belongs to this user and no one else writes."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._current, self._previous = directory / CURRENT, directory / PREVIOUS
        self._sound = False  # the current file is known to be whole: worth keeping as the previous one

    def save(self, state: Mapping[str, Any], key: str) -> None:
        """Write a state; when this returns it is on the disk, and until then the older ones are.

        Parameters
        ----------
        state
            Dictionaries, lists, numbers, strings and numpy arrays.
        key
            What the state belongs to: digests of vehicle, databases and configuration, as ``name=digest``.

        Raises
        ------
        RoadloadError
            The file cannot be written, or the state is too large.
        """
        content = pack(state, key)
        temporary = self._directory / f"{CURRENT}.{os.getpid()}{PART}"
        try:
            self._directory.mkdir(mode=0o700, exist_ok=True)
            self._check_directory()
            _write(temporary, content)
            if self._sound:
                os.replace(self._current, self._previous)
            os.replace(temporary, self._current)
            _sync(self._directory)
        except OSError as error:
            self._sound = False
            with suppress(OSError):  # where nothing could be written there is nothing to remove
                temporary.unlink()
            raise RoadloadError(f"{self._current}: state not saved: {error.strerror}") from error
        self._sound = True

    def load(self, key: str) -> tuple[dict[str, Any] | None, str]:
        """The newest whole state that was saved under ``key``, or None, and why it is not simply the newest.

        The reason is empty when all is well, as where none was saved yet. Leftovers of writers that were cut off are
        removed.
        """
        try:
            self._check_directory()
            for leftover in self._directory.glob(f"{CURRENT}.*{PART}"):
                with suppress(OSError):  # it is never read
                    leftover.unlink()
        except FileNotFoundError:
            return None, ""
        except (OSError, StateError) as error:
            return None, _reason(self._directory, error)
        reasons, missing = [], []
        for path in (self._current, self._previous):
            try:
                state = unpack(read_own(path, MAX_BYTES), key)
            except FileNotFoundError:
                missing.append(f"{path}: is missing")
            except (OSError, StateError) as error:
                reasons.append(_reason(path, error))
            else:
                self._sound = path == self._current
                worse = [*missing, *reasons]
                return state, "; ".join([*worse, "the previous state is used"]) if worse else ""
        return None, "; ".join(reasons)

    def _check_directory(self) -> None:
        check_owner(os.stat(self._directory))


def pack(state: Mapping[str, Any], key: str) -> bytes:
    """Content of a file.

    Raises
    ------
    RoadloadError
        It would be larger than MAX_BYTES.
    """
    name, content = key.encode(), msgspec.msgpack.encode(state, enc_hook=_encode)
    if HEADER.size + len(name) + len(content) > MAX_BYTES:
        raise RoadloadError(f"a state of {len(content)} bytes is too large to keep: make window.samples smaller")
    payload = zlib.compress(content, COMPRESSION_LEVEL)
    front = HEADER.pack(MAGIC, SCHEMA, len(name), len(payload), bytes(16))
    digest = _digest(front, name, payload)
    return b"".join([HEADER.pack(MAGIC, SCHEMA, len(name), len(payload), digest), name, payload])


def unpack(content: bytes, key: str) -> dict[str, Any]:
    """The state in the content of a file.

    Raises
    ------
    StateError
        It is not whole, of another schema, or saved under another key.
    """
    if len(content) < HEADER.size:
        raise StateError("is cut off")
    magic, schema, name_size, payload_size, digest = HEADER.unpack_from(content)
    if magic != MAGIC:
        raise StateError("is no saved state")
    if len(content) != HEADER.size + name_size + payload_size:
        raise StateError("is cut off")
    name, payload = content[HEADER.size :][:name_size], content[HEADER.size + name_size :]
    if digest != _digest(HEADER.pack(magic, schema, name_size, payload_size, bytes(16)), name, payload):
        raise StateError("is damaged: its checksum is wrong")
    if schema != SCHEMA:
        raise StateError(f"has schema {schema} instead of {SCHEMA}")
    if name != key.encode():
        changed = _changed(name.decode(errors="replace"), key)
        raise StateError(f"belongs to another vehicle, database or configuration{changed}")
    try:
        inflated = zlib.decompressobj().decompress(payload, MAX_BYTES)
        state: dict[str, Any] = msgspec.msgpack.decode(inflated, type=dict[str, Any], ext_hook=_decode)
    except (zlib.error, msgspec.MsgspecError, ValueError, OverflowError, RecursionError) as error:
        raise StateError(f"is not readable: {error}") from error
    return state


def _changed(then: str, now: str) -> str:
    """Clause that names the parts ``name=digest`` of two keys that differ; empty where they have none."""
    before, after = (dict(part.split("=", 1) for part in key.split() if "=" in part) for key in (then, now))
    names = sorted(name for name in before.keys() | after.keys() if before.get(name) != after.get(name))
    return f": changed in {', '.join(names)}" if names else ""


def _digest(*parts: bytes) -> bytes:
    digest = blake2b(digest_size=16)
    for part in parts:
        digest.update(part)
    return digest.digest()


def _encode(value: Any) -> Any:
    if isinstance(value, np.ndarray) and value.dtype.str in DTYPES:
        planes = np.frombuffer(value.tobytes(), np.uint8).reshape(-1, value.itemsize).T.tobytes()
        return msgspec.msgpack.Ext(ARRAY, msgspec.msgpack.encode((value.dtype.str, value.shape, planes)))
    raise TypeError(f"a state cannot hold a {type(value).__name__}")


def _decode(code: int, data: memoryview) -> Any:
    if code != ARRAY:
        raise ValueError(f"unknown extension {code}")
    name, shape, planes = msgspec.msgpack.decode(data, type=tuple[str, tuple[int, ...], bytes])
    if name not in DTYPES:
        raise ValueError(f"an array of the unknown type {name[:MAX_NAME_CHARACTERS]!r}")
    if any(length < 0 for length in shape):
        raise ValueError(f"an array of the shape {shape}")
    dtype = np.dtype(name)
    content = np.frombuffer(planes, np.uint8).reshape(dtype.itemsize, -1).T.tobytes()
    return np.frombuffer(content, dtype=dtype).reshape(shape).copy()


def _write(path: Path, content: bytes) -> None:
    descriptor = create(path, 0o600)
    with open(descriptor, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(descriptor)


def _sync(directory: Path) -> None:
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _reason(path: Path, error: OSError | StateError) -> str:
    return f"{path}: {error.strerror if isinstance(error, OSError) else error}"
