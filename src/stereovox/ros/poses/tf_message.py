# SPDX-License-Identifier: Apache-2.0
"""`tf2_msgs/TFMessage` as bytes: packed by hand, with a type support made here if the package is not installed.

`tf2_msgs` is not on PyPI. rclpy sends and receives bytes, for which it needs only the name, hash and description of a
type's support: these are filled into a copy of the support of `geometry_msgs/TransformStamped`, whose C structs follow
the headers in the wheels (`rosidl_runtime_c/message_type_support_struct.h`,
`rosidl_typesupport_fastrtps_cpp/message_type_support.h`, `rosidl_typesupport_introspection_c/message_introspection.h`).
So it works only with the versions of the extra `ros2`.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from ctypes import (
    CFUNCTYPE,
    POINTER,
    Structure,
    addressof,
    byref,
    c_bool,
    c_char_p,
    c_size_t,
    c_uint8,
    c_uint32,
    c_uint64,
    c_void_p,
    pointer,
    py_object,
)
from ctypes import pythonapi as python
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from stereovox.geometry.se3 import Transform
from stereovox.ros.library import optional_message

HASH = "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
"""RIHS01 of `tf2_msgs/msg/TFMessage` (REP 2016)."""
VERSIONS = {
    "ros-rclpy": "9.1.",
    "ros-rosidl-runtime-c": "4.9.",
    "ros-rosidl-typesupport-fastrtps-c": "3.8.",
    "ros-rosidl-typesupport-introspection-c": "4.9.",
}
"""Wheels whose C structs are known, with the prefixes of their versions."""
MIDDLEWARE = "rmw_fastrtps_cpp"
CALLBACKS, MEMBERS = b"rosidl_typesupport_fastrtps_c", b"rosidl_typesupport_introspection_c"
"""Identifiers of type supports: functions for bytes, which are not called, and the members of a message."""
MESSAGE, SEQUENCE_BYTES = 18, 24
"""`ROS_TYPE_MESSAGE` of rosidl_typesupport_introspection_c, and the size of a sequence in C."""
NESTED_SEQUENCE = 145
"""`FIELD_TYPE_NESTED_TYPE_UNBOUNDED_SEQUENCE` of type_description_interfaces."""


def packed_transforms(stamp_ns: int, transforms: Iterable[tuple[str, str, Transform]]) -> bytes:
    """Return a `tf2_msgs/TFMessage` as CDR bytes. transforms: parent, child and T_parent_child (4, 4)."""
    body = bytearray()
    count = 0
    for parent, child, T in transforms:
        count += 1
        body += struct.pack("<iI", *divmod(stamp_ns, 10**9))
        for name in (parent, child):
            body += bytes(-(len(body) + 4) % 4)
            text = name.encode() + b"\0"
            body += struct.pack("<I", len(text)) + text
        body += bytes(-(len(body) + 4) % 8)
        body += struct.pack("<7d", *T[:3, 3], *Rotation.from_matrix(np.asarray(T)[:3, :3]).as_quat())
    return b"\0\1\0\0" + struct.pack("<I", count) + bytes(body)


@cache
def tf_message() -> Any | None:
    """Return the class of `tf2_msgs/TFMessage`: the package's, else one for bytes only; None if neither is available.

    With the latter a publisher takes `packed_transforms`, and a subscription must be `raw=True`.
    """
    return optional_message("tf2_msgs", "TFMessage") or (_made() if _structs_known() else None)


def _structs_known() -> bool:
    from rclpy.utilities import get_rmw_implementation_identifier

    try:
        known = all(version(name).startswith(begin) for name, begin in VERSIONS.items())
    except PackageNotFoundError:
        return False
    return known and get_rmw_implementation_identifier() == MIDDLEWARE


class _String(Structure):
    _fields_: ClassVar = [("data", c_char_p), ("size", c_size_t), ("capacity", c_size_t)]


class _Field(Structure):
    _fields_: ClassVar = [
        ("name", _String), ("type_id", c_uint8), ("capacity", c_uint64), ("string_capacity", c_uint64),
        ("nested_type_name", _String), ("default_value", _String),
    ]  # fmt: skip


class _Fields(Structure):
    _fields_: ClassVar = [("data", POINTER(_Field)), ("size", c_size_t), ("capacity", c_size_t)]


class _Type(Structure):
    _fields_: ClassVar = [("type_name", _String), ("fields", _Fields)]


class _Types(Structure):
    _fields_: ClassVar = [("data", POINTER(_Type)), ("size", c_size_t), ("capacity", c_size_t)]


class _Description(Structure):
    _fields_: ClassVar = [("type_description", _Type), ("referenced", _Types)]


class _Hash(Structure):
    _fields_: ClassVar = [("version", c_uint8), ("value", c_uint8 * 32)]


class _Sources(Structure):
    _fields_: ClassVar = [("data", c_void_p), ("size", c_size_t), ("capacity", c_size_t)]


class _Callbacks(Structure):
    _fields_: ClassVar = [("namespace", c_char_p), ("name", c_char_p), ("functions", c_void_p * 4), ("key", c_void_p)]


class _Member(Structure):
    _fields_: ClassVar = [
        ("name", c_char_p), ("type_id", c_uint8), ("string_bound", c_size_t), ("members", c_void_p),
        ("is_key", c_bool), ("is_array", c_bool), ("array_size", c_size_t), ("is_bounded", c_bool),
        ("offset", c_uint32), ("default", c_void_p), ("functions", c_void_p * 6),
    ]  # fmt: skip


class _Members(Structure):
    _fields_: ClassVar = [
        ("namespace", c_char_p), ("name", c_char_p), ("count", c_uint32), ("size", c_size_t), ("has_key", c_bool),
        ("members", POINTER(_Member)), ("functions", c_void_p * 2),
    ]  # fmt: skip


_GET = CFUNCTYPE(c_void_p, c_void_p)
_FIND = CFUNCTYPE(c_void_p, c_void_p, c_char_p)


class _Support(Structure):
    _fields_: ClassVar = [
        ("identifier", c_char_p), ("data", c_void_p), ("find", _FIND), ("hash", _GET), ("description", _GET),
        ("sources", _GET),
    ]  # fmt: skip


def _made() -> Any:
    """Return a class that rclpy accepts as `tf2_msgs/TFMessage` if messages are bytes."""
    from geometry_msgs.msg import TransformStamped

    kind: Any = type(TransformStamped)
    if kind._TYPE_SUPPORT is None:
        kind.__import_type_support__()
    support, kept = _support(kind._TYPE_SUPPORT)
    capsule = python.PyCapsule_New
    capsule.restype, capsule.argtypes = py_object, [c_void_p, c_char_p, c_void_p]
    others = ("_CREATE_ROS_MESSAGE", "_CONVERT_FROM_PY", "_CONVERT_TO_PY", "_DESTROY_ROS_MESSAGE")
    members = {one: getattr(kind, one) for one in others}  # rclpy reads them, but calls none of them for bytes
    members |= {"_TYPE_SUPPORT": capsule(addressof(support), None, None), "_kept": (support, kept)}
    return type("MetaclassTFMessage", (type,), members)("TFMessage", (), {"__module__": "tf2_msgs.msg"})


def _support(capsule: Any) -> tuple[_Support, list[Any]]:
    """Return the type support of TFMessage, and objects to keep alive with it. capsule: support of TransformStamped."""
    content = python.PyCapsule_GetPointer
    content.restype, content.argtypes = c_void_p, [py_object, c_char_p]
    element = _Support.from_address(content(capsule, None))
    like, inside = (_Support.from_address(element.find(byref(element), kind)) for kind in (CALLBACKS, MEMBERS))
    callbacks = _Callbacks.from_buffer_copy(_Callbacks.from_address(like.data))
    callbacks.namespace, callbacks.name, callbacks.key = b"tf2_msgs::msg", b"TFMessage", None
    member = _Member(b"transforms", MESSAGE, members=addressof(inside), is_array=True)
    members = _Members(b"tf2_msgs__msg", b"TFMessage", 1, SEQUENCE_BYTES, False, pointer(member))
    described, kept = _described(_Description.from_address(like.description(byref(like))))
    digest, sources = _Hash(1, (c_uint8 * 32)(*bytes.fromhex(HASH))), _Sources()
    returns = [_returning(addressof(one)) for one in (digest, described, sources)]
    supports: dict[bytes, _Support] = {}
    find = _FIND(lambda _, kind: addressof(supports[kind]) if kind in supports else None)
    for kind, data in ((CALLBACKS, callbacks), (MEMBERS, members)):
        supports[kind] = _Support(kind, addressof(data), find, *returns)
    return supports[CALLBACKS], [callbacks, member, members, described, digest, sources, returns, kept, find, supports]


def _returning(address: int) -> Any:
    return _GET(lambda _: address)


def _described(element: _Description) -> tuple[_Description, list[Any]]:
    """Return the description of TFMessage, a sequence `transforms` of `element`, and objects to keep alive with it."""
    fields = (_Field * 1)(
        _Field(_string(b"transforms"), NESTED_SEQUENCE, 0, 0, element.type_description.type_name, _string(b""))
    )
    others = [element.type_description, *element.referenced.data[: element.referenced.size]]
    types = (_Type * len(others))(*sorted(others, key=lambda one: one.type_name.data))
    itself = _Type(_string(b"tf2_msgs/msg/TFMessage"), _Fields(fields, 1, 1))
    return _Description(itself, _Types(types, len(types), len(types))), [fields, types]


def _string(text: bytes) -> _String:
    return _String(text, len(text), len(text) + 1)
