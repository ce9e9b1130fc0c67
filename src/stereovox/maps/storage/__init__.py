# SPDX-License-Identifier: Apache-2.0
"""Storage of a map's blocks: memory, a moving window, files, the graphics card."""
