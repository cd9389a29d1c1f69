"""What waits between the daemon's threads, and our own frames that come back."""

import threading

import can
from hypothesis import given
from hypothesis import strategies as st

from estimator.can_io.frames import Frames
from estimator.daemon.reception.echoes import MAX_ECHOES, Echoes
from estimator.daemon.reception.inbox import Inbox

sizes = st.lists(st.integers(1, 40), max_size=60)


@given(sizes, st.integers(0, 100))
def test_what_does_not_fit_is_dropped_whole_and_counted(offered: list[int], most: int) -> None:
    inbox: Inbox[int] = Inbox(most)
    kept: list[int] = []
    for i, frames in enumerate(offered):
        if not kept or sum(offered[k] for k in kept) + frames <= most:
            kept.append(i)
        inbox.offer(i, frames)
    assert inbox.waiting == sum(offered[k] for k in kept)
    assert inbox.dropped == sum(offered) - inbox.waiting
    assert inbox.take() == kept
    assert inbox.waiting == 0
    assert inbox.take() == []


def test_there_is_room_again_after_taking() -> None:
    inbox: Inbox[str] = Inbox(10)
    inbox.offer("a", 10)
    inbox.offer("b", 1)
    inbox.take()
    inbox.offer("c", 10)
    assert inbox.take() == ["c"]
    assert inbox.dropped == 1


def test_a_batch_larger_than_the_queue_is_taken_where_nothing_waits() -> None:
    inbox: Inbox[str] = Inbox(10)
    inbox.offer("a", 11)
    inbox.offer("b", 1)
    assert inbox.take() == ["a"]
    assert inbox.dropped == 1


def test_waiting_ends_with_an_item_with_closing_and_with_patience() -> None:
    inbox: Inbox[str] = Inbox(10)
    assert inbox.wait(0.0)
    heard: list[bool] = []
    for wake in (lambda: inbox.offer("a", 1), inbox.close):
        waiter = threading.Thread(target=lambda: heard.append(inbox.wait(60.0)))
        waiter.start()
        wake()
        waiter.join(10.0)
        assert not waiter.is_alive()
        inbox.take()
    assert heard == [True, False]
    assert not inbox.wait(60.0)


def message(ident: int, data: bytes) -> can.Message:
    return can.Message(arbitration_id=ident, data=data, is_extended_id=True, timestamp=1.0)


def test_what_we_sent_is_taken_out_once_and_what_others_send_stays() -> None:
    echoes = Echoes()
    ours, theirs = message(0x18FF60FB, b"\x01\x02"), message(0x18FF60FB, b"\x01\x03")
    echoes.expect(ours)
    heard, own = echoes.split(Frames.from_messages([theirs, ours, ours]))
    assert [bytes(frame.data) for frame in heard.messages()] == [b"\x01\x03", b"\x01\x02"]
    assert [bytes(frame.data) for frame in own.messages()] == [b"\x01\x02"]
    assert len(echoes.split(Frames.from_messages([ours]))[0]) == 1


def test_only_the_latest_of_what_we_sent_is_remembered() -> None:
    echoes = Echoes()
    sent = [message(0x18FF60FB, i.to_bytes(2, "big")) for i in range(MAX_ECHOES + 5)]
    for each in sent:
        echoes.expect(each)
    heard, _ = echoes.split(Frames.from_messages(sent))
    assert [int.from_bytes(bytes(frame.data), "big") for frame in heard.messages()] == list(range(5))
