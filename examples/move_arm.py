"""Move an arm to a pose, then along a twist, and stop. For a real one: ``connect_arm("ur", host="192.168.1.10")``."""

import touchcell as tc

with tc.connect_arm("sim_arm", start_pose_mm_deg=[0, 0, 200, 180, 0, 0]) as arm:
    print(arm)  # connected; nothing is energised yet
    with arm.control() as control:  # energised here; stopped and given back at the end, whatever happens
        control.move_to([0, 50, 150, 180, 0, 0], speed_mm_s=50)
        print("at", arm.pose_mm_deg().round(1), "mm, deg")
        control.move([0.0, 0.0, 0.01, 0.0, 0.0, 0.0], duration_s=2.0)  # m/s and rad/s along base axes
    print("at", arm.pose_mm_deg().round(1), "mm, deg")
