"""Collect labelled images: touch a known surface repeatedly with varied contacts (paper, Algorithm 1).

For each sample the sensor tilts out of contact, is pressed in along the surface normal, sheared along the surface, and
rests while a frame is taken. The cell stores frame and label.

With ``motions: sequence`` it is pressed in and then moves from one random contact to the next without leaving the
surface, so that the skin sticks and slides as it comes, and every frame is stored with where the sensor was. Each
sequence begins with frames out of contact, whose depth is negative.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from touchcell.control.reach import Reach, is_there
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.protocols import SERVO_ARM
from touchcell.errors import TouchcellError
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.perception.contact_poses import PUBLIC_DEPTH_MM, random_poses
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.perception.runtime.motion import PoseHistory
from touchcell.tasks.interface import (
    DEPTH,
    SPEED,
    Action,
    Observation,
    TaskConfig,
    TaskContext,
    TaskSpec,
    TransitionRecord,
)
from touchcell.tasks.planned_motions import PlannedContact, PlannedMotion, PlannedStart
from touchcell.tasks.servoing import ARM, SENSOR
from touchcell.tasks.state_machine import FAULT, STOP, TRIP, StateDef, Table, TaskMachine, TransitionDef
from touchcell.tasks.state_machine_task import MachineTask

_GAIN_PER_S = 10.0
_MANY = 20
"""Samples of which one is sheared by most of what is allowed."""
_WITHIN_M, _WITHIN_RAD = 2e-5, 5e-4


class DataCollectionConfig(TaskConfig):
    """Parameters of data collection. The ranges are those of the public data.

    Attributes:
        samples: number of samples to collect, including those of earlier runs.
        seed: of the contacts; a single sample k is the same whenever it is taken.
        depth_mm: smallest and largest indentation.
        tilt_deg: radius of the disc of tilts.
        shear_mm: radius of the disc of shears.
        torsion_deg: largest rotation about the surface normal.
        clearance_mm: gap between tip and surface while the sensor tilts.
        speed_mm_s: speed out of contact.
        press_speed_mm_s: speed in contact.
        turn_deg_s: angular rate.
        settle_ms: time at rest before a frame is used.
        motions: ``single`` takes one frame of each contact, at rest; ``sequence`` all frames of contacts that move.
        sequence_frames: frames of a sequence, after which the sensor leaves the surface.
        move_timeout_s: longest time of each motion.
        max_frame_age_ms: the arm stops when the newest frame is older.
        max_state_age_ms: the arm stops when its newest state is older.
        stale_timeout_s: the task trips when the arm has been stopped for lack of either for this long.
    """

    samples: PositiveInt = 1000
    seed: NonNegativeInt = 0
    depth_mm: Annotated[tuple[PositiveFloat, PositiveFloat], DEPTH] = PUBLIC_DEPTH_MM
    tilt_deg: Annotated[float, Field(ge=0.0, le=45.0)] = 25.0
    shear_mm: NonNegativeFloat = 5.0
    torsion_deg: NonNegativeFloat = 5.0
    clearance_mm: PositiveFloat = 3.0
    speed_mm_s: Annotated[PositiveFloat, SPEED] = 40.0
    press_speed_mm_s: Annotated[PositiveFloat, SPEED] = 15.0
    turn_deg_s: PositiveFloat = 60.0
    settle_ms: NonNegativeFloat = 50.0
    motions: Literal["single", "sequence"] = "single"
    sequence_frames: PositiveInt = 200
    move_timeout_s: PositiveFloat = 10.0
    max_frame_age_ms: PositiveFloat = 250.0
    max_state_age_ms: PositiveFloat = 50.0
    stale_timeout_s: PositiveFloat = 0.5


class CollectState(Enum):
    """States of data collection."""

    PREPARE = auto()
    LIFT = auto()
    TILT = auto()
    PRESS = auto()
    SHEAR = auto()
    GRAB = auto()
    ROAM = auto()
    RETRACT = auto()
    DONE = auto()
    STOPPED = auto()
    FAILED = auto()
    TRIPPED = auto()
    FAULTED = auto()


_MOVING = (
    CollectState.LIFT,
    CollectState.TILT,
    CollectState.PRESS,
    CollectState.SHEAR,
    CollectState.ROAM,
    CollectState.RETRACT,
)


def collect_table(config: DataCollectionConfig) -> Table:
    """Return the states and transitions of data collection."""
    s = CollectState
    longest_s = config.move_timeout_s
    return Table(
        "data_collection",
        (
            StateDef(s.PREPARE, longest_s, "timeout"),
            StateDef(s.LIFT, longest_s, "timeout", on_enter="withdraw"),
            StateDef(s.TILT, longest_s, "timeout", on_enter="aim_tilt"),
            StateDef(s.PRESS, longest_s, "timeout", on_enter="aim_press"),
            StateDef(s.SHEAR, longest_s, "timeout", on_enter="aim_shear"),
            StateDef(s.GRAB, longest_s, "timeout", on_enter="start_grab"),
            StateDef(s.ROAM, longest_s, "timeout", on_enter="aim_next"),
            StateDef(s.RETRACT, longest_s, "timeout", on_enter="withdraw"),
            StateDef(s.DONE, terminal=True),
            StateDef(s.STOPPED, terminal=True),
            StateDef(s.FAILED, terminal=True),
            StateDef(s.TRIPPED, terminal=True),
            StateDef(s.FAULTED, terminal=True),
        ),
        (
            TransitionDef("ready", s.PREPARE, s.LIFT),
            TransitionDef("timeout", s.PREPARE, s.FAILED),
            TransitionDef(STOP, s.PREPARE, s.STOPPED),
            TransitionDef("arrived", s.LIFT, s.TILT, guard="more_to_take"),
            TransitionDef("arrived", s.LIFT, s.RETRACT),
            TransitionDef("arrived", s.TILT, s.PRESS),
            TransitionDef("arrived", s.PRESS, s.ROAM, guard="in_sequence"),
            TransitionDef("arrived", s.PRESS, s.SHEAR),
            TransitionDef("arrived", s.SHEAR, s.GRAB),
            TransitionDef("taken", s.GRAB, s.LIFT),
            TransitionDef("arrived", s.ROAM, s.ROAM),
            TransitionDef("taken", s.ROAM, s.LIFT),
            TransitionDef("arrived", s.RETRACT, s.STOPPED, guard="was_stopped"),
            TransitionDef("arrived", s.RETRACT, s.FAILED, guard="more_to_take"),
            TransitionDef("arrived", s.RETRACT, s.DONE),
            TransitionDef("timeout", s.RETRACT, s.FAILED),
            TransitionDef("timeout", None, s.RETRACT),
            TransitionDef(STOP, None, s.RETRACT),
            TransitionDef(TRIP, None, s.TRIPPED),
            TransitionDef(FAULT, None, s.FAULTED),
        ),
    )


@dataclass(frozen=True, slots=True)
class _Sight:
    """Valid, fresh data of one cycle: None where missing or too old."""

    now_ns: int
    T_base_s: Array | None
    contact: ContactEstimate | None

    @property
    def T_s_f(self) -> Array | None:  # noqa: N802  the field's own name
        """Pose of the surface in the sensor frame, (4, 4)."""
        return None if self.contact is None or self.contact.belief is None else self.contact.belief.mean


class DataCollection(MachineTask):
    """The data collection task; see ``touchcell.tasks.interface.Task`` for its members.

    Its estimator has to know the surface pose, also out of contact (``kind: known_surface``).

    Args:
        config: its parameters.
        context: of the cell.

    Raises:
        KeyError: the context has no sensor in the role "sensor".
    """

    def __init__(self, config: DataCollectionConfig, context: TaskContext) -> None:
        self._config = config
        self._T_tcp_sensor = context.T_tcp_sensor[SENSOR]
        self._Ad_tcp_sensor = se3.adjoint(self._T_tcp_sensor)
        self._ttl_s = 3.0 / context.rate_hz
        turn_rad_s = float(np.radians(config.turn_deg_s))
        self._in_air = Reach(_GAIN_PER_S, 1e-3 * config.speed_mm_s, turn_rad_s)
        self._in_contact = Reach(_GAIN_PER_S, 1e-3 * config.press_speed_mm_s, turn_rad_s)
        self._machine = TaskMachine(collect_table(config), self)
        self._sight = _Sight(0, None, None)
        self._T_base_f: Array | None = None
        self._goal: Array | None = None
        self._taken = context.kept
        self._begun = context.kept
        self._leg = 0
        self._labelled = -1
        self._poses = PoseHistory()
        self._arrived_ns = 0
        self._blind_since_ns: int | None = None
        self._stop_seen = False

    def tick(self, observation: Observation) -> Action:
        """Advance by one cycle."""
        if self.finished:
            return Action()
        try:
            self._sight = self._look(observation)
            labels = self._watch(observation)
            self._machine.tick(observation.now_ns)
            V_s = self._twist()
        except TouchcellError as error:
            self._machine.fire(FAULT, str(error), now_ns=observation.now_ns)
            return Action()
        telemetry = {"sample": float(self._taken), "samples": float(self._config.samples)}
        if V_s is None:
            return Action({}, telemetry, labels)
        command = TwistCommand(self._Ad_tcp_sensor @ V_s, TwistFrame.TCP, t_ns=observation.now_ns, ttl_s=self._ttl_s)
        return Action({ARM: command}, telemetry, labels)

    def more_to_take(self) -> bool:
        """Guard: samples are missing."""
        return self._taken < self._config.samples

    def in_sequence(self) -> bool:
        """Guard: frames are taken in motion."""
        return self._config.motions == "sequence"

    def was_stopped(self) -> bool:
        """Guard: the operator requested a stop."""
        return self._stop_seen

    def withdraw(self, record: TransitionRecord) -> None:
        """On entry: straight back from the current pose, orientation unchanged."""
        self._goal = None

    def aim_tilt(self, record: TransitionRecord) -> None:
        """On entry: the next sample's tilt, above its contact point."""
        self._begun, self._leg = self._taken, 0
        _, _, _, alpha, beta, _ = self._sample()
        self._aim([0.0, 0.0, -self._config.clearance_mm, alpha, beta, 0.0])

    def aim_press(self, record: TransitionRecord) -> None:
        """On entry: press in to its depth."""
        _, _, depth, alpha, beta, _ = self._sample()
        self._aim([0.0, 0.0, depth, alpha, beta, 0.0])

    def aim_shear(self, record: TransitionRecord) -> None:
        """On entry: shear along the surface."""
        self._aim(self._sample())

    def aim_next(self, record: TransitionRecord) -> None:
        """On entry: the next contact of the sequence."""
        self._leg += 1
        self._aim(self._sample())

    def start_grab(self, record: TransitionRecord) -> None:
        """On entry: rest, and start the settling time."""
        self._arrived_ns = record.t_ns

    def _sample(self) -> list[float]:
        """Return the contact T_f_s of the current sample, mm and degrees."""
        config = self._config
        number = (self._begun, self._leg) if self.in_sequence() else (self._taken,)
        T_f_s = random_poses(
            1,
            np.random.default_rng((config.seed, *number)),
            config.depth_mm,
            tilt_deg=config.tilt_deg,
            shear_mm=config.shear_mm,
            torsion_deg=config.torsion_deg,
        )[0]
        sample: list[float] = se3.to_euler_mm_deg(T_f_s).tolist()
        return sample

    def _aim(self, T_f_s_mm_deg: Sequence[float]) -> None:
        assert self._T_base_f is not None
        self._goal = se3.compose(self._T_base_f, se3.from_euler_mm_deg(np.array(T_f_s_mm_deg)))

    def _look(self, observation: Observation) -> _Sight:
        now_ns, config = observation.now_ns, self._config
        arm, contact = observation.arms.get(ARM), observation.contacts.get(SENSOR)
        T_base_s = None
        if arm is not None and 0.0 <= arm.age_s(now_ns) <= 1e-3 * config.max_state_age_ms:
            T_base_s = se3.compose(arm.value.T_base_tcp, self._T_tcp_sensor)
            self._poses.record(arm.t_ns, T_base_s)
        if contact is not None and not 0.0 <= now_ns - contact.t_frame_ns <= 1e6 * config.max_frame_age_ms:
            contact = None
        return _Sight(now_ns, T_base_s, contact)

    def _watch(self, observation: Observation) -> Mapping[str, Array]:
        """Post the events of this cycle for the current state; return the label of a frame to be stored."""
        if observation.operator_stop and not self._stop_seen:
            self._stop_seen = True
            self._post(STOP, "operator")
        sight, state = self._sight, self._machine.state
        withdrawing = state is CollectState.RETRACT
        self._watch_sight(blind=sight.T_base_s is None or (sight.T_s_f is None and not withdrawing))
        if sight.T_base_s is None:
            return {}
        match state:
            case CollectState.PREPARE:
                if sight.T_s_f is not None:
                    self._T_base_f = se3.compose(sight.T_base_s, sight.T_s_f)
                    self._post("ready")
            case CollectState.GRAB:
                settled_ns = self._arrived_ns + round(1e6 * self._config.settle_ms)
                if sight.contact is not None and sight.T_s_f is not None and sight.contact.t_frame_ns >= settled_ns:
                    self._taken += 1
                    self._post("taken")
                    return {SENSOR: se3.inverse(sight.T_s_f)}
            case CollectState.PRESS | CollectState.ROAM if self.in_sequence():
                labels = self._labels_in_motion(sight.contact)
                if state is CollectState.ROAM and self._sequence_taken():
                    self._post("taken")
                elif self._is_there(sight.T_base_s):
                    self._post("arrived")
                return labels
            case _:
                if self._is_there(sight.T_base_s):
                    self._post("arrived")
        return {}

    def _is_there(self, T_base_s: Array) -> bool:
        return self._goal is not None and is_there(T_base_s, self._goal, _WITHIN_M, _WITHIN_RAD)

    def _sequence_taken(self) -> bool:
        return self._taken - self._begun >= self._config.sequence_frames or not self.more_to_take()

    def _labels_in_motion(self, contact: ContactEstimate | None) -> Mapping[str, Array]:
        """Return the label of a frame that has none yet: where the sensor was when it was taken."""
        assert self._T_base_f is not None
        if contact is None or contact.seq == self._labelled or self._sequence_taken():
            return {}
        self._labelled = contact.seq
        self._taken += 1
        return {SENSOR: se3.compose(se3.inverse(self._T_base_f), self._poses.at(contact.t_frame_ns))}

    def _watch_sight(self, *, blind: bool) -> None:
        now_ns = self._sight.now_ns
        if not blind or self._machine.state is CollectState.PREPARE:
            self._blind_since_ns = None
            return
        if self._blind_since_ns is None:
            self._blind_since_ns = now_ns
        blind_s = (now_ns - self._blind_since_ns) * 1e-9
        if blind_s > self._config.stale_timeout_s:
            self._post(TRIP, f"no fresh frame or arm state for {blind_s:.3f} s")

    def _post(self, event: str, reason: str = "") -> None:
        self._machine.post(event, reason, epoch=self._machine.epoch)

    def _twist(self) -> Array | None:
        """Return the twist (6,) of the sensor in the current state; None where it has to rest."""
        T_base_s, state = self._sight.T_base_s, self._machine.state
        if T_base_s is None or self._T_base_f is None or state not in _MOVING:
            return None
        # Moving away from the surface is allowed without fresh frames.
        if self._sight.contact is None and state is not CollectState.RETRACT:
            return None
        if self._goal is None:
            pose = se3.to_euler_mm_deg(se3.compose(se3.inverse(self._T_base_f), T_base_s))
            pose[2] = min(float(pose[2]), -self._config.clearance_mm)
            self._aim(pose.tolist())
        assert self._goal is not None
        return (self._in_air if state is CollectState.TILT else self._in_contact).twist(T_base_s, self._goal)


def _motions(config: DataCollectionConfig) -> Iterator[PlannedMotion]:
    """Return how each press begins, and the largest of many shears."""
    way_mm = config.clearance_mm + config.depth_mm[0]
    speed_mm_s = min(config.press_speed_mm_s, _GAIN_PER_S * way_mm)
    yield PlannedStart(("press_speed_mm_s",), 1e-3 * speed_mm_s, 1e-3 * way_mm - 1e-3 * speed_mm_s / _GAIN_PER_S)
    if config.samples >= _MANY:
        yield PlannedContact(("shear_mm",), 1e-3 * config.settle_ms, "grab", 1e-3 * config.shear_mm)


SPEC = TaskSpec(
    name="data_collection",
    summary="touch a known surface with varied contacts and store labelled frames",
    config=DataCollectionConfig,
    arms={ARM: SERVO_ARM},
    sensors=frozenset({SENSOR}),
    build=DataCollection,
    labels_frames=True,
    motions=lambda config, start, mount: _motions(config),
)
