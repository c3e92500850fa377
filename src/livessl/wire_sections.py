"""The sections at the end of a mark: levels of the channels, drift, and clock and load of the node's machine, as bytes.

A section is a tag, the length of its body in bytes, and the body. A figure that is not known is sent as NaN.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from itertools import accumulate
from typing import Final

from livessl.core.types import MAX_MICROPHONES, ChannelLevel, HostState

MAX_DB: Final = 1000.0
"""Largest magnitude of a level or ratio, in decibels: far beyond any that finite samples can have."""

MAX_MEAN: Final = 1e7
"""Largest magnitude of a channel's mean that is accepted; full scale is 1, which samples may exceed, but not so far."""

MAX_HUM_HZ: Final = 1e6

MAX_ERROR_S: Final = 1e9
"""Largest error of a clock, in seconds, and largest load: beyond any that a system reports."""

MAX_PPM: Final = 1e12
"""Largest error of a drift, parts per million: above any that a fit of stamps gives."""

MAX_TEXT_BYTES: Final = 255
"""Longest name of a service, a reference clock or a machine, in bytes; longer ones are cut."""

MAX_SECTIONS_BYTES: Final = 16 * 1024
"""Most bytes of all sections of a mark: over eight times as many as are known, so that newer nodes may send more."""

_LEVELS: Final = 1
_HOST: Final = 2
_DRIFT: Final = 3
_HEAD: Final = struct.Struct("<BH")
# clipped samples; peak, RMS, mean, frequency and level of hum, noise, noise over the neighbours
_LEVEL: Final = struct.Struct("<Q7d")
# synchronized (0, 1 or 2 for unknown), error, lost blocks, load, whether there is a sound server, lengths of the names
# of service, reference and machine
_STATE: Final = struct.Struct("<BdQd?BBB")
_ERROR: Final = struct.Struct("<d")
_SYNCHRONIZED: Final = (False, True, None)


class SectionError(ValueError):
    """Bytes that are not valid sections: what was expected, and what was got."""


@dataclass(frozen=True, slots=True)
class Sections:
    """The sections of a mark.

    Parameters
    ----------
    levels, drift_error_ppm, host
        As in `Mark`.
    """

    levels: tuple[ChannelLevel, ...] = ()
    drift_error_ppm: float | None = None
    host: HostState | None = None


def encode_sections(sections: Sections) -> bytes:
    """Encode the sections; an absent value gives none."""
    levels, host = sections.levels, sections.host
    parts = []
    if levels:
        parts.append(_section(_LEVELS, b"".join(map(_encode_level, levels))))
    if sections.drift_error_ppm is not None:
        parts.append(_section(_DRIFT, _ERROR.pack(sections.drift_error_ppm)))
    if host is not None:
        parts.append(_section(_HOST, _encode_host(host)))
    return b"".join(parts)


def decode_sections(data: memoryview) -> Sections:
    """Return what sections hold; unknown ones are skipped.

    Raises
    ------
    SectionError
        If the sections are too long, or one is truncated or holds a value that no node sends.
    """
    if len(data) > MAX_SECTIONS_BYTES:
        raise SectionError(f"expected sections of {MAX_SECTIONS_BYTES} bytes at most, got {len(data)}")
    levels: tuple[ChannelLevel, ...] = ()
    drift_error_ppm: float | None = None
    host: HostState | None = None
    start = 0
    while start < len(data):
        if len(data) - start < _HEAD.size:
            raise SectionError(f"expected a section of at least {_HEAD.size} bytes, got {len(data) - start}")
        tag, length = _HEAD.unpack_from(data, start)
        start += _HEAD.size
        body = data[start : start + length]
        if len(body) < length:
            raise SectionError(f"expected a section of {length} bytes, got {len(body)}")
        start += length
        if tag == _LEVELS:
            levels = _decode_levels(body)
        elif tag == _DRIFT:
            drift_error_ppm = _decode_error(body)
        elif tag == _HOST:
            host = _decode_host(body)
    return Sections(levels, drift_error_ppm, host)


def _section(tag: int, body: bytes) -> bytes:
    return _HEAD.pack(tag, len(body)) + body


def _encode_level(level: ChannelLevel) -> bytes:
    return _LEVEL.pack(
        level.clipped,
        level.peak_dbfs,
        level.rms_dbfs,
        _or_nan(level.mean),
        _or_nan(level.hum_hz),
        _or_nan(level.hum_dbfs),
        _or_nan(level.noise_dbfs),
        _or_nan(level.noise_over_db),
    )


def _decode_levels(body: memoryview) -> tuple[ChannelLevel, ...]:
    count, rest = divmod(len(body), _LEVEL.size)
    if rest or not 0 < count <= MAX_MICROPHONES:
        raise SectionError(f"expected levels of 1 to {MAX_MICROPHONES} channels, got {len(body)} bytes")
    return tuple(_decode_level(*values) for values in _LEVEL.iter_unpack(body))


def _decode_level(
    clipped: int, peak: float, rms: float, mean: float, hum_hz: float, hum: float, noise: float, noise_over: float
) -> ChannelLevel:
    if not (_within(peak, MAX_DB) and _within(rms, MAX_DB)):
        raise SectionError(f"expected levels up to {MAX_DB:g} dB, got {peak} and {rms}")
    return ChannelLevel(
        peak_dbfs=peak,
        rms_dbfs=rms,
        clipped=clipped,
        mean=_or_none("a mean", mean, MAX_MEAN),
        hum_hz=_or_none("a frequency", hum_hz, MAX_HUM_HZ),
        hum_dbfs=_or_none("a level", hum, MAX_DB),
        noise_dbfs=_or_none("a level", noise, MAX_DB),
        noise_over_db=_or_none("a ratio", noise_over, MAX_DB),
    )


def _decode_error(body: memoryview) -> float:
    if len(body) != _ERROR.size:
        raise SectionError(f"expected an error of the drift of {_ERROR.size} bytes, got {len(body)}")
    (error_ppm,) = _ERROR.unpack(body)
    if not 0.0 <= error_ppm <= MAX_PPM:
        raise SectionError(f"expected an error of the drift from 0 to {MAX_PPM:g} ppm, got {error_ppm}")
    return float(error_ppm)


def _encode_host(host: HostState) -> bytes:
    names = [text.encode("utf-8", "replace")[:MAX_TEXT_BYTES] for text in (host.service, host.reference, host.machine)]
    fixed = _STATE.pack(
        _SYNCHRONIZED.index(host.synchronized),
        _or_nan(host.error_s),
        host.lost_blocks,
        _or_nan(host.load),
        host.sound_server,
        *map(len, names),
    )
    return b"".join([fixed, *names])


def _decode_host(body: memoryview) -> HostState:
    if len(body) < _STATE.size:
        raise SectionError(f"expected a machine's state of at least {_STATE.size} bytes, got {len(body)}")
    synchronized, error_s, lost_blocks, load, sound_server, *lengths = _STATE.unpack_from(body)
    names = bytes(body[_STATE.size :])
    if synchronized >= len(_SYNCHRONIZED) or len(names) != sum(lengths):
        raise SectionError(
            f"expected a machine's state with {sum(lengths)} bytes of names and a clock's state of 0, 1 or 2, "
            f"got {len(names)} bytes and {synchronized}"
        )
    service, reference, machine = (
        names[end - length : end].decode("utf-8", "replace")
        for length, end in zip(lengths, accumulate(lengths), strict=True)
    )
    return HostState(
        synchronized=_SYNCHRONIZED[synchronized],
        service=service,
        reference=reference,
        error_s=_or_none("an error in seconds", error_s, MAX_ERROR_S),
        lost_blocks=lost_blocks,
        load=_or_none("a load", load, MAX_ERROR_S),
        sound_server=sound_server,
        machine=machine,
    )


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def _or_none(what: str, value: float, most: float) -> float | None:
    if math.isnan(value):
        return None
    if not _within(value, most):
        raise SectionError(f"expected {what} up to {most:g}, got {value}")
    return value


def _within(value: float, most: float) -> bool:
    return -most <= value <= most
