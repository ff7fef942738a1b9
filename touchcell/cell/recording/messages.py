"""Messages of a recording, in millimetres and degrees, with the unit in every key, and the types that declare them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from touchcell.cell.recording.message_types import Kind, MessageType, camel_case
from touchcell.control.interlocks.level import Level
from touchcell.control.supervisor import Verdict
from touchcell.drivers.core.commands import Sent, TwistCommand
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.geometry import se3
from touchcell.geometry.finite import all_finite
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.geometry.types import Array
from touchcell.perception.runtime.estimate import ContactEstimate

COMPONENTS = ("x_mm", "y_mm", "z_mm", "alpha_deg", "beta_deg", "gamma_deg")

_POSE: Final = dict.fromkeys(COMPONENTS, Kind.REAL)
_SIGMA: Final = {f"sigma_{name}": Kind.REAL for name in COMPONENTS}
_SIGMA_UNITS: Final = np.array([1e3] * 3 + [180 / np.pi] * 3)
_DECLARED: Final = {
    ("arms", "tcp"): MessageType("Tcp", {"seq": Kind.INTEGER, **_POSE, "speed_mm_s": Kind.REAL, "twist": Kind.REALS}),
    ("arms", "wrench"): MessageType("Wrench", {"seq": Kind.INTEGER, "values": Kind.REALS}),
    ("arms", "external_torque"): MessageType("ExternalTorque", {"seq": Kind.INTEGER, "values": Kind.REALS}),
    ("arms", "command"): MessageType(
        "Command",
        {
            "twist": Kind.REALS,
            "frame": Kind.TEXT,
            "ttl_s": Kind.REAL,
            "limited_by": Kind.TEXTS,
            "asked": Kind.REALS,
            "allowed": Kind.REALS,
            "speed_mm_s": Kind.REAL,
            "sensor_to_command_ms": Kind.REAL,
        },
    ),
    ("sensors", "contact"): MessageType(
        "Contact",
        {
            "seq": Kind.INTEGER,
            "t_frame_ns": Kind.INTEGER,
            "in_contact": Kind.FLAG,
            "in_range": Kind.FLAG,
            "nis": Kind.REAL,
            **_POSE,
            **_SIGMA,
            "change": Kind.REAL,
            "markers": Kind.REAL,
            "refusal": Kind.TEXT,
        },
    ),
    ("sensors", "measurement"): MessageType("Measurement", {"seq": Kind.INTEGER, **_POSE, **_SIGMA}),
    ("sensors", "truth"): MessageType("TrueContact", {"in_contact": Kind.FLAG, **_POSE}),
    ("objects",): MessageType("ObjectPose", _POSE),
    ("interlocks",): MessageType(
        "Levels",
        {
            "interlock": Kind.TEXTS,
            "subject": Kind.TEXTS,
            "value": Kind.REALS,
            "limit": Kind.REALS,
            "unit": Kind.TEXTS,
        },
    ),
    ("safety",): MessageType("Verdict", {"allow": Kind.FLAG, "speed": Kind.REAL, "violations": Kind.TEXTS}),
    ("events",): MessageType("Event", dict.fromkeys(("event", "from", "to", "reason"), Kind.TEXT)),
    ("task",): MessageType("Task", {"state": Kind.TEXT}),
    ("timing",): MessageType("Timing", {}),
}


def declared_type(topic: str) -> MessageType:
    """Return the type of a topic; one without fields, which grows, where none is declared."""
    kind, *rest = topic.strip("/").split("/")
    known = _DECLARED.get((kind, *rest[1:]))
    return known if known is not None else MessageType(camel_case(topic), {})


def pose_message(T: Array) -> dict[str, float]:
    """Return a pose (4, 4) as extrinsic-xyz Euler components; NaN for a non-finite pose, so that it is recorded too."""
    if not all_finite(T):
        return dict.fromkeys(COMPONENTS, float("nan"))
    return dict(zip(COMPONENTS, se3.to_euler_mm_deg(T).tolist(), strict=True))


def tcp_message(state: Stamped[TcpState]) -> dict[str, Any]:
    """Return pose, speed and twist (m/s and rad/s along base axes) of a tool centre point."""
    twist = state.value.twist.tolist()
    return {
        "seq": state.seq,
        **pose_message(state.value.T_base_tcp),
        "speed_mm_s": 1e3 * math.hypot(*twist[:3]),
        "twist": twist,
    }


def values_message(sample: Stamped[Array]) -> dict[str, Any]:
    """Return a wrench (6,) N and N m, or external torques (n,) N m."""
    return {"seq": sample.seq, "values": sample.value.tolist()}


def command_message(sent: Sent[TwistCommand]) -> dict[str, Any]:
    """Return the command as sent, and the limits that changed it."""
    command = sent.command
    twist = command.twist.tolist()
    message: dict[str, Any] = {
        "twist": twist,
        "frame": command.frame.value,
        "ttl_s": command.ttl_s,
        "limited_by": [adjustment.limit for adjustment in sent.adjustments],
        "asked": [adjustment.requested for adjustment in sent.adjustments],
        "allowed": [adjustment.allowed for adjustment in sent.adjustments],
        "speed_mm_s": 1e3 * math.hypot(*twist[:3]),
    }
    if command.t_cause_ns is not None:
        message["sensor_to_command_ms"] = (sent.t_ns - command.t_cause_ns) * 1e-6
    return message


def verdict_message(verdict: Verdict) -> dict[str, Any]:
    """Return the supervisor's violations of one cycle, and whether motion is allowed."""
    return {
        "allow": verdict.allow,
        "speed": verdict.speed,
        "violations": [f"{v.severity.name.lower()} {v.interlock}: {v.subject}: {v.reason}" for v in verdict.violations],
    }


def levels_message(levels: Sequence[tuple[str, Level]]) -> dict[str, Any]:
    """Return what is on its way to the limits of interlocks: one item of each list for each."""
    return {
        "interlock": [name for name, _ in levels],
        "subject": [level.subject for _, level in levels],
        "value": [level.value for _, level in levels],
        "limit": [level.limit for _, level in levels],
        "unit": [level.unit for _, level in levels],
    }


def contact_message(estimate: ContactEstimate) -> dict[str, Any]:
    """Return a contact estimate: pose of the sensor in the surface frame, standard deviations of the belief."""
    message: dict[str, Any] = {
        "seq": estimate.seq,
        "t_frame_ns": estimate.t_frame_ns,
        "in_contact": estimate.in_contact,
        "in_range": estimate.in_range,
        "nis": estimate.nis,
        "change": estimate.change,
        "markers": estimate.markers,
    }
    if estimate.refusal:
        message["refusal"] = estimate.refusal
    if estimate.belief is not None:
        message |= belief_message(estimate.belief)
    return message


def belief_message(belief: PoseGaussian) -> dict[str, Any]:
    """Return a Gaussian over ``T_s_f`` as the pose ``T_f_s``, and its standard deviations.

    The deviations are those of right perturbations of ``T_f_s``, which are the belief's own up to sign: along and about
    the sensor's axes.
    """
    sigma = (np.sqrt(belief.covariance.diagonal()) * _SIGMA_UNITS).tolist()
    return pose_message(se3.inverse(belief.mean)) | dict(zip(_SIGMA, sigma, strict=True))
