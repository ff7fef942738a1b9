"""Jog by the keys of a terminal.

A terminal reports that a key is pressed, and repeats it while it is held; it never reports that it is let go. So a tap
moves for the dead-man time, and a held key moves for as long as it repeats.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

from touchcell.cell.runtime.jog_settings import JogSettings
from touchcell.cell.runtime.operator_channel import OperatorChannel, OperatorRequest, operator_name
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.drivers.core.jog import Axes, JogButton, JogMode, JogRequest
from touchcell.drivers.core.samples import Stamped

HELP: Final = (
    "move  u/j x   i/k y   o/l z, capital letters turn about them; arrow keys and page up/down move too",
    "f frame   m steps   t until touch   b back off   + - faster, slower   tab next arm   z zero",
    "s NAME saves: start, corner, surface, a step's name, or any other   q ends   space or Esc stops at once",
)
_KEYS: Final = ["u", "j", "i", "k", "o", "l", "U", "J", "I", "K", "O", "L"]
_SEQUENCES: Final = {
    b"\x1b[A": "i",
    b"\x1b[B": "k",
    b"\x1b[C": "u",
    b"\x1b[D": "j",
    b"\x1b[5~": "o",
    b"\x1b[6~": "l",
    b"\x1bOA": "i",
    b"\x1bOB": "k",
    b"\x1bOC": "u",
    b"\x1bOD": "j",
}
_BUTTONS: Final = {
    "f": JogButton.FRAME,
    "F": JogButton.FRAME,
    "m": JogButton.STEPS,
    "M": JogButton.STEPS,
    "t": JogButton.UNTIL_TOUCH,
    "T": JogButton.UNTIL_TOUCH,
    "\t": JogButton.NEXT_ARM,
    "+": JogButton.MORE,
    "=": JogButton.MORE,
    "-": JogButton.LESS,
}
_TOKEN: Final = re.compile(rb"\x1b\[[0-9;]*[A-Za-z~]|\x1bO[A-Z]|.", re.DOTALL)
_STEP_HELD_NS: Final = 1_000_000_000
"""A step is asked for until it is done, as long as the terminal is there; no step takes longer."""
_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_-]*\Z")
_LONGEST_NAME: Final = 40


def _deflection(key: str) -> Axes:
    number = _KEYS.index(key)
    axis, sign = number % 6 // 2 + (3 if number >= 6 else 0), 1.0 if number % 2 == 0 else -1.0
    x, y, z, a, b, c = (sign if k == axis else 0.0 for k in range(6))
    return x, y, z, a, b, c


class JogKeyboard:
    """Jog input that reads keys; see ``touchcell.drivers.core.jog.JogInput``.

    Args:
        read: returns the bytes of the keys that have been pressed since the last call; None once the terminal is gone.
        arms: roles of the arms.
        stop: asked by space, Esc and q, and at once when the terminal is gone.
        channel: asked for a reset by r, to resume by g.
        save: called with the arm and the name that the operator has typed after s; returns what to show.

    Attributes:
        settings: how the next key moves.
        message: what to show to the operator.
    """

    def __init__(
        self,
        read: Callable[[], bytes | None],
        arms: Sequence[str],
        stop: StopRequest,
        channel: OperatorChannel | None = None,
        save: Callable[[str, str], str] | None = None,
    ) -> None:
        self._read = read
        self._arms = tuple(arms)
        self._stop = stop
        self._channel = channel
        self._save = save
        self._name: str | None = None
        self._newest: Stamped[JogRequest] | None = None
        self._pressed_ns = 0
        self._seq = 0
        self.settings = JogSettings(self._arms[0])
        self.message = ""

    @property
    def prompt(self) -> str:
        """What the operator is typing; empty while nothing is to be saved."""
        return "" if self._name is None else f"save as: {self._name}_"

    def request(self, now_ns: int) -> Stamped[JogRequest] | None:
        """Read the keys, and return what is asked for now."""
        keys = self._read()
        if keys is None:
            self._stop.ask_at_once()
            self._newest = None
            return None
        for token in _TOKEN.findall(keys):
            self._take(token, now_ns)
        newest = self._newest
        if newest is not None and newest.value.mode is JogMode.STEP and now_ns - self._pressed_ns <= _STEP_HELD_NS:
            self._newest = replace(newest, t_ns=now_ns)
        return self._newest

    def _take(self, token: bytes, now_ns: int) -> None:
        if self._name is not None:
            self._type(token)
            return
        if token.startswith(b"\x1b") and token not in _SEQUENCES:
            # Esc, or a key that is not known here.
            self._stop.ask_at_once()
            return
        key = _SEQUENCES.get(token) or token.decode("ascii", "replace")
        if key in _KEYS:
            self._press(key, now_ns)
            return
        # Whatever else is pressed, the arm is let go.
        self._newest = None
        match key:
            case " ":
                self._stop.ask_at_once()
            case "q" | "Q":
                self._stop.ask()
            case "r" | "R" | "g" | "G" if self._channel is not None:
                ask = OperatorRequest.RESET if key in "rR" else OperatorRequest.RESUME
                self._channel.ask(ask, operator_name())
            case "b" | "B":
                self._ask(self.settings.retraction(), now_ns)
            case "z" | "Z":
                self._ask(JogRequest(self.settings.arm, JogMode.ZERO), now_ns)
                self.message = f"zero: {self.settings.arm}'s sensors touch nothing now"
            case "s" | "S" if self._save is not None:
                self._name = ""
            case _:
                self._set(key)

    def _set(self, key: str) -> None:
        button = _BUTTONS.get(key)
        if button is None:
            self.message = f"{key!r} does nothing" if key.isprintable() else ""
        else:
            self.settings, self.message = self.settings.after(button, self._arms), ""

    def _press(self, key: str, now_ns: int) -> None:
        self._ask(self.settings.request(_deflection(key)), now_ns)

    def _ask(self, request: JogRequest, now_ns: int) -> None:
        self.message = ""
        self._seq += 1
        self._pressed_ns = now_ns
        self._newest = Stamped(request, now_ns, self._seq)

    def _type(self, token: bytes) -> None:
        """One key of the name to save under; Esc cancels."""
        self._newest = None
        assert self._name is not None
        if token in (b"\r", b"\n"):
            name, self._name = self._name, None
            self.message = self._saved(name)
        elif token.startswith(b"\x1b"):
            self._name, self.message = None, "nothing saved"
        elif token in (b"\x7f", b"\b"):
            self._name = self._name[:-1]
        elif token.isalnum() or (token in (b"_", b"-") and self._name):
            self._name = (self._name + token.decode("ascii", "replace"))[:_LONGEST_NAME]

    def _saved(self, name: str) -> str:
        if not _NAME.match(name):
            return f"{name!r} is no name: letters, digits, - and _" if name else "nothing saved"
        assert self._save is not None
        return self._save(self.settings.arm, name)
