"""Probes that run the same things with two trees of livessl; each returns what it compared and what differs."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from unchanged_api import served
from unchanged_trees import (
    MAX_ERROR_CHARACTERS,
    Pair,
    ProbeError,
    Tree,
    differences,
    load_json,
    missing,
    missing_keys,
    ratios,
)

HERE: Final = Path(__file__).parent

REASON: Final = re.compile(rb'"reason": "(?:[^"\\]|\\.)*"')
"""The reason of an event in JSON, with its text."""


@dataclass(frozen=True)
class Options:
    """Sizes of the long probes.

    Parameters
    ----------
    seeds : int
        Number of simulated worlds in which faults happen.
    jobs : int
        Number of processes that share these worlds.
    sounds : int
        Number of sounds of each kind for which the search is compared with the whole map.
    scenes : int
        Number of simulated scenes, from the first on.
    """

    seeds: int = 50
    jobs: int = 2
    sounds: int = 6
    scenes: int = 5


@dataclass(frozen=True)
class Finding:
    """The result of a probe: a few words on what was compared, and one line for each difference."""

    compared: str
    differences: Sequence[str]


@dataclass(frozen=True)
class Scene:
    """A simulated session in a shipped site, and the options with which it is located.

    Parameters
    ----------
    site : str
        Name of the site file in `config`.
    seed : int
        Of the simulation.
    rt60_s : float
        Reverberation time in seconds.
    rate_hz : int
        Sampling rate of the recordings in Hz; the site file has to expect the same.
    located : sequence of str
        Options of `livessl locate` for one run each.
    """

    site: str
    seed: int
    rt60_s: float
    located: Sequence[str]
    rate_hz: int = 44_100

    def simulate(self, tree: Tree, out: Path) -> None:
        """Simulate into `out`, unless it is there already."""
        if not out.exists():
            options = f"--rt60 {self.rt60_s} --seed {self.seed} --sample-rate {self.rate_hz} --count 4".split()
            site = tree.root / "config" / self.site
            done = tree.livessl("simulate", "--site", site, "--out", out, *options, folder=out.parent)
            tree.must(done, f"simulate {self}")

    def recorded(self, pair: Pair) -> Path:
        """Return the folder of the recordings that base simulates, once for all probes."""
        out = pair.folder / f"base-{self.seed}"
        self.simulate(pair.base, out)
        return out

    def __str__(self) -> str:
        return f"{self.site} seed {self.seed}"


SCENES: Final = (
    Scene("demo.yaml", 1, 0.7, ("", "--method srp-phat")),
    Scene("paper.yaml", 2, 0.3, ("", "--method averaged", "--joint both=left,right")),
    Scene("paper.yaml", 3, 0.9, ("", "--method cepstral", "--method srp-phat")),
    Scene("one-array.yaml", 4, 0.4, ("", "--method srp-phat"), 48_000),
    Scene("demo.yaml", 5, 0.0, ("", "--channels north=1,3,2,4")),
)
"""All shipped sites, estimators and reverberation from none to much; wrong channels bring about refused events."""


def simulate(pair: Pair, options: Options) -> Finding:
    """`livessl simulate` writes the same bytes for the same seed."""
    found, files = [], 0
    scenes = SCENES[: options.scenes]
    for scene in scenes:
        base, head = scene.recorded(pair), pair.folder / f"head-{scene.seed}"
        scene.simulate(pair.head, head)
        ours, theirs = ({f"{scene}, {p.name}": p.read_bytes() for p in sorted(d.iterdir())} for d in (base, head))
        found += differences(ours, theirs)
        files += len(ours)
    return Finding(f"{files} files of {len(scenes)} scenes", found)


def locate(pair: Pair, options: Options) -> Finding:
    """`livessl locate --json` prints the same bytes about the same recordings, but for the words of a reason."""
    found, runs, events, reworded = [], 0, 0, 0
    scenes = SCENES[: options.scenes]
    for scene in scenes:
        wavs = [part for p in sorted(scene.recorded(pair).glob("*.wav")) for part in ("--wav", f"{p.stem}={p}")]
        for given in scene.located:
            base, head = (
                tree.livessl(
                    "locate", "--json", "--site", tree.root / "config" / scene.site, *wavs, *given.split(),
                    folder=pair.folder,
                )
                for tree in pair.both()
            )  # fmt: skip
            name = f"{scene} {given}".strip()
            ours, theirs = pair.base.must(base, f"locate {name}").outputs(name), head.outputs(name)
            reworded += ours != theirs and without_reasons(ours) == without_reasons(theirs)
            found += differences(without_reasons(ours), without_reasons(theirs))
            found += [f"{name}, head: {head.err.strip()[-MAX_ERROR_CHARACTERS:]}"] if head.code else []
            runs, events = runs + 1, events + len(base.out.splitlines())
    if events < runs:
        found.append(f"expected an event or more of each of {runs} runs, got {events} in all")
    return Finding(f"{events} events of {runs} runs, {reworded} of them with other words in a reason", found)


def without_reasons(outputs: Mapping[str, bytes]) -> dict[str, bytes]:
    """Return outputs with the text of every reason replaced by dots: that there is one counts, not its words."""
    return {name: REASON.sub(b'"reason": "..."', text) for name, text in outputs.items()}


def wire(pair: Pair, _: Options) -> Finding:
    """Messages have the same bytes, and bytes, damaged ones too, are decoded to the same messages."""
    script, kept = HERE / "unchanged_wire.py", pair.folder / "wire.json"
    base = pair.base.must(pair.base.python(script, folder=pair.folder), "encode messages").out
    kept.write_bytes(base)
    head = pair.head.must(pair.head.python(script, kept, folder=pair.folder), "encode and decode messages").out
    ours, theirs = (load_json(out, "messages") for out in (base, head))
    found = []
    for part, of in (("built", "{}"), ("again", "{}, decoded and encoded again"), ("damaged", "{}, damaged")):
        # one that only one tree can build in this way is compared by its bytes all the same
        expected = {n: v for n, v in ours[part].items() if part != "built" or n in theirs[part]}
        digits = bytes.fromhex if part != "damaged" else str.encode
        one, other = ({of.format(n): digits(side[n]) for n in expected} for side in (ours[part], theirs[part]))
        found += differences(one, other)
    return Finding(f"{len(ours['again'])} messages", found)


BROKEN_SITES: Final = (
    "site: broken\nroom: {size_m: [4, 5]}\narrays: {}\n",
    "site: broken\nroom: {size_m: [4, 5, 3]}\narrays: {a: {microphones_m: [[1, 1, 1], [9, 1, 1]]}}\nnodse: {}\n",
    "site: [broken\n",
)
"""Wrong values, a misspelt key and a microphone outside the room, no YAML: only the exit codes are compared."""


def check(pair: Pair, _: Options) -> Finding:
    """`livessl check --json` prints the same about every shipped site file."""
    outputs: list[dict[str, bytes]] = []
    for tree in pair.both():
        said: dict[str, bytes] = {}
        for name, path in tree.site_files().items():
            said |= tree.livessl("check", "--json", path, folder=pair.folder).outputs(name)
        for number, text in enumerate(BROKEN_SITES, start=1):
            path = pair.folder / f"broken-{number}.yaml"
            path.write_text(text, encoding="utf-8")
            code = tree.livessl("check", path, folder=pair.folder).code
            said[f"broken site {number}, exit code"] = str(code).encode()
        outputs.append(said)
    base, head = outputs
    head = {name: said for name, said in head.items() if name in base}  # head may ship more
    return Finding(f"{len(pair.base.site_files())} shipped site files", differences(base, head))


def commands(pair: Pair, _: Options) -> Finding:
    """Every command, option and choice that the help names is still there."""
    base, head = (set(_described(tree, pair.folder)) for tree in pair.both())
    return Finding(f"{len(base)} commands, options and choices", missing(base, head))


def _described(tree: Tree, folder: Path, *command: str) -> Iterator[str]:
    """Yield what the help of a command names, and that of the commands below it."""
    text = tree.must(tree.livessl(*command, "--help", folder=folder), " ".join((*command, "--help"))).out.decode()
    chosen = [word for choices in re.findall(r"\{([^}]+)\}", text) for word in choices.split(",")]
    below = commands_of(text)
    for word in {*below, *chosen, *re.findall(r"--[a-z][a-z0-9-]*", text)}:
        yield " ".join((*command, word))
    for name in below:
        yield from _described(tree, folder, *command, name)


def commands_of(text: str) -> list[str]:
    """Return the commands that argparse's help lists: below a line with nothing but their name for all or their choice.

    Choices of an option, such as `--log {text,json}`, are no commands.
    """
    lists = re.findall(r"^ {2}(?:[A-Z]+|\{[^}\s]+\})\n((?:^ {4}.*\n?)+)", text, re.MULTILINE)
    return [name for listed in lists for name in re.findall(r"^ {4}([a-z][a-z0-9-]*)(?:  |$)", listed, re.MULTILINE)]


def api(pair: Pair, _: Options) -> Finding:
    """Paths and parameters of the OpenAPI, JSON fields and metrics are still there, after a session was played."""
    session = SCENES[0].recorded(pair)
    base, head = (served(tree, session, pair.folder) for tree in pair.both())
    found = [*missing(base[0], head[0]), *missing_keys(base[1], head[1])]
    return Finding(f"{len(base[0])} paths, parameters and metrics, {len(base[1])} JSON fields", found)


def faults(pair: Pair, options: Options) -> Finding:
    """Head loses and changes no event in simulated worlds in which nodes, links and the server fail."""
    script = pair.head.root / "benchmarks" / "faults.py"
    arguments = ("replayed", "--seeds", options.seeds, "--jobs", options.jobs)
    done = pair.head.python(script, *arguments, folder=pair.folder)
    lines = done.out.decode(errors="replace").splitlines() or [done.err.strip()[-MAX_ERROR_CHARACTERS:]]
    wrong = [line for line in lines if line.startswith("seed ")]
    return Finding(lines[-1], (wrong or lines[-1:]) if done.code else [])


def exactness(pair: Pair, options: Options) -> Finding:
    """Head's search finds the grid point and value of its whole map."""
    script, out = pair.head.root / "benchmarks" / "exactness.py", pair.folder / "exactness"
    done = pair.head.python(script, "--out", out, "--sounds", options.sounds, folder=pair.folder)
    report = out / "exactness.json"
    if not report.exists():
        pair.head.must(done, "exactness")
        raise ProbeError(f"head: exactness: expected {report.name}, got none")
    counts = load_json(report.read_bytes(), report.name)
    what = f"the same grid point on {counts['same']} of {counts['maps']} maps"
    return Finding(what, [] if done.code == 0 and counts["same"] == counts["maps"] > 0 else [what])


PROBES: Final[dict[str, Callable[[Pair, Options], Finding]]] = {
    "wire": wire,
    "check": check,
    "commands": commands,
    "simulate": simulate,
    "locate": locate,
    "api": api,
    "exactness": exactness,
    "faults": faults,
}
"""Quick ones first."""


def performance(pair: Pair, repeats: int) -> list[str]:
    """Run `livessl bench` of both trees in turn, and return a line about each of its rows and one about all."""
    runs: dict[str, list[dict[str, float]]] = {"base": [], "head": []}
    for repeat in range(repeats):
        for tree in pair.both() if repeat % 2 == 0 else reversed(pair.both()):
            done = tree.must(tree.livessl("bench", "--json", folder=pair.folder), "bench")
            timings = load_json(done.out, f"{tree.name}: bench")["timings"]
            runs[tree.name].append({timing["name"]: timing["median_ms"] for timing in timings})
    found = ratios(runs["base"], runs["head"])
    lines = [
        f"{one.name}: head takes {one.ratio:.2f} times base's time ({one.lowest:.2f} to {one.highest:.2f}), "
        f"{'within' if one.within_spread else 'OUTSIDE'} the spread"
        for one in found
    ]
    within = sum(one.within_spread for one in found)
    return [*lines, f"{within} of {len(found)} rows within the spread of {repeats} runs of each tree"]
