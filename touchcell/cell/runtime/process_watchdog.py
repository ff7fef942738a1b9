"""The watchdog chain of a cell: which devices get a process of their own, and how what it finds becomes a trip."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self

from touchcell.cell.runtime.watchdog import NOTES
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.drivers.core.protocols import TwistSink
from touchcell.drivers.hosting.groups import Group, HostedDevice
from touchcell.drivers.hosting.layouts import Reason

if TYPE_CHECKING:
    from touchcell.cell.config.cell_plan import CellPlan, DevicePlan
    from touchcell.drivers.hosting.chain import Chain

SCENE: Final = "scene"


def hosted_groups(plan: CellPlan) -> tuple[Group, ...]:
    """The groups of a cell with `processes: separate`: everything that takes part in one scene, and each other arm.

    Cameras without a scene, and arms that cannot be moved, stay in the task's process; so does a scene without a
    simulated arm in it, for nothing moves by it.
    """
    in_scene = _in_scene(plan)
    groups = []
    if in_scene:
        why = "one simulated scene has one physics"
        groups.append(Group(SCENE, tuple(_hosted(plan, each) for each in in_scene), why, plan.cell.scene))
    taken = {each.name for each in in_scene}
    alone = [
        device
        for device in plan.arms.values()
        if device.name not in taken and TwistSink in device.spec.capabilities.provides
    ]
    return (*groups, *(Group(each.name, (_hosted(plan, each),), "an arm by itself") for each in alone))


def process_lines(plan: CellPlan) -> list[str]:
    """What `touchcell check` says about the processes of a cell."""
    groups = hosted_groups(plan)
    hosted = {device.name for group in groups for device in group.devices}
    local = [name for name in plan.built if name not in hosted]
    lines = [f"task: control at {plan.cell.rate_hz:g} Hz" + (f"; {', '.join(local)}: not moved" if local else "")]
    lines += [
        f"host {group.name!r}: {', '.join(each.name for each in group.devices)} at "
        f"{group.rate_hz(plan.cell.rate_hz):g} Hz; {group.why}"
        for group in groups
    ]
    if groups:
        lines.append(
            f"watchdog: stops all arms after {2.5e3 / plan.cell.rate_hz:g} ms of silence; tested at activation"
        )
    return lines


class ProcessWatchdog:
    """The chain, as the run loop sees it; see ``touchcell.cell.runtime.watchdog.Watch``.

    Args:
        chain: not yet started.
        role_of: role in the task, by name of the arm.
    """

    def __init__(self, chain: Chain, role_of: Mapping[str, str]) -> None:
        self.chain = chain
        self._role_of = role_of
        self._lost = False

    @property
    def lost(self) -> bool:
        """Whether a host or the watchdog has gone or fallen silent since the latest start of a task."""
        return self._lost

    def __enter__(self) -> Self:
        self.chain.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.chain.__exit__(kind, error, trace)

    def self_test(self) -> None:
        """The self-test: both links have to stop all arms in time. Raises SelfTestFailed."""
        from touchcell.drivers.hosting.self_test import self_test

        self.proofs = self_test(self.chain)

    def begin(self) -> None:
        """Have the watchdog guard. Raises DeviceFault."""
        self._lost = False
        self.chain.begin()

    def beat(self) -> None:
        """Report that the loop is alive."""
        self.chain.beat()

    def alarms(self, now_ns: int) -> Sequence[Violation]:
        """What the watchdog or a host has found, as a violation."""
        cause = self.chain.alarm()
        if cause is None:
            return ()
        self._lost = self._lost or cause.reason in (Reason.HOST_GONE, Reason.HOST_SILENT, Reason.WATCHDOG_SILENT)
        about_host = 0 <= cause.host < len(self.chain.groups)
        subject, severity = "task", Severity.TRIP
        if about_host or cause.reason.name.startswith("WATCHDOG"):
            severity = Severity.FAULT
            subject = "watchdog" if not about_host else self._first_arm(self.chain.groups[cause.host])
        timed = cause.limit_s > 0.0
        return (
            Violation(
                "watchdog",
                severity,
                subject,
                cause.reason.description,
                cause.t_ns,
                value=cause.value_s if timed else None,
                limit=cause.limit_s if timed else None,
                unit="s" if timed else "",
            ),
        )

    def end(self) -> None:
        """Nothing is guarded any more."""
        self.chain.end()

    def clear(self) -> None:
        """Clear the latches of watchdog and hosts. Raises LifecycleError, DeviceFault."""
        self.chain.clear()

    def note_to(self, folder: Path) -> None:
        """Have the watchdog write ``watchdog.json`` there when it stops the arms."""
        self.chain.note_to(folder / NOTES)

    def describe(self) -> Sequence[str]:
        """Each process and what scheduling and memory it got, and what the self-test measured."""
        lines = [f"host {link.name!r}: process {link.pid}, {link.realtime}" for link in self.chain.hosts]
        watchdog = self.chain.watchdog
        lines.append(f"watchdog: process {watchdog.pid}, {watchdog.realtime}")
        return [*lines, *(str(proof) for proof in self.proofs)]

    def _first_arm(self, group: Group) -> str:
        name = next((each.name for each in group.devices if each.is_arm), group.name)
        return self._role_of.get(name, name)


def build_chain(plan: CellPlan, clock: Any) -> Chain:
    """The chain of a plan, not yet started."""
    from touchcell.drivers.hosting.chain import Chain

    return Chain(hosted_groups(plan), plan.cell.rate_hz, plan.cell.seed, clock)


def _in_scene(plan: CellPlan) -> list[DevicePlan]:
    """Everything that takes part in the simulated scene, arms first."""
    if plan.cell.scene is None:
        return []
    if not any(each.spec.capabilities.virtual_time for each in plan.arms.values()):
        return []
    sensors = [each for each in plan.sensors.values() if each.spec.capabilities.virtual_time]
    carriers = {plan.cell.sensors[each.name].mounted_on for each in sensors}
    arms = [each for each in plan.arms.values() if each.spec.capabilities.virtual_time or each.name in carriers]
    return [*arms, *sensors]


def _hosted(plan: CellPlan, device: DevicePlan) -> HostedDevice:
    section = plan.cell.arms.get(device.name)
    if section is None:
        return HostedDevice(device.name, device.spec, device.config)
    return HostedDevice(device.name, device.spec, device.config, section.stop_category, section.deactivate.value)
