"""What alerts, clips, history and MQTT cost the live path: `livessl bench --live` with and without them, in turn.

    python benchmarks/alerting.py --arrays 4 --clients 20 --seconds 20 --rounds 3

Every event alerts over a real Mosquitto, is stored in SQLite, and has its clip cut and enhanced. The output is one JSON
object: the latencies and the processor time of each run, and the ratio of the medians. The exit status is 1 if less was
delivered than was raised.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import urllib.request
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import yaml

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from livessl.clock import SystemClock
from livessl.lab.bench import live
from livessl.server.api.encode import JsonObject
from mosquitto import running_mosquitto

PERCENTILES: Final = ("p50", "p95", "p99")


class Service:
    """Starts servers that alert, record and store, and reads at their end what they did.

    Parameters
    ----------
    port : int
        Port of the MQTT broker.
    """

    def __init__(self, port: int) -> None:
        self._port = port
        self._address = ""
        self.done: list[JsonObject] = []
        """For each server, its alerts by state and its clips."""

    def start(self, site_file: Path) -> Any:
        """Start a server with a site file, to which the settings are added."""
        site = yaml.safe_load(site_file.read_text(encoding="utf-8"))
        site["server"] |= {"events_db": "events.sqlite", "clips": {"folder": "clips"}}
        rule = {"events": {"statuses": ["located", "direction-only"]}, "hold_off_s": 0, "actions": ["home"]}
        actions = {"home": {"mqtt": {"host": "127.0.0.1", "port": self._port}}}
        site["alerts"] = {"rules": {"every": rule}, "actions": actions}
        site_file.write_text(yaml.safe_dump(site), encoding="utf-8")
        self._address = f"http://127.0.0.1:{site['server']['http']['port']}"
        return live.serve(site_file)

    def read(self, step: int, steps: int) -> None:
        """Read, at the end of the measured time, what the server has done."""
        if step < steps:
            return
        with urllib.request.urlopen(f"{self._address}/api/v1/alerts?limit=1000", timeout=60.0) as answer:  # noqa: S310
            alerts = json.load(answer)["alerts"]
        with urllib.request.urlopen(f"{self._address}/api/v1/clips", timeout=60.0) as answer:  # noqa: S310
            clips = json.load(answer)
        states = [delivery["state"] for alert in alerts for delivery in alert["deliveries"]]
        counts = {state: states.count(state) for state in sorted(set(states))}
        self.done.append({"alerts": counts, "clips": {name: clips[name] for name in ("written", "shed", "failed")}})


def measured(outcome: live.Outcome) -> JsonObject:
    """What is compared of a run."""
    located = outcome.stages_ms.get("located", {})
    return {
        "latency_ms": {name: outcome.latency_ms[name] for name in PERCENTILES},
        "located_ms": {name: located.get(name) for name in PERCENTILES},
        "cpu_percent": round(outcome.cpu_percent, 1),
        "rss_mb": round(outcome.rss_mb[2]),
        "nothing_dropped": outcome.nothing_dropped,
    }


def main() -> int:
    """Measure and print the outcome."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arrays", type=int, default=4)
    parser.add_argument("--clients", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    demand = live.Demand(arguments.arrays, arguments.clients, arguments.seconds)
    runs: dict[str, list[JsonObject]] = {"without": [], "with": []}
    with TemporaryDirectory(prefix="livessl-alerting-") as folder, running_mosquitto(Path(folder)) as port:
        service = Service(port)
        for _ in range(arguments.rounds):
            runs["without"].append(measured(live.measure(demand, SystemClock())))
            alerting = live.measure(demand, SystemClock(), start=service.start, progress=service.read)
            runs["with"].append({**measured(alerting), **service.done[-1]})
            print(json.dumps({name: each[-1] for name, each in runs.items()}), file=sys.stderr, flush=True)
    medians = {
        name: {p: statistics.median(run["latency_ms"][p] for run in each) for p in PERCENTILES}
        for name, each in runs.items()
    }
    ratio = {p: round(medians["with"][p] / medians["without"][p], 3) for p in PERCENTILES}
    print(json.dumps({"demand": vars(arguments), **runs, "median_latency_ms": medians, "with / without": ratio}))
    whole = all(run["alerts"] and set(run["alerts"]) <= {"delivered", "waiting"} for run in runs["with"])
    return 0 if whole and all(run["clips"]["failed"] == 0 for run in runs["with"]) else 1


if __name__ == "__main__":
    sys.exit(main())
