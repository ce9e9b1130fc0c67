# SPDX-License-Identifier: Apache-2.0
"""Cameras that run now: images meet their poses, enter one map, and outputs follow it."""
