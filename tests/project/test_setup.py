"""Tests of the choice of an installer, and of its failure, in the setup script."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "setup.py"

pytestmark = pytest.mark.skipif(not SCRIPT.exists(), reason="needs a checkout of the repository")


@pytest.fixture
def setup():
    spec = importlib.util.spec_from_file_location("the_setup", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("settings", "is_used"),
    [
        ("global.find-links='/opt/wheels'", True),
        ("global.extra-index-url='https://more'", True),
        (":env:.index-url='https://mirror'", False),
        ("global.no-index='true'", False),
    ],
)
def test_uv_is_not_used_if_pip_has_its_own_index(setup, monkeypatch, settings, is_used):
    pip = [sys.executable, "-c", f"print({settings!r})"]
    monkeypatch.setattr(setup, "pip_of_venv", lambda: pip)
    monkeypatch.setattr(setup, "quiet", lambda command: "uv" in command)
    assert (setup.find_uv() is not None) == is_used


def test_pip_installs_if_uv_fails(setup, monkeypatch):
    commands = []

    def install(command):
        commands.append(command)
        return int(command[0] == "uv")

    monkeypatch.setattr(setup, "find_uv", lambda: ["uv"])
    monkeypatch.setattr(setup, "install_with_progress", install)
    assert setup.install(["numpy"]) == 0
    assert [command[-3:] for command in commands] == [
        ["--python", str(setup.python_of_venv()), "numpy"],
        ["--disable-pip-version-check", "install", "numpy"],
    ]


def test_a_failed_command_is_reported(setup, capsys):
    failing = [sys.executable, "-c", "print('no such version'); raise SystemExit(3)"]
    assert setup.install_with_progress(failing) == 3
    assert "no such version" in capsys.readouterr().err
    with pytest.raises(subprocess.CalledProcessError):
        setup.install_with_progress(failing, check=True)
