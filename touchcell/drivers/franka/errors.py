"""The 41 errors that a Franka controller reports, in the order of its error flags, with class, remedy and hint.

Names and meaning: Franka's documentation of ``franka::Errors`` (libfranka 0.21); class, remedy and hint are our own.
"""

from __future__ import annotations

from typing import NamedTuple

from touchcell.drivers.core.errors import FaultClass, Remedy


class VendorError(NamedTuple):
    """One error flag."""

    name: str
    fault_class: FaultClass
    needs: Remedy
    hint: str


_GUIDE_BACK = "unlock in Desk and guide the arm back by hand"
_SMOOTHER = "the command stream jumped: check the command rate and the load of the host"
_SLOWER = "lower the speed limits of the arm"
_START = "the motion did not start at the arm's present state: stop, wait for standstill, and start again"
_AWAY = "move the arm away from this posture first"
_DESK = "concerns motions started from Desk, not from here"
_PUSHED = "remove the contact, then recover; raise contact limits only with care"

_MOTION, _CONTACT, _CONFIG = FaultClass.MOTION, FaultClass.CONTACT, FaultClass.CONFIGURATION
_RECOVER, _OPERATOR, _SERVICE = Remedy.RECOVER, Remedy.OPERATOR, Remedy.SERVICE

ERRORS: tuple[VendorError, ...] = (
    VendorError("joint_position_limits_violation", _MOTION, _OPERATOR, _GUIDE_BACK),
    VendorError(
        "cartesian_position_limits_violation", _MOTION, _OPERATOR, "the arm is past a virtual wall: " + _GUIDE_BACK
    ),
    VendorError("self_collision_avoidance_violation", _MOTION, _OPERATOR, _GUIDE_BACK),
    VendorError("joint_velocity_violation", _MOTION, _RECOVER, _SLOWER),
    VendorError("cartesian_velocity_violation", _MOTION, _RECOVER, _SLOWER),
    VendorError("force_control_safety_violation", _CONTACT, _RECOVER, _PUSHED),
    VendorError("joint_reflex", _CONTACT, _RECOVER, _PUSHED),
    VendorError("cartesian_reflex", _CONTACT, _RECOVER, _PUSHED),
    VendorError(
        "max_goal_pose_deviation_violation",
        _MOTION,
        _RECOVER,
        "the arm could not reach its goal: check for contact and load",
    ),
    VendorError(
        "max_path_pose_deviation_violation",
        _MOTION,
        _RECOVER,
        "the arm was pushed off its path: check for contact and load",
    ),
    VendorError("cartesian_velocity_profile_safety_violation", _MOTION, _RECOVER, _SLOWER),
    VendorError("joint_position_motion_generator_start_pose_invalid", _MOTION, _RECOVER, _START),
    VendorError("joint_motion_generator_position_limits_violation", _MOTION, _RECOVER, _AWAY),
    VendorError("joint_motion_generator_velocity_limits_violation", _MOTION, _RECOVER, _SLOWER),
    VendorError("joint_motion_generator_velocity_discontinuity", _MOTION, _RECOVER, _SMOOTHER),
    VendorError("joint_motion_generator_acceleration_discontinuity", _MOTION, _RECOVER, _SMOOTHER),
    VendorError("cartesian_position_motion_generator_start_pose_invalid", _MOTION, _RECOVER, _START),
    VendorError("cartesian_motion_generator_elbow_limit_violation", _MOTION, _RECOVER, _AWAY),
    VendorError("cartesian_motion_generator_velocity_limits_violation", _MOTION, _RECOVER, _SLOWER),
    VendorError("cartesian_motion_generator_velocity_discontinuity", _MOTION, _RECOVER, _SMOOTHER),
    VendorError("cartesian_motion_generator_acceleration_discontinuity", _MOTION, _RECOVER, _SMOOTHER),
    VendorError("cartesian_motion_generator_elbow_sign_inconsistent", _MOTION, _RECOVER, _AWAY),
    VendorError("cartesian_motion_generator_start_elbow_invalid", _MOTION, _RECOVER, _START),
    VendorError("force_controller_desired_force_tolerance_violation", _CONTACT, _RECOVER, _PUSHED),
    VendorError("start_elbow_sign_inconsistent", _MOTION, _RECOVER, _DESK),
    VendorError(
        "communication_constraints_violation",
        FaultClass.COMMUNICATION,
        _RECOVER,
        "20 command packets were lost or late: use a PREEMPT_RT kernel, a direct cable, no power saving",
    ),
    VendorError("power_limit_violation", FaultClass.OVERLOAD, _RECOVER, _SLOWER),
    VendorError("cartesian_motion_generator_joint_position_limits_violation", _MOTION, _RECOVER, _AWAY),
    VendorError(
        "cartesian_motion_generator_joint_velocity_limits_violation", _MOTION, _RECOVER, "near a singularity: " + _AWAY
    ),
    VendorError(
        "cartesian_motion_generator_joint_velocity_discontinuity", _MOTION, _RECOVER, "near a singularity: " + _AWAY
    ),
    VendorError(
        "cartesian_motion_generator_joint_acceleration_discontinuity", _MOTION, _RECOVER, "near a singularity: " + _AWAY
    ),
    VendorError(
        "cartesian_position_motion_generator_invalid_frame",
        _CONFIG,
        _RECOVER,
        "the commanded pose was not a rigid transform",
    ),
    VendorError("controller_torque_discontinuity", _MOTION, _RECOVER, _SMOOTHER),
    VendorError("joint_p2p_insufficient_torque_for_planning", FaultClass.OVERLOAD, _RECOVER, _DESK),
    VendorError(
        "tau_j_range_violation",
        FaultClass.OVERLOAD,
        _OPERATOR,
        "check the payload set for the arm, and whether it is jammed",
    ),
    VendorError("instability_detected", _MOTION, _RECOVER, "check the payload and lower the impedance"),
    VendorError(
        "joint_move_in_wrong_direction", _MOTION, _OPERATOR, "guide the joint away from its limit, not towards it"
    ),
    VendorError("cartesian_spline_motion_generator_violation", _MOTION, _RECOVER, _DESK),
    VendorError("joint_via_motion_generator_planning_joint_limit_violation", _MOTION, _RECOVER, _DESK),
    VendorError(
        "base_acceleration_initialization_timeout",
        FaultClass.INTERNAL,
        _SERVICE,
        "the base must stand still while the arm starts",
    ),
    VendorError(
        "base_acceleration_invalid_reading", FaultClass.INTERNAL, _SERVICE, "the base must stand still and upright"
    ),
)
"""Errors by wire index."""

BY_NAME: dict[str, VendorError] = {error.name: error for error in ERRORS}

MODES: dict[str, VendorError] = {
    "Other": VendorError(
        "joints locked or controller not ready",
        FaultClass.SAFETY_STOP,
        _OPERATOR,
        "unlock the joints and activate FCI in Desk",
    ),
    "Guiding": VendorError("guided by hand", FaultClass.SAFETY_STOP, _OPERATOR, "let go of the guiding buttons"),
    "Reflex": VendorError("stopped by a reflex", _MOTION, _RECOVER, "inspect the arm, then recover"),
    "UserStopped": VendorError("user stop", FaultClass.SAFETY_STOP, _OPERATOR, "release the stop button, then recover"),
    "AutomaticErrorRecovery": VendorError("recovering", FaultClass.INTERNAL, _RECOVER, "wait until it has recovered"),
}
"""Robot modes (franky's names) in which the arm executes no commands; "Idle" and "Move" are the normal ones."""
