"""What lies in deploy/ fits together, as far as can be told without running an init system or a container engine."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from conftest import require
from livessl.site.load import load_site

ROOT = Path(__file__).parents[1]
DEPLOY = ROOT / "deploy"
PROGRAM = "/opt/livessl/bin/livessl"


def unit(name: str) -> dict[str, list[str]]:
    """Settings of a unit file; one may be there several times."""
    settings: dict[str, list[str]] = {}
    for line in (DEPLOY / name).read_text(encoding="utf-8").splitlines():
        key, equals, value = line.partition("=")
        if equals and not line.startswith("#"):
            settings.setdefault(key, []).append(value)
    return settings


def compose() -> dict[str, Any]:
    loaded: dict[str, Any] = yaml.safe_load((DEPLOY / "compose.yaml").read_text(encoding="utf-8"))
    return loaded


def instructions() -> list[tuple[str, str]]:
    """Instructions of the Containerfile and their arguments, continuation lines joined."""
    text = re.sub(r"\\\n\s*", " ", (DEPLOY / "Containerfile").read_text(encoding="utf-8"))
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    return [(name, rest) for name, _, rest in (line.partition(" ") for line in lines)]


def commands() -> dict[str, list[str]]:
    """Every command line that deploy/ starts, without its program."""
    found = {}
    for name in ("livessl-server.service", "livessl-node@.service"):
        [line] = unit(name)["ExecStart"]
        found[name] = shlex.split(line)
    for name, service in compose()["services"].items():
        found[f"compose {name}"] = service["command"]
    found["Containerfile"] = next(json.loads(rest) for name, rest in instructions() if name == "CMD")
    for place, words in found.items():
        assert words[0] in ("livessl", PROGRAM), place
    return {place: words[1:] for place, words in found.items()}


@pytest.mark.parametrize("name", ["livessl-server.service", "livessl-node@.service"])
def test_systemd_accepts_the_unit(name: str, tmp_path: Path) -> None:
    require(shutil.which("systemd-analyze") is not None, "systemd-analyze is not installed (systemd)")
    text = (DEPLOY / name).read_text(encoding="utf-8")
    assert PROGRAM in text
    path = tmp_path / name.replace("@", "@lab-pc")
    path.write_text(text.replace(PROGRAM, "/bin/true"), encoding="utf-8")  # the check looks for the program
    checked = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(path)], capture_output=True, text=True, check=False
    )
    said = [line for line in checked.stderr.splitlines() if path.name in line]  # not what ails this machine's own units
    assert said == []
    assert checked.returncode == 0, checked.stderr


@pytest.mark.parametrize("name", ["livessl-server.service", "livessl-node@.service"])
def test_unit_comes_back_and_is_not_root(name: str) -> None:
    settings = unit(name)
    assert settings["Restart"] == ["always"]
    assert settings["DynamicUser"] == ["yes"]
    assert settings["NoNewPrivileges"] == ["yes"]


def test_node_reaches_the_sound_cards() -> None:
    settings = unit("livessl-node@.service")
    assert settings["SupplementaryGroups"] == ["audio"]
    assert settings["DeviceAllow"] == ["char-alsa rw"]
    assert int(settings["LimitRTPRIO"][0]) > 0
    assert "PrivateDevices" not in settings


def test_server_keeps_what_it_compiled() -> None:
    settings = unit("livessl-server.service")
    assert settings["Environment"] == [f"NUMBA_CACHE_DIR=%C/{settings['CacheDirectory'][0]}"]
    assert "MemoryDenyWriteExecute" not in settings  # what numba makes is machine code


def test_commands_are_livessl_commands() -> None:
    for place, (command, *options) in commands().items():
        assert command == ("capture" if "node" in place else "serve"), place
        helped = subprocess.run(
            [sys.executable, "-c", "from livessl.cli.main import main; raise SystemExit(main())", command, "--help"],
            capture_output=True,
            text=True,
            check=False,
        )
        assert helped.returncode == 0, f"{place}: livessl {command} --help: {helped.stderr}"
        for option in (word for word in options if word.startswith("--")):
            assert option in helped.stdout, f"{place}: livessl {command} has no {option}"


def test_compose_services_run_one_image_on_one_site() -> None:
    whole = compose()
    for name, service in whole["services"].items():
        context = (DEPLOY / service["build"]["context"]).resolve()
        assert context == ROOT
        assert (context / service["build"]["dockerfile"]) == DEPLOY / "Containerfile"
        mounts = [volume.split(":") for volume in service["volumes"]]
        for source, _, *_ in mounts:
            there = (DEPLOY / source).is_file() if source.startswith(".") else source in whole["volumes"]
            assert there, f"{name}: {source}"
        [site_file] = [source for source, target, *_ in mounts if target == "/etc/livessl/site.yaml"]
        site = load_site(DEPLOY / site_file)
        command = service["command"]
        assert command[command.index("--site") + 1] == "/etc/livessl/site.yaml"
        if "--node" in command:
            assert command[command.index("--node") + 1] in site.nodes
            assert service["devices"] == ["/dev/snd:/dev/snd"]
            assert service["healthcheck"] == {"disable": True}
    assert len({service["image"] for service in whole["services"].values()}) == 1


def test_containerfile_copies_what_is_there_and_is_let_in() -> None:
    ignored = (DEPLOY / "Containerfile.dockerignore").read_text(encoding="utf-8").splitlines()
    assert ignored[0] == "*"
    copied = [rest.split() for name, rest in instructions() if name == "COPY"]
    sources = [source for words in copied if not words[0].startswith("--from=") for source in words[:-1]]
    assert sources != []
    for source in sources:
        assert (ROOT / source).exists(), source
        assert f"!{source}" in ignored, source


def test_containerfile_runs_as_a_user_with_a_health_check() -> None:
    final: list[tuple[str, str]] = []
    for name, rest in instructions():
        final = [] if name == "FROM" else [*final, (name, rest)]
    assert ("USER", "livessl") in final
    assert any("useradd" in rest for name, rest in final if name == "RUN")
    assert any("libportaudio2" in rest for name, rest in final if name == "RUN")
    [health] = [rest for name, rest in final if name == "HEALTHCHECK"]
    [test] = re.findall(r"CMD (\[.*\])", health)
    program, flag, code = json.loads(test)
    assert (program, flag) == ("python", "-c")
    compile(code, "HEALTHCHECK", "exec")
    assert "http://127.0.0.1:8000/api/v1/health" in code
