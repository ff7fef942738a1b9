"""Finds the files that a cell file names: beside it, never by chance in the working directory.

``os.path`` in place of ``Path``, whose tests raise for a name that is too long.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from touchcell.cell.config.yaml_file import KeyPath, YamlFile
from touchcell.errors import ConfigError, suggest
from touchcell.input_file import InputFile

M = TypeVar("M", bound=BaseModel)


def with_input_files(file: YamlFile, model: M, at: KeyPath = ()) -> tuple[M, list[ConfigError]]:
    """Return a copy of ``model`` whose input files are found from anywhere, and what is wrong with those named.

    Args:
        file: the cell file, which knows where each key comes from.
        model: checked settings.
        at: where they stand in the file.
    """
    problems: list[ConfigError] = []
    return _replaced(file, model, at, problems), problems


def with_paths(data: Mapping[str, Any], model: Any, found: Any) -> dict[str, Any]:
    """Return a copy of ``data``, which ``model`` was built from, with the paths that ``found`` has instead."""
    changed = dict(data)
    for key, value in data.items():
        before, after = _part(model, key), _part(found, key)
        if before is after:
            continue
        changed[key] = with_paths(value, before, after) if isinstance(value, Mapping) else after
    return changed


def _part(section: Any, key: str) -> Any:
    return section[key] if isinstance(section, Mapping) else getattr(section, key)


def _replaced(file: YamlFile, value: Any, at: KeyPath, problems: list[ConfigError]) -> Any:
    if isinstance(value, BaseModel):
        changes = {}
        for name, info in type(value).model_fields.items():
            key, old = info.alias or name, getattr(value, name)
            reference = _reference(info)
            if reference is not None and old is not None:
                new = type(old)(_found(file, reference, str(old), (*at, key), problems))
            else:
                new = _replaced(file, old, (*at, key), problems)
            if new is not old:
                changes[name] = new
        return value.model_copy(update=changes) if changes else value
    if isinstance(value, Mapping):
        made = {key: _replaced(file, inner, (*at, key), problems) for key, inner in value.items()}
        return made if any(made[key] is not inner for key, inner in value.items()) else value
    return value


def _reference(info: FieldInfo) -> InputFile | None:
    return next((each for each in info.metadata if isinstance(each, InputFile)), None)


def _found(file: YamlFile, reference: InputFile, name: str, at: KeyPath, problems: list[ConfigError]) -> str:
    """Return the path of ``name``, as found from the file that names it; ``name`` itself where it ships or is wrong."""
    if reference.has_parts and "#" in name:
        whole, mark, part = name.partition("#")
        return _found(file, reference, whole, at, problems) + mark + part
    shipped = reference.shipped()
    is_path = Path(name).suffix in reference.suffixes or not reference.suffixes
    if reference.prefix and name.startswith(reference.prefix):
        word = name.removeprefix(reference.prefix)
        if word not in shipped:
            hint = suggest(word, shipped, otherwise=f"{reference.prefix}NAME with NAME one of")
            problems.append(file.problem(at, f"no {word!r} ships with touchcell", value=name, hint=hint))
        return name
    if not reference.prefix and name in shipped:
        return name
    if not is_path:
        hint = suggest(name, shipped, otherwise="known")
        problems.append(file.problem(at, f"{name!r} is the name of no {_bare(reference.noun)}", value=name, hint=hint))
        return name
    folder = file.source(at).parent
    path = folder / name
    if os.path.isdir(path) if reference.folder else os.path.isfile(path):
        return str(path.absolute())
    reason, hint = _wrong(reference, path), _remedy(reference, name, folder)
    problems.append(file.problem(at, reason, value=name, hint=hint))
    return name


def _wrong(reference: InputFile, path: Path) -> str:
    if not os.path.exists(path):
        return f"no such {'folder' if reference.folder else 'file'}: {path}"
    return f"is {'no folder' if reference.folder else f'no file, as {reference.noun} is'}: {path}"


def _remedy(reference: InputFile, name: str, folder: Path) -> str:
    if not os.path.exists(folder / name) and os.path.exists(name):
        return f"paths are relative to the cell file: write {os.path.relpath(name, folder)}"
    shipped = ", ".join(f"{reference.prefix}{each}" for each in reference.shipped())
    parts = [reference.hint, f"shipped: {shipped}" if shipped else "", "paths are relative to the cell file"]
    return "; ".join(part for part in parts if part)


def _bare(noun: str) -> str:
    return noun.partition(" ")[2] or noun
