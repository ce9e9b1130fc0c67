# SPDX-License-Identifier: Apache-2.0
"""Live cameras: images get their poses and enter one map, which outputs follow."""
