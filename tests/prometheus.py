"""A real Prometheus on a free port, and its tool that checks rules."""

from __future__ import annotations

import shutil
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import DEVNULL
from typing import Any, Final

import httpx
import yaml

from conftest import require
from livessl.lab.processes import free_port
from small_site import HANG_S, started, wait_until

PROMETHEUS: Final = shutil.which("prometheus")
PROMTOOL: Final = shutil.which("promtool")
MISSING: Final = "Prometheus is not installed (Debian: apt install prometheus)"


class Prometheus:
    """A running Prometheus."""

    def __init__(self, url: str) -> None:
        self._client = httpx.Client(base_url=f"{url}/api/v1/", timeout=HANG_S)

    def get(self, path: str, **query: str) -> Any:
        """Answer to a request of its API."""
        answer = self._client.get(path, params=query)
        assert answer.status_code == 200, answer.text
        return answer.json()["data"]

    def values(self, expression: str) -> dict[str, float]:
        """Result of an expression: the value of each series, by its labels."""
        result = self.get("query", query=expression)["result"]
        return {str(sorted(series["metric"].items())): float(series["value"][1]) for series in result}

    def span(self, expression: str) -> list[Any]:
        """Series of an expression over the last two minutes, as a panel asks for them."""
        now_s = float(self.get("query", query="time()")["result"][1])
        result = self.get("query_range", query=expression, start=f"{now_s - 120}", end=f"{now_s}", step="1")["result"]
        assert isinstance(result, list)
        return result

    def close(self) -> None:
        self._client.close()


@contextmanager
def running_prometheus(folder: Path, target: str, configuration: dict[str, Any]) -> Iterator[Prometheus]:
    """Run Prometheus with a configuration whose one job asks `target`, HOST:PORT."""
    require(PROMETHEUS is not None, MISSING)
    assert PROMETHEUS is not None
    [job] = configuration["scrape_configs"]
    job["static_configs"] = [{"targets": [target]}]
    path, address = folder / "prometheus.yml", f"127.0.0.1:{free_port()}"
    path.write_text(yaml.safe_dump(configuration), encoding="utf-8")
    words = (f"--config.file={path}", f"--web.listen-address={address}", f"--storage.tsdb.path={folder / 'data'}")
    with started(PROMETHEUS, *words, "--log.level=error", stdout=DEVNULL, stderr=DEVNULL) as process:

        def answers() -> bool:
            assert process.poll() is None, "Prometheus has ended"
            try:
                with urllib.request.urlopen(f"http://{address}/-/ready", timeout=1.0):
                    return True
            except OSError:
                return False

        wait_until(answers, "Prometheus")
        prometheus = Prometheus(f"http://{address}")
        try:
            yield prometheus
        finally:
            prometheus.close()
