"""Jog: an operator moves the cell's arms by hand, through the same gate, lease and interlocks as any task.

The dead-man function is the age of the operator's newest request: older than ``dead_man_ms`` it counts as let go, and
the arm is commanded to rest in the same cycle. Nothing moves for longer than a request is held, and after a touch, a
withdrawal or a refusal nothing moves until it has been let go.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from enum import Enum, auto
from typing import Annotated, Final

import numpy as np
from pydantic import Field, PositiveFloat

from touchcell.control.reach import Reach, is_there
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.jog import AT_REST, JogFrame, JogMode, JogRequest
from touchcell.drivers.core.protocols import SERVO_ARM
from touchcell.errors import TouchcellError
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.tasks.interface import (
    SPEED,
    Action,
    Box,
    Observation,
    TaskConfig,
    TaskContext,
    TaskSpec,
    TransitionRecord,
)
from touchcell.tasks.state_machine import FAULT, STOP, TRIP, StateDef, Table, TaskMachine, TransitionDef
from touchcell.tasks.state_machine_task import MachineTask

STEP_WITHIN_M: Final = 5e-5
STEP_WITHIN_RAD: Final = math.radians(0.05)
"""A step is done when no more than this is missing."""
_STEP_GAIN_PER_S: Final = 10.0
_STEP_S: Final = 3.0
_WALL_GAIN_PER_S: Final = 4.0
_WALL_M: Final = 1e-3
_POSE_NAMES: Final = ("x_mm", "y_mm", "z_mm", "alpha_deg", "beta_deg", "gamma_deg")


class JogConfig(TaskConfig):
    """Parameters of moving by hand.

    Attributes:
        dead_man_ms: a request that is older counts as let go.
        speed_mm_s: largest speed of the tool centre point.
        turn_deg_s: largest angular rate.
        touch_speed_mm_s: largest speed while a sensor of the arm touches, and of a guarded motion towards a contact.
        max_accel_mm_s2: largest change of the velocity per second ...
        max_turn_accel_deg_s2: ... and of the angular velocity.
        retract_mm: a withdrawal ends after this distance.
        max_frame_age_ms: a guarded motion ends when the newest frame is older.
        max_state_age_ms: any motion ends when the arm's newest state is older.
        hold_timeout_s: longest motion without letting go.
        idle_timeout_s: the task ends when nothing has been asked of it for this long.
        prepare_timeout_s: longest wait for the first frames and arm states.
    """

    dead_man_ms: Annotated[float, Field(ge=20.0, le=1000.0)] = 150.0
    speed_mm_s: Annotated[float, Field(gt=0.0, le=250.0), SPEED] = 50.0
    turn_deg_s: Annotated[float, Field(gt=0.0, le=60.0)] = 17.0
    touch_speed_mm_s: Annotated[PositiveFloat, SPEED] = 8.0
    max_accel_mm_s2: PositiveFloat = 300.0
    max_turn_accel_deg_s2: PositiveFloat = 100.0
    retract_mm: PositiveFloat = 20.0
    max_frame_age_ms: PositiveFloat = 150.0
    max_state_age_ms: PositiveFloat = 100.0
    hold_timeout_s: PositiveFloat = 60.0
    idle_timeout_s: PositiveFloat = 3600.0
    prepare_timeout_s: PositiveFloat = 10.0


class JogState(Enum):
    """States of moving by hand."""

    PREPARE = auto()
    IDLE = auto()
    MOVING = auto()
    STEPPING = auto()
    UNTIL_TOUCH = auto()
    BACKING_OFF = auto()
    RELEASE = auto()
    DONE = auto()
    FAILED = auto()
    TRIPPED = auto()
    FAULTED = auto()


_MOVES: Final = (JogState.MOVING, JogState.STEPPING, JogState.UNTIL_TOUCH, JogState.BACKING_OFF)


def jog_table(config: JogConfig) -> Table:
    """Return the states and transitions of moving by hand; an operator's stop is its ordinary end, and moves nothing.

    Every motion ends in ``idle`` when the operator lets go, and otherwise in ``release``, which only letting go leaves.
    """
    s = JogState
    # Twice the nominal duration, and as much for a start from rest.
    retract_s = 2.0 * config.retract_mm / config.speed_mm_s + 2.0
    return Table(
        "jog",
        (
            StateDef(s.PREPARE, config.prepare_timeout_s, "timeout"),
            StateDef(s.IDLE, config.idle_timeout_s, "timeout"),
            StateDef(s.MOVING, config.hold_timeout_s, "timeout", on_enter="start_motion"),
            StateDef(s.STEPPING, _STEP_S, "timeout", on_enter="start_motion"),
            StateDef(s.UNTIL_TOUCH, config.hold_timeout_s, "timeout", on_enter="start_motion"),
            StateDef(s.BACKING_OFF, retract_s, "timeout", on_enter="start_motion"),
            StateDef(s.RELEASE, config.idle_timeout_s, "timeout"),
            StateDef(s.DONE, terminal=True),
            StateDef(s.FAILED, terminal=True),
            StateDef(s.TRIPPED, terminal=True),
            StateDef(s.FAULTED, terminal=True),
        ),
        (
            TransitionDef("ready", s.PREPARE, s.IDLE),
            TransitionDef("timeout", s.PREPARE, s.FAILED),
            TransitionDef("pressed", s.IDLE, s.STEPPING, guard="is_step"),
            TransitionDef("pressed", s.IDLE, s.UNTIL_TOUCH, guard="is_until_touch"),
            TransitionDef("pressed", s.IDLE, s.BACKING_OFF, guard="is_retract"),
            TransitionDef("pressed", s.IDLE, s.MOVING),
            TransitionDef("refused", s.IDLE, s.RELEASE),
            TransitionDef("timeout", s.IDLE, s.DONE),
            *(TransitionDef("let_go", state, s.IDLE) for state in (*_MOVES, s.RELEASE)),
            *(TransitionDef("refused", state, s.RELEASE) for state in _MOVES),
            TransitionDef("arrived", s.STEPPING, s.IDLE),
            TransitionDef("touched", s.UNTIL_TOUCH, s.RELEASE),
            TransitionDef("arrived", s.BACKING_OFF, s.RELEASE),
            TransitionDef("timeout", s.RELEASE, s.DONE),
            TransitionDef("timeout", None, s.RELEASE),
            TransitionDef(STOP, None, s.DONE),
            TransitionDef(TRIP, None, s.TRIPPED),
            TransitionDef(FAULT, None, s.FAULTED),
        ),
    )


class Jog(MachineTask):
    """A running task that an operator moves by hand; see ``touchcell.tasks.interface.Task``.

    One arm moves at a time; the others are stopped. Near the wall of a workspace the arm slows down and stands before
    it, so that its interlock has nothing to do.
    """

    def __init__(self, config: JogConfig, context: TaskContext) -> None:
        self._config = config
        self._context = context
        self._period_s = 1.0 / context.rate_hz
        self._machine = TaskMachine(jog_table(config), self)
        self._observation = Observation(0, {}, {})
        self._request: JogRequest | None = None
        self._seq = -1
        self._done_seq = -1
        self._motion: JogRequest | None = None
        self._start: Array | None = None
        self._goal: Array | None = None
        self._twist = np.zeros(6)
        self._zero: frozenset[str] = frozenset()

    def tick(self, observation: Observation) -> Action:
        """Process one cycle."""
        if self.finished:
            return Action()
        self._observation = observation
        try:
            self._read_request(observation)
            self._watch(observation)
            self._machine.tick(observation.now_ns)
            twist = self._command(observation)
            telemetry = self._telemetry()
        except TouchcellError as error:
            self._machine.fire(FAULT, str(error), now_ns=observation.now_ns)
            return Action()
        zero, self._zero = self._zero, frozenset()
        motion = self._motion
        if twist is None or motion is None:
            self._twist = np.zeros(6)
            return Action(telemetry=telemetry, zero=zero)
        self._twist = twist
        command = TwistCommand(twist, TwistFrame.BASE, observation.now_ns, 3.0 * self._period_s)
        return Action({motion.arm: command}, telemetry, zero=zero)

    def is_step(self) -> bool:
        """Guard: the operator asks for a step."""
        return self._request is not None and self._request.mode is JogMode.STEP

    def is_until_touch(self) -> bool:
        """Guard: the operator asks for a guarded motion."""
        return self._request is not None and self._request.mode is JogMode.UNTIL_TOUCH

    def is_retract(self) -> bool:
        """Guard: the operator asks for a withdrawal."""
        return self._request is not None and self._request.mode is JogMode.RETRACT

    def start_motion(self, record: TransitionRecord) -> None:
        """On entry: take note of what is asked for, and of where the arm is."""
        self._motion = self._request
        self._done_seq = self._seq
        self._start = self._goal = None
        if self._motion is not None:
            self._start = self._pose(self._motion.arm)

    def _read_request(self, observation: Observation) -> None:
        """Take the newest request if it is held still, and makes sense."""
        stamped, self._request = observation.jog, None
        if stamped is None:
            return
        age_ns = observation.now_ns - stamped.t_ns
        if not 0 <= age_ns <= round(1e6 * self._config.dead_man_ms):
            return
        request = stamped.value
        if request.arm not in self._arms() or not _is_sound(request):
            return
        if request.axes == AT_REST and request.mode not in (JogMode.RETRACT, JogMode.ZERO):
            return
        self._request, self._seq = request, stamped.seq

    def _watch(self, observation: Observation) -> None:
        if observation.operator_stop:
            self._machine.post(STOP, "operator")
        request, state = self._request, self._machine.state
        if state is JogState.PREPARE:
            self._prepare(observation)
        elif state is JogState.IDLE and request is not None:
            if request.mode is JogMode.ZERO:
                if self._seq > self._done_seq:
                    self._done_seq = self._seq
                    self._zero = frozenset(self._sensors_of(request.arm))
            elif request.mode is not JogMode.STEP or self._seq > self._done_seq:
                reason = self._refusal(request)
                self._post("refused", reason) if reason else self._post("pressed")
        elif state is JogState.RELEASE and request is None:
            self._post("let_go")
        elif state in _MOVES:
            self._watch_motion()

    def _prepare(self, observation: Observation) -> None:
        """Begin once every arm and every sensor has reported; what touches nothing is then compared with this image."""
        sensors = self._context.T_tcp_sensor
        if not all(self._pose(arm) is not None for arm in self._arms()):
            return
        if not all(self._contact(sensor) is not None for sensor in sensors):
            return
        if not self._context.resumed:
            self._zero = frozenset(name for name in sensors if not observation.contacts[name].in_contact)
        self._post("ready")

    def _watch_motion(self) -> None:
        """Post what ends the motion under way."""
        motion, request, state = self._motion, self._request, self._machine.state
        if motion is None or request is None or (request.arm, request.mode) != (motion.arm, motion.mode):
            self._post("let_go")
            return
        if state is not JogState.STEPPING:
            # A step keeps the deflection that it began with.
            self._motion = motion = request
        pose = self._pose(motion.arm)
        if reason := self._refusal(motion, under_way=True):
            self._post("refused", reason)
        elif state is JogState.UNTIL_TOUCH and (touching := self._touching(motion.arm)):
            self._post("touched", ", ".join(touching))
        elif state is JogState.BACKING_OFF and self._has_withdrawn(pose):
            self._post("arrived", f"withdrawn by {self._config.retract_mm:g} mm")
        elif state is JogState.STEPPING and self._has_stepped(pose):
            self._post("arrived")

    def _has_withdrawn(self, pose: Array | None) -> bool:
        if pose is None or self._start is None:
            return False
        return float(np.linalg.norm(pose[:3, 3] - self._start[:3, 3])) >= 1e-3 * self._config.retract_mm

    def _has_stepped(self, pose: Array | None) -> bool:
        return (
            pose is not None and self._goal is not None and is_there(pose, self._goal, STEP_WITHIN_M, STEP_WITHIN_RAD)
        )

    def _refusal(self, request: JogRequest, *, under_way: bool = False) -> str:
        """Return why the arm may not be moved as asked; empty if it may."""
        sensors = self._sensors_of(request.arm)
        if self._pose(request.arm) is None:
            return f"{request.arm}: its newest state is too old"
        if request.mode is JogMode.UNTIL_TOUCH:
            if not sensors:
                return f"{request.arm} carries no tactile sensor that could touch"
            if blind := [name for name in sensors if self._contact(name) is None]:
                return f"{blind[0]}: its newest frame is too old"
            if not under_way and (touching := self._touching(request.arm)):
                return f"{touching[0]} touches already"
        needs_contact = request.mode is not JogMode.RETRACT and request.frame is JogFrame.CONTACT
        if needs_contact and self._contact_pose(request.arm) is None:
            return f"{request.arm} is in no contact along whose axes it could move"
        return ""

    def _command(self, observation: Observation) -> Array | None:
        """Return the twist (6,) along base axes of the arm that moves in the present state; None if none does."""
        motion = self._motion
        if self._machine.state not in _MOVES or motion is None:
            return None
        pose = self._pose(motion.arm)
        if pose is None:
            return None
        if self._machine.state is JogState.STEPPING:
            wanted = self._towards_step(motion, pose)
        elif self._machine.state is JogState.BACKING_OFF:
            wanted = self._withdrawing(motion, pose)
        else:
            wanted = self._as_deflected(motion, pose)
        if wanted is None:
            return None
        held = _slewed(
            self._twist,
            wanted,
            1e-3 * self._config.max_accel_mm_s2 * self._period_s,
            math.radians(self._config.max_turn_accel_deg_s2) * self._period_s,
        )
        return self._before_walls(held, pose, self._context.boxes.get(motion.arm, ()))

    def _as_deflected(self, motion: JogRequest, pose: Array) -> Array | None:
        axes = self._axes(motion, pose)
        if axes is None:
            return None
        R, pivot = axes
        deflection = np.array(motion.axes)
        speed_m_s, turn_rad_s = self._full_speed(motion)
        w = R @ _at_most_one(deflection[3:]) * turn_rad_s
        v = R @ _at_most_one(deflection[:3]) * speed_m_s + np.cross(w, pose[:3, 3] - pivot)
        # A turn about a distant contact moves the tool no faster than it may be moved.
        share = min(1.0, speed_m_s / max(float(np.linalg.norm(v)), 1e-12))
        return share * np.concatenate([v, w])

    def _towards_step(self, motion: JogRequest, pose: Array) -> Array | None:
        if self._goal is None:
            axes = self._axes(motion, pose)
            if axes is None:
                return None
            R, pivot = axes
            deflection = np.array(motion.axes)
            turn = R @ deflection[3:] * motion.step_rad
            T = se3.exp(np.concatenate([np.zeros(3), turn]))
            self._goal = pose.copy()
            self._goal[:3, :3] = T[:3, :3] @ pose[:3, :3]
            self._goal[:3, 3] = pivot + T[:3, :3] @ (pose[:3, 3] - pivot) + R @ deflection[:3] * motion.step_m
        speed_m_s, turn_rad_s = self._full_speed(motion)
        V = Reach(_STEP_GAIN_PER_S, speed_m_s, turn_rad_s).twist(pose, self._goal)
        R_base_tcp = pose[:3, :3]
        return np.concatenate([R_base_tcp @ V[:3], R_base_tcp @ V[3:]])

    def _withdrawing(self, motion: JogRequest, pose: Array) -> Array:
        sensors = self._sensors_of(motion.arm)
        T_tcp_sensor = self._context.T_tcp_sensor[sensors[0]] if sensors else np.eye(4)
        axis = pose[:3, :3] @ T_tcp_sensor[:3, 2]
        return np.concatenate([-1e-3 * self._config.speed_mm_s * _share(motion) * axis, np.zeros(3)])

    def _axes(self, motion: JogRequest, pose: Array) -> tuple[Array, Array] | None:
        """Return the axes (3, 3) of the frame and the point (3,) that is turned about, both in the base frame."""
        if motion.frame is JogFrame.BASE:
            return np.eye(3), pose[:3, 3]
        if motion.frame is JogFrame.TOOL:
            return pose[:3, :3], pose[:3, 3]
        T_tcp_f = self._contact_pose(motion.arm)
        if T_tcp_f is None:
            return None
        T_base_f = se3.compose(pose, T_tcp_f)
        return T_base_f[:3, :3], T_base_f[:3, 3]

    def _full_speed(self, motion: JogRequest) -> tuple[float, float]:
        """Return the largest speed in m/s and angular rate in rad/s."""
        speed_mm_s, share = self._config.speed_mm_s, _share(motion)
        if motion.mode is JogMode.UNTIL_TOUCH or self._touching(motion.arm):
            speed_mm_s = min(speed_mm_s, self._config.touch_speed_mm_s)
        return 1e-3 * speed_mm_s * share, math.radians(self._config.turn_deg_s) * share

    def _before_walls(self, twist: Array, pose: Array, boxes: Iterable[Box]) -> Array:
        """Return ``twist`` with what leads towards a wall taken off as it comes near (a velocity damper, Faverjon and
        Tournassoud, ICRA 1987)."""
        for box in boxes:
            lever = pose[:3, :3] @ box.lever_m
            point, velocity = pose[:3, 3] + lever, twist[:3] + np.cross(twist[3:], lever)
            upward = _WALL_GAIN_PER_S * np.maximum(box.max_m - point - _WALL_M, 0.0)
            downward = _WALL_GAIN_PER_S * np.maximum(point - box.min_m - _WALL_M, 0.0)
            excess = velocity - np.clip(velocity, -downward, upward)
            twist = twist - np.concatenate([excess, np.zeros(3)])
        return twist

    def _arms(self) -> Mapping[str, object]:
        return self._observation.arms

    def _sensors_of(self, arm: str) -> list[str]:
        return sorted(name for name, carrier in self._context.carriers.items() if carrier == arm)

    def _touching(self, arm: str) -> list[str]:
        contacts = self._observation.contacts
        return [name for name in self._sensors_of(arm) if name in contacts and contacts[name].in_contact]

    def _pose(self, arm: str) -> Array | None:
        """Return the pose (4, 4) of an arm's tool; None if it is unknown, too old or not finite."""
        state = self._observation.arms.get(arm)
        if state is None or state.age_s(self._observation.now_ns) > 1e-3 * self._config.max_state_age_ms:
            return None
        pose = state.value.T_base_tcp
        return pose if bool(np.isfinite(pose).all()) else None

    def _contact(self, sensor: str) -> ContactEstimate | None:
        """Return a sensor's newest estimate; None if there is none, or its frame is too old."""
        contact = self._observation.contacts.get(sensor)
        if contact is None:
            return None
        age_ns = self._observation.now_ns - contact.t_frame_ns
        return contact if age_ns <= round(1e6 * self._config.max_frame_age_ms) else None

    def _contact_pose(self, arm: str) -> Array | None:
        """Return the pose (4, 4) of the contact of an arm's first sensor that has one, in the tool frame."""
        for name in self._sensors_of(arm):
            contact = self._contact(name)
            if contact is not None and contact.in_contact and contact.belief is not None and contact.in_range:
                return se3.compose(self._context.T_tcp_sensor[name], contact.belief.mean)
        return None

    def _post(self, event: str, reason: str = "") -> None:
        self._machine.post(event, reason, epoch=self._machine.epoch)

    def _telemetry(self) -> Mapping[str, float]:
        found: dict[str, float] = {}
        arms = sorted(self._arms())
        for arm in arms:
            pose = self._pose(arm)
            if pose is not None:
                prefix = f"{arm}_" if len(arms) > 1 else ""
                values = se3.to_euler_mm_deg(pose)
                found |= {f"{prefix}{name}": float(value) for name, value in zip(_POSE_NAMES, values, strict=True)}
        for name in self._context.T_tcp_sensor:
            contact = self._contact(name)
            if contact is not None and contact.in_contact and contact.belief is not None:
                found[f"{name}_depth_mm"] = 1e3 * float(se3.inverse(contact.belief.mean)[2, 3])
        return found


def _is_sound(request: JogRequest) -> bool:
    """Whether all numbers are finite and within their ranges: an input may be another process."""
    numbers = (*request.axes, request.share, request.step_m, request.step_rad)
    return (
        all(math.isfinite(number) for number in numbers)
        and all(abs(axis) <= 1.0 for axis in request.axes)
        and 0.0 <= request.share <= 1.0
        and 0.0 <= request.step_m <= 0.01
        and 0.0 <= request.step_rad <= math.radians(10.0)
    )


def _share(motion: JogRequest) -> float:
    return min(max(motion.share, 0.0), 1.0)


def _at_most_one(vector: Array) -> Array:
    length = float(np.linalg.norm(vector))
    return vector if length <= 1.0 else vector / length


def _slewed(before: Array, wanted: Array, most_m_s: float, most_rad_s: float) -> Array:
    """Return a twist on the straight way from ``before`` to ``wanted`` that changes by no more than allowed."""
    change = wanted - before
    linear, angular = float(np.linalg.norm(change[:3])), float(np.linalg.norm(change[3:]))
    slewed: Array = before + change / max(linear / most_m_s, angular / most_rad_s, 1.0)
    return slewed


def _of_cell(arms: frozenset[str], sensors: frozenset[str]) -> TaskSpec[JogConfig]:
    return replace(SPEC, arms=dict.fromkeys(sorted(arms), SERVO_ARM), sensors=sensors)


SPEC = TaskSpec(
    "jog",
    "move the arms by hand, with a dead-man function, guarded by touch",
    JogConfig,
    {"arm": SERVO_ARM},
    frozenset({"sensor"}),
    Jog,
    feature=None,
    of_cell=_of_cell,
)
