# SPDX-License-Identifier: Apache-2.0
"""Products of maps: distances, frontiers, ground, paths, projections, and maps derived from maps."""
