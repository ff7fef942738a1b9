"""Run compiled steps: one arm with the tactile sensor that it carries."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from functools import partial

import numpy as np

from touchcell.control.reach import Reach, is_there
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.protocols import SERVO_ARM
from touchcell.errors import TouchcellError
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.tasks.contact_servo import ContactServo
from touchcell.tasks.interface import Action, Observation, TaskContext, TaskSpec, TransitionRecord
from touchcell.tasks.servoing import ARM, SENSOR
from touchcell.tasks.state_machine import FAULT, STOP, TRIP, TaskMachine, state_name
from touchcell.tasks.state_machine_task import MachineTask
from touchcell.tasks.steps.compiler import compile_steps
from touchcell.tasks.steps.model import Hold, Leaf, Move, Record, Retract, Servo, StepsConfig, Until, leaves
from touchcell.tasks.steps.places import planned_motions, planned_places

_GAIN_PER_S = 10.0
_SI = np.array([1e-3] * 3 + [np.pi / 180.0] * 3)
_COMPONENTS = ("x_mm", "y_mm", "z_mm", "alpha_deg", "beta_deg", "gamma_deg")


class _Steady:
    """Servoing with a constant feedforward; the step's own conditions end it."""

    timeout_s = 1.0

    def __init__(self, feedforward: Array) -> None:
        self.feedforward = feedforward

    def update(self, dt_s: float, before: Array, now: Array, T_s_f: Array | None) -> bool:
        """Return False: it never finishes by itself."""
        return False

    def shortfall(self) -> str:
        """Return nothing: the step has its own conditions."""
        return ""

    def telemetry(self) -> Mapping[str, float]:
        """Return no further telemetry."""
        return {}


class StepsTask(MachineTask):
    """A running task of steps; ``touchcell.tasks.interface.Task`` documents its members.

    The arm moves only on a fresh frame and a fresh arm state, except for retracting, which needs the arm's state only.

    Args:
        config: its steps and gains.
        context: of the cell.

    Raises:
        KeyError: the context has no sensor in the role "sensor".
    """

    def __init__(self, config: StepsConfig, context: TaskContext) -> None:
        self._config = config
        self._period_s = 1.0 / context.rate_hz
        self._T_tcp_sensor = context.T_tcp_sensor[SENSOR]
        self._Ad_tcp_sensor = se3.adjoint(self._T_tcp_sensor)
        self.program = compile_steps(config)
        self._servos = {
            state: ContactServo(
                ARM, SENSOR, config, step.reference, _Steady(np.array(step.velocity_mm_deg_s) * _SI), context
            )
            for state, step in self.program.steps.items()
            if isinstance(step, Servo)
        }
        # Knows where sensor and contact are while no servo step runs.
        self._sight = ContactServo(ARM, SENSOR, config, (0.0, 0.0, 1.0, 0.0, 0.0, 0.0), _Steady(np.zeros(6)), context)
        self._counts = [0] * len(self.program.loops)
        for k in range(len(self._counts)):
            setattr(self, f"again_{k}", partial(self._again, k))
        self._machine = TaskMachine(self.program.table, self)
        self._goal: Array | None = None
        self._began_ns = 0
        self._last_ns: int | None = None
        self._blind_s = 0.0
        self._stop_seen = False
        self._force: Array | None = None
        self._first_force: Array | None = None

    def tick(self, observation: Observation) -> Action:
        """Advance by one cycle."""
        if self.finished:
            return Action()
        now_ns = observation.now_ns
        dt_s = self._period_s if self._last_ns is None else (now_ns - self._last_ns) * 1e-9
        self._last_ns = now_ns
        try:
            self._sight.update(observation)
            self._feel(observation)
            for servo in self._servos.values():
                servo.update(observation)
            telemetry = self._watch(observation, dt_s)
            self._machine.tick(now_ns)
            V_tcp = self._twist()
        except TouchcellError as error:
            self._machine.fire(FAULT, str(error), now_ns=now_ns)
            return Action()
        if V_tcp is None:
            return Action({}, telemetry)
        cause_ns = None if self._sight.contact is None else self._sight.contact.t_frame_ns
        command = TwistCommand(V_tcp, TwistFrame.TCP, t_ns=now_ns, ttl_s=3.0 * self._period_s, t_cause_ns=cause_ns)
        return Action({ARM: command}, telemetry)

    def was_stopped(self) -> bool:
        """Guard: the operator requested a stop."""
        return self._stop_seen

    def begin(self, record: TransitionRecord) -> None:
        """On entry: count loops, and measure time, path and goal from here."""
        if record.event == "done":
            self._count(self.program.state(record.source), self.program.state(record.target))
        if record.source != record.target or record.event == "done":
            self._began_ns = record.t_ns
            self._sight.reset_travel()
            self._first_force = None
        self._goal = None
        self._blind_s = 0.0
        servo = self._servos.get(self._machine.state)
        if servo is not None:
            servo.controller.reset()

    def _again(self, k: int) -> bool:
        return self._counts[k] + 1 < self.program.loops[k].times

    def _count(self, source: Enum, target: Enum) -> None:
        for k, loop in enumerate(self.program.loops):
            if loop.last is not source:
                continue
            if target is loop.first and self._again(k):
                self._counts[k] += 1
                return
            self._counts[k] = 0

    def _watch(self, observation: Observation, dt_s: float) -> Mapping[str, float]:
        """Post the events of this cycle for the current state; return its telemetry."""
        if observation.operator_stop and not self._stop_seen:
            self._stop_seen = True
            self._post(STOP, "operator")
        state = self._machine.state
        step = self.program.steps.get(state)
        sight = self._sight
        if step is None:
            if state is self.program.state("prepare"):
                if sight.has_fresh_data:
                    self._post("ready")
            elif 1e3 * sight.travelled_m() >= self._config.withdraw_mm:
                self._post("withdrawn")
            return {}
        retracting = isinstance(step, Retract)
        self._watch_data(dt_s, blind=sight.T_base_sensor is None if retracting else not self._can_act(step))
        if sight.T_base_sensor is None or not (retracting or self._can_act(step)):
            return {}
        telemetry = {} if sight.T_s_f is None else {"depth_mm": 1e3 * self._depth_m()}
        match step:
            case Move():
                self._watch_move(step)
            case Servo():
                if reason := self._met(step.until):
                    self._post("done", reason)
            case Hold():
                if self._stay_s() >= step.time_s:
                    self._post("done")
            case Retract():
                if 1e3 * sight.travelled_m() >= step.distance_mm:
                    self._post("done")
            case Record():
                self._post("done")
                telemetry |= self._record(step, observation)
        return telemetry

    def _watch_move(self, step: Move) -> None:
        if step.until is not None and (reason := self._met(step.until)):
            self._post("done", reason)
        elif self._goal is not None and is_there(
            self._T_base_tcp(), self._goal, 1e-3 * step.tolerance_mm, float(np.radians(step.tolerance_deg))
        ):
            if step.until is not None and step.until.needs_touch:
                wanted, state = step.until.touch(), state_name(self._machine.state)
                self._post("unmet", f"arrived without the {wanted} that {state} waits for")
            else:
                self._post("done", "arrived")

    def _can_act(self, step: Leaf) -> bool:
        """Return True if all data that ``step`` needs is fresh."""
        needs_contact = isinstance(step, Servo) or (
            isinstance(step, Move) and step.frame == "contact" and self._goal is None
        )
        until = step.until if isinstance(step, Move | Servo) else None
        if until is not None and until.force_n is not None and self._force is None:
            return False
        return self._sight.has_fresh_data and (not needs_contact or self._sight.T_s_f is not None)

    def _feel(self, observation: Observation) -> None:
        """Take the force on the tool; none that is too old or not finite."""
        wrench, self._force = observation.wrenches.get(ARM), None
        fresh = wrench is not None and 0.0 <= wrench.age_s(observation.now_ns) <= 1e-3 * self._config.max_state_age_ms
        if wrench is not None and fresh and np.isfinite(wrench.value).all():
            self._force = wrench.value[:3]

    def _watch_data(self, dt_s: float, *, blind: bool) -> None:
        self._blind_s = self._blind_s + dt_s if blind else 0.0
        if self._blind_s > self._config.stale_timeout_s:
            self._post(TRIP, f"no fresh frame, contact or arm state for {self._blind_s:.3f} s")

    def _met(self, until: Until) -> str:
        """Return a description of the first condition that holds; empty if none does."""
        sight = self._sight
        if until.contact is not None and sight.in_contact is until.contact:
            return "contact" if until.contact else "free"
        if until.depth_mm is not None and sight.T_s_f is not None and 1e3 * self._depth_m() >= until.depth_mm:
            return f"depth {1e3 * self._depth_m():.2f} mm"
        if until.force_n is not None and (force_n := self._force_n()) is not None and force_n >= until.force_n:
            return f"force {force_n:.2f} N"
        if until.distance_mm is not None and 1e3 * sight.travelled_m() >= until.distance_mm:
            return f"moved {1e3 * sight.travelled_m():.1f} mm"
        if until.time_s is not None and self._stay_s() >= until.time_s:
            return f"{self._stay_s():.3f} s"
        return ""

    def _force_n(self) -> float | None:
        """Return by how much the force on the tool has changed since the step began, N; None while it is not known."""
        if self._force is None:
            return None
        if self._first_force is None:
            self._first_force = self._force
        return float(np.linalg.norm(self._force - self._first_force))

    def _stay_s(self) -> float:
        return ((self._last_ns or 0) - self._began_ns) * 1e-9

    def _depth_m(self) -> float:
        assert self._sight.T_s_f is not None
        return float(se3.inverse(self._sight.T_s_f)[2, 3])

    def _T_base_tcp(self) -> Array:  # noqa: N802  the field's own name
        assert self._sight.T_base_sensor is not None
        return se3.compose(self._sight.T_base_sensor, se3.inverse(self._T_tcp_sensor))

    def _post(self, event: str, reason: str = "") -> None:
        self._machine.post(event, reason, epoch=self._machine.epoch)

    def _twist(self) -> Array | None:
        """Return the twist (6,) of the tool in the current state; None where the arm has to rest."""
        sight, state = self._sight, self._machine.state
        step = self.program.steps.get(state)
        if sight.T_base_sensor is None:
            return None
        if step is None:
            withdrawing = state is self.program.state("withdraw")
            return sight.along_z(-1e-3 * self._config.withdraw_speed_mm_s) if withdrawing else None
        if isinstance(step, Retract):
            return sight.along_z(-1e-3 * step.speed_mm_s)
        if not self._can_act(step):
            for servo in self._servos.values():
                servo.controller.reset()
            return None
        if isinstance(step, Servo):
            servo = self._servos[state]
            return servo.servo_step(servo.run.feedforward)
        return self._move_twist(step) if isinstance(step, Move) else None

    def _move_twist(self, step: Move) -> Array:
        if step.velocity_mm_deg_s is not None:
            return self._velocity(step, np.array(step.velocity_mm_deg_s) * _SI)
        if self._goal is None:
            self._goal = self._goal_of(step)
        reach = Reach(_GAIN_PER_S, 1e-3 * step.speed_mm_s, float(np.radians(step.turn_deg_s)))
        return reach.twist(self._T_base_tcp(), self._goal)

    def _velocity(self, step: Move, V: Array) -> Array:
        if step.frame == "base":
            R = self._T_base_tcp()[:3, :3]
            return np.concatenate([R.T @ V[:3], R.T @ V[3:]])
        V_tcp: Array = V if step.frame == "tool" else self._Ad_tcp_sensor @ V
        return V_tcp

    def _goal_of(self, step: Move) -> Array:
        """Return the goal pose T_base_tcp (4, 4) of the step."""
        if step.to_mm_deg is not None:
            return se3.from_euler_mm_deg(np.array(step.to_mm_deg))
        assert step.by_mm_deg is not None
        by = se3.from_euler_mm_deg(np.array([*step.by_mm_deg, 0.0, 0.0, 0.0][:6]))
        T_base_tcp = self._T_base_tcp()
        if step.frame == "base":
            goal = T_base_tcp.copy()
            goal[:3, 3] += by[:3, 3]
            goal[:3, :3] = by[:3, :3] @ T_base_tcp[:3, :3]
            return goal
        if step.frame == "tool":
            return se3.compose(T_base_tcp, by)
        T_tcp_frame = self._T_tcp_sensor
        if step.frame == "contact":
            assert self._sight.T_s_f is not None
            T_tcp_frame = se3.compose(T_tcp_frame, self._sight.T_s_f)
        T_base_frame = se3.compose(T_base_tcp, T_tcp_frame)
        return se3.compose(se3.compose(T_base_frame, by), se3.inverse(T_tcp_frame))

    def _record(self, step: Record, observation: Observation) -> Mapping[str, float]:
        tool = se3.to_euler_mm_deg(observation.arms[ARM].value.T_base_tcp).tolist()
        numbers = {f"{step.label}_tool_{name}": value for name, value in zip(_COMPONENTS, tool, strict=True)}
        if self._sight.T_s_f is not None:
            contact = se3.to_euler_mm_deg(se3.inverse(self._sight.T_s_f)).tolist()
            numbers |= {f"{step.label}_contact_{name}": value for name, value in zip(_COMPONENTS, contact, strict=True)}
        return numbers


def _forces(config: StepsConfig) -> Mapping[str, str]:
    """Return the arm, if a step waits for a force."""
    waits = (step.until for step in leaves(config.steps) if isinstance(step, Move | Servo))
    return {ARM: "until.force_n"} if any(until is not None and until.force_n is not None for until in waits) else {}


SPEC = TaskSpec(
    name="steps",
    summary="do guarded motions written in the cell file: move, servo, hold, retract, record, repeat",
    config=StepsConfig,
    arms={ARM: SERVO_ARM},
    sensors=frozenset({SENSOR}),
    build=StepsTask,
    forces=_forces,
    places=planned_places,
    motions=planned_motions,
)
