# SPDX-License-Identifier: Apache-2.0
"""Simulated flights that trust what the map says over MAVLink."""
