# SPDX-License-Identifier: Apache-2.0
"""The node as a managed one (ROS 2's lifecycle): configure, activate, deactivate, cleanup, shutdown.

Unconfigured, it has no topics. Configured, it has them and knows poses, but maps nothing until it is active. Cleanup
saves the map and destroys everything; the next configuration reads the parameters again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from typing import Any

from stereovox.errors import StereovoxError
from stereovox.ros.run import NodeRun
from stereovox.runs.engine import Run

IDLE_S = 0.1
CREATE = {
    "create_publisher": "destroy_publisher",
    "create_subscription": "destroy_subscription",
    "create_service": "destroy_service",
}
"""Methods that make the entities of a node, and those that destroy them."""


class Entities:
    """Stands in for a node, records the entities that are made, and destroys them."""

    def __init__(self, node: Any):
        self._node = node
        self._made: list[tuple[str, Any]] = []

    @property
    def itself(self) -> Any:
        """The node."""
        return self._node

    def __getattr__(self, name: str) -> Any:
        return partial(self._create, name) if name in CREATE else getattr(self._node, name)

    def destroy(self) -> None:
        """Destroy all recorded publishers, subscriptions and services."""
        while self._made:
            name, one = self._made.pop()
            getattr(self._node, CREATE[name])(one)

    def _create(self, name: str, *args: Any, **kwargs: Any) -> Any:
        made = getattr(self._node, name)(*args, **kwargs)
        self._made.append((name, made))
        return made


class Managed(Run[None, dict[str, Any]]):
    """Holds at most one `NodeRun`, by the node's state, until the node is shut down or a signal arrives.

    begin: called at configuration with the stand-in for the node, returns an entered run; if it raises StereovoxError,
    the configuration has failed.
    """

    usual_end = (KeyboardInterrupt,)

    def __init__(self, node: Any, begin: Callable[[Any], NodeRun]):
        from rclpy.executors import SingleThreadedExecutor

        super().__init__()
        self._node, self._begin_run = node, begin
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self._entities = Entities(node)
        self._run: NodeRun | None = None
        self._over, self._ended, self._report = False, False, dict[str, Any]()
        node.managed = self

    def _begin(self, stack: ExitStack) -> None:
        """Wait for transitions."""

    def _steps(self) -> Iterator[None]:
        while not self._ended:
            yield

    def _take(self, step: None) -> None:
        """Receive messages and calls, and map one frame if the node is active."""
        if self._run is None:
            self._executor.spin_once(timeout_sec=IDLE_S)
            return
        self._run.step()
        if self._over:  # not in the callback: topics would vanish while their messages arrive
            self._end()

    def _end(self) -> dict[str, Any]:
        """End the run, if any, and destroy its topics; return the figures of the last run."""
        run, self._run, self._over = self._run, None, False
        if run is not None:
            try:
                self._report = run.end()
            finally:
                self._entities.destroy()
                self._executor.add_node(self._node)
        return self._report

    def configure(self) -> bool:
        """Make the topics and an empty map; return whether that succeeded."""
        if self._over:  # cleanup and configuration were requested before the last run could end
            self._node.get_logger().error("not configured: the last map is still being saved; configure again later")
            return False
        try:
            self._run = run = self._begin_run(self._entities)
        except Exception as error:  # rclpy would swallow it
            self._entities.destroy()
            self._executor.add_node(self._node)
            why = str(error) if isinstance(error, StereovoxError) else repr(error)
            self._node.get_logger().error(f"not configured: {why}")
            return False
        run.map_node.active = False
        return True

    def activate(self, active: bool) -> None:
        """Start or stop mapping."""
        if self._run is not None:
            self._run.map_node.active = active

    def cleanup(self) -> None:
        """End the run soon."""
        self._over = self._run is not None

    def shut_down(self) -> None:
        """End the run soon, and then the process."""
        self.cleanup()
        self._ended = True


def managed_node(name: str, **kwargs: Any) -> Any:
    """Return an unconfigured `rclpy.lifecycle.LifecycleNode` whose transitions go to its `Managed`."""
    from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn

    done, failed = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE

    class Node(LifecycleNode):
        managed: Managed

        def on_configure(self, state: Any) -> Any:
            return done if self.managed.configure() else failed

        def on_activate(self, state: Any) -> Any:
            self.managed.activate(True)
            return done

        def on_deactivate(self, state: Any) -> Any:
            self.managed.activate(False)
            return done

        def on_cleanup(self, state: Any) -> Any:
            self.managed.cleanup()
            return done

        def on_shutdown(self, state: Any) -> Any:
            self.managed.shut_down()
            return done

    return Node(name, **kwargs)
