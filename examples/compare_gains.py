"""Run one cell with several controller gains and compare the depth error."""

import numpy as np

import touchcell as tc

for gain in (4.0, 8.0):
    settings = {"task.distance_mm": 40, "task.kp_per_s": [0, 0, gain, gain, gain, 0]}  # depth and both tilts
    result = tc.run(tc.load_cell("surface_follow_sim", set=settings), out=f"gain_{gain:g}")
    task = tc.read_run(result.folder)["/task"]
    following = task["state"] == "run"
    error_mm = task["error_z_mm"][following]
    print(f"gain {gain:g} 1/s: {result.outcome}, depth error {np.sqrt(np.mean(error_mm**2)):.3f} mm RMS")
