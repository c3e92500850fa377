"""Draw the power map of one sound: how much power comes from each point of a plane through the room.

    python examples/power_map.py [PICTURE]

The picture is power_map.png unless another name is given. It needs matplotlib: pip install 'livessl[figures]'.
"""

import sys
from pathlib import Path

import matplotlib

import livessl

matplotlib.use("Agg")
from matplotlib import pyplot as plt

SITE = Path(__file__).parents[1] / "config" / "demo.yaml"
picture = Path(sys.argv[1] if len(sys.argv) > 1 else "power_map.png")

made = livessl.simulate(SITE, rt60_s=0.5, count=1, seed=3)
(source,) = made.scene.sources
start_s = source.start_s
stop_s = start_s + len(source.sound) / made.sample_rate_hz
found = livessl.power_map(SITE, made.recordings, start_s, stop_s, made.sample_rate_hz)

floor = found.power.max(axis=2)  # the highest power over all heights, (nx, ny)
figure, axes = plt.subplots()
image = axes.pcolormesh(found.x_m, found.y_m, floor.T)
axes.plot(*source.position_m[:2], "w+", markersize=12, label="true position")
axes.set(xlabel="x / m", ylabel="y / m", aspect="equal", title=f"{source.name}, sum of {len(found.arrays)} arrays")
axes.legend()
figure.colorbar(image, label="power")
figure.savefig(picture, dpi=120)
print(f"{picture}: {floor.shape[0]} x {floor.shape[1]} grid points")
