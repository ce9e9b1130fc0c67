# SPDX-License-Identifier: Apache-2.0
"""The depth pipeline from frame to depth image: match, check, clean, and gather on the spherical grid."""

from __future__ import annotations

from functools import cached_property

from stereovox.config import Config
from stereovox.depth.prepare import prepare
from stereovox.depth.quality import check_depth, check_light
from stereovox.depth.sphere.image import through_sphere
from stereovox.depth.stereo.pipeline import StereoDepth
from stereovox.errors import FrameRefused
from stereovox.frame import AnyFrame, DepthImage, Frame, Rays, StereoFrame, name_of
from stereovox.frame.validate import validate_fields


class DepthPipeline:
    """Turns frames into depth images as configured."""

    def __init__(self, config: Config):
        self._config = config

    def matched(self, frame: AnyFrame) -> Frame:
        """Return a stereo frame with its depth, any other frame unchanged.

        Raises FrameRefused as `StereoDepth` and `check_light`, and `bad_form` for clouds and anything that is not a
        frame.
        """
        if isinstance(frame, Frame):
            return frame  # `prepare` validates its fields
        if isinstance(frame, Rays):
            validate_fields(frame, type(frame))
            detail = "is not an image: it can be mapped with given poses, but not tracked"
            raise FrameRefused("bad_form", f"{name_of(frame)}: {detail}")
        validate_fields(frame, StereoFrame, Frame)
        assert isinstance(frame, StereoFrame)
        check_light(frame, self._config.trust.max_unexposed_share)
        return self._stereo(frame)

    def image(self, frame: Frame) -> DepthImage:
        """Return the frame's depth image. Raises FrameRefused as `prepare` and `check_depth`."""
        return through_sphere(self.checked(frame), self._config)

    def checked(self, frame: Frame) -> DepthImage:
        """Return what `image` returns, but before it is gathered on a spherical grid."""
        image = prepare(frame, self._config)
        check_depth(image, frame, self._config)
        return image

    @cached_property
    def _stereo(self) -> StereoDepth:
        """Created for the first stereo frame: other recordings need no OpenCV."""
        return StereoDepth(self._config.stereo)
