"""Model of a Franka arm: kinematics, limits, reflexes. No I/O and no clock: it moves when it is stepped.

Denavit-Hartenberg table, joint and Cartesian limits of the FR3 from Franka's "Robot and interface specifications".
Motion generators have no dynamics: the arm follows them exactly, and a reflex stops it at once where a real arm brakes.
Commanded torques move joints of constant, uncoupled inertia with friction, gravity compensated as Franka's controller
does; that judges protocol and signs, not a control law.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from touchcell.drivers.franka.emulator.codec import Generator, MotionCommand
from touchcell.geometry.types import Array

_DH_A_M = (0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088)
_DH_ALPHA_RAD = tuple(quarter * math.pi / 2 for quarter in (0, -1, 1, 1, -1, 1, 1))
_DH_D_M = (0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0)
_COS_ALPHA = tuple(math.cos(alpha) for alpha in _DH_ALPHA_RAD)
_SIN_ALPHA = tuple(math.sin(alpha) for alpha in _DH_ALPHA_RAD)
_FLANGE_D_M = 0.107

JOINT_MIN_RAD = np.array([-2.7437, -1.7837, -2.9007, -3.0421, -2.8065, 0.5445, -3.0159])
JOINT_MAX_RAD = np.array([2.7437, 1.7837, 2.9007, -0.1518, 2.8065, 4.5169, 3.0159])
JOINT_SPEED_RAD_S = np.array([2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26])
JOINT_ACCEL_RAD_S2 = 10.0
JOINT_JERK_RAD_S3 = 5000.0
SPEED_M_S, ACCEL_M_S2, JERK_M_S3 = 3.0, 9.0, 4500.0
ROT_SPEED_RAD_S, ROT_ACCEL_RAD_S2, ROT_JERK_RAD_S3 = 2.5, 17.0, 8500.0

# Position-based joint velocity limits of the FR3's URDF: (velocity offset rad/s, deceleration limit rad/s²).
_VELOCITY_OFFSET_RAD_S = (0.3, 0.2, 0.2, 0.3, 0.35, 0.35, 0.35)
_DECELERATION_RAD_S2 = (6.0, 2.585, 3.5, 4.0, 17.0, 5.5, 17.0)

TORQUE_N_M = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
TORQUE_RATE_N_M_S = 1000.0
# Of this emulator, in the order of size of an arm of 18 kg.
_INERTIA_KG_M2 = np.array([1.2, 1.2, 0.9, 0.9, 0.15, 0.15, 0.08])
_FRICTION_N_M_S = np.array([6.0, 6.0, 4.0, 4.0, 1.0, 1.0, 0.5])

READY_POSE_RAD = np.array([0.0, -math.pi / 4, 0.0, -3 * math.pi / 4, 0.0, math.pi / 2, math.pi / 4])
_SMALLEST_SINGULAR_VALUE = 0.02
_START_TOLERANCE = 1e-3
_TICK_S = 1e-3


def _hand_frame() -> Array:
    c = s = math.sqrt(0.5)
    return np.array([[c, s, 0, 0], [-s, c, 0, 0], [0, 0, 1, 0.1034], [0, 0, 0, 1]])


def flange_pose(q: Array) -> tuple[Array, Array, Array]:
    """Return T_base_flange (4, 4), joint axes (3, 7) and joint origins (3, 7), all in the base frame."""
    T = np.eye(4)
    axes, origins = np.empty((3, 7)), np.empty((3, 7))
    for i, angle in enumerate(q.tolist()):
        c, s, ca, sa = math.cos(angle), math.sin(angle), _COS_ALPHA[i], _SIN_ALPHA[i]
        T = T @ np.array(
            (
                (c, -s, 0.0, _DH_A_M[i]),
                (s * ca, c * ca, -sa, -_DH_D_M[i] * sa),
                (s * sa, c * sa, ca, _DH_D_M[i] * ca),
                (0.0, 0.0, 0.0, 1.0),
            )
        )
        axes[:, i], origins[:, i] = T[:3, 2], T[:3, 3]
    T[:3, 3] += _FLANGE_D_M * T[:3, 2]
    return T, axes, origins


def urdf() -> str:
    """Return a URDF of the arm: kinematics and limits as above, placeholder inertias."""
    inertial = (
        '<inertial><origin xyz="0 0 0"/><mass value="1"/>'
        '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>'
    )
    parts = ['<?xml version="1.0"?><robot name="fr3"><link name="base"/>']
    parts += [f'<link name="link{i}">{inertial}</link>' for i in range(9)]
    parts.append('<joint name="base_joint" type="fixed"><parent link="base"/><child link="link0"/></joint>')
    for i in range(7):
        alpha, d = _DH_ALPHA_RAD[i], _DH_D_M[i]
        origin = f"{_DH_A_M[i]} {-d * _SIN_ALPHA[i]} {d * _COS_ALPHA[i]}"
        parts.append(
            f'<joint name="joint{i + 1}" type="revolute"><parent link="link{i}"/><child link="link{i + 1}"/>'
            f'<origin rpy="{alpha} 0 0" xyz="{origin}"/><axis xyz="0 0 1"/>'
            f'<limit effort="87" lower="{JOINT_MIN_RAD[i]}" upper="{JOINT_MAX_RAD[i]}"'
            f' velocity="{JOINT_SPEED_RAD_S[i]}"/>'
            f'<position_based_velocity_limits velocity_offset="{_VELOCITY_OFFSET_RAD_S[i]}"'
            f' deceleration_limit="{_DECELERATION_RAD_S2[i]}"/></joint>'
        )
    parts.append(
        '<joint name="joint8" type="fixed"><parent link="link7"/><child link="link8"/>'
        f'<origin rpy="0 0 0" xyz="0 0 {_FLANGE_D_M}"/></joint></robot>'
    )
    return "".join(parts)


class Reflex(Exception):
    """The arm stops with a reflex; ``name`` is Franka's name of the error, ``detail`` the observation."""

    def __init__(self, name: str, detail: str = "") -> None:
        super().__init__(name)
        self.name = name
        self.detail = detail


@dataclass(slots=True)
class _Profile:
    """Last value, velocity and acceleration of the commanded signal, to detect discontinuities.

    ``steady``: whether it replied to the next state; across lost packets derivatives are means.
    """

    message_id: int
    value: Array
    velocity: Array
    acceleration: Array
    steady: bool = True


@dataclass(slots=True)
class EmulatedArm:
    """State and motion of the arm; every array in SI units, base axes.

    Attributes:
        q, dq: joints (7,).
        T_base_ee: pose of the end effector frame.
        J: (6, 7) Jacobian of its origin.
        wrench: (6,) external wrench on the end effector, along base axes.
        force_threshold: (6,) above which a Cartesian reflex stops the arm.
        contact_threshold: (6,) above which contact is reported.
        tau: (7,) N m commanded torques, beyond gravity.
    """

    q: Array = field(default_factory=READY_POSE_RAD.copy)
    dq: Array = field(default_factory=lambda: np.zeros(7))
    F_T_NE: Array = field(default_factory=_hand_frame)
    NE_T_EE: Array = field(default_factory=lambda: np.eye(4))
    EE_T_K: Array = field(default_factory=lambda: np.eye(4))
    wrench: Array = field(default_factory=lambda: np.zeros(6))
    force_threshold: Array = field(default_factory=lambda: np.full(6, 30.0))
    contact_threshold: Array = field(default_factory=lambda: np.full(6, 20.0))
    T_base_ee: Array = field(init=False)
    J: Array = field(init=False)
    twist_c: Array = field(default_factory=lambda: np.zeros(6))
    tau: Array = field(default_factory=lambda: np.zeros(7))
    _generator: Generator = Generator.IDLE
    _by_torque: bool = False
    _torque_id: int = 0
    _profile: _Profile | None = None
    _began_id: int = 0
    _T_commanded: Array = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        self.refresh()

    def refresh(self) -> None:
        """Recompute pose and Jacobian for the present joints and frames."""
        T_base_flange, axes, origins = flange_pose(self.q)
        self.T_base_ee = T_base_flange @ self.F_T_NE @ self.NE_T_EE
        self.J = np.vstack([np.cross(axes, self.T_base_ee[:3, 3:] - origins, axis=0), axes])

    def begin(self, generator: Generator, message_id: int = 0, *, by_torque: bool = False) -> bool:
        """Start a motion generator at state ``message_id``; False if the pose is too singular for a Cartesian one.

        With ``by_torque`` the client closes the loop: its torques move the arm, and its motion is a wish only.
        """
        if generator in (Generator.CARTESIAN_POSITION, Generator.CARTESIAN_VELOCITY):
            smallest = np.linalg.svd(self.J, compute_uv=False)[-1]
            if smallest < _SMALLEST_SINGULAR_VALUE:
                return False
        self._generator = generator
        self._by_torque, self._torque_id = by_torque, message_id
        self._profile = None
        self._began_id = message_id
        self.halt()
        return True

    def halt(self) -> None:
        """Set all velocities to zero."""
        self.dq = np.zeros(7)
        self.twist_c = np.zeros(6)
        self.tau = np.zeros(7)

    def step(self, command: MotionCommand | None, dt_s: float) -> None:
        """Move for ``dt_s`` by the newest command; without one the velocity continues. Raises Reflex."""
        if self._generator is Generator.IDLE or (self._generator is Generator.NONE and not self._by_torque):
            return
        if self._by_torque:
            self._accelerate(command, dt_s)
        elif command is not None:
            self._follow(command)
        if self._generator is Generator.CARTESIAN_VELOCITY and not self._by_torque:
            self.dq = self._inverse(self.twist_c)
        if self._by_torque or self._generator in (Generator.CARTESIAN_VELOCITY, Generator.JOINT_VELOCITY):
            self.q = self.q + self.dq * dt_s
        self._check_joints()
        self.refresh()
        if (np.abs(self.wrench) > self.force_threshold).any():
            raise Reflex("cartesian_reflex")

    def _accelerate(self, command: MotionCommand | None, dt_s: float) -> None:
        """Accelerate by the newest torques, which stay until others come. Raises Reflex."""
        if command is not None:
            tau = np.array(command.tau)
            _check_finite(tau)
            if (np.abs(tau) > TORQUE_N_M).any():
                raise Reflex("tau_j_range_violation", f"{tau} N m")
            gap_s = max(command.message_id - self._torque_id, 1) * _TICK_S
            step = float(np.abs(tau - self.tau).max())
            # Values pass through doubles and a rate limiter that is exact to rounding.
            if step > TORQUE_RATE_N_M_S * gap_s * (1.0 + 1e-6):
                raise Reflex("controller_torque_discontinuity", f"{step:g} N m within {gap_s:g} s")
            self.tau, self._torque_id = tau, command.message_id
        external = self.J.T @ self.wrench
        self.dq = self.dq + dt_s * (self.tau + external - _FRICTION_N_M_S * self.dq) / _INERTIA_KG_M2

    def _follow(self, command: MotionCommand) -> None:
        if self._generator is Generator.CARTESIAN_VELOCITY:
            self.twist_c = np.array(command.O_dP_EE)
            _check_finite(self.twist_c)
            self._check_profile(command.message_id, self.twist_c, is_velocity=True)
        elif self._generator is Generator.JOINT_VELOCITY:
            self.dq = np.array(command.dq)
            _check_finite(self.dq)
            self._check_profile(command.message_id, self.dq, is_velocity=True)
        elif self._generator is Generator.JOINT_POSITION:
            target = np.array(command.q)
            _check_finite(target)
            if self._profile is None and np.abs(target - self.q).max() > _START_TOLERANCE:
                raise Reflex("joint_position_motion_generator_start_pose_invalid")
            self.dq = self._check_profile(command.message_id, target, is_velocity=False)
            self.q = target
        elif self._generator is Generator.CARTESIAN_POSITION:
            self._follow_pose(command)

    def _follow_pose(self, command: MotionCommand) -> None:
        T = np.array(command.O_T_EE).reshape(4, 4).T
        _check_finite(T)
        R = T[:3, :3]
        if np.abs(R @ R.T - np.eye(3)).max() > 1e-5 or np.abs(T[3] - (0, 0, 0, 1)).max() > 1e-9:
            raise Reflex("cartesian_position_motion_generator_invalid_frame")
        step = _pose_step(self.T_base_ee, T)
        if self._profile is None:
            if np.abs(step).max() > _START_TOLERANCE:
                raise Reflex("cartesian_position_motion_generator_start_pose_invalid")
            travelled = np.zeros(6)
        else:
            travelled = self._profile.value + _pose_step(self._T_commanded, T)
        self._T_commanded = T
        self.twist_c = self._check_profile(command.message_id, travelled, is_velocity=False)
        self.dq = self._inverse(self.twist_c)
        self.q = self.q + self._inverse(step)

    def _check_profile(self, message_id: int, value: Array, *, is_velocity: bool) -> Array:
        """Check velocity, acceleration and jerk since the last command; return the velocity. Raises Reflex."""
        last = self._profile or _Profile(
            self._began_id, np.zeros_like(value) if is_velocity else value, np.zeros_like(value), np.zeros_like(value)
        )
        dt_s = (message_id - last.message_id) * _TICK_S
        if dt_s <= 0.0:
            return last.velocity
        velocity = value if is_velocity else (value - last.value) / dt_s
        acceleration = (velocity - last.velocity) / dt_s
        jerk = (acceleration - last.acceleration) / dt_s
        steady = message_id - last.message_id == 1
        self._profile = _Profile(message_id, value, velocity, acceleration, steady)
        if value.shape == (6,):
            prefix = "cartesian"
            speed_ok = _within(velocity, SPEED_M_S, ROT_SPEED_RAD_S)
            accel_ok = _within(acceleration, ACCEL_M_S2, ROT_ACCEL_RAD_S2)
            jerk_ok = _within(jerk, JERK_M_S3, ROT_JERK_RAD_S3)
        else:
            prefix = "joint"
            speed_ok = bool((np.abs(velocity) <= JOINT_SPEED_RAD_S).all())
            accel_ok = bool((np.abs(acceleration) <= JOINT_ACCEL_RAD_S2).all())
            jerk_ok = bool((np.abs(jerk) <= JOINT_JERK_RAD_S3).all())
        # Franka's names: a jump in velocity violates the acceleration limit, a jump in acceleration the jerk limit.
        checks = (
            (speed_ok, "velocity_limits_violation"),
            (accel_ok or not (is_velocity or (steady and last.steady)), "velocity_discontinuity"),
            (jerk_ok or not (steady and last.steady), "acceleration_discontinuity"),
        )
        for is_ok, name in checks:
            if not is_ok:
                detail = f"state {message_id}, {dt_s:g} s after the last: {velocity}, {acceleration}, {jerk} (SI)"
                raise Reflex(f"{prefix}_motion_generator_{name}", detail)
        return velocity

    def _check_joints(self) -> None:
        if self._by_torque:
            if (self.q < JOINT_MIN_RAD).any() or (self.q > JOINT_MAX_RAD).any():
                self.q = np.clip(self.q, JOINT_MIN_RAD, JOINT_MAX_RAD)
                raise Reflex("joint_position_limits_violation")
            if (np.abs(self.dq) > JOINT_SPEED_RAD_S).any():
                raise Reflex("joint_velocity_violation")
            return
        prefix = "joint" if self._generator in (Generator.JOINT_POSITION, Generator.JOINT_VELOCITY) else "cartesian"
        infix = "" if prefix == "joint" else "joint_"
        if (self.q < JOINT_MIN_RAD).any() or (self.q > JOINT_MAX_RAD).any():
            self.q = np.clip(self.q, JOINT_MIN_RAD, JOINT_MAX_RAD)
            raise Reflex(f"{prefix}_motion_generator_{infix}position_limits_violation")
        if (np.abs(self.dq) > JOINT_SPEED_RAD_S).any():
            raise Reflex(f"{prefix}_motion_generator_{infix}velocity_limits_violation")

    def _inverse(self, twist: Array) -> Array:
        J = self.J
        return J.T @ np.asarray(np.linalg.solve(J @ J.T + 1e-9 * np.eye(6), twist))


def _pose_step(T_from: Array, T_to: Array) -> Array:
    """Return the small motion from one pose to the other along base axes, (6,)."""
    R = T_to[:3, :3] @ T_from[:3, :3].T
    turn = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return np.concatenate([T_to[:3, 3] - T_from[:3, 3], turn])


def _within(vector: Array, linear: float, angular: float) -> bool:
    return math.hypot(*vector[:3]) <= linear and math.hypot(*vector[3:]) <= angular


def _check_finite(values: Array) -> None:
    if not np.isfinite(values).all():
        raise Reflex("communication_constraints_violation")
