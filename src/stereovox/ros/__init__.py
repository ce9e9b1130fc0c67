# SPDX-License-Identifier: Apache-2.0
"""ROS 2 node: messages become frames, frames update the map, the map is published. Start reading at `node.py`."""
