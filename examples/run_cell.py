"""Run a cell file from start to end; Ctrl-C stops it in an orderly way."""

import sys

import touchcell as tc

cell = tc.load_cell("surface_follow_sim", set={"task.distance_mm": 40})  # checked, nothing connected
result = tc.run(cell)
print(result)
print(result.summary)
sys.exit(0 if result.done else 1)
