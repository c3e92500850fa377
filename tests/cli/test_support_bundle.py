"""The support bundle: what is in it, what is not, and that it can be made when little works."""

from __future__ import annotations

import json
import logging
import zipfile
from pathlib import Path

from cli.command_runs import Run
from livessl import __version__
from livessl.lab.processes import free_port
from livessl.site.load import load_site
from livessl.site.tokens import add_token
from small_site import Changes, running_server, wait_until, write_site

SECRET = "correct-horse-battery"


def contents(path: Path) -> dict[str, str]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name).decode() for name in archive.namelist()}


def alerts() -> Changes:
    url = f"http://127.0.0.1:9/{SECRET}"
    rule = {"events": {"zones": ["door"]}, "actions": ["guard"]}
    return {"alerts": {"actions": {"guard": {"webhook": {"url": url}}}, "rules": {"door": rule}}}


def test_bundle_of_a_running_server_has_its_answers_and_no_secret(run: Run, tmp_path: Path) -> None:
    path = write_site(tmp_path, {**alerts(), "server.http.tokens": "tokens.yaml", "server.http.port": free_port()})
    token = add_token(tmp_path / "tokens.yaml", "me", "admin")
    (tmp_path / "token").write_text(token, encoding="utf-8")
    out = tmp_path / "bundle.zip"
    with running_server(load_site(path)) as server:
        wait_until(lambda: server.loop is not None, "the server")
        logging.getLogger("livessl.test").error("cannot reach %s as %s", f"http://127.0.0.1:9/{SECRET}", token)
        done = run("support-bundle", "--site", path, "--token-file", tmp_path / "token", "--out", out, "--json")
    assert done.code == 0, done.err
    [found] = done.objects
    parts = contents(out)
    assert found["file"] == str(out)
    assert found["parts"] == {name: len(part.encode()) for name, part in parts.items()}
    assert set(found["missing"]) <= {"journal.txt"}, "which a machine need not have"
    assert json.loads(parts["versions.json"])["livessl"] == __version__
    assert json.loads(parts["health.json"])["version"] == __version__
    assert [rule["name"] for rule in json.loads(parts["rules.json"])["rules"]] == ["door"]
    assert "livessl_uptime_seconds" in parts["metrics.txt"]
    assert any("cannot reach" in line["message"] for line in json.loads(parts["log.json"])["lines"])
    assert parts["check.txt"].endswith("valid\n")
    whole = "".join(parts.values())
    assert SECRET not in whole
    assert token not in whole
    assert out.stat().st_mode & 0o077 == 0


def test_bundle_without_a_server_and_with_a_broken_site_says_what_is_missing(run: Run, tmp_path: Path) -> None:
    path = write_site(tmp_path, {**alerts(), "server.http.port": free_port(), "zones.door.bounds_m": 3})
    out = tmp_path / "bundle.zip"
    done = run("support-bundle", "--site", path, "--out", out)
    assert done.code == 0
    parts = contents(out)
    assert set(parts) - {"journal.txt"} == {"site.yaml", "check.txt", "versions.json", "manifest.json"}
    assert "zones.door.bounds_m" in parts["check.txt"]
    assert "no answer from a server" in json.loads(parts["manifest.json"])["missing"]["health.json"]
    assert "livessl: note: health.json: " in done.err
    assert SECRET not in "".join(parts.values())
    assert run("support-bundle", "--site", path, "--out", out).code == 1, "no file is written over"


def test_site_file_that_is_no_yaml_is_not_in_the_bundle(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "site.yaml"
    path.write_text(f"site: [\npassword: {SECRET}\n", encoding="utf-8")
    out = tmp_path / "bundle.zip"
    done = run("support-bundle", "--site", path, "--url", f"http://127.0.0.1:{free_port()}", "--out", out)
    assert done.code == 0
    parts = contents(out)
    assert "site.yaml" not in parts
    assert SECRET not in "".join(parts.values())
