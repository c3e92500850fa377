"""Words a plan: advice to move arrays, as text and as an object for JSON."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from livessl.core.types import FloatArray
from livessl.lab.plan.design import ANGLES_DEG, DISTANCES_M, SHARES, SOUND_S, ArrayPlan, Errors, Plan
from livessl.lab.plan.prediction import Move, direct_to_reverberant
from livessl.lab.plan.warn import warnings

JsonObject = dict[str, Any]


def move_text(move: Move) -> str:
    """Return a move as advice: "move array 'west' by +1.0 m in x: median predicted error 0.20 → 0.15 m"."""
    return f"move array {move.array!r} by {_shift(move)}"


def addition_text(move: Move) -> str:
    """Return the position of one more array as advice."""
    return f"add an array like {move.array!r}, shifted by {_shift(move)}"


def advice_texts(plan: Plan) -> list[str]:
    """Return all advice, the most helpful first."""
    added = [] if plan.addition is None else [addition_text(plan.addition)]
    return added + [move_text(move) for move in plan.moves]


def _shift(move: Move) -> str:
    shifts = [f"{length_m:+.1f} m in {axis}" for axis, length_m in zip("xy", move.offset_m, strict=True) if length_m]
    return f"{' and '.join(shifts)}: median predicted error {_length(move.before_m)} → {_length(move.after_m)} m"


def as_text(plan: Plan) -> str:
    """Return everything but the maps as text."""
    return "\n".join(_lines(plan))


def _lines(plan: Plan) -> Iterator[str]:
    site, conditions = plan.site, plan.conditions
    size = " x ".join(f"{length:g}" for length in site.room.size_m)
    yield f"{site.site}: room {size} m, RT60 {plan.rt60_s:g} s, c {site.c_m_s:.1f} m/s"
    if plan.rt60_s > 0:
        levels = ", ".join(f"{level:+.1f} dB at {r:g} m" for r, level in _levels(plan))
        yield f"critical distance {conditions.critical_m:.2f} m; direct to reverberant sound {levels}"
    else:
        yield "no reverberation: the only error is that of the microphones' positions"
    yield ""
    yield (
        f"predicted error at {plan.height_m:g} m height (a lower bound: loud sounds, no gross errors; "
        f"microphone positions known to {1000 * conditions.calibration_m:g} mm)"
    )
    yield f"{'':<14}{'median':>8}{'95 %':>8}   median along the line of sight / across it"
    for name, errors in [(array.spec.name, array.alone) for array in plan.arrays] + [("all", plan.fused)]:
        yield (
            f"  {name:<12}{_length(errors.percentile_m(50)):>6} m{_length(errors.percentile_m(95)):>6} m"
            f"   {_length(float(np.median(errors.radial_m)))} / {_length(float(np.median(errors.tangential_m)))} m"
        )
    for array in plan.arrays:
        yield ""
        yield from _array_lines(plan, array)
    yield ""
    yield "advice"
    yield from [f"  {text}" for text in advice_texts(plan)] or ["  no move of a single array is worth its effort"]
    found = warnings(plan)
    if found:
        yield ""
        yield "warnings"
        yield from (f"  {warning}" for warning in found)


def _array_lines(plan: Plan, array: ArrayPlan) -> Iterator[str]:
    spec, (low, high) = array.spec, array.spec.band_hz
    rate = f"{array.sample_rate_hz:g} Hz" + ("" if array.sample_rate_known else " (assumed; no node captures it)")
    yield f"{spec.name}: {len(spec.microphones_m)} microphones, {spec.aperture_m:.3g} m wide, {low:g} to {high:g} Hz"
    errors = ", ".join(
        f"{'none' if np.isnan(error) else f'{error:.3g}°'} at {angle:g}°"
        for angle, error in zip(ANGLES_DEG, array.angle_error_deg, strict=True)
    )
    yield f"  angular error from broadside, lags in whole samples of {rate}: {errors}"
    yield f"  correlation of reverberation between the widest pair: {array.diffuse_correlation:.2g}, mean over the band"
    yield (
        f"  free of spatial aliasing on the {plan.site.grid.spacing_m:g} m grid: up to "
        f"{_frequency(array.alias_free_hz[0])} or more at 95 % of points and pairs, "
        f"{_frequency(array.alias_free_hz[2])} or more at half; {array.beyond_grid:.0%} do not reach the whole band"
    )
    yield f"    {'pair':<8}{'distance':>8}{'95 % reach':>13}{'half reach':>13}"
    for pair in array.pairs[:6]:
        channels = "-".join(map(str, pair.channels))
        low_hz, half_hz = (_frequency(pair.alias_free_hz[k]) for k in (0, 2))
        yield f"    {channels:<8}{pair.spacing_m:>6.3g} m{low_hz:>13}{half_hz:>13}"
    if len(array.pairs) > 6:
        yield f"    … and {len(array.pairs) - 6} more: see --json"


def as_json(plan: Plan) -> JsonObject:
    """Return everything as an object for JSON; infinite and missing values are null."""
    conditions = plan.conditions
    return {
        "site": plan.site.site,
        "rt60_s": plan.rt60_s,
        "height_m": plan.height_m,
        "speed_of_sound_m_s": plan.site.c_m_s,
        "grid_spacing_m": plan.site.grid.spacing_m,
        "assumptions": {
            "sound_s": SOUND_S,
            "counted_s": conditions.time_s,
            "calibration_m": conditions.calibration_m,
        },
        "room": {
            "size_m": list(plan.site.room.size_m),
            "absorption": plan.absorption,
            "critical_distance_m": _finite(conditions.critical_m),
            "direct_to_reverberant_db": [
                {"distance_m": distance, "level_db": _finite(level)} for distance, level in _levels(plan)
            ],
        },
        "predicted_error": _errors_json(plan.fused),
        "arrays": {array.spec.name: _array_json(array) for array in plan.arrays},
        "map": {"x_m": _list(plan.x_m), "y_m": _list(plan.y_m), "error_m": _list(plan.fused.total_m)},
        "advice": [
            *([] if plan.addition is None else [_advice(plan, "add", plan.addition, addition_text(plan.addition))]),
            *(_advice(plan, "move", move, move_text(move)) for move in plan.moves),
        ],
        "warnings": warnings(plan),
    }


def _advice(plan: Plan, kind: str, move: Move, text: str) -> JsonObject:
    return {
        "kind": kind,
        "array": move.array,
        "offset_m": [*move.offset_m, 0.0],
        "position_m": _list(plan.site.array(move.array).centre_m + np.array([*move.offset_m, 0.0])),
        "median_before_m": move.before_m,
        "median_after_m": move.after_m,
        "text": text,
    }


def _array_json(array: ArrayPlan) -> JsonObject:
    spec = array.spec
    return {
        "centre_m": _list(spec.centre_m),
        "microphones": len(spec.microphones_m),
        "aperture_m": spec.aperture_m,
        "band_hz": list(spec.band_hz),
        "sample_rate_hz": array.sample_rate_hz,
        "sample_rate_known": array.sample_rate_known,
        "angle_error": [
            {"from_broadside_deg": angle, "error_deg": _finite(error)}
            for angle, error in zip(ANGLES_DEG, array.angle_error_deg, strict=True)
        ],
        "diffuse_correlation": array.diffuse_correlation,
        "alias_free_hz": _shares_json(array.alias_free_hz),
        "share_below_band": array.beyond_grid,
        "pairs": [
            {
                "channels": list(pair.channels),
                "spacing_m": pair.spacing_m,
                "alias_free_hz": _shares_json(pair.alias_free_hz),
            }
            for pair in array.pairs
        ],
        "predicted_error": _errors_json(array.alone),
        "map_error_m": _list(array.alone.total_m),
    }


def _errors_json(errors: Errors) -> JsonObject:
    return {
        **{f"p{share}_m": errors.percentile_m(share) for share in SHARES},
        "median_radial_m": float(np.median(errors.radial_m)),
        "median_tangential_m": float(np.median(errors.tangential_m)),
    }


def _shares_json(values: tuple[float, ...]) -> JsonObject:
    return {f"p{share}": _finite(value) for share, value in zip(SHARES, values, strict=True)}


def _levels(plan: Plan) -> list[tuple[float, float]]:
    """Return each distance with its direct-to-reverberant ratio in dB."""
    ratios = direct_to_reverberant(np.array(DISTANCES_M), plan.conditions.critical_m)
    return [(r, float(10.0 * np.log10(ratio))) for r, ratio in zip(DISTANCES_M, ratios, strict=True)]


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _list(values: FloatArray) -> Any:
    return np.round(values, 6).tolist()


def _length(metres: float) -> str:
    return f"{metres:.2f}" if metres >= 0.1 else f"{metres:.3f}"


def _frequency(hertz: float) -> str:
    return "any" if np.isinf(hertz) else f"{hertz:.0f} Hz"
