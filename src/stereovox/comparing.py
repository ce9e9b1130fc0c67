# SPDX-License-Identifier: Apache-2.0
"""Evidence that was compared with the map before the map takes it in."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from stereovox.config import Config
from stereovox.frame import AnyFrame, DepthImage
from stereovox.gate import Gate, Passed
from stereovox.integrate import Integrator
from stereovox.integrate.per_camera import PerCamera
from stereovox.integrate.views import sensor_table
from stereovox.localize.elsewhere import pose_on_surfaces
from stereovox.maps import VoxelMap
from stereovox.maps.evidence import Evidence
from stereovox.rigs import VirtualCamera
from stereovox.sensors import make_sensor
from stereovox.sensors.model import InverseSensorModel

FIRM = 0.4
"""Share of the most that a hit says which a hit must say to be firm: what is far says less, for its noise is wider than
a cell."""


class Comparison:
    """Makes evidence and lets a gate decide whether it is to be believed."""

    def __init__(self, config: Config, gate: Gate):
        self._gate, self._compares = gate, config.trust.max_disagreement < 1
        self._firm = PerCamera(partial(_firm, make_sensor(config.sensor), config))
        self._prepared = False

    def evidence(
        self, frame: AnyFrame, image: DepthImage, passed: Passed, integrator: Integrator, voxel_map: VoxelMap
    ) -> tuple[Evidence, Passed]:
        """Return the evidence of an image, and what the gate is to remember of it.

        passed: what `Gate.check` returned. Raises FrameRefused as `Gate.believe`.
        """
        evidence = integrator.evidence(image)
        if not self._compares:
            return evidence, passed
        self._prepare(voxel_map, image)
        firm, fits = self._firm[image.camera], False
        against = voxel_map.agreement(evidence, firm).against
        limit = self._gate.limit_elsewhere(passed, against)
        if limit is not None:
            fits = _fits_elsewhere(image, integrator, voxel_map, firm, limit)
            evidence = integrator.evidence(image)  # each takes the memory of the one before
        with voxel_map.lock:
            passed = self._gate.believe(frame, passed, against, fits)
        return evidence, passed

    def _prepare(self, voxel_map: VoxelMap, image: DepthImage) -> None:
        """Let the first image be looked for elsewhere: kernels are compiled then, and not when one is doubted."""
        if not self._prepared:
            self._prepared = True
            pose_on_surfaces(voxel_map, image)


def _fits_elsewhere(image: DepthImage, integrator: Integrator, voxel_map: VoxelMap, firm: int, limit: float) -> bool:
    """Tell whether an image disagrees with the map by no more than `limit` where it lies on its surfaces."""
    pose = pose_on_surfaces(voxel_map, image)
    if pose is None:
        return False
    against = voxel_map.agreement(integrator.evidence(replace(image, T_world_sensor=pose)), firm).against
    return against is not None and against <= limit


def _firm(sensor: InverseSensorModel, config: Config, camera: VirtualCamera) -> int:
    """Return the evidence in thousandths from which on a hit is firm."""
    return round(FIRM * int(sensor_table(sensor, config, camera).hit.max()))
