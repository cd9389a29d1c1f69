"""What we send, as other J1939 software hears it: the kernel's own stack."""

import socket
import time

import can
import pytest
from made_estimates import MARGINAL, made_estimate

from estimator.can_io.counter_crc import verify
from estimator.can_io.j1939 import GLOBAL, TP_CM
from estimator.can_io.publisher import Publisher, output_database
from estimator.can_io.transport_sender import TransportSender
from estimator.can_io.trouble_codes import CONFIRM_S, DM1, DM2, TroubleCode, TroubleMemory, codes_of
from estimator.settings import Publish

pytestmark = pytest.mark.nightly

PGN_MASS = 0xFF61


def test_the_kernels_j1939_stack_hears_what_we_broadcast(buses):
    with (
        socket.socket(socket.PF_CAN, socket.SOCK_DGRAM, socket.CAN_J1939) as peer,
        can.Bus(interface="socketcan", channel=buses[0], ignore_config=True) as bus,
    ):
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        peer.bind((buses[0], socket.J1939_NO_NAME, socket.J1939_NO_PGN, socket.J1939_NO_ADDR))
        peer.settimeout(5.0)
        sent = Publisher(Publish(cvw=True)).poll(0.0, made_estimate())
        heard = {}
        for message in sent:
            bus.send(message)
            data, (_, _, pgn, source) = peer.recvfrom(64)
            heard[pgn, source] = data
    assert heard == {(m.arbitration_id >> 8 & 0x3FFFF, m.arbitration_id & 0xFF): bytes(m.data) for m in sent}
    assert len(heard) == 7
    layout = output_database().get_message_by_name("RoadloadMass")
    assert layout.decode(heard[PGN_MASS, 0xFB])["MassMean"] == pytest.approx(MARGINAL.mean, abs=1.01)
    assert all(verify(message) for message in sent if message.arbitration_id >> 8 & 0x3FFFF != 0xFE70)


@pytest.mark.parametrize(("pgn", "destination"), [(DM1, GLOBAL), (DM2, 0xF9)], ids=["to all", "to one node"])
def test_the_kernels_j1939_stack_puts_several_packets_together(buses, pgn, destination):
    codes = [TroubleCode(spn, 9) for spn in (84, 190, 513, 544, 516096)]
    memory = TroubleMemory()
    for t in (0.0, CONFIRM_S):
        memory.observe(codes, t)
    content = memory.message(DM1)
    sender = TransportSender()
    assert sender.send(destination, pgn, content)
    with (
        socket.socket(socket.PF_CAN, socket.SOCK_DGRAM, socket.CAN_J1939) as peer,
        can.Bus(interface="socketcan", channel=buses[0], ignore_config=True) as bus,
    ):
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        own = socket.J1939_NO_ADDR if destination == GLOBAL else destination
        peer.bind((buses[0], socket.J1939_NO_NAME, socket.J1939_NO_PGN, own))
        peer.settimeout(5.0)
        for now in iter(time.monotonic, None):
            for message in sender.poll(now, 0xFB):
                bus.send(message)
            while (heard := bus.recv(0.01)) is not None:
                if heard.arbitration_id >> 8 & 0x3FFFF == TP_CM | 0xFB:
                    sender.hear(heard.arbitration_id & 0xFF, bytes(heard.data), now)
            if sender.is_idle:
                break
        data, (_, _, group, source) = peer.recvfrom(64)
    assert (group, source, data) == (pgn, 0xFB, content)
    assert [code for code, _ in codes_of(data)] == codes
