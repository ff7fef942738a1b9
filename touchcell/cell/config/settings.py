"""Values set in place of a cell file's own, by dotted key."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from touchcell.cell.config.yaml_file import parse_value
from touchcell.errors import ConfigError


def parse_settings(arguments: Sequence[str]) -> dict[str, Any]:
    """Read ``KEY=VALUE`` arguments of ``--set``; values are written as in a cell file.

    Raises:
        ConfigError: an argument has no "=", an empty key, or a value that is no YAML.
    """
    found: dict[str, Any] = {}
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if not equals or not all(key.split(".")):
            raise ConfigError("is not KEY=VALUE", file="--set", value=argument, hint="e.g. --set task.depth_mm=2.5")
        try:
            found[key] = parse_value(value)
        except ConfigError as error:
            raise ConfigError(error.reason, file="--set", key=key, value=value, hint=error.hint) from None
    return found


def with_settings(data: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of ``data`` with each setting in place; sections that two keys share through a YAML alias stay apart.

    Args:
        data: content of a cell file.
        settings: values by dotted key, such as "task.speed_mm_s"; a number in a key is an index of a list.

    Raises:
        ConfigError: a key leads through something that is no section.
    """
    found = dict(data)
    for key, value in settings.items():
        _set(found, key, value)
    return found


def _set(data: dict[str, Any], key: str, value: Any) -> None:
    *parents, last = key.split(".")
    section: Any = data
    for part in parents:
        inner = section.get(part, {}) if isinstance(section, dict) else _item(section, part, key)
        if not isinstance(inner, dict | list):
            raise ConfigError(f"{part!r} is no section", key=key, value=value, hint="set the key itself")
        # A copy, so that neither the caller's data nor an alias of this section changes.
        inner = inner.copy()
        section[part if isinstance(section, dict) else int(part)] = inner
        section = inner
    if isinstance(section, list):
        _item(section, last, key)
        section[int(last)] = value
    else:
        section[last] = value


def _item(section: list[Any], part: str, key: str) -> Any:
    if not part.isdigit() or int(part) >= len(section):
        raise ConfigError(f"{part!r} is no index of a list of {len(section)}", key=key, hint="indices begin at 0")
    return section[int(part)]
