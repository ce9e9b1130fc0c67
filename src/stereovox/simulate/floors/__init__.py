# SPDX-License-Identifier: Apache-2.0
"""Simulated floors of a building, and a robot that drives through them."""
