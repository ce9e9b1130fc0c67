# SPDX-License-Identifier: Apache-2.0
"""Parameters of the node: settings of the map by their names, and with `ros.` before them what the node itself is told.

They are read once, at the start; only `ros.out` may be set later.
"""

from __future__ import annotations

from array import array
from typing import Any, NamedTuple

from stereovox.ros.options import PREFIX

FREE = f"{PREFIX}out"
"""The parameter that may change while the node runs."""
OF_ROS = ("use_sim_time", "start_type_description_service", "qos_overrides.")
"""Parameters, and beginnings of some, that rclpy itself has."""


class Given(NamedTuple):
    """settings: of the map, by dotted names. options: of the node, without `ros.`."""

    settings: dict[str, Any]
    options: dict[str, Any]


def given_parameters(node: Any) -> Given:
    """Return the parameters that a node was started with."""
    found = Given({}, {})
    for name, parameter in node.get_parameters_by_prefix("").items():
        value = list(parameter.value) if isinstance(parameter.value, array) else parameter.value
        if name.startswith(PREFIX):
            found.options[name.removeprefix(PREFIX)] = value
        elif not name.startswith(OF_ROS):
            found.settings[name] = value
    return found


def freeze(node: Any, out: str) -> None:
    """Declare `ros.out`, and let nothing else be set from now on."""
    from rcl_interfaces.msg import SetParametersResult

    if not node.has_parameter(FREE):
        node.declare_parameter(FREE, out)

    def check(parameters: list[Any]) -> Any:
        fixed = [one.name for one in parameters if one.name != FREE and not one.name.startswith(OF_ROS)]
        said = f"{', '.join(fixed)}: read at the start only; start the node anew" if fixed else ""
        return SetParametersResult(successful=not fixed, reason=said)

    node.add_on_set_parameters_callback(check)
