"""``touchcell new cell NAME --from SHIPPED``: a cell file of one's own, copied from one that ships."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from touchcell.cell.config.find import find_cell
from touchcell.cell.config.yaml_file import load
from touchcell.errors import ConfigError, suggest
from touchcell.paths import CONFIGS

DEFAULT: Final = "surface_follow_sim.yaml"


def new_cell(name: str, source: str | None, folder: Path) -> list[Path]:
    """Copy a cell file, its comments included, and the files beside it that it names; return the copies.

    Args:
        name: of the new file, with or without ``.yaml``.
        source: a cell file, or the name of one that ships; None for a sensor that follows a surface, simulated.
        folder: where to write it.

    Raises:
        ConfigError: there is no such source, a file exists already or cannot be written.
    """
    source = source or DEFAULT
    original = find_cell(Path(source))
    if not original.is_file():
        known = [path.name for path in CONFIGS.glob("*.yaml")]
        raise ConfigError("is no cell file", key="--from", value=source, hint=suggest(source, known))
    copies = {folder / f"{name.removesuffix('.yaml')}.yaml": original}
    copies |= {folder / file: original.parent / file for file in _named_beside(original)}
    for copy in copies:
        if copy.exists():
            raise ConfigError(f"{copy} is there already", key="NAME", value=name, hint="take another name or --out DIR")
    for copy, file in copies.items():
        try:
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(file.read_bytes())
        except OSError as error:
            raise ConfigError(f"{copy} cannot be written: {error.strerror}", hint="--out DIR") from None
    return list(copies)


def _named_beside(cell: Path) -> list[str]:
    """Return the relative paths of files that a cell file names, and of those that they name, each once."""
    found: dict[str, None] = {}
    for text in _texts(load(cell).data):
        if not _is_beside(cell, text):
            continue
        found[text] = None
        if text.endswith((".yaml", ".yml")):
            inside = Path(text).parent
            found |= dict.fromkeys(str(inside / each) for each in _named_beside(cell.parent / text))
    return list(found)


def _is_beside(cell: Path, text: str) -> bool:
    path = Path(text)
    try:
        return bool(text) and not path.is_absolute() and ".." not in path.parts and (cell.parent / path).is_file()
    except (OSError, ValueError):
        return False


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for each in value.values():
            yield from _texts(each)
    elif isinstance(value, list):
        for each in value:
            yield from _texts(each)
