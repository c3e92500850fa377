"""A tour: from a site file to errors in metres. Read it from top to bottom, like a notebook.

python examples/tour.py
"""

# %% A site is a room and where the microphones are. The site file of the demo has two tetrahedra, 5 m apart.
from pathlib import Path

import numpy as np

import livessl

site = livessl.load_site(Path(__file__).parents[1] / "config" / "demo.yaml")
for array in site.specs:
    print(f"{array.name}: {len(array.microphones_m)} microphones around {np.round(array.centre_m, 2)} m")

# %% Simulate four sounds in that room, which reverberates for 0.7 s. Recordings are (channels, samples) arrays.
made = livessl.simulate(site, rt60_s=0.7, count=4, seed=1)
for name, samples in made.recordings.items():
    print(f"{name}: {samples.shape[0]} channels, {samples.shape[1] / made.sample_rate_hz:.1f} s")

# %% Locate them. An event has a status: located, direction-only or refused; only the last has no estimate.
events = livessl.locate(site, made.recordings, made.sample_rate_hz)
for event in events:
    print(event.id, event.status, event.reason or "")

# %% Compare with the truth: for each source the nearest event in time.
for source in made.scene.sources:
    event = min(events, key=lambda event: abs(event.start_ns / 1e9 - source.start_s))
    assert event.estimate is not None
    error_m = float(np.linalg.norm(event.estimate.position_m - source.position_m))
    sigma_m = float(np.sqrt(np.trace(event.estimate.covariance_m2)))
    print(
        f"{source.name:<14} error {error_m:.3f} m, expected {sigma_m:.3f} m, confidence {event.estimate.confidence:.2f}"
    )

# %% The paper's standard method on the same recordings, by name.
standard = livessl.locate(site, made.recordings, made.sample_rate_hz, method="srp-phat")
for source, event in zip(made.scene.sources, standard, strict=False):
    if event.estimate is not None:
        print(f"srp-phat: error {np.linalg.norm(event.estimate.position_m - source.position_m):.3f} m")

# %% The power map shows where else the first sound could have been.
first = made.scene.sources[0]
found = livessl.power_map(site, made.recordings, first.start_s, first.start_s + 0.5, made.sample_rate_hz)
peak = np.unravel_index(found.power.argmax(), found.power.shape)
print(f"highest point of the map: ({found.x_m[peak[0]]:.2f}, {found.y_m[peak[1]]:.2f}, {found.z_m[peak[2]]:.2f}) m")
