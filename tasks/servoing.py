"""The machine of every task that holds a contact with one arm: find the surface, settle, do the work, withdraw."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, auto
from typing import Annotated, Final, Protocol

import numpy as np
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat

from control.pid import PidGains
from control.servo import TactileServo
from drivers.commands import TwistCommand, TwistFrame
from geometry import se3
from geometry.errors import TouchcellError
from geometry.types import Array
from perception.estimate import ContactEstimate
from tasks.interface import Action, Observation, TaskConfig, TaskContext, TransitionRecord
from tasks.machine import FAULT, STOP, TRIP, StateDef, Table, TaskMachine, TransitionDef, state_name
from tasks.machine_task import MachineTask

ARM: Final = "arm"
"""Role of the arm in tasks with one arm."""
SENSOR: Final = "sensor"
"""Role of the tactile sensor that it carries."""

Six = tuple[float, float, float, float, float, float]
"""One number for each of x, y, z, alpha, beta, gamma."""

SixGains = Annotated[Six, Field(description="x, y, z, alpha, beta, gamma of the sensor's twist; zeros: not controlled")]


class ServoConfig(TaskConfig):
    """Parameters of every task that holds a contact.

    Attributes:
        depth_mm: indentation to hold, normal to the surface and without shear.
        approach_speed_mm_s: speed towards the surface, along the sensor's z axis.
        approach_distance_mm: give up when no contact was made within it.
        settle_tolerance_mm: the contact has settled when the controlled errors are below these ...
        settle_tolerance_deg: ... for ...
        settle_time_s: ... this long.
        settle_timeout_s: give up when it has not settled by then.
        retract_mm: distance to withdraw at the end.
        retract_speed_mm_s: speed of that.
        max_reapproach: how often a lost contact is searched for again.
        kp_per_s: proportional gain of each axis.
        ki_per_s2: integral gain of each axis.
        kd: derivative gain of each axis.
        max_integral_speed_mm_s: largest speed that integral action may ask for.
        max_integral_turn_deg_s: largest turning rate that integral action may ask for.
        integral_zone_mm: larger errors are not integrated, so that pressing in does not overshoot ...
        integral_zone_deg: ... nor does turning.
        max_speed_mm_s: largest speed of the sensor along each axis.
        max_turn_deg_s: largest turning rate of the sensor about each axis.
        max_frame_age_ms: the arm stops when the newest frame is older.
        max_state_age_ms: the arm stops when its newest state is older.
        stale_timeout_s: the task trips when the arm has been stopped for lack of a valid estimate for this long.
        prepare_timeout_s: give up when there is no first frame and arm state by then.
    """

    depth_mm: PositiveFloat
    approach_speed_mm_s: PositiveFloat = 10.0
    approach_distance_mm: PositiveFloat = 50.0
    settle_tolerance_mm: PositiveFloat = 0.3
    settle_tolerance_deg: PositiveFloat = 2.0
    settle_time_s: NonNegativeFloat = 0.3
    settle_timeout_s: PositiveFloat = 10.0
    retract_mm: PositiveFloat = 20.0
    retract_speed_mm_s: PositiveFloat = 20.0
    max_reapproach: NonNegativeInt = 2
    kp_per_s: SixGains
    ki_per_s2: SixGains
    kd: SixGains = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    max_integral_speed_mm_s: NonNegativeFloat = 40.0
    max_integral_turn_deg_s: NonNegativeFloat = 20.0
    integral_zone_mm: PositiveFloat = 1.5
    integral_zone_deg: PositiveFloat = 5.0
    max_speed_mm_s: PositiveFloat = 60.0
    max_turn_deg_s: PositiveFloat = 20.0
    max_frame_age_ms: PositiveFloat = 150.0
    max_state_age_ms: PositiveFloat = 50.0
    stale_timeout_s: PositiveFloat = 0.5
    prepare_timeout_s: PositiveFloat = 5.0

    def gains(self) -> PidGains:
        """Gains and clips in SI units."""
        return PidGains(
            np.array(self.kp_per_s),
            np.array(self.ki_per_s2),
            np.array(self.kd),
            _six(self.max_integral_speed_mm_s, self.max_integral_turn_deg_s),
            _six(self.integral_zone_mm, self.integral_zone_deg),
            _six(self.max_speed_mm_s, self.max_turn_deg_s),
        )


def _six(linear_mm: float, angular_deg: float) -> Array:
    return np.repeat([1e-3 * linear_mm, np.radians(angular_deg)], 3)


class ServoState(Enum):
    """States of a servoing task."""

    PREPARE = auto()
    APPROACH = auto()
    SETTLE = auto()
    RUN = auto()
    RETRACT = auto()
    DONE = auto()
    STOPPED = auto()
    FAILED = auto()
    TRIPPED = auto()
    FAULTED = auto()


def servo_table(task: str, config: ServoConfig, run_timeout_s: float) -> Table:
    """States and transitions of a servoing task; travel times are given twice over before they time out."""
    s = ServoState
    approach_s = 2.0 * config.approach_distance_mm / config.approach_speed_mm_s + 1.0
    retract_s = 2.0 * config.retract_mm / config.retract_speed_mm_s + 1.0
    return Table(
        task,
        (
            StateDef(s.PREPARE, config.prepare_timeout_s, "timeout"),
            StateDef(s.APPROACH, approach_s, "timeout", on_enter="start_approach"),
            StateDef(s.SETTLE, config.settle_timeout_s, "timeout", on_enter="start_settle"),
            StateDef(s.RUN, run_timeout_s, "timeout", on_enter="start_run"),
            StateDef(s.RETRACT, retract_s, "timeout", on_enter="start_retract"),
            StateDef(s.DONE, terminal=True),
            StateDef(s.STOPPED, terminal=True),
            StateDef(s.FAILED, terminal=True),
            StateDef(s.TRIPPED, terminal=True),
            StateDef(s.FAULTED, terminal=True),
        ),
        (
            TransitionDef("ready", s.PREPARE, s.APPROACH),
            TransitionDef("timeout", s.PREPARE, s.FAILED),
            TransitionDef(STOP, s.PREPARE, s.STOPPED),
            TransitionDef("contact", s.APPROACH, s.SETTLE),
            TransitionDef("no_contact", s.APPROACH, s.RETRACT),
            TransitionDef("settled", s.SETTLE, s.RUN),
            TransitionDef("lost", s.SETTLE, s.APPROACH, guard="may_reapproach"),
            TransitionDef("lost", s.SETTLE, s.RETRACT),
            TransitionDef("finished", s.RUN, s.RETRACT),
            TransitionDef("lost", s.RUN, s.APPROACH, guard="may_reapproach"),
            TransitionDef("lost", s.RUN, s.RETRACT),
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


class RunPhase(Protocol):
    """What a servoing task does once the contact has settled."""

    @property
    def feedforward(self) -> Array:
        """Twist (6,) in the desired sensor frame."""
        ...

    @property
    def timeout_s(self) -> float:
        """Longest time that it may take."""
        ...

    def advance(self, dt_s: float, displacement: Array) -> bool:
        """Take in one cycle and tell whether the work is done.

        Args:
            dt_s: how long the cycle was.
            displacement: (3,) m, how far the sensor has moved in it, along its axes.
        """
        ...


@dataclass(frozen=True, slots=True)
class _Sight:
    """What can be relied on in one cycle: None where it is missing or too old."""

    now_ns: int
    T_base_sensor: Array | None
    contact: ContactEstimate | None

    @property
    def T_s_f(self) -> Array | None:  # noqa: N802  the field's own name
        """Valid contact pose (4, 4), or None."""
        if self.contact is None or not (self.contact.in_contact and self.contact.in_range):
            return None
        return None if self.contact.belief is None else self.contact.belief.mean


class ServoTask(MachineTask):
    """A task in execution; see ``tasks.interface.Task`` for what its members mean.

    While it looks for the surface or holds it, it moves only on a fresh frame, a fresh arm state and a valid belief.
    When it withdraws, which is away from the surface, a fresh arm state is enough.

    Args:
        name: the task's name.
        config: its parameters.
        context: of the cell.
        run: what to do once settled.

    Raises:
        TaskDefinitionError: the table is wrong.
        KeyError: the context has no sensor in the role "sensor".
    """

    def __init__(self, name: str, config: ServoConfig, context: TaskContext, run: RunPhase) -> None:
        self._config = config
        self._run = run
        self._period_s = 1.0 / context.rate_hz
        self._T_tcp_sensor = context.T_tcp_sensor[SENSOR]
        self._Ad_tcp_sensor = se3.adjoint(self._T_tcp_sensor)
        T_f_sref = se3.from_euler_mm_deg(np.array([0.0, 0.0, config.depth_mm, 0.0, 0.0, 0.0]))
        self._servo = TactileServo(se3.inverse(T_f_sref), self._T_tcp_sensor, config.gains(), self._period_s)
        self._machine = TaskMachine(servo_table(name, config, run.timeout_s), self)
        self._sight = _Sight(0, None, None)
        self._start: Array | None = None
        self._steady_s = 0.0
        self._blind_s = 0.0
        self._reapproaches = 0
        self._stop_seen = False
        self._finished_run = False

    def tick(self, observation: Observation) -> Action:
        """Advance by one cycle."""
        if self.finished:
            return Action()
        previous = self._sight
        try:
            self._sight = self._look(observation)
            self._watch(observation, previous)
            self._machine.tick(observation.now_ns)
            V_tcp = self._twist()
        except TouchcellError as error:
            self._machine.fire(FAULT, str(error), now_ns=observation.now_ns)
            return Action()
        return Action(self._commands(V_tcp), self._telemetry(observation))

    def may_reapproach(self) -> bool:
        """Guard: a lost contact may be searched for again."""
        return self._reapproaches < self._config.max_reapproach

    def was_stopped(self) -> bool:
        """Guard: a person asked for the end."""
        return self._stop_seen

    def has_finished(self) -> bool:
        """Guard: the work was done."""
        return self._finished_run

    def start_approach(self, record: TransitionRecord) -> None:
        """On entry: measure the way from here."""
        self._reapproaches += record.event == "lost"
        self._start = self._sight.T_base_sensor
        self._blind_s = 0.0

    def start_settle(self, record: TransitionRecord) -> None:
        """On entry: begin to servo, without a past."""
        self._servo.reset()
        self._steady_s = 0.0
        self._blind_s = 0.0

    def start_run(self, record: TransitionRecord) -> None:
        """On entry: keep servoing, now with the feedforward."""
        self._blind_s = 0.0

    def start_retract(self, record: TransitionRecord) -> None:
        """On entry: measure the way from here, or go on measuring if a stop only confirms it."""
        if record.source != state_name(ServoState.RETRACT):
            self._start = self._sight.T_base_sensor
        self._finished_run = self._finished_run or record.event == "finished"

    def _look(self, observation: Observation) -> _Sight:
        now_ns, limits = observation.now_ns, self._config
        arm = observation.arms.get(ARM)
        T_base_sensor = None
        if arm is not None and 0.0 <= arm.age_s(now_ns) <= 1e-3 * limits.max_state_age_ms:
            T_base_sensor = se3.compose(arm.value.T_base_tcp, self._T_tcp_sensor)
        contact = observation.contacts.get(SENSOR)
        if contact is not None and not 0.0 <= now_ns - contact.t_frame_ns <= 1e6 * limits.max_frame_age_ms:
            contact = None
        return _Sight(now_ns, T_base_sensor, contact)

    def _watch(self, observation: Observation, previous: _Sight) -> None:
        """Post what this cycle's observation means for the present state."""
        if observation.operator_stop and not self._stop_seen:
            self._stop_seen = True
            self._machine.post(STOP, "operator")
        sight = self._sight
        dt_s = (sight.now_ns - previous.now_ns) * 1e-9
        match self._machine.state:
            case ServoState.PREPARE:
                if sight.T_base_sensor is not None and sight.contact is not None:
                    self._post("ready")
            case ServoState.APPROACH:
                self._watch_sight(dt_s, blind=sight.T_base_sensor is None or sight.contact is None)
                if sight.contact is not None and sight.contact.in_contact:
                    self._post("contact")
                elif self._travelled_m() >= 1e-3 * self._config.approach_distance_mm:
                    self._post("no_contact", f"none within {self._config.approach_distance_mm:g} mm")
            case ServoState.SETTLE:
                self._watch_contact(dt_s)
                steady = self._steady()
                self._steady_s = self._steady_s + dt_s if steady else 0.0
                if steady and self._steady_s >= self._config.settle_time_s:
                    self._post("settled")
            case ServoState.RUN:
                self._watch_contact(dt_s)
                if sight.T_base_sensor is not None and previous.T_base_sensor is not None:
                    moved = sight.T_base_sensor[:3, 3] - previous.T_base_sensor[:3, 3]
                    if self._run.advance(dt_s, sight.T_base_sensor[:3, :3].T @ moved):
                        self._post("finished")
            case ServoState.RETRACT:
                if self._travelled_m() >= 1e-3 * self._config.retract_mm:
                    self._post("retracted")

    def _watch_contact(self, dt_s: float) -> None:
        contact = self._sight.contact
        if contact is not None and not contact.in_contact:
            self._post("lost", f"frame {contact.seq}")
        self._watch_sight(dt_s, blind=self._sight.T_base_sensor is None or self._sight.T_s_f is None)

    def _watch_sight(self, dt_s: float, *, blind: bool) -> None:
        self._blind_s = self._blind_s + dt_s if blind else 0.0
        if self._blind_s > self._config.stale_timeout_s:
            self._post(TRIP, f"no valid contact estimate or arm state for {self._blind_s:.3f} s")

    def _post(self, event: str, reason: str = "") -> None:
        self._machine.post(event, reason, epoch=self._machine.epoch)

    def _steady(self) -> bool:
        """Whether the errors of the latest servo step are small and it was not held back."""
        if self._sight.T_s_f is None or not self._servo.active:
            return False
        e = self._servo.latest_error
        small = np.linalg.norm(e[:3]) <= 1e-3 * self._config.settle_tolerance_mm
        return bool(small and np.linalg.norm(e[3:]) <= np.radians(self._config.settle_tolerance_deg))

    def _travelled_m(self) -> float:
        """Way of the sensor since the present state was entered; 0 while it cannot be told."""
        if self._sight.T_base_sensor is None:
            return 0.0
        if self._start is None:
            self._start = self._sight.T_base_sensor
        return float(np.linalg.norm(self._sight.T_base_sensor[:3, 3] - self._start[:3, 3]))

    def _twist(self) -> Array | None:
        """Twist (6,) of the tool in the present state; None where it has to stand still."""
        sight = self._sight
        if sight.T_base_sensor is None:
            self._servo.reset()
            return None
        match self._machine.state:
            case ServoState.APPROACH:
                return None if sight.contact is None else self._along_z(1e-3 * self._config.approach_speed_mm_s)
            case ServoState.SETTLE:
                return self._servo_step(np.zeros(6))
            case ServoState.RUN:
                return self._servo_step(self._run.feedforward)
            case ServoState.RETRACT:
                return self._along_z(-1e-3 * self._config.retract_speed_mm_s)
        return None

    def _along_z(self, speed_m_s: float) -> Array:
        V_tcp: Array = self._Ad_tcp_sensor @ np.array([0.0, 0.0, speed_m_s, 0.0, 0.0, 0.0])
        return V_tcp

    def _servo_step(self, V_ff: Array) -> Array | None:
        contact, T_s_f = self._sight.contact, self._sight.T_s_f
        V_tcp = self._servo.step(T_s_f, 0 if contact is None else contact.t_ns, V_ff)
        return None if T_s_f is None else V_tcp

    def _commands(self, V_tcp: Array | None) -> Mapping[str, TwistCommand]:
        if V_tcp is None:
            return {}
        contact = self._sight.contact
        return {
            ARM: TwistCommand(
                V_tcp,
                TwistFrame.TCP,
                t_ns=self._sight.now_ns,
                ttl_s=3.0 * self._period_s,
                t_cause_ns=None if contact is None else contact.t_frame_ns,
            )
        }

    def _telemetry(self, observation: Observation) -> Mapping[str, float]:
        telemetry: dict[str, float] = {}
        contact = observation.contacts.get(SENSOR)
        if contact is not None:
            telemetry["frame_age_ms"] = 1e-6 * (observation.now_ns - contact.t_frame_ns)
        if self._machine.state in (ServoState.SETTLE, ServoState.RUN) and self._servo.active:
            errors, references = _UNITS * self._servo.latest_error, self._servo.reference_mm_deg
            for name, error, reference in zip(_COMPONENTS, errors, references, strict=True):
                if np.isfinite(reference):
                    telemetry[f"error_{name}"] = float(error)
                    telemetry[f"reference_{name}"] = float(reference)
        return telemetry


_COMPONENTS = ("x_mm", "y_mm", "z_mm", "alpha_deg", "beta_deg", "gamma_deg")
_UNITS = np.repeat([1e3, np.degrees(1.0)], 3)
