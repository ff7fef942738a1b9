"""Keys of cell files that name files to be read: found beside the cell file that names them, or shipped by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

BUILTIN = "builtin:"


def _none() -> Mapping[str, Path]:
    return {}


@dataclass(frozen=True, slots=True)
class InputFile:
    """Annotation of a key that names a file or folder: ``Annotated[str, InputFile("a tip file")]``.

    The path is relative to the cell file. The planner replaces it by one that is found from anywhere, and refuses what
    is not there.

    Attributes:
        noun: what it is, with its article.
        shipped: finds the files that ship and are named without a path.
        prefix: what such names begin with in a cell file.
        folder: whether a folder is meant.
        suffixes: endings without which the key is a name and no path; none means that any text may be a path.
        hint: how to get such a file.
        has_parts: whether ``#`` and the name of a part may follow the path.
    """

    noun: str
    shipped: Callable[[], Mapping[str, Path]] = field(default=_none)
    prefix: str = ""
    folder: bool = False
    suffixes: tuple[str, ...] = ()
    hint: str = ""
    has_parts: bool = False


def files_in(folder: Path, suffix: str) -> Callable[[], Mapping[str, Path]]:
    """Return what finds the files of ``folder`` that end in ``suffix``, by their names without it."""
    return lambda: {path.name.removesuffix(suffix): path for path in sorted(folder.glob(f"*{suffix}"))}


def read_yaml(path: Path) -> Any:
    """Return the content of a YAML file of data; builds no objects. Raises OSError, UnicodeDecodeError, YAMLError."""
    import yaml

    # The loader in C, where it was built, is ten times as fast.
    return yaml.load(path.read_text(encoding="utf-8"), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
