from touchcell.simulation.devices.rig import replay_camera_rig, sim_arm_rig, sim_joint_arm_rig, sim_tactip_rig
from touchcell.testing.conformance.suite import suite

TestSimArm = suite(sim_arm_rig)
TestSimJointArm = suite(sim_joint_arm_rig)
TestSimTactip = suite(sim_tactip_rig)
TestReplayCamera = suite(replay_camera_rig)
