# SPDX-License-Identifier: Apache-2.0
"""The floor under a robot, and 2-D grids above it."""
