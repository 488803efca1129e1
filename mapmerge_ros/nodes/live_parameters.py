# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The parameters of a fusion node that runs: checked, and applied when they change."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from rcl_interfaces.msg import SetParametersResult

from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.fusion import FusionConfig
from mapmerge_ros.nodes.parameters import (
    CONFIG_SETTINGS,
    FIXED_CONFIG,
    NODE_SETTINGS,
    NodeSettings,
)
from mapmerge_ros.nodes.settings import Change, Setting, checked, declare, read


class LiveParameters:
    """
    Declares every parameter, refuses changes that cannot be made now, and tells of the others.

    Raises
    ------
    InvalidValue
        A value that was given at the start cannot be used.

    """

    def __init__(
        self, node: Any, is_configured: Callable[[], bool], on_change: Callable[[], None]
    ) -> None:
        self._node = node
        self._is_configured = is_configured
        self._on_change = on_change
        config = config_settings(f'{node.get_fully_qualified_name()[1:]}/global')
        self._settings = {item.name: item for item in (*NODE_SETTINGS, *config)}
        for setting in self._settings.values():
            declare(node, setting)
        self.config()
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._applied)

    def settings(self) -> NodeSettings:
        """Return what is about topics and time, as it is now."""
        values = read(self._node, NODE_SETTINGS)
        values['discovery_pattern'] = re.compile(values['discovery_pattern'])
        del values['autostart']
        return NodeSettings(**values)

    def config(self) -> FusionConfig:
        """Return what is about the merge, as it is now."""
        return FusionConfig(**read(self._node, (self._settings[x.name] for x in CONFIG_SETTINGS)))

    @property
    def autostart(self) -> bool:
        """Whether the node brings itself up."""
        return bool(self._node.get_parameter('autostart').value)

    def _check(self, parameters: Sequence[Any]) -> Any:
        known = [item for item in parameters if item.name in self._settings]
        try:
            changes = {item.name: self._checked(item) for item in known}
            engine = {x.name: changes[x.name] for x in CONFIG_SETTINGS if x.name in changes}
            replace(self.config(), **engine)
        except InvalidValue as err:
            return SetParametersResult(successful=False, reason=str(err))
        return SetParametersResult(successful=True)

    def _checked(self, parameter: Any) -> Any:
        setting = self._settings[parameter.name]
        if setting.change is Change.UNCONFIGURED and self._is_configured():
            raise InvalidValue(f'{setting.name}: may change {setting.change.value}')
        return checked(setting, parameter.value)

    def _applied(self, parameters: Sequence[Any]) -> None:
        if self._is_configured() and any(item.name in self._settings for item in parameters):
            self._on_change()


def config_settings(own_map_id: str) -> tuple[Setting, ...]:
    """Parameters of the engine, for a node whose map is called like this by default."""
    first, *others = (
        replace(item, change=Change.UNCONFIGURED if item.name in FIXED_CONFIG else Change.ALWAYS)
        for item in CONFIG_SETTINGS
    )
    return replace(first, default=own_map_id), *others
