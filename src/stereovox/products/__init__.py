# SPDX-License-Identifier: Apache-2.0
"""What is made of maps: distances, frontiers, ground, paths, and other maps."""
