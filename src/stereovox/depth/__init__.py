# SPDX-License-Identifier: Apache-2.0
"""From a frame as delivered to a depth image that can be trusted."""

from stereovox.depth.pipeline import DepthPipeline
from stereovox.depth.prepare import prepare

__all__ = ["DepthPipeline", "prepare"]
