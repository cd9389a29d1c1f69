"""The outputs that a configuration names; their libraries are imported only then."""

from estimator.config import Config
from estimator.daemon.outputs.credentials import read_secret
from estimator.daemon.outputs.output import Channel
from estimator.errors import ConfigError
from estimator.extras import how_to_install


def check(settings: Config) -> None:
    """Refuse what can never work, before the daemon starts.

    Raises
    ------
    ConfigError
        A library is not installed, or a file cannot be used.
    """
    channels(settings)
    for table, named in (("mqtt", settings.mqtt), ("kuksa", settings.kuksa)):
        for key in ("username_file", "password_file", "token_file"):
            path = getattr(named, key, None)
            if path is not None:
                read_secret(path, f"{table}.{key}")


def channels(settings: Config) -> dict[str, tuple[Channel, float]]:
    """Channels, not yet open, by name, with the period of their reports [s].

    Raises
    ------
    ConfigError
        A library is not installed.
    """
    opened: dict[str, tuple[Channel, float]] = {}
    if settings.mqtt is not None:
        try:
            from estimator.daemon.outputs.mqtt import MqttChannel
        except ImportError as error:
            raise ConfigError(f"mqtt: needs paho-mqtt 2: {how_to_install('mqtt')}") from error
        opened["mqtt"] = MqttChannel(settings.mqtt), settings.mqtt.period_s
    if settings.kuksa is not None:
        try:
            from estimator.daemon.outputs.kuksa import KuksaChannel
        except (ImportError, RuntimeError) as error:  # RuntimeError: grpcio is older than the generated code
            raise ConfigError(f"kuksa: needs kuksa-client: {how_to_install('kuksa')} ({error})") from error
        opened["kuksa"] = KuksaChannel(settings.kuksa), settings.kuksa.period_s
    return opened
