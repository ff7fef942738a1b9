"""How the next deflection of an operator's input moves an arm, and how buttons change that."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from touchcell.drivers.core.jog import Axes, JogButton, JogFrame, JogMode, JogRequest

SHARES: Final = (0.02, 0.1, 0.2, 0.5, 1.0)
"""Shares of the full speed to choose from."""
STEPS_MM: Final = (0.1, 0.5, 1.0, 2.0, 5.0)
"""Steps to choose from; a step of 1 mm goes with one of 1 deg."""


@dataclass(frozen=True, slots=True)
class JogSettings:
    """How the next deflection moves.

    Attributes:
        arm: role of the arm.
        frame: along whose axes.
        steps: whether it moves by a step.
        until_touch: whether it moves until something is touched.
        share: index of the share of the full speed.
        step: index of the step.
    """

    arm: str
    frame: JogFrame = JogFrame.BASE
    steps: bool = False
    until_touch: bool = False
    share: int = 2
    step: int = 2

    def describe(self) -> str:
        """Return the settings for a status line."""
        how = f"step {STEPS_MM[self.step]:g} mm/deg" if self.steps else f"speed {100 * SHARES[self.share]:g} %"
        return f"{self.arm}  {self.frame.value} frame  {how}{'  until touch' if self.until_touch else ''}"

    def after(self, button: JogButton, arms: Sequence[str]) -> JogSettings:
        """Return the settings after a button, one of ``arms`` being moved."""
        change = 1 if button is JogButton.MORE else -1
        match button:
            case JogButton.FRAME:
                frames = tuple(JogFrame)
                return replace(self, frame=frames[(frames.index(self.frame) + 1) % len(frames)])
            case JogButton.STEPS:
                return replace(self, steps=not self.steps, until_touch=False)
            case JogButton.UNTIL_TOUCH:
                return replace(self, until_touch=not self.until_touch, steps=False)
            case JogButton.NEXT_ARM:
                return replace(self, arm=arms[(arms.index(self.arm) + 1) % len(arms)])
            case JogButton.MORE | JogButton.LESS if self.steps:
                return replace(self, step=min(max(self.step + change, 0), len(STEPS_MM) - 1))
            case JogButton.MORE | JogButton.LESS:
                return replace(self, share=min(max(self.share + change, 0), len(SHARES) - 1))
            case _:
                return self

    def request(self, axes: Axes) -> JogRequest:
        """Return what a deflection asks for."""
        mode = JogMode.STEP if self.steps else JogMode.UNTIL_TOUCH if self.until_touch else JogMode.FREE
        step_mm = STEPS_MM[self.step]
        share = 1.0 if self.steps else SHARES[self.share]
        return JogRequest(self.arm, mode, axes, self.frame, share, 1e-3 * step_mm, math.radians(step_mm))

    def retraction(self) -> JogRequest:
        """Return what asks for a withdrawal."""
        return JogRequest(self.arm, JogMode.RETRACT, share=SHARES[self.share])
