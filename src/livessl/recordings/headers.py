"""Repairs headers of WAV and FLAC files that were never finished or are longer than the file.

A program that is killed, or whose disk is full, leaves a header that was never finished. A copy that was interrupted
leaves a file that is shorter than its header claims. In both cases the sound in the file can be read.
"""

from __future__ import annotations

import string
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

_UNKNOWN_32: Final = 0xFFFFFFFF
_STREAMED: Final = 0x7FFFF000
"""Least claimed length, in bytes, that means "unknown": programs that write to a pipe enter 2 or 4 GiB, or a little
less."""

_MAX_HEADER: Final = 1 << 24
"""Largest header, in bytes, that is searched for the beginning of the sound: more than any program writes."""

_CHUNK_LETTERS: Final = frozenset((string.ascii_letters + string.digits + " _-").encode())
"""Bytes of which the name of a RIFF chunk consists."""

_ID3_LENGTH: Final = 128
"""Length, in bytes, of a tag that some programs append to a file."""

STREAMINFO_END: Final = 42
"""End of the first metadata block of every FLAC file, in bytes."""


@dataclass(frozen=True, slots=True)
class Repair:
    """The fault of a sound file's header, and the right header.

    Parameters
    ----------
    header : bytes
        The first bytes of the file as they ought to be.
    end : int
        Length of the file, in bytes, up to its last complete sample of all channels.
    frames : int
        Number of complete samples of each channel.
    fault : str
        Sentence about the fault; it follows the name of the file.
    """

    header: bytes
    end: int
    frames: int
    fault: str


def find_repair(path: Path) -> Repair | None:
    """Return the repair of a WAV or FLAC file's header; None for a good header and for any other kind of file.

    Raises
    ------
    OSError
        If the file cannot be read.
    """
    with path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(0)
        magic = file.read(12)
        if magic[:4] in (b"RIFF", b"RF64") and magic[8:] == b"WAVE":
            return _repair_wav(file, size)
        if magic[:4] == b"fLaC":
            return _repair_flac(file, size)
    return None


def apply_repair(path: Path, repair: Repair) -> None:
    """Write a repaired header into its file, and cut off what follows the last complete sample.

    Raises
    ------
    OSError
        If the file cannot be changed.
    """
    with path.open("r+b") as file:
        file.write(repair.header)
        file.truncate(repair.end)


def flac_header(start: bytes, frames: int) -> bytes:
    """Return the first bytes of a FLAC file with another number of samples; its checksum becomes unknown."""
    changed = bytearray(start)
    packed = int.from_bytes(changed[18:26], "big") >> 36 << 36
    changed[18:26] = (packed | frames).to_bytes(8, "big")
    changed[26:STREAMINFO_END] = bytes(STREAMINFO_END - 26)
    return bytes(changed)


def _repair_wav(file: BinaryIO, size: int) -> Repair | None:
    found = _wav_chunks(file, size)
    if found is None:
        return None
    chunks, start = found
    file.seek(0)
    header = file.read(start)
    align = int.from_bytes(header[chunks[b"fmt "] + 20 :][:2], "little") if b"fmt " in chunks else 0
    if align == 0:
        return None
    long = chunks.get(b"ds64") if header[:4] == b"RF64" else None
    riff, data = struct.unpack("<QQ", header[long + 8 : long + 24]) if long else _short_sizes(header)
    available = size - start
    frames = available // align
    if data > available:
        if not long and data >= _STREAMED:
            return None  # written to a pipe: no length was promised, and libsndfile reads to the end
        fault = "the file is shorter than its header says"
    elif _goes_on(file, size, start, riff, data, align):
        fault = "its header was never finished"
    else:
        return None
    end = start + frames * align
    return Repair(_wav_header(header, long, end, frames * align, frames), end, frames, fault)


def _wav_chunks(file: BinaryIO, size: int) -> tuple[dict[bytes, int], int] | None:
    """Return the places of the chunks before the sound, and the place of the sound; None if there is no sound."""
    chunks: dict[bytes, int] = {}
    at = 12
    while at + 8 <= min(size, _MAX_HEADER):
        file.seek(at)
        name, length = struct.unpack("<4sI", file.read(8))
        if name == b"data":
            return chunks, at + 8
        chunks.setdefault(name, at)
        at += 8 + length + length % 2
    return None


def _short_sizes(header: bytes) -> tuple[int, int]:
    """Return the lengths of the whole and of the sound in a header of 32-bit lengths."""
    return int.from_bytes(header[4:8], "little"), int.from_bytes(header[-4:], "little")


def _goes_on(file: BinaryIO, size: int, start: int, riff: int, data: int, align: int) -> bool:
    """Return True if the sound goes on beyond the end that the header claims, because the header is out of date."""
    end = start + data
    if size - end < align or (data == 0 and riff + 8 == size):
        return False
    if data > 0 and riff + 8 not in (end, end + 1):
        return False
    at = end + data % 2
    while at + 8 <= size:  # chunks behind the sound, such as titles, end where the file ends
        file.seek(at)
        name, length = struct.unpack("<4sI", file.read(8))
        if not _CHUNK_LETTERS.issuperset(name):
            return True
        at += 8 + length + length % 2
    return at not in (size, size + 1)


def _wav_header(header: bytes, long: int | None, end: int, data: int, frames: int) -> bytes:
    """Return a header of the same length for a file that ends at `end`, with `data` bytes of sound."""
    changed = bytearray(header)
    if long is None:
        changed[4:8] = min(end - 8, _UNKNOWN_32).to_bytes(4, "little")
        changed[-4:] = min(data, _UNKNOWN_32).to_bytes(4, "little")
    else:
        changed[long + 8 : long + 32] = struct.pack("<QQQ", end - 8, data, frames)
    return bytes(changed)


@dataclass(frozen=True, slots=True)
class _FlacFrame:
    at: int
    first: int
    """Number of its first sample."""
    length: int
    """Number of its samples."""


def _repair_flac(file: BinaryIO, size: int) -> Repair | None:
    file.seek(0)
    start = file.read(STREAMINFO_END)
    sound = _flac_sound(file, size)
    if len(start) < STREAMINFO_END or sound is None:
        return None
    said = int.from_bytes(start[18:26], "big") & ((1 << 36) - 1)
    last_end = _last_flac_frame(file, size, start, sound)
    if last_end is None and said > 0:
        return None  # damaged in another way, which reading it shows
    frames, end = (0, sound) if last_end is None else last_end
    if said == frames > 0:
        return None
    if said == 0:
        fault = "its header does not say how long it is"
    elif said < frames:
        fault = "its header was never finished"
    else:
        fault = "the file is shorter than its header says"
    return Repair(flac_header(start, frames), end, frames, fault)


def _flac_sound(file: BinaryIO, size: int) -> int | None:
    """Return where the metadata of a FLAC file end; None if the file ends before."""
    at, last = 4, False
    while not last:
        file.seek(at)
        head = file.read(4)
        if len(head) < 4:
            return None
        last = head[0] >= 0x80
        at += 4 + int.from_bytes(head[1:], "big")
    return at if at <= size else None


def _last_flac_frame(file: BinaryIO, size: int, start: bytes, sound: int) -> tuple[int, int] | None:
    """Return the number of samples up to the end of the last complete frame, and the place of that end.

    A frame is complete if its checksum is right.
    """
    block = int.from_bytes(start[8:10], "big")
    longest = int.from_bytes(start[10:12], "big")
    channels, bits = (start[20] >> 1 & 7) + 1, ((start[20] & 1) << 4 | start[21] >> 4) + 1
    most = longest * channels * (bits + 1) // 8 + 256  # bytes of a frame that is not compressed
    file.seek(sound)
    head = file.read(32)
    first = _flac_frame(head, 0, block)
    if first is None:
        return None
    from_ = max(sound, size - 2 * most)
    file.seek(from_)
    tail = file.read()
    if tail[-_ID3_LENGTH:].startswith(b"TAG"):
        tail = tail[:-_ID3_LENGTH]
    frames = [frame for at in _syncs(tail) if (frame := _flac_frame(tail, at, block)) is not None]
    ends = [frame.at for frame in frames] + [len(tail)]
    best: tuple[int, int] | None = None
    for index in range(len(frames) - 1, -1, -1):
        frame = frames[index]
        complete = _complete_ends(tail, frame.at, ends[index + 1 :])
        if complete:
            best = frame.first + frame.length - first.first, from_ + complete[0]
            break
    return best


def _syncs(data: bytes) -> Iterator[int]:
    """Yield the places at which a frame may begin."""
    at = data.find(b"\xff")
    while at >= 0:
        if data[at + 1 : at + 2] in (b"\xf8", b"\xf9"):
            yield at
        at = data.find(b"\xff", at + 1)


def _flac_frame(data: bytes, at: int, block: int) -> _FlacFrame | None:
    """Read the header of a frame; None if there is none (RFC 9639, section 9.1)."""
    head = data[at : at + 16]
    if len(head) < 6 or head[0] != 0xFF or head[1] not in (0xF8, 0xF9):
        return None
    lead = head[4]
    extra = 0 if lead < 0x80 else 8 - (lead ^ 0xFF).bit_length() - 1
    number = lead if extra == 0 else lead & (0x3F >> extra)
    for byte in head[5 : 5 + extra]:
        number = number << 6 | byte & 0x3F
    after = 5 + extra
    size_code, rate_code = head[2] >> 4, head[2] & 15
    length, wide = _block_length(size_code, head[after : after + 2])
    after += wide + {12: 1, 13: 2, 14: 2}.get(rate_code, 0)
    if length == 0 or after >= len(head) or _crc(head[:after], _CRC_8) != head[after]:
        return None
    return _FlacFrame(at, number if head[1] == 0xF9 else number * block, length)


def _block_length(code: int, following: bytes) -> tuple[int, int]:
    """Return the number of samples by its code, and how many bytes of `following` say it; 0 for no such code."""
    if code in (6, 7):
        wide = code - 5
        return int.from_bytes(following[:wide], "big") + 1, wide
    if code == 1:
        return 192, 0
    if 2 <= code <= 5:
        return 576 << (code - 2), 0
    return (256 << (code - 8) if code >= 8 else 0), 0


def _complete_ends(data: bytes, at: int, ends: list[int]) -> list[int]:
    """Return which of `ends`, in ascending order, complete the frame that begins at `at`, by its checksum."""
    found, crc = [], 0
    for end in ends:
        crc = _crc16(data[at:end], crc)
        if crc == 0:
            found.append(end)
        at = end
    return found


def _table(width: int, polynomial: int) -> tuple[int, ...]:
    top, mask = 1 << (width - 1), (1 << width) - 1
    table = []
    for value in range(256):
        crc = value << (width - 8)
        for _ in range(8):
            crc = ((crc << 1) ^ polynomial if crc & top else crc << 1) & mask
        table.append(crc)
    return tuple(table)


_CRC_8: Final = _table(8, 0x07)
_CRC_16: Final = _table(16, 0x8005)


def _crc(data: bytes, table: tuple[int, ...]) -> int:
    crc = 0
    for byte in data:
        crc = table[crc ^ byte]
    return crc


def _crc16(data: bytes, crc: int) -> int:
    for byte in data:
        crc = (crc << 8 & 0xFF00) ^ _CRC_16[crc >> 8 ^ byte]
    return crc
