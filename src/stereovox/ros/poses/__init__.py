# SPDX-License-Identifier: Apache-2.0
"""Poses of the robot in ROS 2: transforms, topics, localisation, tracking."""
