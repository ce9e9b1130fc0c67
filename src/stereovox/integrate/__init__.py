# SPDX-License-Identifier: Apache-2.0
"""Integrators: from a depth image and a sensor model to evidence on cells. They never see the map."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from stereovox import registry
from stereovox.config import Config
from stereovox.errors import FrameRefused
from stereovox.frame import AnyImage, DepthImage
from stereovox.integrate.views import check_place
from stereovox.maps.cells.evidence import Evidence

if TYPE_CHECKING:
    from stereovox.integrate.points import Points

INTEGRATORS = {
    "projective": "stereovox.integrate.projective:Projective",
    "ray": "stereovox.integrate.ray:Ray",
    "line": "stereovox.integrate.ray:Line",
}
DEVICES = {"cpu": INTEGRATORS, "cuda": {"projective": "stereovox.integrate.gpu:GpuProjective"}}
"""The integrators of each device; only processor ones can come from other packages."""


class Integrator(Protocol):
    """Turns depth images into evidence. Made once, with a `Config`, then called for each frame."""

    def evidence(self, image: DepthImage) -> Evidence:
        """Return the evidence of a depth image on the cells it sees.

        Args:
            image: The depth image with its camera and pose.

        Returns:
            Evidence in thousandths of log-odds; its memory may be reused by the next call.

        Raises:
            FrameRefused: The camera or its view is out of proportion (`bad_camera`, `view_too_large`).
        """
        ...


class Integration:
    """Makes evidence from all kinds of images: depth images by the configured integrator, clouds by `Points`."""

    def __init__(self, config: Config):
        self._config, self._images = config, make_integrator(config)
        self._clouds: Points | None = None

    def evidence(self, image: AnyImage) -> Evidence:
        """Return as `Integrator.evidence` and `Points.evidence`.

        Raises FrameRefused `pose_too_far` for cells that no map can have, and `no_clouds` on graphics cards.
        """
        check_place(image.T_world_sensor, self._config)
        if isinstance(image, DepthImage):
            return self._images.evidence(image)
        if self._config.device != "cpu":
            raise FrameRefused("no_clouds", "clouds are mapped on the processor only; leave device=cuda out")
        from stereovox.integrate.points import Points

        self._clouds = self._clouds or Points(self._config)
        return self._clouds.evidence(image)


def make_integrator(config: Config) -> Integrator:
    """Return the configured integrator of depth images. Raises ConfigError for an unknown name."""
    return registry.find("integrators", DEVICES[config.device], config.integrator)(config)
