"""State on disk: what comes back is what was saved, or nothing and the reason."""

import os
import struct
import zlib
from contextlib import suppress
from hashlib import blake2b

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from estimator.checkpoint.store import CURRENT, MAX_BYTES, PREVIOUS, SCHEMA, StateStore, pack, unpack
from estimator.errors import RoadloadError, StateError

arrays = hnp.arrays(
    st.sampled_from([np.float64, np.int64, np.uint8, np.bool_]), hnp.array_shapes(min_dims=1, max_dims=3, min_side=0)
)
values = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(-(2**63), 2**64 - 1), st.floats(), st.text(), arrays),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(), inner, max_size=3)),
    max_leaves=8,
)


def same(a, b) -> bool:
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list):
        return len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and (a == b or (a != a and b != b))


@pytest.mark.slow
@given(st.dictionaries(st.text(), values, max_size=4), st.text(st.characters(exclude_categories=["Cs"])))
def test_what_goes_in_comes_out(state, key):
    assert same(unpack(pack(state, key), key), state)


@given(st.binary(max_size=200))
def test_any_bytes_are_refused_by_name(content):
    with pytest.raises(StateError):
        unpack(content, "k")


def test_generations(tmp_path):
    store = StateStore(tmp_path)
    assert store.load("k") == (None, "")
    for n in range(3):
        store.save({"n": n}, "k")
    assert store.load("k") == ({"n": 2}, "")
    assert sorted(os.listdir(tmp_path)) == [CURRENT, PREVIOUS]
    (tmp_path / CURRENT).unlink()
    state, reason = store.load("k")
    assert state == {"n": 1}
    assert reason == f"{tmp_path}/state: is missing; the previous state is used"


def test_a_damaged_newest_gives_way_and_does_not_become_the_previous(tmp_path):
    store = StateStore(tmp_path)
    for n in range(2):
        store.save({"n": n}, "k")
    (tmp_path / CURRENT).write_bytes(b"\0" * 1000)
    other = StateStore(tmp_path)
    state, reason = other.load("k")
    assert state == {"n": 0}
    assert "is no saved state; the previous state is used" in reason
    other.save({"n": 5}, "k")
    (tmp_path / CURRENT).unlink()
    assert StateStore(tmp_path).load("k")[0] == {"n": 0}


def test_both_damaged(tmp_path):
    store = StateStore(tmp_path)
    for n in range(2):
        store.save({"n": n}, "k")
    for name in (CURRENT, PREVIOUS):
        (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:-1])
    state, reason = StateStore(tmp_path).load("k")
    assert state is None
    assert reason.count("is cut off") == 2


def test_another_key_is_discarded(tmp_path):
    StateStore(tmp_path).save({"n": 1}, "truck 1")
    state, reason = StateStore(tmp_path).load("truck 2")
    assert state is None
    assert reason == f"{tmp_path}/state: belongs to another vehicle, database or configuration"


def test_what_differs_in_another_key_is_named(tmp_path):
    StateStore(tmp_path).save({"n": 1}, "vehicle=a1 bus=b prior=c road.map=d")
    _, reason = StateStore(tmp_path).load("vehicle=a2 bus=b prior=c2")
    assert reason.endswith("or configuration: changed in prior, road.map, vehicle")


def test_another_schema_is_discarded(tmp_path, monkeypatch):
    monkeypatch.setattr("estimator.checkpoint.store.SCHEMA", SCHEMA + 1)
    StateStore(tmp_path).save({"n": 1}, "k")
    monkeypatch.undo()
    assert StateStore(tmp_path).load("k")[1].endswith(f"has schema {SCHEMA + 1} instead of {SCHEMA}")


def test_lengths_that_lie(tmp_path):
    content = bytearray(pack({"n": 1}, "k"))
    struct.pack_into("<I", content, 12, 0xFFFFFFFF)
    with pytest.raises(StateError, match="cut off"):
        unpack(bytes(content), "k")


def test_a_state_too_large_is_not_written(tmp_path, monkeypatch):
    monkeypatch.setattr("estimator.checkpoint.store.MAX_BYTES", 1000)
    with pytest.raises(RoadloadError, match=r"window\.samples"):
        StateStore(tmp_path).save({"a": np.zeros(200)}, "k")
    assert not os.listdir(tmp_path)


def test_a_file_too_large_is_not_read(tmp_path):
    with (tmp_path / CURRENT).open("wb") as file:
        file.truncate(MAX_BYTES + 1)
    assert "too large" in StateStore(tmp_path).load("k")[1]


def test_what_cannot_be_stored_is_an_error_of_the_caller(tmp_path):
    with pytest.raises(TypeError, match="Generator"):
        StateStore(tmp_path).save({"a": np.random.default_rng(1)}, "k")


def forged(name: str, shape: list[int], planes: bytes = bytes(24)) -> bytes:
    """A whole file, with a right checksum, whose only array is as given."""
    array = msgspec.msgpack.Ext(1, msgspec.msgpack.encode((name, shape, planes)))
    payload = zlib.compress(msgspec.msgpack.encode({"a": array}))
    front = struct.pack("<8sHHI", b"roadload", SCHEMA, 1, len(payload))
    return front + blake2b(front + bytes(16) + b"k" + payload, digest_size=16).digest() + b"k" + payload


@pytest.mark.parametrize(
    "name", ["|O8", "O", "<q9", "???", "", "<M8[s]", "(2,)<f8", "|V8", "<U2", "<c16", "f8,f8", "x" * 999]
)
def test_objects_and_unknown_types_are_not_made_from_files(name):
    with pytest.raises(StateError, match="not readable: an array of the unknown type"):
        unpack(forged(name, [3]), "k")


@pytest.mark.parametrize("shape", [[4], [-1, 2], [2**64 - 1], [2**62, 4], [-3], []])
def test_shapes_that_lie(shape):
    with pytest.raises(StateError, match="not readable"):
        unpack(forged("<f8", shape), "k")
    assert unpack(forged("<f8", [3]), "k")["a"].tolist() == [0.0] * 3


@given(st.text(max_size=8), st.lists(st.integers(-(2**63), 2**63 - 1), max_size=3), st.binary(max_size=40))
def test_any_array_in_a_file_is_read_or_refused(name, shape, planes):
    with suppress(StateError):
        assert isinstance(unpack(forged(name, shape, planes), "k")["a"], np.ndarray)


def test_what_would_fill_the_memory_is_not_inflated(monkeypatch):
    content = pack({"a": np.zeros(10_000)}, "k")
    assert len(content) < 1000
    monkeypatch.setattr("estimator.checkpoint.store.MAX_BYTES", 1000)
    with pytest.raises(StateError, match="not readable"):
        unpack(content, "k")


# Who else may write there


@pytest.mark.parametrize("name", [".", CURRENT])
def test_what_everybody_may_write_is_not_trusted(tmp_path, name):
    store = StateStore(tmp_path)
    store.save({"n": 1}, "k")
    (tmp_path / name).chmod(0o777)
    state, reason = store.load("k")
    assert state is None
    assert "may be written by everybody" in reason
    if name == ".":
        with pytest.raises(StateError, match="everybody"):
            store.save({"n": 2}, "k")


def test_what_belongs_to_another_user_is_not_trusted(tmp_path, monkeypatch):
    StateStore(tmp_path).save({"n": 1}, "k")
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    assert "belongs to another user" in StateStore(tmp_path).load("k")[1]


def test_links_and_pipes_are_not_followed(tmp_path):
    StateStore(tmp_path).save({"n": 1}, "k")
    (tmp_path / CURRENT).rename(tmp_path / "elsewhere")
    (tmp_path / CURRENT).symlink_to(tmp_path / "elsewhere")
    assert StateStore(tmp_path).load("k")[0] is None
    (tmp_path / CURRENT).unlink()
    os.mkfifo(tmp_path / CURRENT)
    assert "is no file" in StateStore(tmp_path).load("k")[1]


def test_a_directory_is_made_for_its_owner_alone(tmp_path):
    StateStore(tmp_path / "new").save({"n": 1}, "k")
    assert (tmp_path / "new").stat().st_mode & 0o777 == 0o700
    assert (tmp_path / "new" / CURRENT).stat().st_mode & 0o777 == 0o600


def test_no_place_to_save_is_one_line(tmp_path):
    with pytest.raises(RoadloadError, match="state not saved: No such file or directory"):
        StateStore(tmp_path / "a" / "b").save({}, "k")
    (tmp_path / "file").touch()
    with pytest.raises(RoadloadError, match="state not saved"):
        StateStore(tmp_path / "file").save({}, "k")
    assert StateStore(tmp_path / "file").load("k")[0] is None


def test_a_full_disk_loses_nothing(tmp_path, monkeypatch):
    store = StateStore(tmp_path)
    store.save({"n": 1}, "k")

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(RoadloadError, match="No space left"):
        store.save({"n": 2}, "k")
    monkeypatch.undo()
    assert os.listdir(tmp_path) == [CURRENT]
    assert store.load("k") == ({"n": 1}, "")
    store.save({"n": 3}, "k")
    assert store.load("k") == ({"n": 3}, "")


def test_it_goes_on_when_its_files_are_taken_away(tmp_path):
    store = StateStore(tmp_path)
    store.save({"n": 1}, "k")
    (tmp_path / CURRENT).unlink()
    with pytest.raises(RoadloadError):
        store.save({"n": 2}, "k")
    store.save({"n": 3}, "k")
    assert store.load("k") == ({"n": 3}, "")
