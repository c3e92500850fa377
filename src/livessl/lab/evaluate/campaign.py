"""Runs a campaign of experiments on cores or on Dask, keeps every finished position, and resumes."""

from __future__ import annotations

import json
import os
import resource
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from threadpoolctl import threadpool_limits

from livessl.lab.evaluate.job import Job, Unit
from livessl.lab.evaluate.parquet import write_smallest
from livessl.workers import on_cores

REPORT_FILES: Final = ("report.md", "summary.csv", "claims.md", "claims.csv", "figures")
"""Files and folders that a report writes."""

FILES: Final = ("results.parquet", "parts", "cost.jsonl", *REPORT_FILES)
"""Files and folders that a campaign and its report write, besides `campaign.json`."""


@dataclass(frozen=True, slots=True)
class Done:
    """A finished position: its rows as a Parquet file, and its cost on one core."""

    position: int
    parquet: bytes
    cpu_s: float
    peak_mib: float


def run_campaign(
    job: Job,
    out: Path,
    *,
    jobs: int,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Compute the positions that `out` does not hold yet, then join all of them in `results.parquet`.

    Finished positions are files in `parts/`. If that folder is missing, they are taken from `results.parquet`. The
    bytes of the result do not depend on the number of workers, the order of positions or interruptions.

    Parameters
    ----------
    job : Job
    out : Path
        Holds `campaign.json`, `parts/` and `cost.jsonl`.
    jobs : int
        Processes on this machine, one core each.
    scheduler : str or None
        Address of a Dask scheduler to use instead of processes.
    progress : callable or None
        Called with (positions done, positions in all).

    Raises
    ------
    ValueError
        If `out` holds another campaign.
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
        source = _by_dask(job, wanted, scheduler) if scheduler else on_cores(compute, job, wanted, jobs)
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
    """Return the recorded cost of each position: `position`, `cpu_s`, `peak_mib`."""
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


def _worker(job: Job) -> Unit:
    """Return this process's unit for a job; it is kept, because its matrices serve every position."""
    with _keeping:
        key = job.digest
        if key not in _kept:
            _kept.clear()
            _kept[key] = job.unit()
        return _kept[key]


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
        held = _claimed(path)
        if held.get("digest") != job.digest:
            raise ValueError(
                f"--out {out}: expected an empty folder or the same campaign, got one with other settings or sounds; "
                f"see {path}, or choose another folder"
            )
    else:
        require_no_others(out, FILES)
    out.mkdir(parents=True, exist_ok=True)
    sounds = {name: [clip for clip, _ in clips] for name, clips in job.clips.items()}
    text = json.dumps({"digest": job.digest, "settings": job.settings.as_dict(), "sounds": sounds}, indent=1)
    _write(path, text.encode())


def require_no_others(out: Path, names: Sequence[str]) -> None:
    """Check that a folder holds none of some files, which might be those of another program.

    Raises
    ------
    ValueError
        If it does.
    """
    found = next((out / name for name in names if os.path.lexists(out / name)), None)
    if found is not None:
        raise ValueError(
            f"--out {out}: expected a new or an empty folder, got one with {found.name}, which no campaign here made "
            "and which would be written over; name another folder"
        )


def _claimed(path: Path) -> dict[str, Any]:
    """Return what a campaign has written of itself; an empty object if the file is another."""
    try:
        held = json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        return {}
    return held if isinstance(held, dict) else {}


def _unpack(results: Path, parts: Path, schema: pa.Schema) -> None:
    """Write the parts that results were joined from, as far as they are missing."""
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
    tables = [pq.read_table(part, schema=schema) for part in parts]
    write_smallest(pa.concat_tables(tables).unify_dictionaries().combine_chunks(), temporary)
    temporary.replace(path)
    return path


def _part(parts: Path, number: int) -> Path:
    return parts / f"{number:06d}.parquet"


def _write(path: Path, content: bytes) -> None:
    """Write a file completely or not at all, even if the machine loses power."""
    temporary = path.with_suffix(".tmp")
    with temporary.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)
