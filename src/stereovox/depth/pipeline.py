# SPDX-License-Identifier: Apache-2.0
"""All that happens between a frame and its depth image: match, check, clean, and gather on the sphere."""

from __future__ import annotations

from functools import cached_property

from stereovox.config import Config
from stereovox.depth.prepare import prepare
from stereovox.depth.quality import check_depth, check_light
from stereovox.depth.sphere.image import through_sphere
from stereovox.depth.stereo.pipeline import StereoDepth
from stereovox.frame import AnyFrame, DepthImage, Frame, StereoFrame
from stereovox.trust.validate import validate_fields


class DepthPipeline:
    """Makes depth images of frames as `config` says."""

    def __init__(self, config: Config):
        self._config = config

    def matched(self, frame: AnyFrame) -> Frame:
        """Return a stereo frame as one with depth, any other as it is.

        Raises FrameRefused as `StereoDepth` and `check_light`, and `bad_form` for what is no frame at all.
        """
        if isinstance(frame, Frame):
            return frame  # `prepare` looks at its form
        validate_fields(frame, StereoFrame, Frame)
        check_light(frame, self._config.trust.max_unexposed_share)
        return self._stereo(frame)

    def image(self, frame: Frame) -> DepthImage:
        """Return the frame's depth image. Raises FrameRefused as `prepare` and `check_depth`."""
        image = prepare(frame, self._config)
        check_depth(image, frame, self._config)
        return through_sphere(image, self._config)

    @cached_property
    def _stereo(self) -> StereoDepth:
        """Made with the first stereo frame: other recordings need no OpenCV."""
        return StereoDepth(self._config.stereo)
