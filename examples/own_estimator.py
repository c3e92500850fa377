"""Write a localization method of your own, and compare its errors with those of `srp-phat`.

    python examples/own_estimator.py

The command line can use the method as well, by its import path, in the folder of this file:

    livessl locate --site SITE --wav ARRAY=FILE --method own_estimator:Product
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

import livessl

SITE = Path(__file__).parents[1] / "config" / "demo.yaml"


class Product(livessl.MapEstimator):
    """Multiply the arrays' power maps instead of adding them, so that all arrays must agree on a position."""

    def locate(self, sounds: Mapping[str, livessl.Sound]) -> livessl.Localization:
        """Return the grid point with the highest product."""
        evidence = self.evidence(sounds)  # the GCC-PHAT of each array
        maps = self.power_maps(evidence)  # the power at each grid point, (G,), of each array and of their sum
        product = np.prod([np.maximum(power, 0.0) for power in maps.arrays.values()], axis=0)
        position_m = maps.grid.point_m(int(product.argmax()))
        covariance_m2 = np.diag(maps.grid.cell_m**2)  # a position is known to one cell of the grid
        return livessl.Localization(position_m, covariance_m2, confidence=0.5, evidence=evidence)


def main() -> None:
    """Locate the same simulated sounds by both methods, and print the error of each."""
    livessl.register("product", Product)
    made = livessl.simulate(SITE, rt60_s=0.5, count=3, seed=3)
    for method in ("product", "srp-phat"):
        events = livessl.locate(SITE, made.recordings, made.sample_rate_hz, method=method)
        for source in made.scene.sources:
            event = min(events, key=lambda event: abs(event.start_ns / 1e9 - source.start_s))
            if event.estimate is not None:
                error_m = float(np.linalg.norm(event.estimate.position_m - source.position_m))
                print(f"{event.method:<9} {source.name:<14} error {error_m:.2f} m")


if __name__ == "__main__":
    main()
