# SPDX-License-Identifier: Apache-2.0
"""Simulated recordings: scenes, cameras, robots and what their sensors make of the truth."""
