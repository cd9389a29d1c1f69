"""The estimate for an MQTT broker: its state, retained while it is valid, and whether this daemon is there.

Messages have quality of service 1 and a connection no memory: the broker confirms each one, the next report waits for
that, and nothing of one connection is repeated in the next. With MQTT 5 a message expires in the broker too.
"""

import socket
import ssl
import time
from collections.abc import Callable
from re import sub

from paho.mqtt.client import Client, ConnectFlags, DisconnectFlags, MQTTMessageInfo, MQTTv5, MQTTv311, error_string
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode

from estimator.answers.answer import encode
from estimator.answers.published import PublishedAnswer, Usability
from estimator.daemon.outputs.credentials import read_secret
from estimator.daemon.outputs.home_assistant import discovery, discovery_topic
from estimator.daemon.outputs.output import OutputError, Trouble
from estimator.errors import ConfigError
from estimator.settings import Mqtt

ONLINE, OFFLINE = b"online", b"offline"
TIMEOUT = 10.0  # s for a connection to be made, and for a message to be confirmed
TURN = 0.1  # s for which the network is waited for at a time
MAX_PACKETS = 20  # read in one turn: a broker that sends without end does not hold us up


class MqttChannel:
    """A connection to a broker, made anew each time with the secrets that the files then hold."""

    def __init__(self, settings: Mqtt, clock: Callable[[], float] = time.monotonic) -> None:
        port = settings.port or (8883 if settings.tls else 1883)
        self.address = f"mqtt {settings.host}:{port}"
        self.client_id = settings.client_id or sub("[^A-Za-z0-9_-]", "_", f"roadload-{socket.gethostname()}")[:64]
        self.state_topic, self.availability_topic = f"{settings.topic}/state", f"{settings.topic}/availability"
        self._settings, self._port, self._clock = settings, port, clock
        self._client: Client | None = None
        self._answer: ReasonCode | None = None  # to the request to connect
        self._goodbye: ReasonCode | None = None  # of a broker that ends the connection
        self._refused: ReasonCode | None = None  # of a message
        self._waiting: list[MQTTMessageInfo] = []  # messages that the broker has not confirmed
        self._waiting_since = 0.0  # [s]
        self._may_be_retained = True  # an earlier state, by us or a run before

    def open(self) -> None:
        """Connect, and say that we are there."""
        self._answer = self._goodbye = self._refused = None
        self._waiting, self._may_be_retained = [], True
        try:
            client = self._client = self._prepared()
            client.connect(self._settings.host, self._port, self._settings.keepalive_s)
        except (OSError, ConfigError) as error:
            raise OutputError(Trouble.UNREACHABLE, str(error)) from error
        self._turn_until(lambda: self._answer is not None, TIMEOUT)
        if self._answer is None:
            raise OutputError(Trouble.TIMED_OUT, f"no answer to the connection within {TIMEOUT:g} s")
        if self._settings.discovery_prefix is not None:
            content = discovery(
                self.client_id, self.state_topic, self.availability_topic, self._settings.expire_after_s
            )
            self._publish(discovery_topic(self._settings.discovery_prefix, self.client_id), content, retain=True)
        self._publish(self.availability_topic, ONLINE, retain=True)
        self._turn_until(lambda: not self._waiting, TIMEOUT)
        self._require_confirmation()

    def attend(self) -> None:
        """Read confirmations, and ping when it is time."""
        for _ in range(MAX_PACKETS):
            before = len(self._waiting)
            self._turn(0.0)
            if len(self._waiting) == before:
                break
        self._require_confirmation()

    def send(self, report: PublishedAnswer) -> bool:
        """Publish the state; a state without an estimate is not retained, and an earlier one is no longer."""
        if self._waiting:
            return False
        is_valid = report.status is Usability.ESTIMATED
        if not is_valid and self._may_be_retained:
            self._publish(self.state_topic, b"", retain=True)
        self._publish(self.state_topic, encode(report), retain=is_valid, expires=True)
        self._may_be_retained = is_valid
        return True

    def withdraw(self, timeout: float) -> None:
        """Take the state back, and say that we are gone; the broker's last will is for other ends."""
        if self._client is None:
            return
        self._publish(self.state_topic, b"", retain=True)
        self._publish(self.availability_topic, OFFLINE, retain=True)
        self._turn_until(lambda: not self._waiting, timeout)
        self._client.disconnect()

    def close(self) -> None:
        """Close the socket; a broker that was not told of it sends the last will."""
        client, self._client = self._client, None
        if client is not None and (connection := client.socket()) is not None:
            client.on_disconnect = None
            connection.close()

    def _prepared(self) -> Client:
        """A client that is not connected yet."""
        settings = self._settings
        client = Client(
            CallbackAPIVersion.VERSION2,
            client_id=self.client_id,
            protocol=MQTTv5 if settings.protocol == "5" else MQTTv311,
            reconnect_on_failure=False,
        )
        client.connect_timeout = TIMEOUT
        client.on_connect, client.on_disconnect, client.on_publish = self._connected, self._ended, self._confirmed
        client.will_set(self.availability_topic, OFFLINE, qos=1, retain=True)
        if settings.username_file is not None:
            password = settings.password_file
            client.username_pw_set(
                read_secret(settings.username_file, "mqtt.username_file"),
                None if password is None else read_secret(password, "mqtt.password_file"),
            )
        if settings.tls:
            context = ssl.create_default_context(cafile=settings.ca_file)
            if settings.certificate_file is not None:
                context.load_cert_chain(settings.certificate_file, settings.key_file)
            client.tls_set_context(context)
        return client

    def _publish(self, topic: str, content: bytes, retain: bool, expires: bool = False) -> None:
        assert self._client is not None
        properties = None
        if expires and self._settings.protocol == "5":
            properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
            properties.MessageExpiryInterval = self._settings.expire_after_s
        if not self._waiting:
            self._waiting_since = self._clock()
        sent = self._client.publish(topic, content, qos=1, retain=retain, properties=properties)
        if sent.rc is not MQTTErrorCode.MQTT_ERR_SUCCESS:
            raise OutputError(Trouble.LOST, f"connection lost: {error_string(sent.rc)}")
        self._waiting.append(sent)

    def _require_confirmation(self) -> None:
        if self._refused is not None:
            raise OutputError(Trouble.REFUSED, f"the broker refuses a message: {self._refused}")
        if self._waiting and self._clock() - self._waiting_since >= TIMEOUT:
            raise OutputError(Trouble.TIMED_OUT, f"a message was not confirmed within {TIMEOUT:g} s")

    def _turn(self, timeout: float) -> None:
        """Read and write what the network takes."""
        assert self._client is not None
        code = self._client.loop(timeout)
        self._waiting = [message for message in self._waiting if not message.is_published()]
        if self._answer is not None and self._answer.is_failure:
            raise OutputError(Trouble.REFUSED, f"the broker refuses the connection: {self._answer}")
        if self._goodbye is not None and self._goodbye.is_failure:
            raise OutputError(Trouble.LOST, f"the broker ends the connection: {self._goodbye}")
        if code is MQTTErrorCode.MQTT_ERR_PROTOCOL:
            raise OutputError(Trouble.GARBAGE, "the answer is not MQTT")
        if code is not MQTTErrorCode.MQTT_ERR_SUCCESS and self._answer is None:
            raise OutputError(Trouble.REFUSED, f"closed before it was established: {error_string(code)}")
        if code is not MQTTErrorCode.MQTT_ERR_SUCCESS:
            raise OutputError(Trouble.LOST, f"connection lost: {error_string(code)}")

    def _turn_until(self, is_done: Callable[[], bool], timeout: float) -> None:
        deadline = self._clock() + timeout
        while not is_done() and self._clock() < deadline:
            self._turn(TURN)

    def _connected(
        self, client: Client, userdata: object, flags: ConnectFlags, code: ReasonCode, properties: Properties | None
    ) -> None:
        self._answer = code

    def _ended(
        self, client: Client, userdata: object, flags: DisconnectFlags, code: ReasonCode, properties: Properties | None
    ) -> None:
        if flags.is_disconnect_packet_from_server:
            self._goodbye = code

    def _confirmed(
        self, client: Client, userdata: object, mid: int, code: ReasonCode, properties: Properties | None
    ) -> None:
        if code.is_failure:
            self._refused = code
