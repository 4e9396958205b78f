"""Campaigns with the wheel, installed in a new environment and run from another folder."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

import napari_hmrf

ROOT = Path(__file__).resolve().parents[2]

pytestmark = [
    pytest.mark.campaign,
    pytest.mark.skipif(
        not (ROOT / "pyproject.toml").exists(), reason="needs a checkout of the repository"
    ),
]

SOLVE_ELSEWHERE = """
import sys
from pathlib import Path

import napari_hmrf
from napari_hmrf import BackendError, solve
from napari_hmrf.samples.phantoms import PHANTOM_NAMES, phantom, reference_displacement, sample
from napari_hmrf.resources import resource_folder

package = Path(napari_hmrf.__file__).resolve().parent
assert package.is_relative_to(Path(sys.prefix).resolve()), package
assert (package / "py.typed").is_file()
assert (package / "napari.yaml").is_file()
for folder in ("shaders", "sample_data"):
    assert resource_folder(folder) == package / folder
assert list(resource_folder("shaders").glob("*.glsl"))
for name in PHANTOM_NAMES:
    assert sample(name).image.shape == reference_displacement(name).shape[:2]
try:
    solution = solve(phantom("expansion", 32).problem, backend="opengl")
except BackendError:
    solution = solve(phantom("expansion", 32).problem, backend="cpu")
assert solution.displacement.shape == (32, 32, 2)
print("solved", float(abs(solution.displacement).max()) > 0.5)
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder)]
    run([*command, str(ROOT)])
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def elsewhere(wheel, tmp_path_factory) -> Path:
    """Return the interpreter of a new environment with the wheel and borrowed dependencies."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False, symlinks=os.name != "nt")
    scripts = "Scripts" if os.name == "nt" else "bin"
    python = folder / scripts / ("python.exe" if os.name == "nt" else "python")
    purelib = sysconfig.get_path("purelib", vars={"base": str(folder)}, scheme="venv")
    # pip of this environment installs into the new one, offline. Most modules are never imported.
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    pip += ["--python", str(python), "install", "--no-compile", "--no-deps", "--no-index"]
    run([*pip, str(wheel)])
    # The .pth file adds only the folders of the dependencies. Python does not read .pth files in
    # these folders, so an editable checkout is not found.
    borrowed = sorted({sysconfig.get_path("purelib"), sysconfig.get_path("platlib")})
    (Path(purelib) / "borrowed.pth").write_text("\n".join(borrowed) + "\n", encoding="utf-8")
    bring_loops(Path(purelib) / "napari_hmrf")
    return python


def bring_loops(installed: Path) -> None:
    """Copy the compiled loops of this checkout if their sources are equal."""
    package = ROOT / "napari_hmrf"
    for source in package.rglob("*.py"):
        target = installed / source.relative_to(package)
        if target.exists() and target.read_bytes() == source.read_bytes():
            shutil.copystat(source, target)  # numba compares the modification times.
    for kept in package.rglob("*.nb[ic]"):
        target = installed / kept.relative_to(package)
        target.parent.mkdir(exist_ok=True)
        shutil.copy2(kept, target)


def run(command: list[str], **options) -> str:
    """Run a command, assert that it succeeds, and return its output."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment["NUMBA_NUM_THREADS"] = "1"  # Other tests run beside this one.
    done = subprocess.run(command, capture_output=True, text=True, env=environment, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_wheel_contains_only_the_package_and_its_data(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.partition("/")[0] for name in names}
    assert tops == {"napari_hmrf", f"napari_hmrf-{napari_hmrf.__version__}.dist-info"}
    assert "napari_hmrf/napari.yaml" in names
    assert "napari_hmrf/py.typed" in names
    for folder, ending in (("shaders", ".glsl"), ("sample_data", ".npz")):
        own = {path.name for path in (ROOT / folder).iterdir() if path.suffix == ending}
        packed = {Path(name).name for name in names if name.startswith(f"napari_hmrf/{folder}/")}
        assert own
        assert own <= packed
    built = re.compile(r"(^|/)test_|tests/|__pycache__|\.\w+_cache|\.nb[ic]$")
    assert not [name for name in names if built.search(name)]


def test_an_installed_wheel_solves_from_another_folder(elsewhere, tmp_path):
    assert run([str(elsewhere), "-c", SOLVE_ELSEWHERE], cwd=tmp_path).strip() == "solved True"


def test_the_installed_command_runs_from_another_folder(elsewhere, tmp_path):
    command = elsewhere.parent / ("napari-hmrf.exe" if os.name == "nt" else "napari-hmrf")
    printed = run(
        [str(command), "demo", "--size", "16", "--backend", "cpu", "--no-window", "--out", "here"],
        cwd=tmp_path,
    )
    assert "mean energy" in printed
    assert (tmp_path / "here" / "solution.npz").is_file()


def test_napari_finds_the_plugin_in_the_wheel(elsewhere, tmp_path):
    pytest.importorskip("npe2")
    code = "import npe2; print(npe2.PluginManifest.from_distribution('napari-hmrf').name)"
    assert run([str(elsewhere), "-c", code], cwd=tmp_path).strip() == "napari-hmrf"
