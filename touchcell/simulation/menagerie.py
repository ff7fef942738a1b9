"""Load arms from a user's checkout of MuJoCo Menagerie: https://github.com/google-deepmind/mujoco_menagerie

Only joints and the masses of links are used. Visual and collision meshes are ignored, so their files are not needed;
motors are our own, as for the arms of rods. Imported only for such an arm.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from touchcell.drivers.kinematics.chain import ChainDescription, SerialChain
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.simulation.dynamics_model import quaternion

_ARMS = {
    "panda": ("franka_emika_panda/panda_nohand.xml", tuple(f"joint{i}" for i in range(1, 8))),
    "ur5e": (
        "universal_robots_ur5e/ur5e.xml",
        tuple(f"{name}_joint" for name in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")),
    ),
}
# Its UR5e differs from the manufacturer's table by a millimetre, as a real arm does.
_TOLERANCE_M = 5e-3
_TOLERANCE_RAD = np.radians(0.5)


def menagerie_arm(root: Path, name: str, description: ChainDescription) -> tuple[Any, Any, Array]:
    """Load the bare arm ``name``, with its base at the chain's.

    Args:
        root: folder of the checkout.
        name: ``panda`` or ``ur5e``.
        description: chain by which it is commanded.

    Returns:
        Its MjSpec without motors, that spec's last link, and T_link_flange (4, 4).

    Raises:
        ConfigError: no such file, it cannot be read, its joints have other names, or its kinematics differ from the
            chain's.
    """
    file, names = _ARMS[name]
    path = root / file
    if not path.is_file():
        raise _unusable(path, "no such file", "the folder that contains franka_emika_panda and the others")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        _strip(spec)
        model = spec.compile()
    except ValueError as error:
        raise _unusable(path, f"MuJoCo cannot read it: {error}") from None
    found = tuple(joint.name for joint in spec.joints)
    if found != names:
        raise _unusable(path, f"its joints are {', '.join(found) or 'none'}", f"expected are {', '.join(names)}")
    link = spec.joints[-1].parent
    T_chain_model, T_link_flange = _fit(model, link.name, SerialChain(description), path)
    for base in spec.worldbody.bodies:
        T = T_chain_model @ _pose(base.pos, base.quat)
        base.pos, base.quat = T[:3, 3], quaternion(T[:3, :3])
    for body in spec.bodies[1:]:
        body.gravcomp = 1.0
    for joint in spec.joints:
        joint.damping = np.zeros_like(joint.damping)
    return spec, link, T_link_flange


def _strip(spec: Any) -> None:
    for kind in ("keys", "actuators", "sensors", "excludes", "equalities", "tendons", "geoms", "sites", "lights"):
        for each in list(getattr(spec, kind)):
            spec.delete(each)
    for each in [*spec.meshes, *spec.materials, *spec.textures, *spec.cameras]:
        spec.delete(each)


def _fit(model: Any, link: str, chain: SerialChain, path: Path) -> tuple[Array, Array]:
    """Return the quarter turn of its base relative to the chain's, and the pose of the flange on its last link."""
    data = mujoco.MjData(model)
    postures = [np.zeros(chain.joint_count), *np.random.default_rng(1).uniform(-1.5, 1.5, (4, chain.joint_count))]

    def link_pose(q: Array) -> Array:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        T = np.eye(4)
        T[:3, 3], T[:3, :3] = data.body(link).xpos, data.body(link).xmat.reshape(3, 3)
        return T

    model_poses, chain_poses = [link_pose(q) for q in postures], [chain.forward(q) for q in postures]
    off_m = np.inf
    for quarters in range(4):
        T_chain_model = np.asarray(se3.from_euler_mm_deg((0.0, 0.0, 0.0, 0.0, 0.0, 90.0 * quarters)))
        T_link_flange = se3.inverse(T_chain_model @ model_poses[0]) @ chain_poses[0]
        errors = [
            se3.log(se3.inverse(T_chain) @ T_chain_model @ T_model @ T_link_flange)
            for T_model, T_chain in zip(model_poses, chain_poses, strict=True)
        ]
        turned_rad = max(float(np.linalg.norm(error[3:])) for error in errors)
        worst_m = max(float(np.linalg.norm(error[:3])) for error in errors)
        if worst_m < _TOLERANCE_M and turned_rad < _TOLERANCE_RAD:
            return T_chain_model, T_link_flange
        off_m = min(off_m, worst_m)
    raise _unusable(path, f"it differs from {chain.description.name}: the flange by {1e3 * off_m:.0f} mm")


def _pose(position: Array, quat: Array) -> Array:
    T, R = np.eye(4), np.empty(9)
    unit = np.asarray(quat, dtype=np.float64)
    mujoco.mju_quat2Mat(R, unit / np.linalg.norm(unit))
    T[:3, 3], T[:3, :3] = position, R.reshape(3, 3)
    return T


def _unusable(path: Path, reason: str, hint: str = "") -> ConfigError:
    return ConfigError(
        f"not a usable arm of MuJoCo Menagerie: {reason}", file=str(path), key="menagerie", value=str(path), hint=hint
    )
