# SPDX-License-Identifier: Apache-2.0
"""Change bytes as a damaged disk or a hostile author would; the same seed gives the same change."""

from __future__ import annotations

import random
import re
import struct
import zlib

MAX_BYTES = 1 << 16
NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?")
WORDS = (
    b"nan", b"inf", b"-inf", b"-1", b"0", b"1e308", b"1e-320", b"1e999999999", b"9" * 400, b"0x" + b"f" * 5000,
    b"65535", b"65536", b"2147483647", b"4294967295", b"4294967296", b"9223372036854775807", b"18446744073709551615",
    b"null", b"true", b'""', b"[]", b"{}", b"[" * 2000, b"{" * 2000, b'{"a":' * 2000, b"a." * 300, b"*a", b"&a [*a]",
    b"<<: *a", b"!!python/object/apply:os.system ['false']", b"../../../../etc/passwd", b"/etc/passwd", b"\0",
    b"\x1b[2J", b"\r\n", b"\n", b"'", b'"', b"#", b"\xff\xfe", b"\xef\xbb\xbf", "٣".encode(), b"1_0", b"1:1:1:1",
)  # fmt: skip
"""Replacements for a field."""
INTEGERS = (0, 1, 2, 7, 8, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x10000, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-38, 1e38, float("inf"), float("-inf"), float("nan"), 1e300)


def mutated(data: bytes, dice: random.Random) -> bytes:
    """Return `data` with one to five changes."""
    changed = bytearray(data)
    for _ in range(dice.choice((1, 1, 1, 2, 3, 5))):
        dice.choice(CHANGES)(changed, dice)
    return bytes(changed[:MAX_BYTES])


def with_right_sums(png: bytes) -> bytes:
    """Return a PNG with correct checksums in all chunks that can be parsed."""
    fixed, at = bytearray(png), 8
    while at + 12 <= len(fixed):
        (length,) = struct.unpack_from(">I", fixed, at)
        end = at + 8 + length
        if end + 4 > len(fixed):
            break
        fixed[end : end + 4] = zlib.crc32(fixed[at + 4 : end]).to_bytes(4)
        at = end + 4
    return bytes(fixed)


def _place(data: bytearray, dice: random.Random, size: int = 1) -> int:
    return dice.randrange(max(1, len(data) - size + 1))


def _bit(data: bytearray, dice: random.Random) -> None:
    if data:
        data[_place(data, dice)] ^= 1 << dice.randrange(8)


def _byte(data: bytearray, dice: random.Random) -> None:
    if data:
        data[_place(data, dice)] = dice.choice((0, 1, 127, 128, 255, dice.randrange(256)))


def _integer(data: bytearray, dice: random.Random) -> None:
    size, order = dice.choice(((2, "H"), (4, "I"), (8, "Q"))), dice.choice("<>")
    if len(data) >= size[0]:
        at = _place(data, dice, size[0])
        (before,) = struct.unpack_from(order + size[1], data, at)
        value = dice.choice((*INTEGERS, before + 1, before - 1, 2 * before, ~before))
        struct.pack_into(order + size[1], data, at, value & (256 ** size[0] - 1))


def _float(data: bytearray, dice: random.Random) -> None:
    kind = dice.choice(("<f", "<d"))
    if len(data) >= struct.calcsize(kind):
        value = dice.choice(FLOATS)
        value = max(min(value, 3e38), -3e38) if kind == "<f" and abs(value) < 1e301 else value
        struct.pack_into(kind, data, _place(data, dice, struct.calcsize(kind)), value)


def _cut(data: bytearray, dice: random.Random) -> None:
    del data[_place(data, dice) :]


def _drop(data: bytearray, dice: random.Random) -> None:
    start = _place(data, dice)
    del data[start : start + dice.choice((1, 2, 4, 8, 30, 300))]


def _repeat(data: bytearray, dice: random.Random) -> None:
    start = _place(data, dice)
    part = data[start : start + dice.choice((1, 4, 16, 80, 400))]
    data[start:start] = part * dice.choice((1, 1, 2, 50))


def _insert(data: bytearray, dice: random.Random) -> None:
    data[_place(data, dice) : 0] = dice.randbytes(dice.choice((1, 3, 8, 40)))


def _word(data: bytearray, dice: random.Random) -> None:
    start = _place(data, dice)
    data[start : start + dice.choice((0, 0, 4))] = dice.choice(WORDS)


def _number(data: bytearray, dice: random.Random) -> None:
    found = [match.span() for match in NUMBER.finditer(bytes(data))]
    if found:
        start, end = dice.choice(found)
        data[start:end] = dice.choice(WORDS)


CHANGES = (_bit, _byte, _byte, _integer, _integer, _float, _cut, _drop, _repeat, _insert, _word, _number, _number)
