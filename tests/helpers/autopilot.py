"""An autopilot to test against: a process of its own that speaks MAVLink 2 by pymavlink's own connections.

python autopilot.py PORT CLOCK_AHEAD_S POSES      0 for any port; POSES: none, odometry, local or angles

It prints one JSON object a line: its port, then what it understood of each message. Its clock is ahead of the
machine's. Poses are those of `flown`, in its own clock and frames (NED, FRD).
"""

import json
import math
import os
import sys
import time

os.environ["MAVLINK20"] = "1"
os.environ["MAVLINK_DIALECT"] = "ardupilotmega"
from pymavlink import mavutil

SYSTEM, COMPONENT = 1, 1


def flown(seconds):
    """North, east, down in metres, and roll, pitch, yaw in radians."""
    return (2 * math.cos(seconds), 2 * math.sin(seconds), -1.5, 0.1, -0.2, 0.5 * seconds)


def quaternion(roll, pitch, yaw):
    """W, x, y, z by multiplying three quaternions out."""

    def times(a, b):
        (aw, ax, ay, az), (bw, bx, by, bz) = a, b
        return (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        )

    def about(axis, angle):
        return (math.cos(angle / 2), *(math.sin(angle / 2) * (k == axis) for k in range(3)))

    return times(times(about(2, yaw), about(1, pitch)), about(0, roll))


def px4(message):
    """Metres that PX4 1.14 reads for its 36 sectors, "unknown", or "free" (CollisionPrevention.cpp)."""
    read = []
    for i in range(36):
        cm = message.distances[math.ceil((10 * i - message.angle_offset) % 360 / message.increment_f) % 72]
        if cm == 65535:
            read.append("unknown")
        elif cm <= message.min_distance:
            read.append("ignored")
        else:
            read.append("free" if cm > message.max_distance else cm / 100)
    return read


def ardupilot(message):
    """Metres that ArduPilot reads for its 8 faces, None if there is nothing (AP_Proximity_MAV.cpp)."""
    faces = [None] * 8
    for j, cm in enumerate(message.distances):
        if cm in (0, 65535) or not message.min_distance <= cm <= message.max_distance:
            continue
        angle = (j * (message.increment_f or message.increment) + message.angle_offset) % 360
        face = int((angle + 22.5) % 360 // 45)
        faces[face] = cm / 100 if faces[face] is None else min(faces[face], cm / 100)
    return faces


def understood(message, machine_s, ahead_s):
    """What a message says, as plain values; None for messages that are of no interest."""
    kind, out = message.get_type(), {"from": [message.get_srcSystem(), message.get_srcComponent()], "at": machine_s}
    if kind == "HEARTBEAT":
        return {"is": kind, **out, "type": message.type, "autopilot": message.autopilot}
    if kind == "OBSTACLE_DISTANCE":
        keys = ("min_distance", "max_distance", "increment", "increment_f", "angle_offset", "frame", "time_usec")
        out |= {key: getattr(message, key) for key in keys} | {"distances": list(message.distances)}
        return {"is": kind, **out, "px4": px4(message), "ardupilot": ardupilot(message)}
    if kind == "OBSTACLE_DISTANCE_3D":
        keys = ("x", "y", "z", "min_distance", "max_distance", "frame", "obstacle_id", "time_boot_ms")
        return {"is": kind, **out, **{key: getattr(message, key) for key in keys}}
    if kind in ("ODOMETRY", "VISION_POSITION_ESTIMATE"):
        return {"is": kind, **out, **message.to_dict()}
    if kind == "TIMESYNC" and message.tc1:
        return {"is": "answer", **out, "tc1": message.tc1, "ts1": message.ts1}
    return None


def fly(link, poses, seconds):
    """Send where it is at `seconds` of its own clock."""
    n, e, d, roll, pitch, yaw = flown(seconds)
    q, boot_ms = quaternion(roll, pitch, yaw), round(1e3 * seconds)
    if poses == "odometry":
        none = [math.nan, *[0.0] * 20]
        link.mav.odometry_send(round(1e6 * seconds), 1, 12, n, e, d, q, 0, 0, 0, 0, 0, 0, none, none, 0, 0, 0)
    if poses == "local":
        link.mav.attitude_quaternion_send(boot_ms, *q, 0, 0, 0)
    if poses == "angles":
        link.mav.attitude_send(boot_ms, roll, pitch, (yaw + math.pi) % (2 * math.pi) - math.pi, 0, 0, 0)
    if poses in ("local", "angles"):
        at = round(1e3 * (seconds - 0.005))
        n, e, d, *_ = flown(at / 1e3)
        link.mav.local_position_ned_send(at, n, e, d, 0, 0, 0)


def main(port, ahead_s, poses):
    link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", source_system=SYSTEM, source_component=COMPONENT)
    print(json.dumps({"port": link.port.getsockname()[1]}), flush=True)
    ahead_s, due, asked = float(ahead_s), 0.0, 0.0
    while True:
        message = link.recv_match(blocking=True, timeout=0.005)
        machine_s = time.monotonic()
        mine_s = machine_s + ahead_s
        if message is not None and message.get_type() == "TIMESYNC" and message.tc1 == 0:
            link.mav.timesync_send(round(1e9 * mine_s), message.ts1)
        told = message and understood(message, machine_s, ahead_s)
        if told:
            print(json.dumps(told), flush=True)
        if machine_s >= due:
            due = machine_s + 0.02
            fly(link, poses, mine_s)
        if machine_s >= asked:
            asked = machine_s + 0.5
            link.mav.heartbeat_send(2, 12, 0, 0, 4)
            link.mav.timesync_send(0, round(1e9 * mine_s))


if __name__ == "__main__":
    main(*sys.argv[1:])
