# SPDX-License-Identifier: Apache-2.0
"""Where a ground robot is: localisation in a map, and SLAM where there is none. Both turn odometry into a `Track`."""

from __future__ import annotations
