"""State machine of all tasks that hold contacts: approach the surface, settle, run the behavior, retract."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from enum import Enum, auto
from typing import Annotated, Final, TypeVar

import numpy as np
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat

from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.protocols import SERVO_ARM
from touchcell.errors import TouchcellError
from touchcell.geometry.types import Array
from touchcell.tasks.contact_servo import Assuming, Behavior, ContactServo, ContactServoConfig, Six
from touchcell.tasks.interface import (
    DEPTH,
    DISTANCE,
    SPEED,
    Action,
    Observation,
    TaskContext,
    TaskSpec,
    TransitionRecord,
)
from touchcell.tasks.planned_motions import PlannedContact, PlannedMotion, PlannedStart, PlannedTime, PlannedTurn
from touchcell.tasks.planned_places import PlannedPlace
from touchcell.tasks.sensor_check import SensorCheck, sheared_for, turned_at
from touchcell.tasks.state_machine import FAULT, STOP, TRIP, StateDef, Table, TaskMachine, TransitionDef, state_name
from touchcell.tasks.state_machine_task import MachineTask

ARM: Final = "arm"
"""Role of the arm in tasks with one arm."""
SENSOR: Final = "sensor"
"""Role of the tactile sensor that it carries."""
CHECKING: Final = "check"
"""State in which a model's estimates are checked; one that has no model is not in it."""
_SIDESTEP_S: Final = 60.0
"""Longest motion beside an object; eight touches of each edge take 40 s."""
_RETURN_S: Final = 10.0
"""Longest return to where a contact was lost; the way is that of a few frames."""


_START_CHANGE: Final = 0.02
"""Change of the image, of 1, by which a sensor that backs off shows that it was in contact: 0.2 mm of depth."""


class _Preparation(Enum):
    """What has been done before the approach."""

    FIRST_ZERO = auto()
    BACK_OFF = auto()
    STAND = auto()
    READY = auto()


class ServoConfig(ContactServoConfig):
    """Parameters of all tasks that hold contacts; those of one contact servo apply to the leading arm.

    Attributes:
        back_off_mm: distance to withdraw before the approach, while the sensor's image is compared with a zero frame:
            one that changes was in contact.
        approach_speed_mm_s: speed towards the surface, along the sensor's z axis.
        approach_distance_mm: the approach fails when no contact was made within it.
        check_s: duration of the motion after first contact whose measured answer must agree with the arm's before the
            arm servos on a model's estimates (``sensor_check``); 0 leaves it out.
        check_press_mm: depth that this motion adds.
        check_shift_mm: its largest shift along the surface; at most the shear up to which models are taught.
        check_tilt_deg: its largest tilt.
        settle_time_s: the contact has settled when errors were below the tolerances for this long.
        settle_timeout_s: settling fails when it takes longer.
        retract_mm: distance to withdraw at the end.
        retract_speed_mm_s: speed of that.
        sidestep_speed_mm_s: speed beside an object that is to be touched elsewhere.
        return_lift_mm: before a contact that was lost while the behavior ran is searched for again, the sensor returns
            to where it was last felt, less deep by this much; none searches from where the sensor is.
        max_reapproach: number of times that a lost contact is searched for again.
        stale_timeout_s: the task trips when the arm has been stopped for lack of a valid estimate for this long.
        prepare_timeout_s: longest wait for the first frame and arm state.
    """

    back_off_mm: PositiveFloat = 2.0
    approach_speed_mm_s: Annotated[PositiveFloat, SPEED] = 10.0
    approach_distance_mm: PositiveFloat = 50.0
    check_s: NonNegativeFloat = 2.0
    check_press_mm: Annotated[NonNegativeFloat, DEPTH] = 0.5
    check_shift_mm: Annotated[PositiveFloat, Field(le=5.0)] = 0.3
    check_tilt_deg: PositiveFloat = 1.0
    settle_time_s: NonNegativeFloat = 0.3
    settle_timeout_s: PositiveFloat = 10.0
    retract_mm: Annotated[PositiveFloat, DISTANCE] = 20.0
    retract_speed_mm_s: Annotated[PositiveFloat, SPEED] = 20.0
    sidestep_speed_mm_s: Annotated[PositiveFloat, SPEED] = 20.0
    return_lift_mm: PositiveFloat | None = None
    max_reapproach: NonNegativeInt = 2
    stale_timeout_s: PositiveFloat = 0.5
    prepare_timeout_s: PositiveFloat = 5.0


class ServoState(Enum):
    """States of a servoing task."""

    PREPARE = auto()
    APPROACH = auto()
    CHECK = auto()
    SETTLE = auto()
    RUN = auto()
    RETURN = auto()
    SIDESTEP = auto()
    RETRACT = auto()
    DONE = auto()
    STOPPED = auto()
    FAILED = auto()
    TRIPPED = auto()
    FAULTED = auto()


_SERVOING: Final = (ServoState.APPROACH, ServoState.SETTLE, ServoState.RUN)


def servo_table(
    task: str,
    config: ServoConfig,
    run_timeout_s: float,
    *,
    sidesteps: bool = False,
    servos: int = 1,
    needs_feature: bool = False,
) -> Table:
    """Return the states and transitions of a servoing task; motions time out after twice their nominal duration.

    Args:
        task: its name.
        config: its parameters.
        run_timeout_s: longest time in ``run``.
        sidesteps: whether a contact may be given up for another beside it.
        servos: number of sensors, which are checked one after another.
        needs_feature: whether a contact may turn out to be of another feature than the behavior is for.
    """
    s = ServoState
    approach_s = 2.0 * config.approach_distance_mm / config.approach_speed_mm_s + 1.0
    check_s = 5.0 * servos * config.check_s + 1.0
    retract_s = 2.0 * config.retract_mm / config.retract_speed_mm_s + 1.0
    return Table(
        task,
        (
            StateDef(s.PREPARE, config.prepare_timeout_s, "timeout"),
            StateDef(s.APPROACH, approach_s, "timeout", on_enter="start_approach"),
            StateDef(s.CHECK, check_s, "timeout", on_enter="start_check"),
            StateDef(s.SETTLE, config.settle_timeout_s, "timeout", on_enter="start_settle"),
            StateDef(s.RUN, run_timeout_s, "timeout", on_enter="start_run"),
            StateDef(s.RETURN, _RETURN_S, "timeout", on_enter="start_return"),
            *((StateDef(s.SIDESTEP, _SIDESTEP_S, "timeout", on_enter="start_sidestep"),) * sidesteps),
            StateDef(s.RETRACT, retract_s, "timeout", on_enter="start_retract"),
            StateDef(s.DONE, terminal=True),
            StateDef(s.STOPPED, terminal=True),
            StateDef(s.FAILED, terminal=True),
            StateDef(s.TRIPPED, terminal=True),
            StateDef(s.FAULTED, terminal=True),
        ),
        (
            TransitionDef("ready", s.PREPARE, s.APPROACH),
            TransitionDef("touching", s.PREPARE, s.FAILED),
            TransitionDef("timeout", s.PREPARE, s.FAILED),
            TransitionDef(STOP, s.PREPARE, s.STOPPED),
            TransitionDef("contact", s.APPROACH, s.CHECK, guard="must_check"),
            TransitionDef("contact", s.APPROACH, s.SETTLE),
            TransitionDef("no_contact", s.APPROACH, s.RETRACT),
            TransitionDef("agrees", s.CHECK, s.SETTLE),
            TransitionDef("lost", s.CHECK, s.APPROACH, guard="may_reapproach"),
            TransitionDef("lost", s.CHECK, s.RETRACT),
            TransitionDef("settled", s.SETTLE, s.RUN),
            TransitionDef("lost", s.SETTLE, s.APPROACH, guard="may_reapproach"),
            TransitionDef("lost", s.SETTLE, s.RETRACT),
            TransitionDef("finished", s.RUN, s.RETRACT),
            TransitionDef("missed", s.RUN, s.RETRACT),
            *(TransitionDef("missed", state, s.RETRACT) for state in (s.CHECK, s.SETTLE) if needs_feature),
            TransitionDef("lost", s.RUN, s.RETURN, guard="may_return"),
            *(
                (
                    TransitionDef("aside", s.RUN, s.SIDESTEP),
                    TransitionDef("placed", s.SIDESTEP, s.APPROACH),
                    TransitionDef("missed", s.SIDESTEP, s.RETRACT),
                )
                if sidesteps
                else ()
            ),
            TransitionDef("lost", s.RUN, s.APPROACH, guard="may_reapproach"),
            TransitionDef("lost", s.RUN, s.RETRACT),
            TransitionDef("returned", s.RETURN, s.APPROACH),
            TransitionDef("retracted", s.RETRACT, s.STOPPED, guard="was_stopped"),
            TransitionDef("retracted", s.RETRACT, s.DONE, guard="has_finished"),
            TransitionDef("retracted", s.RETRACT, s.FAILED),
            TransitionDef("timeout", s.RETRACT, s.FAILED),
            TransitionDef("timeout", None, s.RETRACT),
            TransitionDef(STOP, None, s.RETRACT),
            TransitionDef(TRIP, None, s.TRIPPED),
            TransitionDef(FAULT, None, s.FAULTED),
        ),
    )


class ServoTask(MachineTask):
    """A running servoing task; see ``touchcell.tasks.interface.Task`` for its members.

    While the contact servos search for the surface or hold it, they move only on fresh frames, fresh arm states and
    valid estimates, all of them or none. When they retract, away from the surface, a fresh arm state suffices. A servo
    that has made its contact holds it until the others have made theirs; until its sensor was checked it stands still.
    The sensors are checked one after another, once.

    Args:
        name: the task's name.
        config: parameters of its state machine.
        context: of the cell.
        servos: the contact servos. With several, telemetry names begin with the sensor's role.
        shears: see ``SensorCheck``.

    Raises:
        TaskDefinitionError: the table is invalid.
    """

    def __init__(
        self, name: str, config: ServoConfig, context: TaskContext, *servos: ContactServo, shears: bool = True
    ) -> None:
        self._config = config
        self._shears = shears
        self._period_s = 1.0 / context.rate_hz
        self._servos = servos
        timeout_s = min(servo.run.timeout_s for servo in servos)
        self._sidestepping = [run for servo in servos if (run := servo.sidestepping_run) is not None]
        sidesteps = any(run.may_sidestep for run in self._sidestepping)
        needs_feature = any(servo.feature_run is not None for servo in servos)
        table = servo_table(
            name, config, timeout_s, sidesteps=sidesteps, servos=len(servos), needs_feature=needs_feature
        )
        self._machine = TaskMachine(table, self)
        self._checks: list[SensorCheck] = []
        self._unchecked = config.check_s > 0.0
        self._now_ns = 0
        self._steady_s = 0.0
        self._blind_s = 0.0
        self._reapproaches = 0
        self._placed = False
        self._stop_seen = False
        self._finished_run = False
        self._prepared = _Preparation.FIRST_ZERO
        self._resumed = context.resumed
        self._stood_s = 0.0
        self._zero: frozenset[str] = frozenset()
        self._zero_seq: dict[str, int] = {}

    def tick(self, observation: Observation) -> Action:
        """Process one cycle."""
        if self.finished:
            return Action()
        dt_s = (observation.now_ns - self._now_ns) * 1e-9
        self._now_ns = observation.now_ns
        try:
            for servo in self._servos:
                servo.update(observation)
            self._watch(observation, dt_s)
            self._machine.tick(observation.now_ns)
            twists = self._twists()
        except TouchcellError as error:
            self._machine.fire(FAULT, str(error), now_ns=observation.now_ns)
            return Action()
        zero, self._zero = self._zero, frozenset()
        return Action(
            {servo.arm: self._command(servo, V) for servo, V in twists}, self._telemetry(observation), zero=zero
        )

    @property
    def rests_on(self) -> Sequence[str]:
        """What success rests on that nothing has measured."""
        runs = [servo.run for servo in self._servos]
        return [each for run in runs if isinstance(run, Assuming) for each in run.rests_on]

    def must_check(self) -> bool:
        """Guard: a sensor's contact is estimated by a model, and the sensors have not been checked yet."""
        return self._unchecked and any(servo.is_estimated for servo in self._servos)

    def may_reapproach(self) -> bool:
        """Guard: a lost contact may be searched for again."""
        return self._reapproaches < self._config.max_reapproach

    def may_return(self) -> bool:
        """Guard: a lost contact is searched for again, from where it was last felt."""
        return self.may_reapproach() and self._config.return_lift_mm is not None

    def was_stopped(self) -> bool:
        """Guard: the operator requested a stop."""
        return self._stop_seen

    def has_finished(self) -> bool:
        """Guard: the behavior has finished."""
        return self._finished_run

    def start_approach(self, record: TransitionRecord) -> None:
        """On entry: measure the travelled distance from here."""
        self._reapproaches += record.event == "lost"
        self._placed = record.event == "placed"
        for servo in self._servos:
            servo.start_approach()
        self._blind_s = 0.0

    def start_return(self, record: TransitionRecord) -> None:
        """On entry: aim at where each contact was last felt."""
        self._reapproaches += 1
        for servo in self._servos:
            servo.aim_back(1e-3 * (self._config.return_lift_mm or 0.0))
        self._blind_s = 0.0

    def start_check(self, record: TransitionRecord) -> None:
        """On entry: begin the motion of the first sensor."""
        c = self._config
        self._checks = [
            SensorCheck(
                c.check_s,
                press_mm=c.check_press_mm,
                shift_mm=c.check_shift_mm,
                tilt_deg=c.check_tilt_deg,
                shears=self._shears,
            )
            for _ in self._servos
        ]
        self._blind_s = 0.0

    def start_settle(self, record: TransitionRecord) -> None:
        """On entry: reset the controllers."""
        for servo in self._servos:
            servo.controller.reset()
        self._steady_s = 0.0
        self._blind_s = 0.0

    def start_run(self, record: TransitionRecord) -> None:
        """On entry: keep servoing, now with the feedforward."""
        self._blind_s = 0.0

    def start_sidestep(self, record: TransitionRecord) -> None:
        """On entry: plan the step aside of the servos that asked for one; the others hold their contact."""
        self._blind_s = 0.0
        for servo in self._servos:
            servo.start_sidestep()

    def start_retract(self, record: TransitionRecord) -> None:
        """On entry: measure the travelled distance from here, unless a stop only confirms a retraction under way."""
        if record.source != state_name(ServoState.RETRACT):
            for servo in self._servos:
                servo.reset_travel()
        self._finished_run = self._finished_run or record.event == "finished"

    def _watch(self, observation: Observation, dt_s: float) -> None:
        """Post the events of this cycle's observation for the current state."""
        if observation.operator_stop and not self._stop_seen:
            self._stop_seen = True
            self._machine.post(STOP, "operator")
        match self._machine.state:
            case ServoState.PREPARE:
                self._prepare()
            case ServoState.APPROACH:
                self._watch_approach(dt_s)
            case ServoState.CHECK:
                self._watch_contact(dt_s)
                if astray := self._astray(dt_s):
                    self._post("missed", astray)
                self._watch_check()
            case ServoState.SETTLE:
                self._watch_settling(dt_s)
            case ServoState.RUN:
                self._watch_run(dt_s)
            case ServoState.RETURN:
                self._watch_motion(dt_s)
                if all(servo.is_back() for servo in self._servos):
                    self._post("returned")
            case ServoState.SIDESTEP:
                self._watch_motion(dt_s)
                if blocked := next((servo.blocked for servo in self._servos if servo.blocked), ""):
                    self._post("missed", blocked)
                elif not any(servo.sidestepping for servo in self._servos):
                    self._post("placed")
            case ServoState.RETRACT:
                if all(servo.travelled_m() >= 1e-3 * self._config.retract_mm for servo in self._servos):
                    self._post("retracted")

    def _watch_approach(self, dt_s: float) -> None:
        self._watch_motion(dt_s)
        searching = [servo for servo in self._servos if not servo.touches]
        if stuck := next((servo.sensor for servo in self._servos if servo.contact_is_stuck), None):
            self._post(TRIP, f"{stuck}: its contact does not change while the arm moves")
        elif self._placed and (carrying := next((servo.sensor for servo in self._servos if servo.carries), None)):
            self._post("no_contact", f"{carrying} carries the object along: where it is cannot be felt")
        elif not searching:
            self._post("contact")
        elif max(servo.travelled_m() for servo in searching) >= 1e-3 * self._config.approach_distance_mm:
            self._post("no_contact", f"none within {self._config.approach_distance_mm:g} mm")

    def _watch_settling(self, dt_s: float) -> None:
        self._watch_contact(dt_s)
        steady = all(servo.only_touches or servo.steady() for servo in self._servos)
        self._steady_s = self._steady_s + dt_s if steady else 0.0
        if astray := self._astray(dt_s):
            self._post("missed", astray)
        elif steady and self._steady_s >= self._config.settle_time_s:
            self._post("settled")

    def _watch_run(self, dt_s: float) -> None:
        self._watch_contact(dt_s)
        # Every servo processes the cycle, even if another one has already finished.
        finished = [servo.advance(dt_s) for servo in self._servos]
        if astray := self._astray(dt_s):
            self._post("missed", astray)
        elif any(finished):
            shortfalls = [servo.run.shortfall() for servo in self._servos]
            if missed := "; ".join(filter(None, shortfalls)):
                self._post("missed", missed)
            else:
                self._post("finished")
        elif any(run.wants_sidestep for run in self._sidestepping):
            self._post("aside", "the object is to be touched elsewhere")

    def _astray(self, dt_s: float) -> str:
        """Return why a behavior cannot go on, by what its sensor touches; empty where all can."""
        for servo in self._servos:
            run = servo.feature_run
            if servo.contact is not None and run is not None and (why := run.astray(dt_s, servo.contact.touched)):
                return f"{servo.sensor}: {why}"
        return ""

    def _watch_check(self) -> None:
        """Record what the sensors measure, and judge it when all have moved."""
        for check, servo in zip(self._checks, self._servos, strict=True):
            if servo.T_base_sensor is not None:
                check.record_pose(self._now_ns, servo.T_base_sensor)
            contact, T_s_f = servo.contact, servo.T_s_f_measured
            if contact is not None and T_s_f is not None and check is self._moving_check():
                check.record_contact(contact.seq, contact.t_frame_ns, T_s_f)
        if self._moving_check() is not None:
            return
        for check, servo in zip(self._checks, self._servos, strict=True):
            if wrong := check.verdict():
                self._post(TRIP, f"{servo.sensor}: {wrong}")
                return
        self._unchecked = False
        self._post("agrees")

    def _moving_check(self) -> SensorCheck | None:
        return next((check for check in self._checks if not check.finished), None)

    def _prepare(self) -> None:
        """Take a zero frame, back off a little, and take another, unless the first motion changes the image."""
        servos = self._servos
        if not all(servo.has_fresh_data and servo.seq > self._zero_seq.get(servo.sensor, -1) for servo in servos):
            # Until a frame has come after the zero frame, what is known still compares with what was before it.
            return
        match self._prepared:
            case _Preparation.FIRST_ZERO if self._resumed and any(servo.in_contact for servo in servos):
                self._post("ready")
            case _Preparation.FIRST_ZERO:
                if touching := next(
                    (servo.sensor for servo in servos if not servo.has_zero and servo.in_contact), None
                ):
                    self._post("touching", f"{touching} is in contact before the approach: move it clear")
                elif any(servo.has_zero for servo in servos):
                    self._take_zero(_Preparation.BACK_OFF)
                    for servo in servos:
                        servo.reset_travel()
                else:
                    self._post("ready")
            case _Preparation.BACK_OFF:
                touching = next((servo.sensor for servo in servos if servo.change_since_zero > _START_CHANGE), None)
                if touching is not None:
                    self._post("touching", f"{touching} is in contact before the approach: move it clear")
                elif all(s.travelled_m() >= 1e-3 * self._config.back_off_mm for s in servos if s.has_zero):
                    self._prepared = _Preparation.STAND
            case _Preparation.STAND:
                # A frame that was exposed after the motion.
                self._stood_s += self._period_s
                if self._stood_s >= 1e-3 * max(servo.max_frame_age_ms for servo in servos) / 3.0:
                    self._take_zero(_Preparation.READY)
            case _Preparation.READY:
                self._post("ready")

    def _take_zero(self, then: _Preparation) -> None:
        self._zero = frozenset(servo.sensor for servo in self._servos if servo.has_zero)
        self._zero_seq = {servo.sensor: servo.seq for servo in self._servos}
        self._prepared = then

    def _watch_contact(self, dt_s: float) -> None:
        for servo in self._servos:
            if servo.contact is not None and not servo.contact.in_contact:
                self._post("lost", f"{servo.sensor}, frame {servo.contact.seq}")
                break
        self._watch_sight(
            dt_s,
            blind=any(servo.T_base_sensor is None or servo.T_s_f is None for servo in self._servos),
        )

    def _watch_motion(self, dt_s: float) -> None:
        """Watch over a motion that needs no valid estimate."""
        self._watch_sight(dt_s, blind=not all(servo.has_fresh_data for servo in self._servos))

    def _watch_sight(self, dt_s: float, *, blind: bool) -> None:
        self._blind_s = self._blind_s + dt_s if blind else 0.0
        if self._blind_s > self._config.stale_timeout_s:
            self._post(TRIP, f"no valid contact estimate or arm state for {self._blind_s:.3f} s")

    def _post(self, event: str, reason: str = "") -> None:
        self._machine.post(event, reason, epoch=self._machine.epoch)

    def _twists(self) -> list[tuple[ContactServo, Array]]:
        """Return the twist (6,) of each tool that moves in the current state."""
        c, servos, state = self._config, self._servos, self._machine.state
        if state is ServoState.RETRACT:
            speed_m_s = -1e-3 * c.retract_speed_mm_s
            return [(servo, servo.along_z(speed_m_s)) for servo in servos if servo.T_base_sensor is not None]
        if not all(servo.has_fresh_data for servo in servos):
            for servo in servos if state in _SERVOING else ():
                servo.controller.reset()
            return []
        match state:
            case ServoState.CHECK:
                return self._check_twists()
            case ServoState.RETURN:
                return [(servo, servo.way_back(1e-3 * c.approach_speed_mm_s)) for servo in servos]
            case ServoState.PREPARE if self._prepared is _Preparation.BACK_OFF:
                speed_m_s = -1e-3 * c.approach_speed_mm_s
                return [(servo, servo.along_z(speed_m_s)) for servo in servos if servo.has_zero]
            case ServoState.SIDESTEP:
                return [(servo, V) for servo in servos if (V := self._aside(servo)) is not None]
            case ServoState.APPROACH | ServoState.SETTLE | ServoState.RUN:
                return self._servo_twists(state)
        return []

    def _servo_twists(self, state: Enum) -> list[tuple[ContactServo, Array]]:
        searching, running = state is ServoState.APPROACH, state is ServoState.RUN
        if not searching and any(servo.T_s_f is None for servo in self._servos):
            for servo in self._servos:
                servo.controller.reset()
            return []
        twists = []
        for servo in self._servos:
            V_tcp: Array | None
            if searching and not servo.touches:
                V_tcp = servo.search(1e-3 * self._config.approach_speed_mm_s)
            elif (searching and self._unchecked and servo.is_estimated) or servo.only_touches:
                V_tcp = None
            else:
                V_tcp = servo.servo_step(servo.run.feedforward if running else np.zeros(6), running=running)
            if V_tcp is not None:
                twists.append((servo, V_tcp))
        return twists

    def _aside(self, servo: ContactServo) -> Array | None:
        """Return the twist (6,) of a tool whose servo steps aside, or holds its contact while another one does."""
        if not servo.sidestepping:
            return servo.servo_step(np.zeros(6))
        c = self._config
        return servo.step_aside(1e-3 * c.sidestep_speed_mm_s, 1e-3 * c.approach_speed_mm_s)

    def _check_twists(self) -> list[tuple[ContactServo, Array]]:
        if any(servo.T_s_f is None for servo in self._servos):
            return []
        for check, servo in zip(self._checks, self._servos, strict=True):
            if not check.finished and servo.T_base_sensor is not None:
                return [(servo, servo.in_tcp(check.step(self._period_s, servo.T_base_sensor)))]
        return []

    def _command(self, servo: ContactServo, V_tcp: Array) -> TwistCommand:
        return TwistCommand(
            V_tcp,
            TwistFrame.TCP,
            t_ns=self._now_ns,
            ttl_s=3.0 * self._period_s,
            t_cause_ns=None if servo.contact is None else servo.contact.t_frame_ns,
        )

    def _telemetry(self, observation: Observation) -> Mapping[str, float]:
        servoing = self._machine.state in (ServoState.SETTLE, ServoState.RUN)
        telemetry: dict[str, float] = {}
        for servo in self._servos:
            prefix = f"{servo.sensor}_" if len(self._servos) > 1 else ""
            values = servo.telemetry(observation, servoing=servoing)
            telemetry |= {f"{prefix}{name}": value for name, value in values.items()}
        return telemetry


def servo_motions(config: ServoConfig, *, shears: bool = True) -> Iterator[PlannedMotion]:
    """Return what every servoing task surely does: it approaches, is checked, settles and retracts.

    Args:
        config: parameters of the task.
        shears: False where a shift of the sensor is no shear, as along an edge.
    """
    # A sensor with images backs off at the speed of the approach, and has that way ahead of it at least.
    yield PlannedStart(
        ("approach_speed_mm_s",),
        1e-3 * config.approach_speed_mm_s,
        1e-3 * min(config.back_off_mm, config.retract_mm),
        presses=True,
    )
    yield PlannedStart(("retract_speed_mm_s",), 1e-3 * config.retract_speed_mm_s, 1e-3 * config.retract_mm)
    back_off_s = config.back_off_mm / config.approach_speed_mm_s
    yield PlannedTime(("prepare_timeout_s",), back_off_s, config.prepare_timeout_s, "to back off", by_model=True)
    yield PlannedContact(("settle_time_s",), config.settle_time_s, "settle")
    yield PlannedTime(("settle_timeout_s",), config.settle_time_s, config.settle_timeout_s, "to settle")
    if config.check_s > 0.0:
        for shear_mm, lasts_s in sheared_for(config.check_s, config.check_shift_mm) if shears else ():
            yield PlannedContact(("check_shift_mm",), lasts_s, CHECKING, 1e-3 * shear_mm)
        yield PlannedContact(("check_s",), config.check_s, CHECKING)
        yield PlannedTurn(("check_tilt_deg",), math.radians(turned_at(config.check_s, config.check_tilt_deg)), CHECKING)


ServoConfigT = TypeVar("ServoConfigT", bound=ServoConfig)


def one_arm_task(
    name: str,
    summary: str,
    config: type[ServoConfigT],
    behavior: Callable[[ServoConfigT], Behavior],
    reference_mm_deg: Callable[[ServoConfigT], Six],
    places: Callable[[ServoConfigT, Array | None, Array], Iterable[PlannedPlace]] | None = None,
    motions: Callable[[ServoConfigT, Array | None, Array], Iterable[PlannedMotion]] | None = None,
    *,
    surface_rests: bool = False,
) -> TaskSpec[ServoConfigT]:
    """Return the spec of a task in which ``arm`` holds a gliding contact with ``sensor`` and runs one behavior.

    Args:
        name: of the task.
        summary: one line for ``touchcell list``.
        config: pydantic model of its parameters.
        behavior: creates the behavior from the parameters.
        reference_mm_deg: returns the contact to hold, Euler components of ``T_f_s``.
        places: of its ``TaskSpec``.
        motions: of its ``TaskSpec``; None for what every servoing task does.
        surface_rests: see ``ContactServo``.
    """

    def build(config: ServoConfigT, context: TaskContext) -> ServoTask:
        servo = ContactServo(
            ARM, SENSOR, config, reference_mm_deg(config), behavior(config), context, surface_rests=surface_rests
        )
        return ServoTask(name, config, context, servo)

    return TaskSpec(
        name,
        summary,
        config,
        {ARM: SERVO_ARM},
        frozenset({SENSOR}),
        build,
        starts_free=True,
        glides=True,
        places=places,
        motions=motions or (lambda config, start, mount: servo_motions(config)),
    )
