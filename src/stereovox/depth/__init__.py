# SPDX-License-Identifier: Apache-2.0
"""From a raw frame to a checked depth image."""

from stereovox.depth.pipeline import DepthPipeline
from stereovox.depth.prepare import prepare

__all__ = ["DepthPipeline", "prepare"]
