"""Fixtures of the command line's tests."""

from __future__ import annotations

import pytest

from cli.command_runs import Done, Recorded, Run, simulate_arguments
from livessl.cli.main import main
from small_site import write_site


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """A function that runs a command in this process and returns its exit code and output."""

    def run(*arguments: object) -> Done:
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as end:  # raised by argparse
            code = int(end.code or 0)
        printed = capsys.readouterr()
        assert "Traceback" not in printed.err
        return Done(code, printed.out, printed.err)

    return run


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """A simulated session; no test changes it."""
    directory = tmp_path_factory.mktemp("recorded")
    site = write_site(tmp_path_factory.mktemp("site"))
    assert main(simulate_arguments(site, directory)) == 0
    return Recorded(directory, site)
