"""File of a calibrated sensor: the parameters of one tip, its camera and its mount from ``touchcell calibrate-sim``."""

from __future__ import annotations

import os
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from touchcell.errors import ConfigError, suggest
from touchcell.input_file import read_yaml
from touchcell.simulation.mount import MountModel
from touchcell.simulation.tip import TipParameters

SHIPPED = Path(__file__).parent / "tips"


class TipFile(BaseModel):
    """Parameters of one sensor; units are in their names.

    Attributes:
        tip: layout, camera and skin.
        rig: mount and slip.
        measured: fit method and marker errors on held-out images, for the operator.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, defer_build=True)

    schema_: Literal[1] = Field(default=1, alias="schema")
    tip: TipParameters
    rig: MountModel = MountModel()
    measured: dict[str, str | int | float | dict[str, float]] = {}

    @model_validator(mode="before")
    @classmethod
    def _known(cls, data: Any) -> Any:
        for section, kind in (("tip", TipParameters), ("rig", MountModel)):
            given = data.get(section) if isinstance(data, dict) else None
            names = [each.name for each in fields(kind)]
            for name in given if isinstance(given, dict) else ():
                if name not in names:
                    hint = suggest(name, names)
                    raise ValueError(f"{section}.{name} is unknown{'; ' + hint if hint else ''}")
        return data


def load_tip(name: str) -> TipFile:
    """Read the tip file ``name``: a path, or the name of a sensor that ships with touchcell.

    Raises:
        ConfigError: no such file, or its content is invalid.
    """
    shipped = SHIPPED / f"{name}.yaml"
    path = shipped if os.path.isfile(shipped) else Path(name)
    try:
        data = read_yaml(path)
        return TipFile.model_validate(data)
    except OSError as error:
        known = ", ".join(sorted(each.stem for each in SHIPPED.glob("*.yaml")))
        raise ConfigError(
            f"cannot be read: {error.strerror}",
            file=str(path),
            hint=f"make one with `touchcell calibrate-sim`; these ship: {known}",
        ) from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"is not YAML: {error}", file=str(path)) from None
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise ConfigError(first["msg"], file=str(path), key=key) from None


def save_tip(tip: TipFile, path: Path) -> None:
    """Write a tip file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {
        "schema": 1,
        "tip": _plain(asdict(tip.tip)),
        "rig": _plain(asdict(tip.rig)),
        "measured": dict(tip.measured),
    }
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """Round to six digits: more than the precision of any of them."""
    return {
        name: [float(f"{each:.6g}") for each in value]
        if isinstance(value, tuple)
        else value
        if isinstance(value, int)
        else float(f"{value:.6g}")
        for name, value in values.items()
    }
