"""`livessl support-bundle`: collects log, settings and state of a server into one file without secrets and sound."""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import distributions
from pathlib import Path
from typing import Any, Final

from livessl import __version__
from livessl.cli.exits import OK
from livessl.cli.options import add_json
from livessl.cli.output import complain
from livessl.cli.server_answers import add_server, ask, check_address, fetch
from livessl.clock import SystemClock, utc_text
from livessl.errors import ConfigError, RunError, UseError

LINES: Final = 1000
"""Most lines of the server's log, and of the journal."""

JOURNAL_S: Final = 20.0
"""Longest wait, in seconds, for the journal."""

ANSWERS: Final = {
    "health.json": "health",
    "arrays.json": "arrays",
    "site.json": "site",
    "findings.json": "findings",
    "rules.json": "alerts/rules",
    "log.json": f"log?limit={LINES}",
}
"""Parts of the bundle that a running server answers: the name of each, and its path under /api/v1."""


@dataclass
class Bundle:
    """The parts of a bundle by name, and the reason for each part that is missing."""

    secrets: frozenset[str] = frozenset()
    parts: dict[str, bytes] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)

    def add(self, name: str, make: Callable[[], str]) -> None:
        """Add a part without its secrets, or note why it could not be made."""
        from livessl.site.redact import scrubbed

        try:
            text = make()
        except (RunError, UseError, OSError, ValueError, subprocess.SubprocessError) as error:
            self.missing[name] = scrubbed(str(error), self.secrets)
        else:
            self.parts[name] = scrubbed(text, self.secrets).encode()


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    parser.add_argument("--site", type=Path, required=True, help="site file; it need not be valid")
    add_server(parser, "default: this machine, with the port of the site file")
    parser.add_argument("--out", type=Path, metavar="FILE", help="file to write (default: livessl-support-TIME.zip)")
    add_json(parser, "print one JSON object: the file, its parts with their sizes, and what is missing and why")


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    if arguments.url is not None:
        check_address(arguments.url)
    time_utc = utc_text(SystemClock().now_ns())
    stamp = time_utc.partition(".")[0].replace("-", "").replace(":", "")
    path = arguments.out or Path(f"livessl-support-{stamp}Z.zip")
    if path.exists():
        raise RunError(f"--out: {path} exists already; give another name")
    bundle = Bundle()
    data = _add_site(bundle, arguments.site)
    bundle.add("versions.json", lambda: _json(_versions()))
    _add_answers(bundle, arguments.url or _url(data), arguments.token_file)
    bundle.add("journal.txt", _journal)
    contents = {"time_utc": time_utc, "parts": [*bundle.parts, "manifest.json"], "missing": bundle.missing}
    bundle.add("manifest.json", lambda: _json(contents))
    _write(path, bundle)
    if arguments.json:
        sizes = {name: len(part) for name, part in bundle.parts.items()}
        print(json.dumps({"file": str(path), "parts": sizes, "missing": bundle.missing}))
        return OK
    for name, part in bundle.parts.items():
        print(f"{len(part):>9,} bytes  {name}")
    for name, why in bundle.missing.items():
        complain(f"{name}: {why}", kind="note")
    print(
        f"{path}: look through it before you give it away; secrets and sound are left out, names and addresses are not"
    )
    return OK


def _add_site(bundle: Bundle, path: Path) -> Any:
    """Add the site file without secrets, and what `check` finds in it; return its data, or None if it is not YAML."""
    import yaml

    from livessl.site.findings import read_yaml
    from livessl.site.redact import redacted

    try:
        data = read_yaml(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError) as error:
        bundle.missing["site.yaml"] = f"{path} cannot be read as YAML ({type(error).__name__}); run `livessl check`"
        data = None
    else:
        shown, bundle.secrets = redacted(data)
        bundle.add("site.yaml", lambda: yaml.safe_dump(shown, sort_keys=False, allow_unicode=True))
    bundle.add("check.txt", lambda: _checked(path))
    return data


def _checked(path: Path) -> str:
    from livessl.site.load import load_site

    try:
        site = load_site(path)
    except ConfigError as error:
        return f"{error}\n"
    return "".join(f"note: {warning}\n" for warning in site.warnings) + "valid\n"


def _versions() -> dict[str, Any]:
    """Return the versions of livessl, Python and all packages, and what machine this is."""
    found = ((one.metadata["Name"], one.version) for one in distributions())
    packages = {name: version for name, version in found if name}  # leftovers of an uninstalled package have no name
    return {
        "livessl": __version__,
        "python": sys.version,
        "platform": platform.platform(),
        "machine": platform.machine(),
        "processors": os.cpu_count(),
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "packages": dict(sorted(packages.items(), key=lambda item: item[0].lower())),
    }


def _add_answers(bundle: Bundle, url: str, token_file: Path | None) -> None:
    """Add what a running server answers; if the first request gets no answer, the others are not tried."""
    for name, path in ANSWERS.items():
        bundle.add(name, lambda path=path: _json(ask(url, path, token_file)))  # type: ignore[misc]
        if "health.json" in bundle.missing:
            bundle.missing["the other answers of the server"] = "not tried, as it gave no health"
            return
    bundle.add("metrics.txt", lambda: fetch(f"{url.rstrip('/')}/metrics", token_file).decode())


def _url(data: Any) -> str:
    """Return the address of the server on this machine, from the data of a site file that need not be valid."""
    from livessl.site.addresses import in_url

    http = data
    for key in ("server", "http"):
        http = http.get(key) if isinstance(http, dict) else None
    known = http if isinstance(http, dict) else {}
    host = known.get("host", "127.0.0.1")
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(str(host), str(host))  # noqa: S104
    scheme = "https" if known.get("certificate") else "http"
    return f"{scheme}://{in_url(host)}:{known.get('port', 8000)}"


def _journal() -> str:
    """Return the last lines of the journal of livessl's units.

    Raises
    ------
    RunError
        If this machine has no journal, or its journal has no lines of these units.
    """
    program = shutil.which("journalctl")
    if program is None:
        raise RunError("this machine has no journalctl")
    command = [program, "--unit=livessl-*", f"--lines={LINES}", "--no-pager", "--output=short-iso", "--quiet"]
    read = subprocess.run(command, capture_output=True, text=True, timeout=JOURNAL_S, check=False)  # noqa: S603
    if read.returncode or not read.stdout:
        raise RunError(f"the journal has no lines of livessl's units {read.stderr.strip()}".strip())
    return read.stdout


def _json(found: Any) -> str:
    return json.dumps(found, indent=2, ensure_ascii=False) + "\n"


def _write(path: Path, bundle: Bundle) -> None:
    """Write the bundle; it is readable by its owner only."""
    try:
        with (
            os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file,
            zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive,
        ):
            for name, part in bundle.parts.items():
                archive.writestr(name, part)
    except FileExistsError as error:
        raise RunError(f"--out: {path} exists already; give another name") from error
