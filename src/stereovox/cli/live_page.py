# SPDX-License-Identifier: Apache-2.0
"""A page that shows a map while a command makes it, and stays when it is made."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from typing import TYPE_CHECKING

from stereovox.cli.terminal import say

if TYPE_CHECKING:
    from stereovox.formats.rerun import RerunLog
    from stereovox.frame import AnyFrame, UpdateReport
    from stereovox.mapper import Mapper
    from stereovox.viewer.live import LiveView


class NoPage:
    """What a command tells of its frames where nobody wants to see."""

    def after(self, frame: AnyFrame, report: UpdateReport) -> None:
        """Note a frame that was offered to the map."""

    def finish(self) -> None:
        """Show the map whole, when its last frame is in it."""

    def stay(self) -> None:
        """Keep what is shown until somebody ends it."""


class Page(NoPage):
    """A live view for a command."""

    def __init__(self, live: LiveView):
        self._live = live

    def after(self, frame: AnyFrame, report: UpdateReport) -> None:
        """Show the map, if it is time."""
        self._live.after(frame, report)

    def finish(self) -> None:
        """Show the map whole, when its last frame is in it."""
        self._live.finish()

    def stay(self) -> None:
        """Keep the page until Ctrl-C."""
        say(f"{self._live.url} shows the whole map; Ctrl-C ends")
        with suppress(KeyboardInterrupt):
            self._live.viewer.wait()


@contextmanager
def page_of(mapper: Mapper, name: str, port: int | None) -> Iterator[NoPage]:
    """Serve a page of the mapper's map at `port` while this is open; None: none."""
    if port is None:
        yield NoPage()
        return
    from stereovox.cli.view import quiet
    from stereovox.viewer.live import LiveView

    quiet()
    with closing(LiveView(mapper, name, port=port)) as live:
        say(f"open {live.url} in a browser to see the map grow")
        yield Page(live)


@contextmanager
def rerun_of(mapper: Mapper, file: str | None) -> Iterator[NoPage]:
    """Write a Rerun recording of the mapper's frames and map while this is open; None: none."""
    if file is None:
        yield NoPage()
        return
    from stereovox.depth import DepthPipeline
    from stereovox.formats.rerun import RerunLog, rerun_file

    with rerun_file(file, mapper.config.up) as opened:
        stopped = None
        try:
            yield Recorded(mapper, RerunLog(opened, DepthPipeline(mapper.config)))
        except KeyboardInterrupt as told:  # what was mapped is saved, and so is this
            stopped = told
    say(f"saved {file}; look at it with: rerun {file}")
    if stopped is not None:
        raise stopped


class Recorded(NoPage):
    """A Rerun recording for a command."""

    def __init__(self, mapper: Mapper, log: RerunLog):
        self._mapper, self._log = mapper, log

    def after(self, frame: AnyFrame, report: UpdateReport) -> None:
        """Write the frame, and the map, if it is time."""
        self._log.after(self._mapper.map, frame)

    def finish(self) -> None:
        """Write the map whole."""
        self._log.finish(self._mapper.map)
