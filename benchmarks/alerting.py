"""The cost of alerts, MQTT, clips and the history on the live path: the service runs with and without them, in turn.

    python benchmarks/alerting.py --arrays 4 --clients 20 --seconds 20 --rounds 5     # two minutes a round
    python benchmarks/alerting.py --write                                             # the table in docs/alerts.md

A round is `livessl bench --live` without anything and with everything, one after the other, in an order that changes
from round to round. With everything, each located event is stored in SQLite, alerts over a real Mosquitto, and has its
clip cut and enhanced. The ratios are those of the two runs of a round, which the machine slows down alike. The output
is one JSON object. The exit status is 1 if an alert or a clip failed, or if the median ratio of the latency, at 50 or
95 %, is above `--most`. It is also 1 if a run dropped or shed sound, because then the two did not do the same work.
"""

from __future__ import annotations

import argparse
import json
import sys
import urllib.request
from collections import Counter
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any, Final

import yaml

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import machine
from livessl.cli.progress import counted
from livessl.clock import SystemClock
from livessl.lab.bench import live
from livessl.server.api.encode import JsonObject
from mosquitto import running_mosquitto

PERCENTILES: Final = ("p50", "p95", "p99")
JUDGED: Final = ("p50", "p95")
"""Percentiles that are compared with `--most`; the 99 % of a short run are a handful of updates."""

PAGE: Final = Path(__file__).parents[1] / "docs" / "alerts.md"
BEGIN: Final = "<!-- begin alerting -->\n"
END: Final = "<!-- end alerting -->"

RULE: Final[JsonObject] = {
    "events": {"statuses": ["located", "direction-only"]},
    "hold_off_s": 0,
    "actions": ["home"],
}
"""Every event that has a position or a direction alerts."""


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
        self.done: JsonObject = {}
        """Deliveries of the last server by state, and its clips by outcome."""

    def start(self, site_file: Path) -> Any:
        """Start a server with a site file, to which the settings are added."""
        site = yaml.safe_load(site_file.read_text(encoding="utf-8"))
        site["server"] |= {"events_db": "events.sqlite", "clips": {"folder": "clips"}}
        action = {"mqtt": {"host": "127.0.0.1", "port": self._port}}
        site["alerts"] = {"rules": {"every": RULE}, "actions": {"home": action}}
        site_file.write_text(yaml.safe_dump(site), encoding="utf-8")
        self._address = f"http://127.0.0.1:{site['server']['http']['port']}/api/v1"
        return live.serve(site_file)

    def read(self, step: int, steps: int) -> None:
        """Read, at the end of the measured time, what the server has done."""
        if step < steps:
            return
        alerts, clips = self._get("alerts?limit=1000")["alerts"], self._get("clips")
        states = Counter(delivery["state"] for alert in alerts for delivery in alert["deliveries"])
        self.done = {
            "alerts": dict(sorted(states.items())),
            "clips": {name: clips[name] for name in ("written", "waiting", "shed", "failed")},
        }

    def _get(self, path: str) -> JsonObject:
        with urllib.request.urlopen(f"{self._address}/{path}", timeout=60.0) as answer:  # noqa: S310 - our own address
            return dict(json.load(answer))


def measured(outcome: live.Outcome) -> JsonObject:
    """Return what is compared of a run."""
    located = outcome.stages_ms["located"]
    return {
        "latency_ms": {name: outcome.latency_ms[name] for name in PERCENTILES},
        "located_ms": {name: located[name] for name in PERCENTILES},
        "cpu_percent": round(outcome.cpu_percent, 1),
        "rss_mb": round(outcome.rss_mb[2]),
        "events": outcome.events,
        "nothing_dropped": outcome.nothing_dropped,
    }


def measure(demand: live.Demand, rounds: int) -> JsonObject:
    """Return the runs of all rounds, and their comparison."""
    runs: dict[str, list[JsonObject]] = {"without": [], "with": []}
    about = machine.describe()
    with TemporaryDirectory(prefix="livessl-alerting-") as folder, running_mosquitto(Path(folder)) as port:
        service, clock = Service(port), SystemClock()
        with counted("alerting", "round") as show:
            for number in range(rounds):
                for kind in sorted(runs, reverse=number % 2 == 1):
                    if kind == "without":
                        runs[kind].append(measured(live.measure(demand, clock)))
                        continue
                    outcome = live.measure(demand, clock, start=service.start, progress=service.read)
                    runs[kind].append(measured(outcome) | service.done)
                show(number + 1, rounds)
    return {
        "machine": about,
        "demand": {"arrays": demand.arrays, "clients": demand.clients, "seconds": demand.seconds, "rounds": rounds},
        **runs,
        "compared": compared(runs["without"], runs["with"]),
    }


def compared(without: list[JsonObject], with_all: list[JsonObject]) -> JsonObject:
    """Return the medians of both kinds of run, and the median, least and largest ratio within a round."""

    def of(run: JsonObject) -> dict[str, float]:
        latencies = {f"latency {name}": run["latency_ms"][name] for name in PERCENTILES}
        return {**latencies, "processor": run["cpu_percent"], "memory": run["rss_mb"]}

    before, after = [of(run) for run in without], [of(run) for run in with_all]
    found = {}
    for name in before[0]:
        ratios = [one[name] / other[name] for other, one in zip(before, after, strict=True)]
        found[name] = {
            "without": round(median(run[name] for run in before), 2),
            "with": round(median(run[name] for run in after), 2),
            "ratio": round(median(ratios), 3),
            "least_ratio": round(min(ratios), 3),
            "largest_ratio": round(max(ratios), 3),
        }
    return found


def is_comparable(found: JsonObject) -> bool:
    """Return whether no run dropped or shed sound, so that both kinds did the same work."""
    return all(run["nothing_dropped"] for kind in ("without", "with") for run in found[kind])


def faults(found: JsonObject, most: float) -> list[str]:
    """Return what is not as it should be, in words."""
    said = []
    for run in found["with"]:
        lost = {state: count for state, count in run["alerts"].items() if state not in ("delivered", "waiting")}
        if lost or not run["alerts"].get("delivered"):
            said.append(f"alerts: expected deliveries and nothing else, got {run['alerts']}")
        if run["clips"]["failed"] or not run["clips"]["written"]:
            said.append(f"clips: expected some and no failure, got {run['clips']}")
    busy = {kind: sum(not run["nothing_dropped"] for run in found[kind]) for kind in ("without", "with")}
    said += [
        f"{count} of {len(found[kind])} runs {kind} dropped or shed sound: expected a machine that carries the load; "
        "stop what else runs on it, or lower --arrays"
        for kind, count in busy.items()
        if count
    ]
    for name in JUDGED:
        ratio = found["compared"][f"latency {name}"]["ratio"]
        if not ratio <= most:  # NaN if a run had no update at all
            said.append(f"latency {name}: expected at most {most:g} times that without, got {ratio:g} times")
    return said


def document(found: JsonObject) -> str:
    """Return the table and what belongs to it."""
    demand, about, compares = found["demand"], found["machine"], found["compared"]
    units = {"latency p50": "ms", "latency p95": "ms", "latency p99": "ms", "processor": "% of a core", "memory": "MB"}
    lines = [
        f"{demand['arrays']} arrays, {demand['clients']} clients, {demand['rounds']} rounds of {demand['seconds']:g} s",
        f"each, {about['cpu']} with {about['cores']} cores; load average before: {about['load_before']}.",
        "",
        "| | without | with | ratio of a round: median, least to largest |",
        "|---|---|---|---|",
    ]
    for name, unit in units.items():
        row = compares[name]
        ratio = f"{row['ratio']:.2f}, {row['least_ratio']:.2f} to {row['largest_ratio']:.2f}"
        lines.append(f"| {name} ({unit}) | {row['without']:g} | {row['with']:g} | {ratio} |")
    delivered = sum(run["alerts"].get("delivered", 0) for run in found["with"])
    written = sum(run["clips"]["written"] for run in found["with"])
    shed, failed = (sum(run["clips"][name] for run in found["with"]) for name in ("shed", "failed"))
    lines += ["", f"{delivered} alerts were delivered, {written} clips written, {shed} shed, and {failed} failed."]
    return "\n".join(lines) + "\n"


def write(page: Path, text: str) -> None:
    """Put a text in the place of a page that its comments name.

    Raises
    ------
    ValueError
        If the page has no such place.
    """
    old = page.read_text(encoding="utf-8")
    if BEGIN not in old or END not in old:
        raise ValueError(f"{page}: expected the lines {BEGIN.strip()} and {END}; add them where the table belongs")
    fresh = old[: old.index(BEGIN) + len(BEGIN)] + "\n" + text + "\n" + old[old.index(END) :]
    page.write_text(fresh, encoding="utf-8")


def main() -> int:
    """Measure and print the outcome."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arrays", type=int, default=4)
    parser.add_argument("--clients", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--most", type=float, default=1.1, help="largest ratio of the latency (default: 1.1)")
    parser.add_argument("--write", action="store_true", help=f"put the table into {PAGE.name}, if nothing was shed")
    arguments = parser.parse_args()
    found = measure(live.Demand(arguments.arrays, arguments.clients, arguments.seconds), arguments.rounds)
    print(json.dumps(found, indent=1))
    said = faults(found, arguments.most)
    if arguments.write and is_comparable(found):
        write(PAGE, document(found))
    print("\n".join(said), file=sys.stderr, end="\n" if said else "")
    return 1 if said else 0


if __name__ == "__main__":
    sys.exit(main())
