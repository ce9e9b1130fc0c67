# SPDX-License-Identifier: Apache-2.0
"""The sources of poses for a live run, by name."""

from __future__ import annotations

from stereovox import registry
from stereovox.errors import SourceError
from stereovox.runs.pose_choice import GIVEN, TRACK
from stereovox.sources.poses.pose_stream import PoseStream

POSES = {
    "udp": "stereovox.sources.poses.pose_stream:UdpPoses",
    "tcp": "stereovox.sources.poses.pose_stream:TcpPoses",
    "t265": "stereovox.sources.poses.pose_stream:T265",
    "mavlink": "stereovox.mavlink.poses:MavlinkPoses",
}
"""Streams of poses (`PoseStream`), tried in this order after entry points in the group `stereovox.poses`."""


def open_poses(where: str) -> PoseStream:
    """Return the stream of poses that `where` names, not yet started.

    Raises:
        SourceError: It names no stream, or one that cannot be used.
    """
    for kind in registry.every("poses", POSES):
        if kind.recognises(where):
            return kind(where)
    words = f"{TRACK}, {GIVEN}, t265, udp://:5005, tcp://HOST:5005 or mavlink:udpin:0.0.0.0:14540"
    raise SourceError(f"poses '{where}' is unknown; give {words}")
