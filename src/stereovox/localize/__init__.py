# SPDX-License-Identifier: Apache-2.0
"""Localisation of ground robots in a map, and SLAM without one. Both turn odometry into a `Track`."""

from __future__ import annotations
