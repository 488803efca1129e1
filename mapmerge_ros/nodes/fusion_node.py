# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Node that merges the sub-maps of a fleet as they come, and says whether to believe it.

It is a managed node: a lifecycle manager may bring it up and down; by default it does so itself.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn

from mapmerge_ros.errors import MapMergeError
from mapmerge_ros.nodes.live_parameters import LiveParameters, own_settings
from mapmerge_ros.nodes.process import run_node
from mapmerge_ros.nodes.session import Session

RCLError = rclpy_implementation.RCLError


class StartError(MapMergeError):
    """The node could not bring itself up."""


class FusionNode(LifecycleNode):  # type: ignore[misc]
    """Parameters for all its life; a session from `configure` to `cleanup`."""

    def __init__(self, **options: Any) -> None:
        super().__init__('fusion_node', **options)
        self._survive_impossible_transitions()
        self.session: Session | None = None
        self.parameters = LiveParameters(
            self, lambda: self.session is not None, self._on_parameters
        )
        if self.parameters.autostart:
            for bring_up in (self.trigger_configure, self.trigger_activate):
                if bring_up() is not TransitionCallbackReturn.SUCCESS:
                    raise StartError('the node could not be started, its log says why')

    def on_configure(self, state: Any) -> Any:
        """Make the engine, topics and services, and begin to tell how one is."""
        return self._transition('configure', self._configure)

    def on_activate(self, state: Any) -> Any:
        """Listen and merge."""
        return self._transition('activate', self._activate)

    def on_deactivate(self, state: Any) -> Any:
        """Stop listening and merging; the maps stay."""
        return self._transition('deactivate', self._deactivate)

    def on_cleanup(self, state: Any) -> Any:
        """Forget everything but the parameters."""
        if self.session is not None and self.session.merges.awaited:
            self.get_logger().warning('cleanup: somebody waits for a merge')
            return TransitionCallbackReturn.FAILURE
        return self._transition('cleanup', self._end)

    def on_shutdown(self, state: Any) -> Any:
        """Forget everything, for ever."""
        return self._transition('shutdown', self._end)

    def on_error(self, state: Any) -> Any:
        """Begin anew after a failed transition."""
        return self._transition('error', self._end)

    def _survive_impossible_transitions(self) -> None:
        """Answer who asks for one; rclpy raises, and the node would end with all its maps."""
        service = self._service_change_state
        change = service.callback

        def answer(request: Any, response: Any) -> Any:
            try:
                return change(request, response)
            except RCLError:
                _, state = self._state_machine.current_state
                wanted = request.transition.label or request.transition.id
                self.get_logger().warning(f'transition {wanted} is not possible while {state}')
                response.success = False
                return response

        service.callback = answer

    def close(self) -> None:
        """End the worker; a merge that does not end is left behind."""
        if self.session is not None and not self.session.merges.close():
            # The logger is gone with the context.
            print('ended during a merge, which is lost', file=sys.stderr)

    def _configure(self) -> None:
        self.session = Session(self, self.parameters)

    def _activate(self) -> None:
        assert self.session is not None
        self.session.activate()

    def _deactivate(self) -> None:
        assert self.session is not None
        self.session.deactivate()

    def _end(self) -> None:
        if self.session is not None:
            session, self.session = self.session, None
            session.destroy()

    def _transition(self, name: str, do: Callable[[], None]) -> Any:
        """Without this a failure would be seen as a state, and its reason nowhere."""
        try:
            do()
        except Exception as err:
            self.get_logger().error(f'{name} failed: {err}\n{traceback.format_exc()}')
            return TransitionCallbackReturn.ERROR
        return TransitionCallbackReturn.SUCCESS

    def _on_parameters(self) -> None:
        if self.session is not None:
            self.session.reconfigure()


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until it is stopped."""
    return run_node(FusionNode, args, own_settings('', 'fusion_node'))


if __name__ == '__main__':
    raise SystemExit(main())
