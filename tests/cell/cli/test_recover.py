"""``touchcell recover``: asks a person for every faulted device, and moves nothing."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from touchcell.cell.cli import recover
from touchcell.cell.cli.exit_codes import EXIT_BAD_INPUT
from touchcell.cell.cli.main import main
from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.device import Device, Lifecycle, OperatorToken
from touchcell.drivers.core.errors import DeviceError, DeviceFault


class Arm(Device):
    """A device that has ``trouble`` from before; recovery clears it unless it ``stays``."""

    def __init__(self, name: str, trouble: DeviceError | None = None, *, stays: bool = False) -> None:
        super().__init__(name, VirtualClock())
        self.trouble = trouble
        self.stays = stays
        self.activated = False

    def _open(self) -> None: ...

    def _close(self) -> None: ...

    def _present_fault(self) -> DeviceError | None:
        return self.trouble

    def _activate(self) -> None:
        self.activated = True

    def _recover(self, token: OperatorToken) -> None:
        assert token.operator
        if self.stays:
            assert self.trouble is not None
            raise self.trouble
        self.trouble = None


@pytest.fixture
def arms(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Arm]]:
    made: list[Arm] = []
    monkeypatch.setattr(recover, "plan_cell", lambda path: SimpleNamespace(devices={}))
    monkeypatch.setattr(recover, "build_devices", lambda plan, wanted: {arm.name: arm for arm in made})
    yield made
    assert not any(arm.activated for arm in made)
    assert all(arm.state is Lifecycle.DISCONNECTED for arm in made)


def fault(name: str) -> DeviceFault:
    return DeviceFault(name, "communication_constraints_violation", vendor_code=25)


def test_only_faulted_devices_are_asked_about_and_recovered(arms: list[Arm]) -> None:
    arms += [Arm("left"), Arm("right", fault("right"))]
    questions: list[str] = []
    lines: list[str] = []

    def ask(question: str) -> str:
        questions.append(question)
        return "yes"

    assert recover.recover_cell(Path("cell.yaml"), ask, lines.append)
    assert len(questions) == 1
    assert lines[0] == "left: no fault"
    assert "communication_constraints_violation" in lines[1]
    assert lines[2] == "right: recovered"
    assert arms[1].trouble is None


@pytest.mark.parametrize("answer", ["no", "", "y"])
def test_any_other_answer_than_yes_changes_nothing(arms: list[Arm], answer: str) -> None:
    arms.append(Arm("left", fault("left")))
    assert not recover.recover_cell(Path("cell.yaml"), lambda question: answer, lambda line: None)
    assert arms[0].trouble is not None


def test_a_fault_that_stays_is_shown_and_the_next_device_still_recovered(arms: list[Arm]) -> None:
    arms += [Arm("left", fault("left"), stays=True), Arm("right", fault("right"))]
    lines: list[str] = []
    assert not recover.recover_cell(Path("cell.yaml"), lambda question: "yes", lines.append)
    assert lines[-1] == "right: recovered"


def test_without_a_terminal_nobody_can_answer(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["recover", "configs/dual_push_sim.yaml"]) == EXIT_BAD_INPUT
    assert "terminal" in capsys.readouterr().err
