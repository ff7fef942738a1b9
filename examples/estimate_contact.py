"""Press a tactile sensor onto a surface, read its camera, and estimate the contact from single images."""

import touchcell as tc

estimator = tc.load_estimator("builtin:sim_gdn")
with tc.connect_cell("surface_follow_sim") as cell:  # its devices, nothing energised
    arm, camera = cell.arms["arm"], cell.cameras["sensor"]
    with arm.control() as control:
        control.move([0, 0, -0.010, 0, 0, 0], duration_s=0.6)  # down to the surface, 5 mm below the tip
        for _ in range(3):
            control.move([0, 0, -0.005, 0, 0, 0], duration_s=0.2)
            contact = estimator.predict(camera.read())
            depth, sigma = contact.pose_mm_deg[2], contact.sigma_mm_deg[2]
            print(f"depth {depth:.2f} mm, standard deviation {sigma:.2f} mm, in range: {contact.in_range}")
        control.move([0, 0, 0.020, 0, 0, 0], duration_s=1.0)
