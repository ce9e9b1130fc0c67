# SPDX-License-Identifier: Apache-2.0
"""Integrators: from a depth image and a sensor model to evidence on cells. They never see the map."""

from __future__ import annotations

from typing import Protocol

from stereovox import registry
from stereovox.config import Config
from stereovox.frame import DepthImage
from stereovox.maps.evidence import Evidence

INTEGRATORS = {
    "projective": "stereovox.integrate.projective:Projective",
    "ray": "stereovox.integrate.ray:Ray",
    "line": "stereovox.integrate.ray:Line",
}


class Integrator(Protocol):
    """A way to turn depth images into evidence; made once from the settings, then called for each frame."""

    def evidence(self, image: DepthImage) -> Evidence:
        """Return what `image` says about the cells it sees. The memory it lies in is used again by the next call."""
        ...


def make_integrator(config: Config) -> Integrator:
    """Return the integrator that `config` names. Raises ConfigError for an unknown name."""
    return registry.find("integrators", INTEGRATORS, config.integrator)(config)
