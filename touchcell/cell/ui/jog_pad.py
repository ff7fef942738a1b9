"""The page's buttons that move an arm by hand."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from nicegui import ui


class JogPad(ui.element, component=Path(__file__).with_suffix(".js")):  # type: ignore[misc, call-arg]
    """Buttons that are held; see ``jog_pad.js``.

    Args:
        run: name of the run.
        arms: roles of its arms.
    """

    def __init__(self, run: str, arms: Sequence[str]) -> None:
        super().__init__()
        self.classes("w-full")
        self._props["run"] = run
        self._props["arms"] = list(arms)
