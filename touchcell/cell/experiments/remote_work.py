"""Work on other machines: functions that workers cannot import, and time limits where an executor has none."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import packages_distributions
from typing import Any, Final

TIMED_OUT: Final = 124
"""Exit code of a worker that ended itself, as of ``timeout``."""


@dataclass(frozen=True, slots=True)
class LimitedWork:
    """Calls ``work``; its process ends if that takes longer than ``time_limit_s``.

    A thread in Python cannot be ended from outside, and work may hang in a library that never returns.
    """

    work: Callable[[Any], Any]
    time_limit_s: float | None

    def __call__(self, item: Any) -> Any:
        """Return ``work(item)``."""
        if self.time_limit_s is None:
            return self.work(item)
        timer = threading.Timer(self.time_limit_s, os._exit, [TIMED_OUT])
        timer.daemon = True
        timer.start()
        try:
            return self.work(item)
        finally:
            timer.cancel()


def send_by_value(function: Callable[..., Any]) -> None:
    """Have cloudpickle, which dask, Ray and submitit use, send the module of ``function`` itself.

    That is for modules of a script or a notebook; those of installed packages are imported by the worker.
    """
    module = sys.modules.get(getattr(function, "__module__", "__main__"))
    if module is None or module.__name__ == "__main__":
        return
    root = module.__name__.partition(".")[0]
    if root == "touchcell" or root in packages_distributions():
        return
    import cloudpickle

    cloudpickle.register_pickle_by_value(module)
