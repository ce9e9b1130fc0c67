# SPDX-License-Identifier: Apache-2.0
"""A room of its own for these tests: no message leaves this machine, or comes from another test."""

from __future__ import annotations

import os

import pytest


@pytest.fixture
def alone(domains) -> dict[str, str]:
    """The environment of processes that are to hear each other and nobody else."""
    pytest.importorskip("rclpy", reason="rclpy is not installed: pip install 'stereovox[ros2]'")
    return {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": str(domains[0])}
