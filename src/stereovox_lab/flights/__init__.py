# SPDX-License-Identifier: Apache-2.0
"""Simulated flights that rely on the map's MAVLink messages."""
