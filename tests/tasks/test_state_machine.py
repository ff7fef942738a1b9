"""The state machine: the table's linter, time, order of events, and guards that are never bypassed."""

from __future__ import annotations

from dataclasses import replace
from enum import Enum, auto

import pytest

from touchcell.tasks.errors import TaskDefinitionError
from touchcell.tasks.state_machine import Accepted, Refused, StateDef, Table, TaskMachine, TransitionDef, lint, mermaid


class S(Enum):
    IDLE = auto()
    MOVING = auto()
    DONE = auto()
    STOPPED = auto()
    FAULTED = auto()


STATES = (
    StateDef(S.IDLE, timeout_s=5.0, on_timeout="stop"),
    StateDef(S.MOVING, timeout_s=2.0, on_timeout="late", on_enter="start"),
    StateDef(S.DONE, terminal=True),
    StateDef(S.STOPPED, terminal=True),
    StateDef(S.FAULTED, terminal=True),
)
ROWS = (
    TransitionDef("go", S.IDLE, S.MOVING, guard="ready"),
    TransitionDef("arrive", S.MOVING, S.DONE),
    TransitionDef("late", S.MOVING, S.STOPPED),
    TransitionDef("stop", None, S.STOPPED),
    TransitionDef("trip", None, S.FAULTED),
    TransitionDef("fault", None, S.FAULTED),
)
TABLE = Table("example", STATES, ROWS)


class Model:
    """Counts its starts; can be made to refuse or to raise."""

    def __init__(self, ready=True, start_error=None, guard_error=None):
        self.is_ready = ready
        self.start_error = start_error
        self.guard_error = guard_error
        self.starts = []
        self.machine = None
        self.inner = None

    def ready(self):
        if self.guard_error:
            raise self.guard_error
        return self.is_ready

    def start(self, record):
        self.starts.append(record)
        if self.machine:
            self.inner = self.machine.fire("arrive")
        if self.start_error:
            raise self.start_error


def machine(**model) -> tuple[TaskMachine, Model]:
    m = Model(**model)
    return TaskMachine(TABLE, m), m


def s_to_ns(seconds: float) -> int:
    return round(seconds * 1e9)


def test_events_take_effect_in_order_at_the_tick():
    task, model = machine()
    task.post("go", "button")
    task.post("arrive")
    assert task.state is S.IDLE
    task.tick(s_to_ns(1.0))
    assert task.state is S.DONE
    assert task.finished
    assert [(r.t_ns, r.source, r.event, r.target, r.reason) for r in task.records] == [
        (s_to_ns(1.0), "idle", "go", "moving", "button"),
        (s_to_ns(1.0), "moving", "arrive", "done", ""),
    ]
    assert model.starts == [task.records[0]]


def test_fire_returns_the_result():
    task, _ = machine()
    task.tick(0)
    outcome = task.fire("go")
    assert outcome == Accepted(task.records[0])
    assert task.fire("go") == Refused("go", "not accepted in moving")
    assert task.fire("fly") == Refused("fly", "no such event")
    assert [r.event for r in task.refusals] == ["go", "fly"]


def test_a_guard_that_returns_false_is_named():
    task, model = machine(ready=False)
    assert task.fire("go") == Refused("go", "guard ready returned False")
    assert task.state is S.IDLE
    assert task.records == ()
    model.is_ready = True
    assert isinstance(task.fire("go"), Accepted)


def test_no_trigger_bypasses_the_guard():
    task, _ = machine(ready=False)
    for way in ("to_moving", "to_MOVING", "MOVING"):
        assert task.fire(way) == Refused(way, "no such event")
    assert not [name for name in dir(task._engine_model) if name.startswith("to_")]
    assert task.state is S.IDLE


def test_timeout_is_counted_from_entry():
    task, _ = machine()
    task.tick(s_to_ns(100.0))
    task.post("go")
    task.tick(s_to_ns(104.9))
    assert task.state is S.MOVING
    task.tick(s_to_ns(106.8))
    assert task.state is S.MOVING
    assert task.stay_s() == pytest.approx(1.9)
    task.tick(s_to_ns(106.9))
    assert task.state is S.STOPPED
    assert task.records[-1].event == "late"
    assert "2.000 s in moving" in task.records[-1].reason


def test_a_late_timeout_of_a_state_that_was_left_is_dropped():
    task, _ = machine()
    task.tick(0)
    task.fire("go")
    task.post("arrive")
    task.tick(s_to_ns(60.0))
    assert task.state is S.DONE
    assert [r.event for r in task.records] == ["go", "arrive"]
    assert task.refusals == (Refused("late", "the state it was bound to has been left"),)


def test_a_fired_event_is_recorded_at_its_own_time():
    task, _ = machine()
    task.tick(5)
    assert task.fire("trip", "too deep", now_ns=9).record.t_ns == 9


def test_an_event_bound_to_an_old_stay_is_dropped():
    task, _ = machine()
    task.tick(0)
    task.post("stop", epoch=task.epoch)
    task.fire("go")
    task.tick(1)
    assert task.state is S.MOVING


def test_an_exception_on_entry_ends_in_the_fault_state_before_anything_else():
    task, _ = machine(start_error=RuntimeError("no power"))
    task.post("go")
    task.post("arrive")
    task.tick(0)
    assert task.state is S.FAULTED
    assert [r.event for r in task.records] == ["go", "fault"]
    assert "no power" in task.records[-1].reason
    assert task.refusals[-1] == Refused("arrive", "not accepted in faulted")


def test_an_exception_in_a_guard_is_a_fault_too():
    task, _ = machine(guard_error=ZeroDivisionError("oops"))
    task.post("go")
    task.tick(0)
    assert task.state is S.FAULTED
    assert "oops" in task.records[-1].reason


def test_a_callback_cannot_fire():
    task, model = machine()
    model.machine = task
    assert isinstance(task.fire("go"), Accepted)
    assert isinstance(model.inner, Refused)
    assert task.state is S.MOVING


def test_terminal_states_accept_nothing():
    task, _ = machine()
    task.fire("stop")
    for event in ("go", "arrive", "stop", "trip", "fault"):
        assert isinstance(task.fire(event), Refused)
    task.tick(s_to_ns(1e6))
    assert task.state is S.STOPPED


def test_a_good_table_has_no_problems():
    assert lint(TABLE, Model()) == []


IDLE, MOVING, DONE, STOPPED, FAULTED = STATES
GO, ARRIVE, LATE, STOP, TRIP, FAULT = ROWS


@pytest.mark.parametrize(
    ("states", "rows", "problem"),
    [
        ((IDLE, replace(MOVING, timeout_s=None), *STATES[2:]), ROWS, "state moving has no finite timeout"),
        ((IDLE, replace(MOVING, timeout_s=0.0), *STATES[2:]), ROWS, "state moving has no finite timeout"),
        ((IDLE, replace(MOVING, timeout_s=float("nan")), *STATES[2:]), ROWS, "state moving has no finite timeout"),
        (
            (IDLE, replace(MOVING, on_timeout=None), *STATES[2:]),
            ROWS,
            "state moving does not always accept (no on_timeout)",
        ),
        ((IDLE, replace(MOVING, on_timeout="never"), *STATES[2:]), ROWS, "state moving does not always accept never"),
        ((IDLE, replace(MOVING, on_enter="strat"), *STATES[2:]), ROWS, "on_enter 'strat' of state moving does not"),
        ((*STATES[:2], replace(DONE, timeout_s=1.0), *STATES[3:]), ROWS, "terminal state done has a timeout"),
        ((*STATES, DONE), ROWS, "a state is defined twice"),
        (STATES, (replace(GO, guard="redy"), *ROWS[1:]), "guard 'redy' of go does not exist"),
        (STATES, (GO, ARRIVE, LATE, STOP, TRIP), "state idle does not always accept fault"),
        (STATES, (*ROWS[:3], replace(STOP, guard="ready"), TRIP, FAULT), "state moving does not always accept stop"),
        (STATES, (GO, ARRIVE, LATE, STOP, FAULT), "state moving does not always accept trip"),
        (
            STATES,
            (GO, ARRIVE, LATE, replace(STOP, source=S.IDLE), TRIP, FAULT),
            "state moving does not always accept stop",
        ),
        (STATES, (STOP, GO, ARRIVE, LATE, TRIP, FAULT), "go from idle comes after a wildcard"),
        (STATES, (ARRIVE, LATE, STOP, TRIP, FAULT), "state moving cannot be reached"),
        (STATES, (*ROWS[:3], TransitionDef("again", S.DONE, S.IDLE), *ROWS[3:]), "again leaves terminal state done"),
        (STATES, (GO, ARRIVE, replace(ARRIVE, target=S.STOPPED), *ROWS[2:]), "arrive from moving is shadowed"),
        (STATES[:-1], ROWS, "trip leads from or to a state that is not defined"),
        (
            (replace(IDLE, on_timeout="trip"), replace(MOVING, on_timeout="trip"), *STATES[2:]),
            (GO, replace(STOP, target=S.MOVING), TRIP, FAULT),
            "state idle never reaches a terminal state without a trip or a fault",
        ),
    ],
)
def test_the_linter_finds(states, rows, problem):
    assert any(problem in found for found in lint(Table("bad", states, rows), Model()))


def test_building_a_bad_table_lists_all_problems():
    rows = (replace(GO, guard="redy"), ARRIVE, LATE, STOP, TRIP)
    with pytest.raises(TaskDefinitionError) as caught:
        TaskMachine(Table("bad", STATES, rows), Model())
    assert caught.value.task == "bad"
    assert len(caught.value.problems) == 3  # the guard, and two states that do not accept a fault
    assert all(problem in str(caught.value) for problem in caught.value.problems)


def test_mermaid():
    assert mermaid(TABLE) == (
        "stateDiagram-v2\n"
        "    state active {\n"
        "        [*] --> idle\n"
        "        idle --> moving: go [ready]\n"
        "    }\n"
        "    moving --> done: arrive\n"
        "    moving --> stopped: late\n"
        "    active --> stopped: stop\n"
        "    active --> faulted: trip, fault\n"
        "    done --> [*]\n"
        "    stopped --> [*]\n"
        "    faulted --> [*]"
    )
