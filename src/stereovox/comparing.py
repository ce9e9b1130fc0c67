# SPDX-License-Identifier: Apache-2.0
"""Evidence that was compared with the map before the map takes it in."""

from __future__ import annotations

from dataclasses import replace

from stereovox.frame import AnyFrame, DepthImage
from stereovox.gate import Gate, Passed
from stereovox.integrate import Integrator
from stereovox.maps import VoxelMap
from stereovox.maps.evidence import Evidence


def compared(
    frame: AnyFrame, image: DepthImage, gate: Gate, integrator: Integrator, voxel_map: VoxelMap
) -> tuple[Evidence, Passed]:
    """Return the evidence of an image, and what the gate is to remember of it.

    Raises FrameRefused as `Gate.check` and `Gate.believe`.
    """
    passed = gate.check(frame, image)
    asked = False

    def moved(limit: float) -> bool:
        nonlocal asked
        from stereovox.localize.elsewhere import pose_on_surfaces

        asked, pose = True, pose_on_surfaces(voxel_map, image)
        if pose is None:
            return False
        against = voxel_map.agreement(integrator.evidence(replace(image, T_world_sensor=pose))).against
        return against is not None and against <= limit

    evidence = integrator.evidence(image)
    passed = gate.believe(frame, passed, voxel_map.agreement(evidence).against, moved)
    return (integrator.evidence(image) if asked else evidence), passed  # the next one takes the memory of the last
