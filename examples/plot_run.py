"""Read a run folder into arrays and plot what the sensor felt against the truth."""

import matplotlib.pyplot as plt

import touchcell as tc

result = tc.run(tc.load_cell("surface_follow_sim", set={"task.distance_mm": 40}))
recording = tc.read_run(result.folder)
print(recording)
for name, topic in recording.items():
    print(f"  {name}: {', '.join(f'{column} {unit}'.strip() for column, unit in topic.units.items())}")

contact, truth = recording["/sensors/sensor/contact"], recording["/sensors/sensor/truth"]
figure, axes = plt.subplots()
axes.plot(contact.t_s, contact["z_mm"], label="estimate")
axes.plot(truth.t_s, truth["z_mm"], "--", label="truth")
axes.set(xlabel="time, s", ylabel=f"depth, {contact.units['z_mm']}")
axes.legend()
figure.savefig(result.folder / "depth.png")
print("wrote", result.folder / "depth.png")
