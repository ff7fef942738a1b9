"""The C extensions: used where they were built, and never missing in silence.

Where one is missing, plain code serves, slower, or says what it cannot do. A process logs that as a warning, once;
reports and ``touchcell devices`` show it too. With the environment variable ``TOUCHCELL_REQUIRE_COMPILED`` set, as in
continuous integration, a missing one is an error where it is imported.
"""

from __future__ import annotations

import logging
import os
from importlib import import_module
from types import ModuleType
from typing import Final

from touchcell.errors import TouchcellError

EXTENSIONS: Final = {
    "touchcell.geometry._se3c": "poses and Gaussians on them are computed in Python, about 20 times slower",
    "touchcell.control.interlocks._distances": "distances between arms and obstacles take 0.2 ms a cycle, not 0.01",
    "touchcell.drivers.v4l2._jpegc": "damage inside a camera's JPEG frame is not noticed, only a missing end",
    "touchcell.perception._kernelsc": "image filters are OpenCV's, slower; marker estimators cannot be used",
    "touchcell.simulation._paint": "simulated images are drawn in Python, slower",
    "touchcell.simulation.meshes._mesh": "nearest points of meshes are searched in Python, about 1000 times slower",
}
"""Module name -> what its absence costs."""

REQUIRE: Final = "TOUCHCELL_REQUIRE_COMPILED"
PURE: Final = "TOUCHCELL_PURE_PYTHON"

_logger = logging.getLogger(__name__)
_warned: set[str] = set()


class ExtensionMissing(TouchcellError, ImportError):
    """A C extension is missing, and ``TOUCHCELL_REQUIRE_COMPILED`` asks for it.

    Attributes:
        extension: its module name.
    """

    def __init__(self, extension: str, reason: str) -> None:
        super().__init__(
            f"the C extension {extension} cannot be imported: {reason}",
            hint=f"install a C compiler and install touchcell again, or unset {REQUIRE}",
        )
        self.extension = extension


def unless_plain(name: str) -> ModuleType | None:
    """The extension ``name`` for code that has plain kernels, too: None where it was not built, or these are asked for.

    The environment variable ``TOUCHCELL_PURE_PYTHON`` asks for them.

    Raises:
        ExtensionMissing: as ``extension`` does.
    """
    return None if os.environ.get(PURE) else extension(name)


def extension(name: str) -> ModuleType | None:
    """The extension ``name``, or None with a warning where it was not built.

    Raises:
        ExtensionMissing: it was not built, and ``TOUCHCELL_REQUIRE_COMPILED`` is set.
    """
    try:
        return import_module(name)
    except ImportError as error:
        if os.environ.get(REQUIRE):
            raise ExtensionMissing(name, str(error)) from None
        if not _warned:
            _warned.add(name)
            _logger.warning("C extension %s is missing: %s", name, EXTENSIONS[name])
        return None


def missing() -> list[str]:
    """One line for each extension that is missing; empty where all are there."""
    lines = []
    for name, cost in EXTENSIONS.items():
        try:
            import_module(name)
        except ImportError:
            lines.append(f"C extension {name} is missing: {cost}")
    return lines
