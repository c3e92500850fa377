"""How far off the answers are: prints docs/accuracy.md. Takes some minutes, and the recordings (see `recordings`)."""

from __future__ import annotations

import sys

import numpy as np

import recordings as r
from livessl.simulation.scene import NamedSound, read_sounds, synthesised_sounds

SEEDS = range(100, 110)
COUNT = 16
RESAMPLES = 2000
METHODS = ("onset", "srp-phat")
"""The default, and the paper's standard; simulated rooms are of the default."""

HEAD = """# Accuracy

Made by `python benchmarks/accuracy.py > docs/accuracy.md`, with the recordings that `benchmarks/recordings.py` names.
The method is `onset`, the default, as `locate` and the server run it; beside it, on the recordings, `srp-phat`, the
paper's standard. The recordings of the field led to decisions 1 and 2 and to windows as long as a wide array needs; no
other figure here was used to choose anything. How the two compare on simulated sounds is in
[accuracy/localizer](accuracy/localizer/report.md).
Brackets hold 99 % bootstrap intervals of the median.
"""


def main() -> int:
    """Measure everything and print it."""
    print(HEAD)
    _print_recordings()
    _print_simulations()
    return 0


def _print_recordings() -> None:
    print("## Real recordings and measured rooms\n")
    print("| what | events | method | error, mean | median | 90 % | worst |")
    print("|---|---|---|---|---|---|---|")
    for method in METHODS:
        fields = r.field_errors_m(method)
        per_file = [float(np.median(errors)) for errors in fields.values()]
        every = [error for errors in fields.values() for error in errors]
        print(
            f"| pulses in a field of 4.6 m, five microphones, {len(fields)} files: horizontal; median over files | "
            f"{len(every)} | {method} | {np.mean(every):.3f} m | {np.median(per_file):.3f} m | "
            f"{np.percentile(every, 90):.3f} m | {max(every):.3f} m |"
        )
    for method in METHODS:
        degrees, played = r.measured_room_errors_deg(method)
        print(
            f"| {played} sounds in seven measured rooms, squares of four microphones 0.2 m wide: azimuth "
            f"| {len(degrees)} | {method} | {np.mean(degrees):.2f}° | "
            f"{np.median(degrees):.2f}° | {np.percentile(degrees, 90):.2f}° | {max(degrees):.2f}° |"
        )
    for take, nominal in r.TALKERS.items():
        for method in METHODS:
            errors = r.talker_errors_deg(take, method)
            print(
                f"| talker at {nominal:.0f}° (good to 10°), four microphones 64 mm wide, `{take}`: azimuth "
                f"| {len(errors)} | {method} | | {np.median(errors):.1f}° | | {max(errors):.1f}° |"
            )


def _print_simulations() -> None:
    print("\n## Simulated room\n")
    print("8 x 10 x 4 m, two tetrahedra of 0.5 m, 5 m apart, grid 0.1 m, places uniform in the room between 0.5 and")
    print(f"2.2 m height, 0.5 m off the walls; seeds {SEEDS.start} to {SEEDS.stop - 1}, {COUNT} sounds each. The last")
    print("column is the median squared error in units of the covariance given: 2.37 if it means what it says.\n")
    columns = ["sounds", "RT60 (s)", "found", "median (m)", "90 % (m)", "over 0.5 m", "over 1 m"]
    columns += ["events without a sound", "error² / covariance"]
    print(f"| {' | '.join(columns)} |")
    print("|---" * len(columns) + "|")
    sources: dict[str, list[NamedSound]] = {
        "our own": list(synthesised_sounds(44100.0, 0)),
        "DCASE 2016 task 2": list(read_sounds(r.DATA / "dcase2016_task2", 44100.0)),
    }
    for name, sounds in sources.items():
        for rt60_s in (0.0, 0.4, 0.7, 1.0, 2.0):
            _print_simulation(name, sounds, rt60_s)


def _print_simulation(name: str, sounds: list[NamedSound], rt60_s: float) -> None:
    found, surplus = r.simulated(sounds, rt60_s, list(SEEDS), COUNT)
    errors = np.array([one.error_m for one in found if one.error_m is not None])
    distances2 = [one.mahalanobis2 for one in found if one.mahalanobis2 is not None]
    rng = np.random.default_rng(0)
    medians = np.median(rng.choice(errors, (RESAMPLES, len(errors))), axis=1)
    low, high = np.percentile(medians, [0.5, 99.5])
    print(
        f"| {name} | {rt60_s:g} | {len(errors)} of {len(found)} | {np.median(errors):.3f} [{low:.3f}, {high:.3f}] | "
        f"{np.percentile(errors, 90):.2f} | {(errors > 0.5).mean():.1%} | {(errors > 1.0).mean():.1%} | {surplus} | "
        f"{np.median(distances2):.2f} |",
        flush=True,
    )


if __name__ == "__main__":
    sys.exit(main())
