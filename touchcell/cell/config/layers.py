"""A cell file and what it builds on: ``extends``, ``x-`` keys, and settings from the command line, merged.

``extends: base.yaml`` takes another file as the base: its path is relative to the file that names it, or it is the bare
name of a cell that ships. Mappings are merged key by key, but for a section that names another driver, kind or task;
any other value replaces the base's. Top-level keys that begin with ``x-`` hold YAML anchors and are left out. Each key
remembers the file and line, or the option, that it comes from.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from touchcell.cell.config.find import find_cell
from touchcell.cell.config.settings import with_settings
from touchcell.cell.config.true_contact import answerable
from touchcell.cell.config.yaml_file import KeyPath, YamlFile, load

EXTENDS: Final = "extends"
PRIVATE: Final = "x-"
OPTION: Final = Path("--set")
_MOST_LAYERS: Final = 8
_logger = logging.getLogger(__name__)


def load_layers(
    path: Path, settings: Mapping[str, Any] | None = None, world_settings: Mapping[str, Any] | None = None
) -> YamlFile:
    """Read a cell file with all files that it extends, and put ``settings`` in place.

    Args:
        path: the cell file.
        settings: values in place of the files' own, by dotted key. With another estimator go the interlocks that only
            the one before could answer.
        world_settings: values that a world puts in place of the files' own; ``settings`` go before them.

    Raises:
        ConfigError: as ``yaml_file.load``; ``extends`` is no path, leads in a circle or too far; a setting's key leads
            through something that is no section.
    """
    merged = _load(path, [])
    if world_settings:
        merged = _with_settings(merged, world_settings, Path(f"--on {world_settings.get('world', '')}".strip()))
    return _with_settings(merged, settings, OPTION) if settings else merged


def _with_settings(merged: YamlFile, settings: Mapping[str, Any], source_of_them: Path) -> YamlFile:
    lines, sources = dict(merged.lines), dict(merged.sources)
    for key in settings:
        at = tuple(int(part) if part.isdigit() else part for part in key.split("."))
        # Sections that only the setting makes come from it too.
        made = [at[:count] for count in range(1, len(at) + 1) if at[:count] not in lines or count == len(at)]
        lines = {known: line for known, line in lines.items() if known[: len(at)] != at} | dict.fromkeys(made, 0)
        sources = {known: source for known, source in sources.items() if known[: len(at)] != at}
        sources |= dict.fromkeys(made, source_of_them)
    data = with_settings(merged.data, settings)
    if any(key.endswith(".estimator") for key in settings):
        data = _without_unanswered(data)
    return YamlFile(merged.path, data, lines, sources)


def _without_unanswered(data: dict[str, Any]) -> dict[str, Any]:
    """Return ``data`` without interlocks that no estimator of it answers any more, and say which those are."""
    interlocks, kept = data.get("interlocks"), answerable(data)
    left = sorted(str(name) for name in interlocks if name not in kept) if isinstance(interlocks, Mapping) else []
    if left:
        _logger.warning("left out with the estimator that they ask: interlocks %s", ", ".join(left))
    return {**data, "interlocks": kept} if left else data


def explain(file: YamlFile) -> str:
    """Return the merged file as YAML, each value with the file and line, or the option, that it comes from."""
    rows = list(_rows(file, file.data, (), 0))
    width = min(max((len(text) for text, _ in rows), default=0), 72)
    return "\n".join(f"{text:{width}}  # {origin}" if origin else text for text, origin in rows)


def _load(path: Path, above: Sequence[Path]) -> YamlFile:
    file = load(path)
    resolved = path.resolve()
    private = [key for key in file.data if isinstance(key, str) and key.startswith(PRIVATE)]
    data = {key: value for key, value in file.data.items() if key not in private and key != EXTENDS}
    own = {known: line for known, line in file.lines.items() if not known or known[0] in data}
    if EXTENDS not in file.data:
        return YamlFile(path, data, own)
    base_name = file.data[EXTENDS]
    if not isinstance(base_name, str) or not base_name:
        raise file.problem((EXTENDS,), "is no path of a cell file", value=base_name, hint="e.g. `extends: base.yaml`")
    base_path = path.parent / base_name
    if not os.path.lexists(base_path) and Path(base_name).name == base_name:
        base_path = find_cell(base_path)
    if base_path.resolve() in [*above, resolved]:
        raise file.problem((EXTENDS,), "leads back to a file that extends this one", value=base_name)
    if len(above) >= _MOST_LAYERS:
        raise file.problem((EXTENDS,), f"leads through more than {_MOST_LAYERS} files", value=base_name)
    if not os.path.isfile(base_path):  # Path.is_file raises for a name that is too long
        hint = "the path is relative to the file that names it"
        raise file.problem((EXTENDS,), f"no such file: {base_name}", value=base_name, hint=hint)
    base = _load(base_path, [*above, resolved])
    lines, sources = dict(base.lines), {known: base.source(known) for known in base.lines}
    result = _merge(base.data, data, (), own, path, lines, sources)
    return YamlFile(path, result, lines, sources)


def _merge(
    base: Mapping[str, Any],
    over: Mapping[str, Any],
    at: KeyPath,
    over_lines: Mapping[KeyPath, int],
    path: Path,
    lines: dict[KeyPath, int],
    sources: dict[KeyPath, Path],
) -> dict[str, Any]:
    """Return ``over`` merged onto ``base``, and change ``lines`` and ``sources`` of the base accordingly."""
    merged = dict(base)
    for key, value in over.items():
        here = (*at, key)
        below = merged.get(key)
        if isinstance(value, dict) and isinstance(below, dict) and not _another(below, value):
            merged[key] = _merge(below, value, here, over_lines, path, lines, sources)
            continue
        merged[key] = value
        for known in [known for known in lines if known[: len(here)] == here]:
            del lines[known], sources[known]
        for known, line in over_lines.items():
            if known[: len(here)] == here:
                lines[known], sources[known] = line, path
    return merged


def _another(base: Mapping[str, Any], over: Mapping[str, Any]) -> bool:
    """Return whether ``over`` is of another kind than ``base``, so that their keys do not belong together."""
    return any(key in over and over[key] != base.get(key, over[key]) for key in ("driver", "kind", "name"))


def _rows(file: YamlFile, data: Mapping[str, Any], at: KeyPath, depth: int) -> Sequence[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for key, value in data.items():
        here = (*at, key)
        indent = "  " * depth
        if isinstance(value, dict) and value:
            rows.append((f"{indent}{key}:", ""))
            rows += _rows(file, value, here, depth + 1)
        else:
            source, line = file.source(here), file.line(here)
            origin = f"{source}:{line}" if line else str(source)
            rows.append((f"{indent}{key}: {_inline(value)}", origin))
    return rows


def _inline(value: Any) -> str:
    """Return ``value`` as YAML on one line."""
    import yaml

    text: str = yaml.safe_dump(value, default_flow_style=True, allow_unicode=True, width=10**6)
    return text.strip().removesuffix("...").strip()
