"""Makes a test class out of a rig: one small test for each check, skipped with a reason where it does not apply."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import pytest

from touchcell.testing.emulation.rig import Rig, RigFunction

C = TypeVar("C", bound=Callable[..., None])


@dataclass(frozen=True, slots=True)
class Needs:
    """What a check needs to make sense.

    Attributes:
        needs: abilities, "arm", "camera", "truth" (an emulator), "process" (an emulator of its own), "limited axes".
        on_bench: whether it may be done to a real device.
        of_faults: chooses among the rig's faults, by name, value and lawful answer, those for each of which it is done;
            None for a check that has nothing to do with them.
    """

    needs: tuple[str, ...]
    on_bench: bool
    of_faults: Callable[[str, Any, str], bool] | None

    def missing(self, rig: Rig) -> str | None:
        """Why the check does not apply to ``rig``, or None."""
        capabilities = rig.spec.capabilities
        if rig.start is None and not self.on_bench:
            return "not done to a real device"
        for need in self.needs:
            if need in ("arm", "camera"):
                if capabilities.kind != need:
                    return f"no {need}"
            elif need == "truth":
                if rig.start is None:
                    return "a real device tells no truth beside its own"
            elif need == "process":
                if not rig.process:
                    return "simulated in the client's own process: it cannot vanish or hang while the client lives"
            elif need == "limited axes":
                if all(capabilities.twist_axes):
                    return "follows all six axes"
            elif need not in capabilities.abilities:
                return f"its capability record does not name {need}"
        return None


def check(
    *needs: str, on_bench: bool = False, of_faults: Callable[[str, Any, str], bool] | None = None
) -> Callable[[C], C]:
    """Make a function of a ``Bench`` (and a fault's name) a check of the suite; see ``Needs``."""

    def mark(function: C) -> C:
        function.conformance = Needs(needs, on_bench, of_faults)  # type: ignore[attr-defined]
        return function

    return mark


def suite(rig: RigFunction, *, prefix: str = "Test") -> type:
    """The test class of ``rig``; assign it to a name that begins with ``prefix``.

    Args:
        rig: a function of a module, so that a child process can import it: it must be able to make the client that the
            suite kills.
        prefix: what pytest takes for a test class.
    """
    plan = rig(Path(), 0)
    body: dict[str, Any] = {"rig_function": staticmethod(rig), "driver": plan.spec.name}
    for function in _checks():
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
    def method(self: object, conformance_bench: Any) -> None:
        function(conformance_bench)

    return _named(method, function)


def _fault_method(function: Any) -> Any:
    def method(self: object, conformance_bench: Any, fault: str) -> None:
        function(conformance_bench, fault)

    return _named(method, function)


def _named(method: Any, function: Any) -> Any:
    method.__name__ = f"test_{function.__name__}"
    method.__doc__ = function.__doc__
    method.conformance = function.conformance
    return method
