# SPDX-License-Identifier: Apache-2.0
"""Whether a frame may change the map, and what is remembered of those before it."""
