# SPDX-License-Identifier: Apache-2.0
"""A live ROS 2 node: messages become frames, frames a map, the map messages. `node.py` shows how."""
