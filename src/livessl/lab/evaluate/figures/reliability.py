"""The reliability diagram: how often a stated confidence was right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from livessl.lab.evaluate.figures.canvas import COLOURS, panels, save


def draw_reliability(directory: Path, classes: Sequence[Mapping[str, float]]) -> None:
    """Draw the share of sounds that are right, with its interval, against the confidence.

    Parameters
    ----------
    directory : Path
        Folder of `reliability.png`.
    classes : sequence of mapping
        Mean `confidence` of each class, number of `sounds`, and share `near`, with `near_low` and `near_high`.
    """
    figure, axes = panels(1, 1, (5.0, 4.6))
    axis = axes[0, 0]
    axis.plot((0.0, 1.0), (0.0, 1.0), ":", color=COLOURS[-1])
    confidence, near = ([each[name] for each in classes] for name in ("confidence", "near"))
    below = [each["near"] - each["near_low"] for each in classes]
    above = [each["near_high"] - each["near"] for each in classes]
    axis.errorbar(confidence, near, (below, above), fmt="o-", capsize=3, color=COLOURS[0])
    for each in classes:
        axis.annotate(f"{each['sounds']:g}", (each["confidence"], each["near"]), (6, -12), textcoords="offset points")
    axis.set(xlabel="mean confidence", ylabel="share within 0.5 m", xlim=(0.0, 1.02), ylim=(0.0, 1.02))
    axis.grid(visible=True, alpha=0.3)
    save(figure, directory / "reliability.png")
