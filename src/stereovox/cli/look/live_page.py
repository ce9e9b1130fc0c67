# SPDX-License-Identifier: Apache-2.0
"""Live outputs of `stereovox map`: a page that shows the growing map and stays afterwards, and a Rerun recording."""

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


class NoOutput:
    """No live output; the base of those below."""

    def after(self, frame: AnyFrame, report: UpdateReport) -> None:
        """Process a frame that was offered to the map."""

    def finish(self) -> None:
        """Show the complete map after its last frame."""

    def stay(self) -> None:
        """Keep the output open until the user ends it."""


class LivePage(NoOutput):
    """Live page of a command."""

    def __init__(self, live: LiveView):
        self._live = live

    def after(self, frame: AnyFrame, report: UpdateReport) -> None:
        """Update the page if an update is due."""
        self._live.after(frame, report)

    def finish(self) -> None:
        """Show the complete map after its last frame."""
        self._live.finish()

    def stay(self) -> None:
        """Keep the page open until Ctrl-C."""
        say(f"{self._live.url} shows the whole map; Ctrl-C ends")
        with suppress(KeyboardInterrupt):
            self._live.viewer.wait()


@contextmanager
def page_of(mapper: Mapper, name: str, port: int | None) -> Iterator[NoOutput]:
    """Serve a page of the mapper's map at `port` while the context is open; None: no page."""
    if port is None:
        yield NoOutput()
        return
    from stereovox.cli.look.view import silence_server_log
    from stereovox.viewer.live import LiveView

    silence_server_log()
    with closing(LiveView(mapper, name, port=port)) as live:
        say(f"open {live.url} in a browser to see the map grow")
        yield LivePage(live)


@contextmanager
def rerun_of(mapper: Mapper, file: str | None) -> Iterator[NoOutput]:
    """Write a Rerun recording of frames and map while the context is open; None: no recording."""
    if file is None:
        yield NoOutput()
        return
    from stereovox.depth import DepthPipeline
    from stereovox.formats.rerun import RerunLog, rerun_file

    with rerun_file(file, mapper.config.up) as opened:
        stopped = None
        try:
            yield RerunRecording(mapper, RerunLog(opened, DepthPipeline(mapper.config)))
        except KeyboardInterrupt as interrupt:  # the map so far is saved, and so is this
            stopped = interrupt
    say(f"saved {file}; look at it with: rerun {file}")
    if stopped is not None:
        raise stopped


class RerunRecording(NoOutput):
    """Rerun recording of a command."""

    def __init__(self, mapper: Mapper, log: RerunLog):
        self._mapper, self._log = mapper, log

    def after(self, frame: AnyFrame, report: UpdateReport) -> None:
        """Write the frame, and the map if an update is due."""
        self._log.after(self._mapper.map, frame)

    def finish(self) -> None:
        """Write the complete map."""
        self._log.finish(self._mapper.map)
