"""Poses that were taught by moving an arm by hand, written into the cell file with its comments kept."""

from __future__ import annotations

import io
import os
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.config.settings import with_settings
from touchcell.cell.config.yaml_file import load
from touchcell.control.interlocks.boundary import WorkspaceConfig
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.paths import CONFIGS

if TYPE_CHECKING:
    from ruamel.yaml import YAML

START: Final = "start"
CORNER: Final = "corner"
SURFACE: Final = "surface"
POSES: Final = "x-poses"
"""Section of poses under names of their own, each with a YAML anchor: ``to_mm_deg: *NAME`` takes one."""

Check = Callable[[Mapping[str, Any]], object]
"""Plans the cell with settings in place of the file's own; raises ConfigError where they make no valid cell."""


class Teacher:
    """Turns names and poses into changes of one cell file, and writes them.

    Args:
        path: the cell file.
        plan: of the cell as it runs.
        check: see ``Check``.
    """

    def __init__(self, path: Path, plan: CellPlan, check: Check) -> None:
        self._path = path.resolve()
        self._plan = plan
        self._check = check
        self._corners: dict[str, Array] = {}

    def save(self, arm: str, name: str, T_base_tcp: Array) -> str:
        """Save a pose under a name, and return what was written.

        Args:
            arm: role of the arm.
            name: ``start``, ``corner``, ``surface``, the name of a step with ``to_mm_deg``, or any other.
            T_base_tcp: (4, 4) pose of its tool.

        Raises:
            ConfigError: the file has no place for it, would not pass ``touchcell check`` with it, or cannot be written.
        """
        if self._path.is_relative_to(CONFIGS.resolve()):
            hint = f"`touchcell new cell NAME --from {self._path.name}` makes a copy to jog"
            raise ConfigError("ships with touchcell and is not changed", file=str(self._path), hint=hint)
        if name == CORNER and arm not in self._corners:
            self._require_workspace(arm)
            self._corners[arm] = T_base_tcp
            return "first corner taken; move to the opposite one and save `corner` again"
        changes = self._changes(arm, name, T_base_tcp)
        write_changes(self._path, changes, self._check)
        self._corners.pop(arm, None)
        return "; ".join(f"{key}: {value}" for key, value in changes.items())

    def _changes(self, arm: str, name: str, T_base_tcp: Array) -> dict[str, Any]:
        device = self._plan.arm_roles.get(arm, arm)
        if name == START:
            return {f"arms.{device}.start_pose_mm_deg": pose_mm_deg(T_base_tcp)}
        if name == SURFACE:
            return self._surface(arm, T_base_tcp)
        if name == CORNER:
            return self._box(arm, T_base_tcp)
        data = load(self._path).data
        if (at := _step(data.get("task"), name)) is not None:
            return {f"{at}.to_mm_deg": pose_mm_deg(T_base_tcp)}
        return {f"{POSES}.{name}": pose_mm_deg(T_base_tcp)}

    def _surface(self, arm: str, T_base_tcp: Array) -> dict[str, Any]:
        device = self._plan.arm_roles.get(arm, arm)
        for name, section in self._plan.cell.sensors.items():
            if section.mounted_on == device and hasattr(section.estimator, "surface_mm_deg"):
                pose = pose_mm_deg(se3.compose(T_base_tcp, section.T_tcp_sensor))
                return {f"sensors.{name}.estimator.surface_mm_deg": pose}
        hint = "estimator: {kind: known_surface, ...} has one"
        raise ConfigError(f"no sensor on {device} has a surface_mm_deg", file=str(self._path), key="sensors", hint=hint)

    def _require_workspace(self, arm: str) -> tuple[str, WorkspaceConfig]:
        for name, entry in self._plan.cell.interlocks.items():
            if isinstance(entry, WorkspaceConfig) and entry.arm == arm:
                return name, entry
        reason = f"no interlock of kind workspace guards {arm!r}"
        raise ConfigError(reason, file=str(self._path), key="interlocks", hint="add one, with any box")

    def _box(self, arm: str, T_base_tcp: Array) -> dict[str, Any]:
        name, entry = self._require_workspace(arm)
        T_tcp_point = np.eye(4)
        if entry.sensor is not None:
            T_tcp_point = self._plan.cell.sensors[self._plan.sensor_roles[entry.sensor]].T_tcp_sensor
        first, second = (1e3 * se3.compose(T, T_tcp_point)[:3, 3] for T in (self._corners[arm], T_base_tcp))
        low, high = np.minimum(first, second), np.maximum(first, second)
        return {f"interlocks.{name}.min_mm": _numbers(low, 2), f"interlocks.{name}.max_mm": _numbers(high, 2)}


def pose_mm_deg(T: Array) -> list[float]:
    """Return a pose (4, 4) as a cell file has it: x, y, z in mm, alpha, beta, gamma in degrees."""
    values = se3.to_euler_mm_deg(T)
    return [*_numbers(values[:3], 2), *_numbers(values[3:], 3)]


def write_changes(path: Path, changes: Mapping[str, Any], check: Check) -> None:
    """Put values into a cell file, by dotted key, atomically and with its comments, order and formatting kept.

    Raises:
        ConfigError: the cell would not pass ``touchcell check``, the file cannot be written, or its YAML cannot be kept
            as it is.
    """
    check({key: value for key, value in changes.items() if not key.startswith("x-")})
    before = path.read_text(encoding="utf-8")
    wanted = with_settings(load(path).data, changes)
    new = path.with_name(f".{path.name}.new")
    try:
        new.write_text(changed_text(before, changes), encoding="utf-8")
        shutil.copymode(path, new)
        if load(new).data != wanted:
            hint = "put the values in by hand"
            raise ConfigError(f"cannot be changed with its form kept: {changes}", file=str(path), hint=hint)
        with new.open("rb") as stream:
            os.fsync(stream.fileno())
        os.replace(new, path)
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", file=str(path)) from None
    finally:
        new.unlink(missing_ok=True)


def changed_text(text: str, changes: Mapping[str, Any]) -> str:
    """Return YAML ``text`` with values in place, by dotted key; the rest stays as it is written."""
    yaml = _round_trip(text)
    data = yaml.load(text)
    for key, value in changes.items():
        _put(data, key.split("."), value)
    out = io.StringIO()
    yaml.dump(data, out)
    return out.getvalue()


def _round_trip(text: str) -> YAML:
    from ruamel.yaml import YAML

    yaml = YAML(typ="rt")
    yaml.preserve_quotes = True
    yaml.width = 1 << 20
    # Sequences are indented as the first one that stands below its key.
    below = re.search(r"^( *)[^\s#-][^\n]*:[ \t]*(?:#[^\n]*)?\n(?:[ \t]*#[^\n]*\n|\s*\n)*( *)- ", text, re.MULTILINE)
    offset = max(len(below[2]) - len(below[1]), 0) if below else 2
    nested = re.search(r"^( *)[^\s#-][^\n]*:[ \t]*(?:#[^\n]*)?\n( +)[^\s#-]", text, re.MULTILINE)
    mapping = max(len(nested[2]) - len(nested[1]), 1) if nested else 2
    yaml.indent(mapping=mapping, sequence=offset + 2, offset=offset)
    return yaml


def _put(data: Any, keys: Sequence[str], value: Any) -> None:
    from ruamel.yaml.comments import CommentedMap, CommentedSeq

    *parents, last = keys
    for part in parents:
        if isinstance(data, list):
            data = data[int(part)]
            continue
        if data.get(part) is None:
            data[part] = CommentedMap()
        data = data[part]
    present = data.get(last)
    if isinstance(present, CommentedSeq) and present.anchor.value is None and len(present) == len(value):
        for k, each in enumerate(value):
            present[k] = each
        return
    made = CommentedSeq(value)
    made.fa.set_flow_style()
    if keys[0] == POSES:
        made.yaml_set_anchor(last, always_dump=True)
    data[last] = made


def _step(task: Any, name: str) -> str | None:
    """Return the dotted key of the step ``name`` that moves to a pose; None if there is none."""

    def found(steps: Any, at: str) -> str | None:
        for k, step in enumerate(steps if isinstance(steps, list) else ()):
            for kind, fields in step.items() if isinstance(step, dict) else ():
                here = f"{at}.{k}.{kind}"
                if not isinstance(fields, dict):
                    continue
                if fields.get("name") == name and "to_mm_deg" in fields:
                    return here
                if (inner := found(fields.get("steps"), f"{here}.steps")) is not None:
                    return inner
        return None

    return found(task.get("steps"), "task.steps") if isinstance(task, dict) else None


def _numbers(values: Array, digits: int) -> list[float]:
    """Return plain numbers; whole ones without a decimal point, as people write them, and none of them -0."""
    rounded = [round(float(value), digits) + 0.0 for value in values]
    return [int(value) if value == int(value) else value for value in rounded]
