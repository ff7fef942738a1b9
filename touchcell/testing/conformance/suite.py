"""Build a test class from a device fixture: one test per check, skipped with a reason where it does not apply."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import pytest

from touchcell.testing.conformance.check import Needs
from touchcell.testing.emulation.rig import FixtureFactory


def suite(rig: FixtureFactory, *, prefix: str = "Test", only: Collection[str] | None = None) -> type:
    """Return the test class of ``rig``; assign it to a name that begins with ``prefix``.

    Args:
        rig: a module-level function, so that the client process that the suite kills can import it.
        prefix: prefix of test classes in pytest.
        only: names of the checks to run; None for all.
    """
    plan = rig(Path(), 0)
    body: dict[str, Any] = {"rig_function": staticmethod(rig), "driver": plan.spec.name}
    for function in _checks():
        if only is not None and function.__name__ not in only:
            continue
        needs: Needs = function.conformance
        choose = needs.of_faults
        if choose is None:
            body[f"test_{function.__name__}"] = _method(function)
        elif chosen := [fault for fault, (value, answer) in plan.faults.items() if choose(fault, value, answer)]:
            body[f"test_{function.__name__}"] = pytest.mark.parametrize("fault", chosen)(_fault_method(function))
    return type(f"{prefix}{plan.spec.name.title().replace('_', '')}", (), body)


def _checks() -> Iterator[Any]:
    from touchcell.testing.conformance import commands, faults, frames, lifecycle, motion, samples

    for module in (lifecycle, samples, commands, motion, faults, frames):
        for function in vars(module).values():
            if hasattr(function, "conformance") and function.__module__ == module.__name__:
                yield function


def _method(function: Any) -> Any:
    def method(self: object, conformance_context: Any) -> None:
        function(conformance_context)

    return _named(method, function)


def _fault_method(function: Any) -> Any:
    def method(self: object, conformance_context: Any, fault: str) -> None:
        function(conformance_context, fault)

    return _named(method, function)


def _named(method: Any, function: Any) -> Any:
    method.__name__ = f"test_{function.__name__}"
    method.__doc__ = function.__doc__
    method.conformance = function.conformance
    return method
