"""Runs a campaign: hands out positions, keeps every finished one, resumes. It knows nothing of what a position is."""

from __future__ import annotations

import hashlib
import json
import os
import resource
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures import as_completed as completed
from dataclasses import dataclass
from io import BytesIO
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.signal import butter, sosfilt
from threadpoolctl import threadpool_limits

from livessl.lab.evaluate.localizer import SCHEMA as LOCALIZER_SCHEMA
from livessl.lab.evaluate.localizer import LocalizerPosition, LocalizerSettings
from livessl.lab.evaluate.paper import Settings
from livessl.lab.evaluate.sessions import SCHEMA as SESSIONS_SCHEMA
from livessl.lab.evaluate.sessions import SessionPosition, SessionSettings
from livessl.lab.evaluate.unit import Clips, Position, Row
from livessl.simulation.scene import read_sounds

HIGH_PASS_HZ: Final = 100.0
"""As in Allen and Berkley's rooms; the correlations begin there, so only the activity sees it."""

NAME: Final = pa.dictionary(pa.int32(), pa.string())

SCHEMA: Final = pa.schema(
    [
        ("position", pa.int32()),
        ("system", NAME),
        ("method", NAME),
        ("sound", NAME),
        ("clip", NAME),
        ("rt60_s", pa.float32()),
        ("t30_s", pa.float32()),
        ("active_s", pa.float32()),
        *((f"{axis}_m", pa.float32()) for axis in "xyz"),
        *((f"found_{axis}_m", pa.float32()) for axis in "xyz"),
        *((name, pa.float32()) for name in ("error_m", "radial_m", "azimuth_deg", "elevation_deg")),
    ]
)
"""One row per event, condition and method: truth, estimate, error and its parts, seen from the system's centre."""


class Unit(Protocol):
    """What turns the number of a position into its rows."""

    def rows(self, number: int) -> list[Row]:
        """All rows of a position."""
        ...


@dataclass(frozen=True)
class Job:
    """What a worker needs: small enough to be sent to each once."""

    settings: Settings | LocalizerSettings | SessionSettings
    clips: Clips

    @property
    def schema(self) -> pa.Schema:
        """Of the rows that `unit` makes."""
        match self.settings:
            case Settings():
                return SCHEMA
            case LocalizerSettings():
                return LOCALIZER_SCHEMA
            case SessionSettings():
                return SESSIONS_SCHEMA

    def unit(self) -> Unit:
        """Make what turns the number of a position into its rows."""
        match self.settings:
            case Settings() as settings:
                return Position(settings, self.clips)
            case LocalizerSettings() as settings:
                return LocalizerPosition(settings, self.clips)
            case SessionSettings() as settings:
                return SessionPosition(settings, self.clips)

    @property
    def digest(self) -> str:
        """Tells jobs apart: the same for the same settings (but for the number of positions) and sounds."""
        known = self.settings.as_dict() | {"positions": None}
        hashed = hashlib.sha256(json.dumps(known, sort_keys=True).encode())
        for name, clips in sorted(self.clips.items()):
            for clip, samples in clips:
                hashed.update(f"{name}/{clip}".encode())
                hashed.update(samples.tobytes())
        return hashed.hexdigest()


@dataclass(frozen=True, slots=True)
class Done:
    """A finished position: its rows as a Parquet file, and what it cost on one core."""

    position: int
    parquet: bytes
    cpu_s: float
    peak_mib: float


def read_clips(directory: Path, classes: Iterable[str], sample_rate_hz: float) -> Clips:
    """Clips of each class wanted: the files of a folder, named by class and number, as in `doorslam001.wav`.

    They are high-passed below the band: at 0 Hz all images of a room add, and rumble would else decide what is active.

    Raises
    ------
    ValueError
        Where there is no sound, or none of a class.
    """
    if not directory.is_dir():
        raise ValueError(f"--events {directory}: expected a folder of sounds, got no such folder")
    high_pass = butter(2, HIGH_PASS_HZ, "highpass", fs=sample_rate_hz, output="sos")
    found: dict[str, list[Any]] = {}
    for name, samples in read_sounds(directory, sample_rate_hz):
        heard = np.asarray(sosfilt(high_pass, samples), dtype=np.float32)
        found.setdefault(name.rstrip("0123456789_-"), []).append((name, heard))
    missing = [name for name in classes if name not in found]
    if missing:
        raise ValueError(
            f"--events {directory}: expected clips of {', '.join(missing)} (such as {missing[0]}001.wav), got the "
            f"classes {', '.join(sorted(found))}; name others with --classes"
        )
    return {name: tuple(found[name]) for name in classes}


def run_campaign(
    job: Job,
    out: Path,
    *,
    jobs: int,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Compute the positions that `out` does not hold yet, then join all of them in `results.parquet`.

    Positions are held in `parts/`; where that is gone, `results.parquet` with `campaign.json` is as good.

    Whoever computes them, in whatever order, after however many interruptions: the bytes are the same.

    Parameters
    ----------
    job : Job
    out : Path
        Holds `campaign.json`, `parts/` and `cost.jsonl`.
    jobs : int
        Processes on this machine, one core each.
    scheduler : str or None
        Address of a Dask scheduler that is asked instead.
    progress : callable or None
        Called with (positions done, positions in all).

    Raises
    ------
    ValueError
        Where `out` holds another campaign.
    """
    parts = out / "parts"
    _claim(out, job)
    parts.mkdir(exist_ok=True)
    _unpack(out / "results.parquet", parts, job.schema)
    total = job.settings.positions
    wanted = [number for number in range(total) if not _part(parts, number).exists()]
    finished = total - len(wanted)
    if progress is not None:
        progress(finished, total)
    if wanted:
        source = _by_dask(job, wanted, scheduler) if scheduler else _by_processes(job, wanted, jobs)
        with (out / "cost.jsonl").open("a", encoding="utf-8") as costs:
            for done in source:
                _write(_part(parts, done.position), done.parquet)
                cost = {"position": done.position, "cpu_s": round(done.cpu_s, 3), "peak_mib": round(done.peak_mib)}
                costs.write(json.dumps(cost) + "\n")
                costs.flush()
                finished += 1
                if progress is not None:
                    progress(finished, total)
    return _joined(out, [_part(parts, number) for number in range(total)], job.schema)


def read_costs(out: Path) -> list[Mapping[str, float]]:
    """What each position cost, as far as it is known."""
    path = out / "cost.jsonl"
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line.endswith("}")]


def compute(job: Job, number: int) -> Done:
    """Compute one position, on one core."""
    before = os.times()
    with threadpool_limits(limits=1):  # sums in another order would differ in the last bit
        rows = _worker(job).rows(number)
    after = os.times()
    table = pa.Table.from_pylist(rows, schema=job.schema)
    buffer = BytesIO()
    pq.write_table(table, buffer, compression="zstd")
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    cpu_s = after.user + after.system - before.user - before.system
    return Done(number, buffer.getvalue(), cpu_s, peak_mib)


_kept: dict[str, Unit] = {}
_keeping = threading.Lock()
_sent: list[Job] = []


def _worker(job: Job) -> Unit:
    """Give what this process has made for a job, or make it: matrices that every position needs."""
    with _keeping:
        key = job.digest
        if key not in _kept:
            _kept.clear()
            _kept[key] = job.unit()
        return _kept[key]


def _by_processes(job: Job, wanted: list[int], jobs: int) -> Iterator[Done]:
    pool = ProcessPoolExecutor(
        min(jobs, len(wanted)), mp_context=get_context("spawn"), initializer=_begin, initargs=(job,)
    )
    try:  # not `with`: on Ctrl-C that would wait for every position still to come
        for future in completed([pool.submit(_compute_sent, number) for number in wanted]):
            yield future.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _begin(job: Job) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to answer
    _sent[:] = [job]
    parent = parent_process()
    assert parent is not None

    def end_with_parent() -> None:
        parent.join()
        os._exit(1)  # a killed parent cannot tell its workers to stop

    threading.Thread(target=end_with_parent, daemon=True).start()


def _compute_sent(number: int) -> Done:
    return compute(_sent[0], number)


def _by_dask(job: Job, wanted: list[int], scheduler: str | None) -> Iterator[Done]:
    try:
        from dask.distributed import Client, as_completed
    except ImportError as error:
        raise ValueError(f"--scheduler needs Dask: pip install 'livessl[evaluate-cluster]' ({error})") from error
    with Client(scheduler) as client:  # type: ignore[no-untyped-call]
        everywhere = client.scatter(job, broadcast=True)
        futures = [client.submit(compute, everywhere, number, pure=False) for number in wanted]
        for future in as_completed(futures):  # type: ignore[no-untyped-call]
            yield future.result()
            future.release()


def _claim(out: Path, job: Job) -> None:
    path = out / "campaign.json"
    if path.exists():
        held = json.loads(path.read_text(encoding="utf-8"))
        if held.get("digest") != job.digest:
            raise ValueError(
                f"--out {out}: expected an empty folder or the same campaign, got one with other settings or sounds; "
                f"see {path}, or choose another folder"
            )
    out.mkdir(parents=True, exist_ok=True)
    sounds = {name: [clip for clip, _ in clips] for name, clips in job.clips.items()}
    text = json.dumps({"digest": job.digest, "settings": job.settings.as_dict(), "sounds": sounds}, indent=1)
    _write(path, text.encode())


def _unpack(results: Path, parts: Path, schema: pa.Schema) -> None:
    """Make the parts that results were joined from, where they are not there."""
    if not results.exists():
        return
    table = pq.read_table(results, schema=schema)
    numbers, first, counts = np.unique(table.column("position").to_numpy(), return_index=True, return_counts=True)
    for number, start, count in zip(numbers, first, counts, strict=True):
        path = _part(parts, int(number))
        if not path.exists():
            buffer = BytesIO()
            pq.write_table(table.slice(int(start), int(count)), buffer, compression="zstd")
            _write(path, buffer.getvalue())


def _joined(out: Path, parts: list[Path], schema: pa.Schema) -> Path:
    path = out / "results.parquet"
    temporary = path.with_suffix(".tmp")
    # one by one: a thousand positions fit no worker's memory as Python objects, and need not
    tables = [pq.read_table(part, schema=schema) for part in parts]
    pq.write_table(pa.concat_tables(tables).unify_dictionaries().combine_chunks(), temporary, compression="zstd")
    temporary.replace(path)
    return path


def _part(parts: Path, number: int) -> Path:
    return parts / f"{number:06d}.parquet"


def _write(path: Path, content: bytes) -> None:
    """Write a file so that it is there as a whole or not at all, even if the machine goes down."""
    temporary = path.with_suffix(".tmp")
    with temporary.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)
