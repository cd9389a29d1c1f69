"""Home Assistant's discovery of a device by MQTT: one retained message that describes the sensors of a vehicle.

Source: home-assistant.io, integration MQTT, "Device discovery payload". A template gives none, which is shown as
"unknown", where the estimate has no value or is withdrawn by an empty message.
"""

import json
from typing import Any

from estimator import __version__
from estimator.answers.run import Parameters

NAMES = {"mass_kg": "Mass", "A_N": "Rolling resistance A", "C_N_s2_m2": "Drag C"}
UNITS = {"mass_kg": "kg", "A_N": "N", "C_N_s2_m2": "N·s²/m²"}
DIGITS = {"mass_kg": 0, "A_N": 0, "C_N_s2_m2": 2}


def discovery_topic(prefix: str, client_id: str) -> str:
    """Topic of the message."""
    return f"{prefix}/device/{client_id}/config"


def discovery(client_id: str, state_topic: str, availability_topic: str, expire_after: int) -> bytes:
    """The message, as JSON; a value is shown for ``expire_after`` [s] after the last one."""
    sensors = {name: _parameter(name, state_topic) for name in Parameters.__struct_fields__}
    status = "{{ value_json.status if value_json is defined else none }}"
    sensors["status"] = {"name": "Status", "value_template": status}
    described = {
        "device": {"identifiers": [client_id], "name": client_id, "model": "roadload", "sw_version": __version__},
        "origin": {"name": "roadload", "sw_version": __version__},
        "state_topic": state_topic,
        "availability_topic": availability_topic,
        "components": {
            name: {
                "platform": "sensor",
                "unique_id": f"{client_id}_{name}",
                "expire_after": expire_after,
                **sensor,
            }
            for name, sensor in sensors.items()
        },
    }
    return json.dumps(described, ensure_ascii=False).encode()


def _parameter(name: str, state_topic: str) -> dict[str, Any]:
    """The sensor of a parameter; its interval and status are attributes."""
    there = "if value_json is defined and value_json.estimate else"
    values = f"value_json.estimate.parameters.{name}"
    sensor = {
        "name": NAMES[name],
        "unit_of_measurement": UNITS[name],
        "state_class": "measurement",
        "suggested_display_precision": DIGITS[name],
        "value_template": f"{{{{ {values}.mean {there} none }}}}",
        "json_attributes_topic": state_topic,
        "json_attributes_template": f"{{{{ ({values} {there} {{}}) | to_json }}}}",
    }
    return {**sensor, "device_class": "weight"} if UNITS[name] == "kg" else sensor
