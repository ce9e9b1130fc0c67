# SPDX-License-Identifier: Apache-2.0
"""From a raw frame to a checked depth image."""

from stereovox.depth.prepare import DepthPipeline, prepare

__all__ = ["DepthPipeline", "prepare"]
