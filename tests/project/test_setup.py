"""Tests of the choice of an installer in the setup script."""

import importlib.util
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
    monkeypatch.setattr(setup, "PIP", [sys.executable, "-c", f"print({settings!r})"])
    monkeypatch.setattr(setup, "quiet", lambda command: "uv" in command)
    assert (setup.find_uv() is not None) == is_used


def test_pip_installs_if_uv_fails(setup, monkeypatch):
    commands = []

    def call(command):
        commands.append(command)
        return int(command[0] == "uv")

    monkeypatch.setattr(setup, "find_uv", lambda: ["uv"])
    monkeypatch.setattr(setup.subprocess, "call", call)
    assert setup.install(["numpy"]) == 0
    assert [command[0] for command in commands] == ["uv", setup.PIP[0]]
    assert all(command[-1] == "numpy" for command in commands)
