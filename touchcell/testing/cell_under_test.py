"""A running cell as a test object: step it, inject faults, reset it, and ask what happened."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from pydantic import TypeAdapter

from touchcell.cell.config.armed import cell_facts
from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.config.find import find_cell
from touchcell.cell.config.schema import plan_in_world
from touchcell.cell.config.worlds import WorldName
from touchcell.cell.recording.message_types import Encoded
from touchcell.cell.runtime.compose import AnyInterlock, compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.operator_channel import OperatorChannel, OperatorRequest
from touchcell.cell.runtime.run_result import RunResult
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.cell.runtime.stopping import StopReport
from touchcell.control.interlocks.boundary import WorkspaceConfig
from touchcell.control.interlocks.config import InterlocksConfig
from touchcell.control.interlocks.coverage import CannotTrip, Fault, Provable
from touchcell.control.interlocks.settings import InterlockSettings
from touchcell.control.interlocks.violation import Violation
from touchcell.control.proof import prove
from touchcell.drivers.core.device import Device
from touchcell.errors import ConfigError, suggest
from touchcell.testing.emulation.world import EmulatedCell
from touchcell.testing.shown_interlock import Shown, shown

OPERATOR: Final = "test"
_LIMIT_S: Final = 60.0
_TRIPS_WITHIN_S: Final = 1.0


@dataclass(frozen=True, slots=True)
class Message:
    """One recorded message.

    Attributes:
        topic: e.g. "/arms/arm/command".
        t_ns: time on the cell's clock.
        encoded: content as it is recorded.
    """

    topic: str
    t_ns: int
    encoded: Encoded

    @property
    def data(self) -> Mapping[str, Any]:
        """Content, units in the keys."""
        content: Mapping[str, Any] = self.encoded.decode()
        return content


class CellUnderTest:
    """A cell on simulated devices and virtual time, stepped by the test.

    It waits for a reset after a trip, whatever the cell file says, so that reset and resume can be tested. As a context
    manager it is connected and activated, and given back at the end.

    Args:
        file: a cell file, or the name of one that ships; or a plan, that waits for a reset after a trip.
        on: the world that it runs in; None as the file is written.
        set: values in place of the file's own, by dotted key.
        faults: faults from the start, by device: ``{"arm": {"stale": True}}``.
        emulated: the emulators of the plan, running.

    Raises:
        ConfigError: the cell is not valid, runs in real time, or has no such device or fault.
    """

    def __init__(
        self,
        file: str | PathLike[str] | CellPlan,
        *,
        on: WorldName | None = None,
        set: Mapping[str, Any] | None = None,
        faults: Mapping[str, Mapping[str, Any]] | None = None,
        emulated: EmulatedCell | None = None,
    ) -> None:
        self._emulated = emulated
        self._first_faults = dict(faults or {})
        if isinstance(file, CellPlan):
            self.plan = file
        else:
            settings = {"on_trip": "wait_for_reset", **(set or {})}
            self.plan = plan_in_world(find_cell(Path(file)), on, settings=settings, prove=False)
        if self.plan.cell.time != "simulated" and not isinstance(file, CellPlan):
            raise ConfigError(
                "runs in real time, so a test cannot step it",
                file=str(self.plan.file),
                key="time",
                value=self.plan.cell.time,
                hint='run it on="sim", or use a cell with `time: simulated`',
            )
        self._shown: dict[str, Shown] = {}
        self.cell = compose(self.plan, arrange=self._arrange)
        self.messages: list[Message] = []
        self._stop = StopRequest()
        self._channel = OperatorChannel()
        self._loop = RunLoop(self.cell, None, box=self, stop=self._stop, channel=self._channel)
        self._going = True
        self._broken: list[str] = []
        for device in self._first_faults:
            self._device(device)

    def __enter__(self) -> Self:
        self.cell.__enter__()
        for device, values in self._first_faults.items():
            self.inject(device, **values)
        self._loop.begin()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._loop.end()
        finally:
            # A device that the test has broken cannot be seen at rest, and would not be given back.
            for device in self._broken:
                self.clear(device)
            self.cell.__exit__(kind, error, trace)

    def __repr__(self) -> str:
        return f"<CellUnderTest {self.plan.cell.name!r}: {self.state} after {self.t_s:.3f} s>"

    def add(self, messages: Sequence[tuple[str, int, Encoded]]) -> None:
        """Keep topics, stamps and messages; called by the run loop."""
        self.messages += [Message(*message) for message in messages]

    # What is the case.

    @property
    def t_s(self) -> float:
        """Time since the cell was activated."""
        return (self.cell.clock.now_ns() - self.cell.start_ns) * 1e-9

    @property
    def state(self) -> str:
        """The task's state."""
        return self.cell.task.state

    @property
    def waits_for_reset(self) -> bool:
        """Whether the cell has tripped and waits for the operator."""
        return self._loop.state.name == "WAITING_FOR_RESET"

    @property
    def has_ended(self) -> bool:
        """Whether the run is over."""
        return not self._going

    @property
    def result(self) -> RunResult:
        """How the run stands, or how it ended."""
        return self._loop.result

    @property
    def first_cause(self) -> Violation | None:
        """What tripped first since the last reset; None if nothing has."""
        return self.cell.supervisor.latch.first_cause

    @property
    def tripped_by(self) -> str | None:
        """Kind of the interlock that tripped first; its name where it is always on. None if nothing has tripped."""
        cause = self.first_cause
        if cause is None:
            return None
        entry = self.plan.cell.interlocks.get(cause.interlock)
        return cause.interlock if entry is None else str(getattr(entry, "kind", cause.interlock))

    @property
    def stops(self) -> Mapping[str, StopReport]:
        """How each arm came to rest, by role: time, distance, and what was declared."""
        return self.result.stops

    @property
    def at_rest(self) -> bool:
        """Whether all arms stand still, as their drivers measure it."""
        return all(arm.at_rest() for arm in self.cell.arms.values())

    def commands(self, since_s: float = 0.0) -> list[Message]:
        """Commands that were sent, from ``since_s`` of cell time on."""
        start_ns = self.cell.start_ns + round(since_s * 1e9)
        return [each for each in self.messages if each.topic.endswith("/command") and each.t_ns >= start_ns]

    def values(self, topic: str, key: str) -> list[Any]:
        """Recorded values of one key of one topic, in order."""
        found = (each.data for each in self.messages if each.topic == topic)
        return [data[key] for data in found if key in data]

    # What the test does.

    def step(self, cycles: int = 1) -> None:
        """Run control cycles; fewer if the run ends."""
        for _ in range(cycles):
            if not self._going:
                return
            self._going = self._loop.step()

    def run_for(self, seconds: float) -> None:
        """Run for cell time."""
        end_s = self.t_s + seconds
        while self._going and self.t_s < end_s:
            self.step()

    def run_until(self, state: str, limit_s: float = _LIMIT_S) -> None:
        """Run until the task is in ``state``; fail the test if the run ends or ``limit_s`` of cell time passes."""
        end_s = self.t_s + limit_s
        while self.state != state:
            if not self._going or self.waits_for_reset:
                raise AssertionError(f"ended in {self.state}, not in {state}: {self.result.reason or self.first_cause}")
            if self.t_s >= end_s:
                raise AssertionError(f"still in {self.state} after {limit_s:g} s, not in {state}")
            self.step()

    def run_until_trip(self, limit_s: float = _LIMIT_S) -> Violation:
        """Run until the cell has tripped and its arms stand; return the first cause. Fails the test if it does not."""
        end_s = self.t_s + limit_s
        while not self.waits_for_reset:
            if not self._going:
                raise AssertionError(f"ended as {self.result.outcome.value} without a trip: {self.result.reason}")
            if self.t_s >= end_s:
                raise AssertionError(f"nothing tripped within {limit_s:g} s")
            self.step()
        assert self.first_cause is not None
        return self.first_cause

    def finish(self, limit_s: float = 600.0) -> RunResult:
        """Run to the end. Fails the test if ``limit_s`` of cell time passes first, or the cell waits for a reset."""
        end_s = self.t_s + limit_s
        while self._going:
            if self.waits_for_reset:
                raise AssertionError(f"tripped: {self.first_cause}")
            if self.t_s >= end_s:
                raise AssertionError(f"still in {self.state} after {limit_s:g} s")
            self.step()
        return self.result

    def inject(self, device: str, **faults: Any) -> None:
        """Begin faults of a device, by the device's name in the cell; see ``touchcell.simulation.faults``.

        They have the same names and effects on simulated devices and on emulators.

        Raises:
            ConfigError: no such device, it has no faults to inject, or no such fault.
        """
        found = self._device(device)
        self._broken.append(device)
        if self._emulated is not None:
            self._emulated.inject(device, faults)
            return
        present = getattr(found, "faults", None)
        if present is None:
            raise ConfigError("has no faults that can be injected", key=device, hint="use a simulated device")
        known = [field.name for field in fields(present)]
        for name in faults:
            if name not in known:
                raise ConfigError(f"unknown fault {name!r}", key=device, value=name, hint=suggest(name, known))
        found.faults = replace(present, **faults)  # type: ignore[attr-defined]

    def clear(self, device: str) -> None:
        """End all faults of a device."""
        found = self._device(device)
        if self._emulated is not None:
            self._emulated.clear(device)
            return
        if (present := getattr(found, "faults", None)) is not None:
            found.faults = type(present)()  # type: ignore[attr-defined]

    def provoke(self, interlock: str, settings: Mapping[str, Any] | None = None) -> Violation:
        """Show an interlock, alone, the first fault that must trip it, until it trips; return the first cause.

        The other interlocks still see the cell as it is, so that what trips is this one. It works in
        every world: a bench stops its real arms.

        Args:
            interlock: its name in the cell file.
            settings: of the interlock that the fault is made for; None for its own.

        Raises:
            ConfigError: there is no such interlock, or nothing that this cell can show trips it.
        """
        fault = next((each for each in self._faults(interlock, settings) if isinstance(each, Fault)), None)
        if fault is None:
            raise ConfigError("nothing that this cell can show trips it", key=f"interlocks.{interlock}")
        self._shown[interlock].begin(fault, cell_facts(self.plan), self.cell.clock.now_ns())
        try:
            return self.run_until_trip(limit_s=fault.before_s + fault.within_s + _TRIPS_WITHIN_S)
        finally:
            self._shown[interlock].end()

    def assert_armed(self, interlock: str, settings: Mapping[str, Any], after_s: float) -> None:
        """Fail the test unless each fault that trips an interlock with ``settings`` trips the cell's in time.

        Args:
            interlock: its name in the cell file.
            settings: as the cell file had them when the test was written.
            after_s: the time that it took then, at most.
        """
        expected = _settings_of(interlock, settings)
        proofs = prove(interlock, expected, self._shown_or_missing(interlock).rule, cell_facts(self.plan))
        for proof in proofs:
            assert proof.tripped_s is not None or not proof.fatal, f"{interlock} of {proof.subject}: {proof.problem}"
            late = proof.tripped_s is not None and proof.tripped_s > after_s + 2.0 / self.cell.rate_hz
            assert not late, f"{interlock} of {proof.subject}: {proof.fault}: {proof.tripped_s} s, expected {after_s} s"
        own = self.plan.cell.interlocks[interlock]
        if isinstance(own, WorkspaceConfig) and isinstance(expected, WorkspaceConfig):
            # It is shown a tool as far outside as its margin; a box that has grown by less would trip all the same.
            grown = any(mine < theirs for mine, theirs in zip(own.min_mm, expected.min_mm, strict=True))
            grown = grown or any(mine > theirs for mine, theirs in zip(own.max_mm, expected.max_mm, strict=True))
            assert not grown, f"{interlock}: its box is {own.min_mm} to {own.max_mm} mm, larger than it was"
        assert own.level == expected.level, f"{interlock}: level is {own.level.name}, expected {expected.level.name}"

    def _faults(self, interlock: str, settings: Mapping[str, Any] | None) -> Iterator[Fault | CannotTrip]:
        self._shown_or_missing(interlock)
        own = self.plan.cell.interlocks[interlock] if settings is None else _settings_of(interlock, settings)
        if isinstance(own, Provable):
            yield from own.faults(cell_facts(self.plan))

    def _shown_or_missing(self, interlock: str) -> Shown:
        assert interlock in self._shown, f"the cell has no interlock {interlock!r}: {', '.join(self._shown) or 'none'}"
        return self._shown[interlock]

    def _arrange(self, interlocks: Sequence[AnyInterlock]) -> Sequence[AnyInterlock]:
        """Put each interlock behind what it can be shown."""
        self._shown = {each.name: shown(each) for each in interlocks}
        return list(self._shown.values())

    def stop(self) -> None:
        """Ask for an orderly end, as Ctrl-C does."""
        self._stop.ask()

    def stop_at_once(self) -> None:
        """Stop all arms where they are, as a second Ctrl-C does."""
        self._stop.ask_at_once()

    def reset(self) -> str:
        """Ask for a reset, as an operator does; return the answer. Nothing moves by it."""
        return self._ask(OperatorRequest.RESET)

    def resume(self) -> str:
        """Ask the task to start again after a reset; return the answer."""
        return self._ask(OperatorRequest.RESUME)

    # What the test asserts.

    def assert_tripped_by(self, *kinds: str) -> None:
        """Fail the test unless an interlock of one of these kinds tripped first."""
        assert self.tripped_by in kinds, (
            f"tripped by {self.tripped_by}, expected {' or '.join(kinds)}: {self.first_cause}"
        )

    def assert_stopped_as_declared(self) -> None:
        """Fail the test unless every arm came to rest within the time and distance that its stop declares."""
        assert self.stops, "no arm was stopped"
        for role, report in self.stops.items():
            assert report.kept, f"{role}: rest after {report.time_s} s, {report.distance_m} m; declared {report}"
        assert self.at_rest, "an arm still moves"

    def true_stop_s(self) -> Mapping[str, float]:
        """Return for each arm, by name, how long after the trip it truly moved, by the ground truth of its simulation.

        It also holds where a driver cannot see its arm, as when no state arrives.

        Raises:
            AssertionError: nothing has tripped.
        """
        cause = self.first_cause
        assert cause is not None, "nothing has tripped"
        if self._emulated is None:
            moved = {arm.name: getattr(arm, "moved_ns", 0) for arm in self.cell.arms.values()}
        else:
            moved = self._emulated.process.state()["moved_ns"]
        return {name: max(0.0, 1e-9 * (t_ns - cause.t_ns)) for name, t_ns in moved.items()}

    def assert_truly_stopped_as_declared(self) -> None:
        """Fail the test unless every arm truly stood within its declared stopping time, whatever its driver saw."""
        names = {role: arm.name for role, arm in self.cell.arms.items()}
        true_s = self.true_stop_s()
        for role, report in self.stops.items():
            limit_s = report.declared_s + 1.0 / self.cell.rate_hz
            assert true_s[names[role]] <= limit_s, f"{role}: moved for {true_s[names[role]]:.3f} s, declared {limit_s}"

    def assert_nothing_sent_since_trip(self) -> None:
        """Fail the test if a command was sent in or after the cycle that tripped."""
        cause = self.first_cause
        assert cause is not None, "nothing has tripped"
        late = [each for each in self.commands() if each.t_ns >= cause.t_ns]
        assert not late, f"{len(late)} commands after the trip, the first at {late[0].t_ns} ns"

    def _ask(self, request: OperatorRequest) -> str:
        if not self.waits_for_reset:
            raise AssertionError(f"{request.value}: the cell does not wait for a reset, it is in {self.state}")
        self._channel.ask(request, OPERATOR)
        self.step()
        return self._channel.last_reply

    def _device(self, name: str) -> Device:
        devices: dict[str, Device] = {
            each.name: each for each in [*self.cell.arms.values(), *self.cell.cameras.values()]
        }
        if name not in devices:
            raise ConfigError(f"no device {name!r} in this cell", key=name, hint=suggest(name, devices))
        return devices[name]


def _settings_of(name: str, settings: Mapping[str, Any]) -> InterlockSettings:
    """Return the settings of one interlock, from what a cell file says of it."""
    checked: Mapping[str, InterlockSettings] = TypeAdapter(InterlocksConfig).validate_python({name: dict(settings)})
    return checked[name]
