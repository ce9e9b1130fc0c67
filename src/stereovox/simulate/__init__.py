# SPDX-License-Identifier: Apache-2.0
"""Simulated recordings: scenes, cameras, robots and models of their sensors."""
