"""What a task's parameters ask of every run, in the order of the file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel

from touchcell.cell.config.yaml_file import KeyPath
from touchcell.tasks.interface import Demand


def demands(config: Any, quantity: str, at: KeyPath = ()) -> Iterator[tuple[KeyPath, float]]:
    """What a task's parameters ask for, with the key of each; steps of a task are wrapped in their own names."""
    if isinstance(config, list | tuple):
        for index, each in enumerate(config):
            yield from demands(each, quantity, (*at, index, *_wrapper(each)))
    if not isinstance(config, BaseModel):
        return
    for name, info in type(config).model_fields.items():
        value = getattr(config, name)
        demand = next((each for each in info.metadata if isinstance(each, Demand)), None)
        if demand is None:
            yield from demands(value, quantity, (*at, name))
        elif demand.quantity == quantity and value is not None:
            numbers = value if isinstance(value, tuple) else (value,)
            yield (*at, name), float(max(numbers) if demand.item is None else numbers[demand.item])


def _wrapper(step: Any) -> KeyPath:
    kind = getattr(step, "kind", None)
    return (kind,) if isinstance(kind, str) else ()
