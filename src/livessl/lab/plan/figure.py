"""A plan as a figure: floor maps of the predicted error, and the angular error against spacing. Needs matplotlib."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from livessl.core.types import FloatArray
from livessl.errors import RunError
from livessl.lab.plan.design import ANGLES_DEG, Errors, Plan
from livessl.lab.plan.prediction import angle_error_deg
from livessl.lab.plan.words import advice_texts

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TICKS_M: Final = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Candidates for the contours and ticks of the predicted error."""

COLUMNS: Final = 3
"""Panels in a row if there are more than four."""

SPACINGS_M: Final = np.geomspace(0.03, 4.0, 200)
_INK: Final = "#222222"


class FigureError(RunError):
    """The figure cannot be drawn."""


def require_matplotlib(option: str = "--out") -> None:
    """Check, before anything is computed, that figures can be drawn.

    Parameters
    ----------
    option : str
        The option that asked for the figure.

    Raises
    ------
    FigureError
        If matplotlib is missing; the message names the cure.
    """
    logging.getLogger("matplotlib").setLevel(logging.WARNING)  # its debug messages list fonts
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise FigureError(
            f"figures need matplotlib, which is not installed; run `sh scripts/setup.sh figures`, or omit {option}"
        ) from error


def draw(plan: Plan, path: Path) -> None:
    """Write the plan as a PNG.

    Raises
    ------
    FigureError
        If matplotlib is missing.
    OSError
        If the file cannot be written.
    """
    require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = [("all arrays", plan.fused)]
    if len(plan.arrays) > 1:
        panels += [(f"{array.spec.name} alone", array.alone) for array in plan.arrays]
    columns = 2 if len(panels) < 4 else COLUMNS
    rows = -(-(len(panels) + 1) // columns)
    size_x, size_y = _ends(plan.x_m)[1] - _ends(plan.x_m)[0], _ends(plan.y_m)[1] - _ends(plan.y_m)[0]
    height = float(np.clip(4.4 * size_y / size_x, 3.0, 6.5))
    figure = Figure(figsize=(5.2 * columns + 0.8, height * rows + 0.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    norm, image = _norm([errors for _, errors in panels]), None
    for ax, (title, errors) in zip(axes, panels, strict=False):
        image = _floor(ax, plan, title, errors, norm)
    _moves(axes[0], plan)
    _bar(figure, image, list(axes), norm)
    _angles(axes[len(panels)], plan)
    for ax in axes[len(panels) + 1 :]:
        ax.set_axis_off()
    figure.suptitle(
        f"{plan.site.site}: predicted position error at {plan.height_m:g} m height, RT60 {plan.rt60_s:g} s",
        color=_INK,
    )
    figure.savefig(path, dpi=110, metadata={"Software": "livessl"})


def _norm(all_errors: list[Errors]) -> Any:
    from matplotlib.colors import LogNorm

    low = min(float(np.percentile(errors.total_m, 2)) for errors in all_errors)
    high = max(float(np.percentile(errors.total_m, 98)) for errors in all_errors)
    return LogNorm(low, max(high, 2.0 * low))


def _floor(ax: Axes, plan: Plan, title: str, errors: Errors, norm: Any) -> Any:
    from matplotlib.patches import Rectangle
    from matplotlib.ticker import MaxNLocator

    image = ax.imshow(
        errors.total_m,
        origin="lower",
        extent=(*_ends(plan.x_m), *_ends(plan.y_m)),
        norm=norm,
        cmap="viridis_r",
        interpolation="bilinear",
    )
    if min(errors.total_m.shape) >= 2:
        lines = ax.contour(
            plan.x_m, plan.y_m, errors.total_m, levels=_inside(errors), colors="white", linewidths=0.8, alpha=0.9
        )
        ax.clabel(lines, fmt="%g m", fontsize=8)
    room_x, room_y, _ = plan.site.room.size_m
    ax.add_patch(Rectangle((0, 0), room_x, room_y, fill=False, edgecolor=_INK, linewidth=1.5))
    for array in plan.arrays:
        own = title in ("all arrays", f"{array.spec.name} alone")
        microphones, centre = array.spec.microphones_m, array.spec.centre_m
        ax.plot(
            *microphones[:, :2].T, "o", color="#d62728" if own else "#999999", markersize=4, markeredgecolor="white"
        )
        ax.annotate(
            array.spec.name,
            (float(centre[0]), float(microphones[:, 1].min())),
            xytext=(0, -5),
            textcoords="offset points",
            ha="center",
            va="top",
            fontsize=8,
            color=_INK,
            bbox={"facecolor": "white", "alpha": 0.7, "edgecolor": "none", "pad": 1.0},
        )
    ax.spines[:].set_visible(False)
    margin = 0.02 * max(room_x, room_y)
    ax.set_xlim(-margin, room_x + margin)
    ax.set_ylim(-margin, room_y + margin)
    ax.set_title(f"{title}: median {errors.percentile_m(50):.2g} m, 95 % {errors.percentile_m(95):.2g} m", fontsize=10)
    ax.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    ax.yaxis.set_major_locator(MaxNLocator(8, integer=True))
    ax.set_xlabel("x (m)")
    ax.set_ylabel("y (m)")
    return image


def _ends(points_m: FloatArray) -> tuple[float, float]:
    """Return the outer edges of the cells around grid points; half a metre to either side of a single one."""
    half = 0.5 * float(points_m[1] - points_m[0]) if len(points_m) > 1 else 0.5
    return float(points_m[0]) - half, float(points_m[-1]) + half


def _inside(errors: Errors) -> list[float]:
    """Return the levels of contours, without those in the narrow minima around microphones."""
    low, high = errors.percentile_m(3), float(errors.total_m.max())
    return [tick for tick in TICKS_M if low < tick < high]


def _moves(ax: Axes, plan: Plan) -> None:
    for move in (*plan.moves, *(() if plan.addition is None else (plan.addition,))):
        x, y, _ = plan.site.array(move.array).centre_m
        dx, dy = move.offset_m
        ax.annotate(
            "",
            (x + dx, y + dy),
            xytext=(x, y),
            arrowprops={
                "arrowstyle": "-|>" if move is plan.addition else "->",
                "color": "#d62728",
                "linewidth": 1.8,
                "linestyle": ":" if move is plan.addition else "--",
            },
        )
    texts = advice_texts(plan)
    if texts:
        ax.text(
            0.5,
            -0.16,
            "\n".join(texts),
            transform=ax.transAxes,
            ha="center",
            va="top",
            fontsize=8,
            color="#d62728",
        )


def _bar(figure: Any, image: Any, axes: list[Axes], norm: Any) -> None:
    bar = figure.colorbar(image, ax=axes, location="right", shrink=0.7, aspect=40, pad=0.02, extend="both")
    ticks = [tick for tick in TICKS_M if norm.vmin <= tick <= norm.vmax]
    bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    bar.minorticks_off()
    bar.set_label("predicted error (m)")


def _angles(ax: Axes, plan: Plan) -> None:
    rate_hz = plan.arrays[0].sample_rate_hz
    for angle in ANGLES_DEG:
        errors = angle_error_deg(angle, SPACINGS_M, rate_hz, plan.site.c_m_s)
        ax.loglog(SPACINGS_M, errors, label=f"{angle:g}° from broadside")
    for array in plan.arrays:
        ax.axvline(array.spec.aperture_m, color="#999999", linewidth=0.8, linestyle=":")
    named: dict[float, list[str]] = {}
    for array in plan.arrays:
        named.setdefault(round(array.spec.aperture_m, 3), []).append(array.spec.name)
    for aperture, names in named.items():
        ax.text(
            aperture,
            0.02,
            f" {', '.join(names)}",
            transform=ax.get_xaxis_transform(),
            rotation=90,
            va="bottom",
            ha="right",
            fontsize=8,
            color=_INK,
        )
    ax.set_title(f"angular error, lags in whole samples of {rate_hz:g} Hz", fontsize=10)
    ax.set_xlabel("distance between two microphones (m)")
    ax.set_ylabel("error (°)")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter(lambda value, _: f"{value:g}")
    ax.grid(visible=True, which="major", alpha=0.3)
    ax.legend(fontsize=8)
