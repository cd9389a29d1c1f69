"""Opening a bus with the options of python-can; errors that may pass are separated from permanent ones."""

import argparse
import errno
import ipaddress
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import can
import msgspec
from can.typechecking import CanFilter

from estimator.errors import ConfigError, RoadloadError
from estimator.settings import BusOptions

CONFIGURABLE = ("interface", "channel", "bitrate")
OPTIONS = ("interface", "channel", "bitrate", "fd", "data_bitrate", "timing")  # of `can.cli.add_bus_arguments`
PERMANENT_ERRORS = {  # errors of opening a socket that do not pass by waiting, with the remedy
    errno.EPERM: "no permission; let the service run as a user who may open it",
    errno.EACCES: "no permission; let the service run as a user who may open it",
    errno.EAFNOSUPPORT: "this kernel has no SocketCAN; load the module can",
    errno.EPROTONOSUPPORT: "this kernel has no raw CAN sockets; load the module can_raw",
}
INTERFACES = Path("/sys/class/net")
ARPHRD_CAN = 280  # type of a CAN network device (linux/if_arp.h)
B = TypeVar("B", bound=BusOptions)
MISSING = re.compile(r"missing \d+ required .*arguments?: (.*)")  # a TypeError of Python about a call
MAX_NAME_CHARACTERS = 15  # characters of a network device's name (IFNAMSIZ - 1)


class NotThereError(RoadloadError):
    """A bus cannot be opened now; later it may."""


@dataclass(frozen=True)
class BusSpec:
    """Which bus: keyword arguments of `can.Bus`, completed by python-can from can.conf and the environment."""

    options: dict[str, Any] = field(default_factory=dict)
    context: str | None = None

    @property
    def is_named(self) -> bool:
        """Whether any of it is named: by the command line, the configuration, can.conf or the environment."""
        if self.options or self.context is not None:
            return True
        try:
            can.util.load_config()
        except (can.CanError, ValueError):
            return False
        return True

    def resolved(self) -> dict[str, Any]:
        """All arguments, as `can.Bus` will see them.

        Raises
        ------
        ConfigError
            No interface is named, or none that python-can knows, or a device or group that cannot exist.
        """
        try:
            found: dict[str, Any] = dict(can.util.load_config(config=dict(self.options), context=self.context))
        except (can.CanError, ValueError, TypeError) as error:
            reason = "no interface is named" if "interface" not in self.options else error
            raise ConfigError(f"bus: {reason}; give -i INTERFACE and -c CHANNEL, or write them in can.conf") from error
        if found["channel"] is None:
            raise ConfigError(f"bus: no channel of {found['interface']}; give -c CHANNEL, or write it in can.conf")
        name = str(found["channel"])
        if found["interface"] == "socketcan" and not _is_device_name(name):
            raise ConfigError(f"bus: {name!r} cannot be the name of an interface; give one such as can0")
        if found["interface"] == "udp_multicast" and not _is_group(name):
            raise ConfigError(f"bus: {name!r} is no multicast address, as udp_multicast needs; give -c 239.0.0.77")
        return found

    @property
    def label(self) -> str:
        """Name of the bus in messages: interface and channel."""
        found = self.resolved()
        return f"{found['interface']} {found['channel']}"


def _is_device_name(name: str) -> bool:
    return (
        0 < len(name) <= MAX_NAME_CHARACTERS and "/" not in name and name not in "." and not any(map(str.isspace, name))
    )


def _is_group(name: str) -> bool:
    """Whether python-can can join it: it takes addresses only, no names of hosts."""
    try:
        return ipaddress.ip_address(name).is_multicast
    except ValueError:
        return False


def spec_of(namespace: argparse.Namespace, table: BusOptions, prefix: str = "") -> BusSpec:
    """Bus from the command line, completed by a table of the configuration."""
    options = {name: getattr(table, name) for name in CONFIGURABLE if getattr(table, name) is not None}
    options |= _given(namespace, OPTIONS, prefix)
    return BusSpec(options | getattr(namespace, f"{prefix}bus_kwargs", {}), table.context)


def with_bus(table: B, namespace: argparse.Namespace, prefix: str = "") -> B:
    """A table of the configuration with the bus that the command line names in its place."""
    return msgspec.structs.replace(table, **_given(namespace, CONFIGURABLE, prefix))


def _given(namespace: argparse.Namespace, names: tuple[str, ...], prefix: str) -> dict[str, Any]:
    return {name: getattr(namespace, prefix + name) for name in names if hasattr(namespace, prefix + name)}


def open_bus(spec: BusSpec, filters: list[CanFilter] | None) -> can.BusABC:
    """Open a bus.

    Raises
    ------
    NotThereError
        It cannot be opened now; the error may pass.
    ConfigError
        It cannot be opened with this configuration.
    """
    found = spec.resolved()
    if found["interface"] == "socketcan":
        _check_type(str(found["channel"]))
    try:
        return can.Bus(**spec.options, config_context=spec.context, can_filters=filters)
    except can.CanInterfaceNotImplementedError as error:
        raise ConfigError(f"{spec.label}: {error}") from error
    except OSError as error:
        if error.errno in PERMANENT_ERRORS:
            raise ConfigError(f"{spec.label}: {PERMANENT_ERRORS[error.errno]}") from error
        raise NotThereError(error.strerror or str(error)) from error
    except can.CanError as error:
        raise NotThereError(str(error)) from error
    except (ImportError, NotImplementedError, AttributeError, TypeError, ValueError) as error:
        raise ConfigError(f"{spec.label}: {_of_constructor(str(error))}") from error


def _of_constructor(complaint: str) -> str:
    """Remedy where Python complains of arguments that an interface lacks; other complaints are returned as is."""
    missing = MISSING.search(complaint)
    if missing is None:
        return complaint
    names = re.findall(r"'(\w+)'", missing[1])
    given = " ".join(f"{name}=..." for name in names)
    return f"the interface needs {' and '.join(names)}; give --bus-kwargs {given}, or write them in can.conf"


def _check_type(name: str) -> None:
    try:
        kind = int((INTERFACES / name / "type").read_text(encoding="ascii"))
    except (OSError, ValueError):
        return
    if kind != ARPHRD_CAN:
        raise ConfigError(f"socketcan {name}: is not a CAN interface; CAN interfaces are listed by: ip link")
