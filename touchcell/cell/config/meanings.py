"""What each key of a section means: ``Field(description=...)`` of its model, or ``Attributes:`` of the docstrings."""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping
from typing import Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

_ATTRIBUTES = re.compile(r"^Attributes:\n((?:    .*(?:\n|$)|\n)+)", re.MULTILINE)
_ENTRY = re.compile(r"^    ([\w, ]+): (.*(?:\n {6,}.*)*)", re.MULTILINE)


def meanings(model: type[BaseModel]) -> Mapping[str, str]:
    """Return the meaning of every field of ``model`` that has one, by the name of the field."""
    found: dict[str, str] = {}
    for base in reversed(model.__mro__):
        found |= _of_docstring(base)
    for name, field in model.model_fields.items():
        if field.description:
            found[name] = field.description
        elif name not in found and (tag := _tag(field)) is not None:
            found[name] = f"`{tag}`: which kind this is."
    return {name: found[name] for name in model.model_fields if name in found}


def summary(model: type[BaseModel]) -> str:
    """Return what the docstring of ``model`` says before its attributes."""
    text = inspect.cleandoc(model.__dict__.get("__doc__") or "")
    return _ATTRIBUTES.sub("", text).strip()


def _of_docstring(base: type) -> dict[str, str]:
    found = _ATTRIBUTES.search(inspect.cleandoc(base.__dict__.get("__doc__") or ""))
    if found is None:
        return {}
    return {name: " ".join(text.split()) for names, text in _ENTRY.findall(found[1]) for name in names.split(", ")}


def _tag(field: FieldInfo) -> str | None:
    choices = get_args(field.annotation) if get_origin(field.annotation) is Literal else ()
    return str(choices[0]) if len(choices) == 1 else None
