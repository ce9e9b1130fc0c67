# SPDX-License-Identifier: Apache-2.0
"""Inverse sensor models: the occupancy that a measured depth implies in front of, at and behind it. Plain NumPy."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from stereovox import registry
from stereovox.config import SensorConfig
from stereovox.errors import ConfigError, did_you_mean
from stereovox.sensors.protocol import InverseSensorModel

SENSORS = {
    "stereo": "stereovox.sensors.models:Stereo",
    "andert": "stereovox.sensors.models:Andert",
    "valenti": "stereovox.sensors.models:Valenti",
    "constant": "stereovox.sensors.models:Constant",
}


def make_sensor(config: SensorConfig) -> InverseSensorModel:
    """Return the configured sensor model. Raises ConfigError for an unknown model or parameter."""
    model = registry.find("sensors", SENSORS, config.model)
    parameters = config.parameters()
    known = {field.name for field in fields(model)}
    for name, value in parameters.items():
        if name not in known:
            raise ConfigError(f"sensor.{name}: unknown for model '{config.model}'{did_you_mean(name, known)}")
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ConfigError(f"sensor.{name} {value!r}: must be a number")
    return _checked(model(**parameters), config.model)


def _checked(model: Any, name: str) -> InverseSensorModel:
    for field in fields(model):
        value = getattr(model, field.name)
        if (field.name.startswith("p_") or field.name == "prior") and not 0 < value < 1:
            raise ConfigError(f"sensor.{field.name} {value}: a probability must lie between 0 and 1, both excluded")
        if not value > 0:
            raise ConfigError(f"sensor.{field.name} {value}: must be greater than 0")
    if not model.p_free < model.p_unknown:
        raise ConfigError(f"sensor: p_free {model.p_free} must be smaller than p_unknown {model.p_unknown} ({name})")
    return model
