"""Where the model files are that cell files name."""

from __future__ import annotations

from pathlib import Path

from touchcell.paths import MODELS

BUILTIN = "builtin:"


def model_path(name: str) -> Path:
    """The file behind a cell file's ``model:``: a path, or ``builtin:NAME`` for one that ships with touchcell."""
    return MODELS / f"{name.removeprefix(BUILTIN)}.safetensors" if name.startswith(BUILTIN) else Path(name)
