# SPDX-License-Identifier: Apache-2.0
"""Where a map keeps its blocks: memory, a moving window, files, the graphics card."""
