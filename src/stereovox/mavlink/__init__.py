# SPDX-License-Identifier: Apache-2.0
"""Autopilots over MAVLink: obstacle distances out, poses in (extra `mavlink`)."""
