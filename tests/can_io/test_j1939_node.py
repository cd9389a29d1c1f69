"""The J1939 node: claims, gives way, answers, refuses, and is never drawn into a flood."""

import heapq
from itertools import count

import can
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.can_io.counter_crc import verify
from estimator.can_io.foreign_senders import COLLISION_HOLD, CVW, CVW_HOLD, ForeignSenders
from estimator.can_io.frames import Frames
from estimator.can_io.j1939_name import Name
from estimator.can_io.j1939_node import ANSWER_BURST, ANSWER_RATE, CLAIM_BURST, CLAIM_RATE, FREE, NULL, Node
from estimator.can_io.publisher import Publisher
from estimator.errors import ConfigError
from estimator.settings import Publish

OURS = Name(identity=1000, manufacturer=500, function=130)
STUBBORN = Name(identity=1000, manufacturer=500, function=130, arbitrary_address_capable=0)
LOWER, HIGHER = 5, (1 << 64) - 1
CLAIM, REQUEST, ACK = 0xEE, 0xEA, 0xE8  # PDU formats


def frame(pdu_format: int, source: int, data: bytes, destination: int = 0xFF) -> can.Message:
    ident = 6 << 26 | pdu_format << 16 | destination << 8 | source
    return can.Message(arbitration_id=ident, data=data, is_extended_id=True)


def claim(source: int, name: int) -> can.Message:
    return frame(CLAIM, source, name.to_bytes(8, "little"))


def request(pgn: int, source: int = 0x33, destination: int = 0xFF) -> can.Message:
    return frame(REQUEST, source, pgn.to_bytes(3, "little"), destination)


def new(name: Name = OURS, address: int = 0xFB, answer=lambda pgn, requester: None) -> Node:
    return Node(name, address, np.random.default_rng(1), answer)


def listed(message: can.Message | None) -> list[can.Message] | None:
    return None if message is None else [message]


def echo(message: can.Message) -> can.Message:
    """A message as our own bus gives it back."""
    return can.Message(arbitration_id=message.arbitration_id, data=message.data, is_extended_id=True, is_rx=False)


def put(node: Node, messages: list[can.Message], t: float) -> list[can.Message]:
    """Let messages of the node pass over the bus at once."""
    for message in messages:
        assert node.hear(echo(message), t) == []
    return messages


def settled(**arguments) -> Node:
    node = new(**arguments)
    put(node, node.poll(0.0), 0.0)
    node.poll(0.3)
    assert node.address is not None
    return node


def kind(message: can.Message) -> int:
    return message.arbitration_id >> 16 & 0xFF


def sender(message: can.Message) -> int:
    return message.arbitration_id & 0xFF


# The NAME


@given(st.integers(0, (1 << 64) - 1))
def test_a_name_survives_its_bytes(number):
    data = number.to_bytes(8, "little")
    assert bytes(Name.from_bytes(data)) == data
    assert int(Name.from_bytes(data)) == number


def test_fields_stand_where_they_belong():
    assert (
        int(
            Name(
                identity=0x1FFFFF,
                manufacturer=0,
                ecu_instance=0,
                function_instance=0,
                function=0,
                reserved=0,
                vehicle_system=0,
                vehicle_system_instance=0,
                industry_group=0,
                arbitrary_address_capable=0,
            )
        )
        == 0x1FFFFF
    )
    assert (
        int(
            Name(
                identity=0,
                manufacturer=1,
                ecu_instance=0,
                function_instance=0,
                function=0,
                reserved=0,
                vehicle_system=0,
                vehicle_system_instance=0,
                industry_group=0,
                arbitrary_address_capable=0,
            )
        )
        == 1 << 21
    )
    assert (
        int(
            Name(
                identity=0,
                manufacturer=0,
                ecu_instance=0,
                function_instance=0,
                function=1,
                reserved=0,
                vehicle_system=0,
                vehicle_system_instance=0,
                industry_group=0,
                arbitrary_address_capable=0,
            )
        )
        == 1 << 40
    )
    assert int(
        Name(
            identity=0,
            manufacturer=0,
            ecu_instance=0,
            function_instance=0,
            function=0,
            reserved=0,
            vehicle_system=0,
            vehicle_system_instance=0,
            industry_group=1,
            arbitrary_address_capable=1,
        )
    ) == (1 << 60) | (1 << 63)


def test_a_field_that_does_not_fit_is_named():
    with pytest.raises(ConfigError, match=r"manufacturer = 2048: give 0\.\.2047"):
        Name(identity=0, manufacturer=2048)


# Claiming


def test_the_claim_stands_after_a_quarter_of_a_second():
    node = new()
    assert node.address is None
    sent = node.poll(10.0)
    assert [(m.arbitration_id, bytes(m.data)) for m in sent] == [
        (0x18EAFFFE, bytes([0x00, 0xEE, 0x00])),
        (0x18EEFFFB, bytes(OURS)),
    ]
    put(node, sent, 10.0)
    assert node.poll(10.24) == []
    assert node.address is None
    assert node.poll(10.26) == []
    assert node.address == 0xFB


def test_the_quarter_of_a_second_begins_when_the_claim_has_been_on_the_bus():
    node = new()
    sent = node.poll(10.0)
    node.poll(10.4)
    assert node.address is None
    put(node, sent, 10.5)
    node.poll(10.74)
    assert node.address is None
    node.poll(10.76)
    assert node.address == 0xFB


def test_a_claim_that_has_not_been_on_the_bus_is_sent_again_and_counted():
    node = new()
    node.poll(10.0)
    assert node.poll(10.9) == []
    again = node.poll(11.1)
    assert [m.arbitration_id for m in again] == [0x18EEFFFB]
    assert node.counts["claim not confirmed"] == 1
    put(node, again, 11.1)
    assert node.poll(13.0) == []
    assert node.address == 0xFB


def test_the_claim_of_another_address_or_time_or_name_confirms_nothing():
    node = new()
    ours = node.poll(10.0)[-1]
    node.hear(echo(ours), 9.9)  # of the bus before it was opened anew
    node.hear(echo(claim(0xFC, int(OURS))), 10.1)
    node.hear(echo(claim(0xFB, HIGHER)), 10.1)
    node.poll(10.9)
    assert node.address is None


def test_a_lower_name_takes_the_address_and_we_the_next_free_one():
    node = settled()
    node.hear(claim(128, LOWER + 1), 0.4)
    sent = put(node, node.hear(claim(0xFB, LOWER), 0.5), 0.5)
    assert node.address is None
    assert [m.arbitration_id for m in sent] == [0x18EEFF81]
    node.poll(0.7)
    assert node.address is None
    node.poll(0.76)
    assert node.address == 129


def test_a_higher_name_is_told_off():
    node = settled()
    sent = node.hear(claim(0xFB, HIGHER), 0.5)
    assert [(m.arbitration_id, bytes(m.data)) for m in sent] == [(0x18EEFFFB, bytes(OURS))]
    assert node.address == 0xFB


def test_who_may_not_move_says_so_after_a_moment():
    node = settled(name=STUBBORN)
    assert node.hear(claim(0xFB, LOWER), 0.5) == []
    assert node.lost
    assert node.address is None
    sent = [m for i in range(17) for m in node.poll(0.5 + 0.01 * i)]
    assert [(m.arbitration_id, bytes(m.data)) for m in sent] == [(0x18EEFFFE, bytes(STUBBORN))]
    late = [*node.hear(request(0xEE00), 1.0), *(m for i in range(17) for m in node.poll(1.0 + 0.01 * i))]
    assert [sender(m) for m in late] == [NULL]
    assert node.hear(request(0xFF61, destination=0xFB), 2.0) == []


def test_delays_of_those_who_lost_differ():
    def delay(seed: int) -> float:
        node = Node(STUBBORN, 0xFB, np.random.default_rng(seed))
        node.poll(0.0)
        node.hear(claim(0xFB, LOWER), 0.0)
        return next(t for t in np.arange(0, 1, 0.001) if node.poll(t))

    delays = [delay(seed) for seed in range(40)]
    assert 0.0 <= min(delays) < 0.03
    assert 0.12 < max(delays) <= 0.154


def test_no_free_address_is_a_loss():
    node = settled()
    for address in FREE:
        node.hear(claim(address, LOWER + address), 1.0)
    node.hear(claim(0xFB, LOWER), 2.0)
    assert node.lost
    assert [sender(m) for m in node.poll(2.2)] == [NULL]


def test_an_address_that_its_owner_left_is_free():
    node = settled()
    node.hear(claim(128, LOWER), 1.0)
    node.hear(claim(200, LOWER), 1.1)
    sent = node.hear(claim(0xFB, LOWER + 1), 1.2)
    assert [sender(m) for m in sent] == [128]


def test_chased_through_every_address_it_gives_up_slowly():
    node, t, sent = new(), 0.0, []
    while not node.lost:
        t += 0.01
        sent += node.poll(t)
        if (target := max(map(sender, sent[-1:]), default=NULL)) != NULL:
            sent += node.hear(claim(target, LOWER + target), t)
    claims = [m for m in sent if kind(m) == CLAIM]
    assert len(claims) <= CLAIM_BURST + CLAIM_RATE * t
    assert {sender(m) for m in claims} == {0xFB, *FREE}


def test_an_equal_name_is_a_fault():
    node = settled()
    assert node.hear(claim(0x80, int(OURS)), 1.0) == []
    assert node.lost
    assert "at address 128, has our NAME" in node.fault
    assert node.hear(request(0xEE00), 2.0) == []
    assert node.poll(100.0) == []


@pytest.mark.parametrize("source", [0xFB, NULL])
def test_a_copy_of_our_own_claim_is_no_rival(source):
    node = settled()
    assert node.hear(claim(source, int(OURS)), 1.0) == []
    assert node.poll(2.0) == []
    assert node.address == 0xFB
    assert node.counts == {"own claim repeated": 1}


def test_what_is_heard_before_the_first_claim_counts():
    twin, late = new(), new()
    assert twin.hear(claim(0x80, int(OURS)), 0.0) == []
    assert twin.fault
    assert [sender(m) for m in late.hear(claim(0xFB, LOWER), 0.0)] == [NULL, 128]


def test_our_own_echo_is_no_other_node():
    node = new()
    put(node, node.poll(0.0), 0.01)
    node.poll(0.3)
    assert node.address == 0xFB
    assert not node.counts


def test_another_user_of_our_address_is_counted():
    node = settled()
    for _ in range(3):
        assert node.hear(can.Message(arbitration_id=0x18FEF1FB, data=bytes(8)), 1.0) == []
    assert node.counts["our address used by another"] == 3
    assert node.address == 0xFB


def test_an_address_out_of_range_is_refused():
    with pytest.raises(ConfigError, match="address 254"):
        new(address=254)


# Requests


@pytest.mark.parametrize("destination", [0xFF, 0xFB])
def test_a_request_for_the_claim_is_always_answered(destination):
    node = new()
    node.poll(0.0)
    assert [m.arbitration_id for m in node.hear(request(0xEE00, NULL, destination), 0.1)] == [0x18EEFFFB]


def test_what_we_do_not_have_is_refused_to_one_and_passed_over_for_all():
    node = settled()
    assert node.hear(request(0xFEE5), 1.0) == []
    assert node.hear(request(0xFEE5, destination=0x12), 1.0) == []
    assert node.hear(request(0xFEE5, source=NULL, destination=0xFB), 1.0) == []
    (refusal,) = node.hear(request(0xFEE5, source=0x33, destination=0xFB), 1.0)
    assert refusal.arbitration_id == 0x18E8FFFB
    assert bytes(refusal.data) == bytes([1, 0xFF, 0xFF, 0xFF, 0x33, 0xE5, 0xFE, 0x00])


def test_what_we_publish_is_sent_on_request():
    publisher = Publisher(Publish(cvw=True))
    node = settled(answer=lambda pgn, requester: listed(publisher.answer(pgn, 0.5, None)))
    publisher.poll(0.5, None)
    for pgn, destination in ((0xFF61, 0xFB), (0xFF60, 0xFF), (CVW, 0xFF)):
        (answer,) = node.hear(request(pgn, destination=destination), 1.0)
        assert answer.arbitration_id == 6 << 26 | pgn << 8 | 0xFB
        assert pgn == CVW or verify(answer)
    assert kind(node.hear(request(0xFF66, destination=0xFB), 1.0)[0]) == ACK


def test_nothing_is_answered_before_the_address_stands():
    node = new(answer=lambda pgn, requester: pytest.fail("asked too early"))
    node.poll(0.0)
    assert node.hear(request(0xFF61, destination=0xFB), 0.1) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("attack", "limit"),
    [
        (request(0xFEE5, destination=0xFB), ANSWER_BURST + ANSWER_RATE * 10),
        (request(0xEE00), CLAIM_BURST + CLAIM_RATE * 10),
        (claim(0xFB, HIGHER), CLAIM_BURST + CLAIM_RATE * 10),
    ],
    ids=["requests", "requests for claim", "claims"],
)
def test_a_flood_is_not_answered_with_a_flood(attack, limit):
    node = settled()
    sent = sum(len(node.hear(attack, 1 + 0.001 * i)) for i in range(10_000))
    assert limit / 2 < sent <= limit + 1
    assert sum(node.counts.values()) > 9000
    assert node.address == 0xFB
    # What is owed is paid once there is room: the address stays defended.
    assert len(node.poll(20.0)) <= 1
    assert node.poll(21.0) == []


# Whatever comes


idents = st.one_of(
    st.integers(0, (1 << 29) - 1),
    st.builds(
        lambda f, d, s: 6 << 26 | f << 16 | d << 8 | s,
        st.sampled_from([CLAIM, REQUEST, ACK, 0xFF]),
        st.sampled_from([0xFF, 0xFB, 0x61, 128]),
        st.sampled_from([0x33, 0xFB, 128, 129, NULL, 0xFF]),
    ),
)
payloads = st.one_of(
    st.binary(max_size=8),
    st.sampled_from([bytes(OURS), LOWER.to_bytes(8, "little"), HIGHER.to_bytes(8, "little"), b"\x00\xee\x00"]),
)
steps = st.tuples(st.floats(-2, 5), st.one_of(st.none(), st.tuples(idents, payloads, st.booleans(), st.booleans())))


@pytest.mark.slow
@settings(deadline=None, max_examples=300)
@given(st.lists(steps, max_size=60), st.sampled_from([OURS, STUBBORN]), st.integers(0, 253))
def test_any_traffic_at_any_time(sequence, name, address):
    value = 0xFF61

    def answer(pgn: int, requester: int) -> list[can.Message] | None:
        assert node.address is not None
        return [frame(0xFF, node.address, bytes(8), 0x61)] if pgn == value else None

    node = new(name, address, answer)
    t, latest, sent = 0.0, 0.0, []
    for step, content in sequence:
        t += step
        latest = max(latest, t)
        if content is None:
            out = node.poll(t)
        else:
            ident, data, remote, received = content
            message = can.Message(arbitration_id=ident, data=data, is_extended_id=True, is_rx=received)
            message.is_remote_frame = remote
            out = node.hear(message, t)
        assert not (node.lost and node.address is not None)
        assert not node.fault or out == []
        for reply in out:
            assert kind(reply) in (CLAIM, REQUEST) or sender(reply) == node.address is not None
        sent += out
    claims = sum(kind(m) == CLAIM for m in sent)
    assert claims <= CLAIM_BURST + CLAIM_RATE * latest + 1
    assert len(sent) - claims <= ANSWER_BURST + ANSWER_RATE * latest + 2


class Network:
    """A bus on which each message reaches each other node after its own delay."""

    def __init__(self, nodes: list[Node], starts: list[float], rng: np.random.Generator) -> None:
        self.nodes, self.starts, self.rng = nodes, starts, rng
        self.events: list[tuple[float, int, int, can.Message]] = []
        self.order = count()

    def run(self, until: float) -> None:
        for t in np.arange(0, until, 0.02):
            while self.events and self.events[0][0] <= t:
                at, _, target, message = heapq.heappop(self.events)
                if at >= self.starts[target]:
                    self.send(target, self.nodes[target].hear(message, at), at)
            for i, node in enumerate(self.nodes):
                if t >= self.starts[i]:
                    self.send(i, node.poll(float(t)), float(t))

    def send(self, origin: int, messages: list[can.Message], t: float) -> None:
        for message in messages:
            self.send(origin, self.nodes[origin].hear(echo(message), t), t)
            received = can.Message(arbitration_id=message.arbitration_id, data=message.data, is_extended_id=True)
            for target in range(len(self.nodes)):
                if target != origin:
                    at = t + self.rng.uniform(0.0005, 0.02)
                    heapq.heappush(self.events, (at, next(self.order), target, received))


@pytest.mark.slow
@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.tuples(st.sampled_from([0xFB, 128, 129, 247]), st.booleans()), min_size=2, max_size=5),
    st.integers(0, 1000),
)
def test_nodes_on_one_bus_end_with_different_addresses(wishes, seed):
    rng = np.random.default_rng(seed)
    identities = rng.permutation(len(wishes)).tolist()
    names = [
        Name(identity=i, manufacturer=500, arbitrary_address_capable=int(c))
        for i, (_, c) in zip(identities, wishes, strict=True)
    ]
    nodes = [Node(name, want, rng) for name, (want, _) in zip(names, wishes, strict=True)]
    Network(nodes, rng.uniform(0, 1, len(nodes)).tolist(), rng).run(4.0)
    addresses = [node.address for node in nodes if not node.lost]
    assert None not in addresses
    assert len(set(addresses)) == len(addresses)
    for node, name in zip(nodes, names, strict=True):
        assert not node.lost or not name.arbitrary_address_capable
    # The lowest NAME gets what it wants.
    lowest = min(range(len(nodes)), key=lambda i: int(names[i]))
    assert nodes[lowest].address == wishes[lowest][0]


# Neighbours


def batch(*idents: int, t: float = 100.0, extended: bool = True) -> Frames:
    return Frames.from_messages(
        can.Message(timestamp=t, arbitration_id=ident, data=bytes(8), is_extended_id=extended) for ident in idents
    )


def test_ids_of_ours_that_others_send_are_learnt():
    neighbours = ForeignSenders([0xFF60, 0xFF61])
    neighbours.watch(batch(0x18FF60FB, 0x0CFF6133, 0x18FEF1FB))
    assert neighbours.is_occupied(0xFF60, 0xFB, 101.0)
    assert not neighbours.is_occupied(0xFF61, 0xFB, 101.0)
    assert neighbours.senders(0xFF61, 101.0) == [0x33]
    assert neighbours.senders(0xFEF1, 101.0) == []
    assert not neighbours.is_occupied(0xFF60, 0xFB, 101.0 + COLLISION_HOLD)


def test_a_foreign_weight_is_one_too_many_whoever_sends_it():
    neighbours = ForeignSenders([0xFF60])
    assert not neighbours.is_occupied(CVW, 0xFB, 100.0)
    neighbours.watch(batch(0x18FE7021))
    assert neighbours.is_occupied(CVW, 0xFB, 100.0)
    assert neighbours.senders(CVW, 99.0 + CVW_HOLD) == [0x21]
    assert neighbours.senders(CVW, 101.0 + CVW_HOLD) == []


def test_eleven_bit_ids_are_nobodys_group():
    neighbours = ForeignSenders([0x0000])
    neighbours.watch(batch(0x7B, extended=False))
    assert neighbours.senders(0, 100.0) == []
