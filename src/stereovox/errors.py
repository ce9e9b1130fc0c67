# SPDX-License-Identifier: Apache-2.0
"""Errors that a user can cause. Each message is one line that names the file or value and the cure."""

from __future__ import annotations

import difflib
import errno
import re
from collections.abc import Iterable

DISK_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""Error numbers of a file that has no room to grow: the disk, a quota or a limit is reached."""
MAX_WORD_LENGTH = 100
"""Most characters of a word that are compared; words from a file may be longer."""
MAX_LINE_LENGTH = 10_000
"""Most characters of a message."""
MAX_PRINTED, MAX_SHOWN = 289, 100
"""Most characters of a printed message (a line of 300 with the command's name), and of a path in a longer one."""


class StereovoxError(ValueError):
    """Bad input or bad usage. Commands print the message and exit with status 2.

    The message is always one printable line, whatever text from a file it quotes.

    Args:
        message: What is wrong, with the value and the cure.
    """

    def __init__(self, message: object = ""):
        super().__init__(one_line(str(message)))


class ConfigError(StereovoxError):
    """A setting is unknown, of the wrong type or out of range."""


class SourceError(StereovoxError):
    """A recording or device cannot be opened."""


class NoPoses(SourceError):  # noqa: N818 - reads as what happened
    """A recording has usable images, but no poses."""


class MapFileError(StereovoxError):
    """A saved map cannot be read or written."""


class MissingExtra(StereovoxError, ImportError):  # noqa: N818 - reads as what happened
    """An optional library is not installed."""

    def __init__(self, library: str, extra: str):
        StereovoxError.__init__(self, f"{library} is not installed; run: pip install 'stereovox[{extra}]'")


class FrameRefused(StereovoxError):  # noqa: N818 - reads as what happened
    """A frame cannot be trusted and must not change the map.

    Attributes:
        reason: Short fixed word by which refusals are counted (`pose_not_rigid`); the message has the details.
    """

    def __init__(self, reason: str, message: str):
        super().__init__(message)
        self.reason = reason


def without_name(error: Exception, name: object) -> str:
    """Return an error's message without the name, for a line that already has it."""
    return str(error).removeprefix(f"{name}: ")


def one_line(text: str) -> str:
    """Return `text` as one printable line: line ends and terminal colours are escaped, a long middle is cut."""
    if len(text) > MAX_LINE_LENGTH:
        text = f"{text[: MAX_LINE_LENGTH // 2]} ... {text[-MAX_LINE_LENGTH // 2 :]}"
    return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def shortened(text: str, length: int = MAX_SHOWN) -> str:
    """Return `text` in at most `length` characters: a long middle is left out."""
    if len(text) <= length:
        return text
    start = (length - 3) // 2
    return f"{text[:start]}...{text[len(text) + start + 3 - length :]}"


def printed(message: str, names: Iterable[str] = ()) -> str:
    """Return a message in at most MAX_PRINTED characters: long paths lose their middles first, the cure stays.

    names: words in the message that may contain spaces, such as a command's paths.
    """
    names = sorted({one_line(name) for name in names}, key=len, reverse=True)
    line = message
    for length in (MAX_SHOWN, 60, 40):
        if len(line) <= MAX_PRINTED:
            return line
        line = message
        for name in names:
            line = line.replace(name, shortened(name, length)) if len(name) > length else line
        line = re.sub(rf"\S{{{length + 1},}}", lambda word, length=length: shortened(word[0], length), line)
    return shortened(line, MAX_PRINTED)


def did_you_mean(word: str, known: Iterable[str], prefix: str = "") -> str:
    """Return " (did you mean 'x'?)" with the closest known word, or the list of known words.

    prefix: shown before each word but not compared (`--`).
    """
    known = sorted(known)
    close = difflib.get_close_matches(word[:MAX_WORD_LENGTH], known, n=1)
    if close:
        return f" (did you mean '{prefix}{close[0]}'?)"
    return f" (known: {', '.join(prefix + name for name in known)})" if known else ""
