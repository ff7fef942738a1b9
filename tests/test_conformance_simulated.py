from drivers.conformance.suite import suite
from drivers.emulators.rigs.simulated import (
    replay_camera_rig,
    sim_arm_rig,
    sim_joint_arm_rig,
    sim_tactip_rig,
)

TestSimArm = suite(sim_arm_rig)
TestSimJointArm = suite(sim_joint_arm_rig)
TestSimTactip = suite(sim_tactip_rig)
TestReplayCamera = suite(replay_camera_rig)
