"""Tests of the setup script and of its progress messages."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "setup.py"

pytestmark = pytest.mark.skipif(not SCRIPT.exists(), reason="needs a checkout of the repository")

PIP = """
print("Obtaining file:///somewhere")
print("Collecting numpy>=1.26 (from napari-hmrf)")
print("  Downloading numpy-2.4.0.whl (16.6 MB)")
print("Collecting scipy")
print("Installing collected packages: numpy, scipy, napari-hmrf")
print("Successfully installed numpy-2.4.0")
"""


@pytest.fixture
def setup():
    spec = importlib.util.spec_from_file_location("the_setup", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_progress_names_the_downloaded_package_and_the_number_of_packages(setup):
    stages = setup.Stages(152)
    said = [stages.after(line) for line in PIP.replace('print("', "").splitlines()[1:]]
    assert said[0] == "downloading ..."
    assert said[1] == said[2] == "downloading package 1 of about 152 (numpy>=1.26)"
    assert said[3].startswith("downloading package 2 of about 152 (scipy")
    assert said[4] == "installing 3 packages (a minute or two)"
    assert said[5] == "installed"


def test_progress_of_uv_names_the_number_of_packages(setup):
    stages = setup.Stages(152)
    lines = ("Using Python 3.11", "Resolved 155 packages in 2s", "Prepared 154 packages in 9s")
    said = [stages.after(line) for line in (*lines, "Installed 155 packages", " + numpy==2.4.0")]
    assert said == [
        "downloading ...",
        "downloading 155 packages",
        "installing 154 packages",
        "installed",
        "installed",
    ]


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


def test_progress_prints_one_line_per_stage_without_a_terminal(setup, capsys):
    assert setup.install_with_progress([sys.executable, "-c", PIP]) == 0
    said = capsys.readouterr().err.split("\n")
    assert [line.split()[0] for line in said if line] == ["downloading", "installing", "installed"]


def test_the_output_of_a_failed_command_is_printed(setup, capsys):
    failing = [sys.executable, "-c", "print('no such version'); raise SystemExit(3)"]
    assert setup.install_with_progress(failing) == 3
    assert "no such version" in capsys.readouterr().err
    with pytest.raises(subprocess.CalledProcessError):
        setup.install_with_progress(failing, check=True)
