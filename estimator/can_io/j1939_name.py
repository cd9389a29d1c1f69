"""64-bit NAME of a J1939 node; of two nodes that claim one address, the lower NAME keeps it (SAE J1939-81)."""

from dataclasses import astuple, dataclass, fields

from estimator.errors import ConfigError

_WIDTHS = (21, 11, 3, 5, 8, 1, 7, 4, 3, 1)  # bits of the fields of `Name`, least significant first
BYTES = 8


@dataclass(frozen=True, kw_only=True)
class Name:
    """Fields of a NAME, the least significant first.

    ``manufacturer`` codes are assigned by SAE; ``identity`` is the serial number that makes two units of one kind
    differ. ``arbitrary_address_capable`` 1: the node may take another address when it loses its own.

    Raises
    ------
    ConfigError
        A field does not fit its bits.
    """

    identity: int
    manufacturer: int
    ecu_instance: int = 0
    function_instance: int = 0
    function: int = 255  # not available
    reserved: int = 0
    vehicle_system: int = 0  # non-specific
    vehicle_system_instance: int = 0
    industry_group: int = 1  # on-highway equipment
    arbitrary_address_capable: int = 1

    def __post_init__(self) -> None:
        for field, width, value in zip(fields(self), _WIDTHS, astuple(self), strict=True):
            if not 0 <= value < 1 << width:
                raise ConfigError(f"NAME field {field.name} = {value}: give 0..{(1 << width) - 1}")

    def __int__(self) -> int:
        number, shift = 0, 0
        for value, width in zip(astuple(self), _WIDTHS, strict=True):
            number, shift = number | value << shift, shift + width
        return number

    def __bytes__(self) -> bytes:
        return int(self).to_bytes(BYTES, "little")

    @classmethod
    def from_bytes(cls, data: bytes) -> "Name":
        """Read the payload of an address claim (8 bytes)."""
        number = int.from_bytes(data, "little")
        values = {}
        for field, width in zip(fields(cls), _WIDTHS, strict=True):
            values[field.name] = number & (1 << width) - 1
            number >>= width
        return cls(**values)
