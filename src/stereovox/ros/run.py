# SPDX-License-Identifier: Apache-2.0
"""The run of the ROS node: live topics become a map until a signal, or the node's own transitions, end it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path
from typing import Any

from stereovox.config import Config
from stereovox.errors import MapFileError
from stereovox.evaluate.metrics import mostly_lost, percentiles
from stereovox.files.safe_io import FLOOR_ENDINGS, check_file, check_in_space
from stereovox.formats.map_server import write_map_server
from stereovox.frame import UpdateReport
from stereovox.maps.files.lock import only_writer_in, only_writer_of_floor
from stereovox.maps.files.store import check_target, sweep
from stereovox.ros.mapping import Mapping, check_continuable
from stereovox.ros.node import MapNode
from stereovox.ros.options import OUT, SLAM, Options, freeze
from stereovox.ros.poses.corrections import check_corrections
from stereovox.runs.engine import Checkpoints, MapOptions, Run
from stereovox.runs.pose_choice import NOT_COMPARED, TRACK, uncompared
from stereovox.runs.warm_up import warm_up

MAX_REPORTS = 10_000
"""Most recent frames whose times are summarised at the end."""


@dataclass(frozen=True, kw_only=True)
class NodeOptions(MapOptions):
    """Options of a `NodeRun`, in addition to `MapOptions`.

    Attributes:
        load: Map to continue; "" for none.
        report: Called at the end, before the map is saved, with the figures and the reports of the last frames.
    """

    checkpoint_s: float = 0.0
    load: str = ""
    report: Callable[[dict[str, Any], Sequence[UpdateReport]], None] = lambda result, reports: None


class NodeRun(Run[None, dict[str, Any]]):
    """Maps live topics until a signal; then it maps waiting frames, saves the map, and returns figures for the report.

    Args:
        node: rclpy's, or its stand-in (`Entities`).
        config: All settings of the map.
        topics: Options of the node: topics, frames, times, and where to save the map.
        options: Options of the run.

    Attributes:
        map_node: The node that makes the map, once entered.

    Raises:
        StereovoxError: On entering: invalid options, or another run writes there.
    """

    usual_end = (KeyboardInterrupt,)
    map_node: MapNode

    def __init__(self, node: Any, config: Config, topics: Options, options: NodeOptions):
        super().__init__(options.notify)
        self._node, self._config, self._topics, self._options = node, config, topics, options
        self._reports: deque[UpdateReport] = deque(maxlen=MAX_REPORTS)

    def _begin(self, stack: ExitStack) -> None:
        config, topics, load = self._config, self._topics, self._options.load
        if config.dimensions == 2 and topics.localised and not load:
            trusting = uncompared(config)
            why = "SLAM and localisation may correct the robot's pose by more than a cell"
            if trusting is not config:
                self._node.get_logger().info(NOT_COMPARED.format(why=why))
            config = trusting
        topics.check_sources()
        check_corrections(topics, config)
        reserve(topics.out, config.dimensions, stack)
        if topics.slam_out:
            reserve(topics.slam_out, 2, stack)
        warm_up(config, topics.poses == TRACK, topics.localised, bool(topics.cloud or topics.scan or topics.range))
        tiles = Path(topics.out).parent / f".{Path(topics.out).name}-tiles" if topics.out else None
        self._mapping = Mapping(config, topics.heights, tiles, self._node.get_logger().warning)
        stack.callback(self._mapping.close)
        if load:
            check_continuable(load, topics.poses not in (TRACK, SLAM))
            self._mapping.load(load)
        stack.callback(freeze(self._node, topics.out))
        self.map_node = MapNode(self._node, self._mapping, topics, self._out, self._reports.append)
        period_s = self._options.checkpoint_s if topics.out else 0.0
        self._checkpoints = Checkpoints(lambda: self._mapping.save(self._out()), topics.out, period_s)

    def step(self) -> None:
        """Receive messages, map one frame, publish what is due, and save the map if that is due."""
        self._go(None)

    def end(self) -> dict[str, Any]:
        """Map waiting frames, save the map, release everything; return figures for the report."""
        with self._open:
            return self._end()

    def _steps(self) -> Iterable[None]:
        return repeat(None)

    def _take(self, step: None) -> None:
        self._or_saved(self.map_node.spin_once)

    def _save_if_due(self) -> None:
        try:
            super()._save_if_due()
        except MapFileError as error:  # a full disk does not stop the robot
            self._node.get_logger().error(str(error), throttle_duration_sec=10.0)

    @property
    def _kept(self) -> int:
        return self._mapping.history.frames

    def _end(self) -> dict[str, Any]:
        ended = self._or_saved(self.map_node.close)
        grid = ended.pop("slam_map", None)
        result = {**self._figures(), **ended}
        self._options.report(result, self._reports)
        few = "".join(f", but {doubt['text']}" for doubt in result.get("doubts", ()))
        try:
            if self._save(few):
                result["out"] = self._out()
            elif self._out():
                self._notify("no frame could be used, so no map is written")
        finally:  # SLAM's map is kept even if the other one cannot be
            if grid is not None and self._topics.slam_out:
                write_map_server(grid, self._topics.slam_out)
                self._notify(f"SLAM's map is saved in {self._topics.slam_out}")
        return result

    def _or_saved(self, act: Callable[[], Any]) -> Any:
        """Call `act`; if it fails, save the map so far."""
        try:
            return act()
        except Exception:
            self._save()
            raise

    def _save(self, few: str = "") -> bool:
        """Save the map if it holds a frame and `ros.out` is set; return whether it was saved. few: a remark on it."""
        if not (self._out() and self._kept):
            return False
        self._mapping.save(self._out())
        self._notify(f"saved in {self._out()}{few}")
        return True

    def _out(self) -> str:
        """Return where to save the map, by a parameter that may change; "": nowhere."""
        return str(self._node.get_parameter(OUT).value)

    def _figures(self) -> dict[str, Any]:
        history, dropped = self._mapping.history, dict(self.map_node.waiting.dropped)
        mapped = [one for one in self._reports if not one.refused]
        found = {
            "frames": history.frames,
            "frames_refused": history.refused.total(),
            "refused": dict(history.refused.most_common()),
            "received": dict(self.map_node.received),
            "dropped": dropped,
            "frame_ms": percentiles([one.match_ms + one.depth_ms + one.integrate_ms for one in mapped]),
            "out": "",
        }
        came = found["frames"] + found["frames_refused"] + sum(dropped.values())
        doubts = mostly_lost(found["frames"], came, "frames")
        return {**found, "doubts": doubts} if doubts else found


def reserve(out: str, dimensions: int, stack: ExitStack) -> None:
    """Check that the map can be saved, and keep others from writing there."""
    if out and dimensions == 2:
        stack.enter_context(only_writer_of_floor(check_file(out, FLOOR_ENDINGS)))
    elif out:
        check_in_space(out)
        check_target(Path(out))
        stack.enter_context(only_writer_in(Path(out)))
        sweep(Path(out))
