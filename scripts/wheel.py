"""Test of the wheel with the oldest and the newest napari that the package allows.

    python scripts/wheel.py [oldest] [newest]

The wheel is built from this checkout and installed into new environments in temporary folders: one
with the lower bounds of all dependencies, which `.github/oldest.txt` lists, and one with the newest
versions. In each environment the command ``napari-hmrf selftest`` checks the solver; napari then
opens a sample in a window, and the dock of the plugin deforms it. The test requires a display and
the network, and takes some minutes, because each environment compiles the loops.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
#: Options of pip for each environment.
VERSIONS = {"oldest": ["--constraint", str(ROOT / ".github" / "oldest.txt")], "newest": []}
#: Program that opens the plugin in napari, as a user does.
IN_NAPARI = """
import sys, time
from importlib.metadata import version
import napari, napari_hmrf

assert napari_hmrf.__file__.startswith(sys.prefix), napari_hmrf.__file__
viewer = napari.Viewer()
viewer.open_sample("napari-hmrf", "growth")
_, dock = viewer.window.add_plugin_dock_widget("napari-hmrf", "Soft tissue")
finished = []
dock.finished.connect(finished.append)
dock.deform()
ends = time.monotonic() + 300
while not finished and time.monotonic() < ends:
    napari.qt.get_qapp().processEvents()
assert finished and dock.solution is not None, dock.status
moved = abs(dock.solution.displacement).max()
assert moved > 1, moved
print(f"napari {version('napari')}, npe2 {version('npe2')}: a sample moves by up to {moved:.1f} px")
viewer.close()
"""


def run(*command: object, folder: Path = ROOT) -> None:
    """Run a command of an environment; exit if it fails."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run([*map(str, command)], cwd=folder, env=environment)
    if done.returncode:
        sys.exit(f"failed: {' '.join(map(str, command))}")


def install(python: Path, *wanted: object) -> None:
    """Install packages into an environment, with uv if it is installed here, or with pip."""
    if importlib.util.find_spec("uv"):
        run(sys.executable, "-m", "uv", "pip", "install", "--quiet", "--python", python, *wanted)
    else:
        run(sys.executable, "-m", "pip", "--quiet", "--python", python, "install", *wanted)


def check(wheel: Path, name: str, folder: Path) -> None:
    """Install the wheel into a new environment, and run the self-test and napari."""
    venv.create(folder / name, with_pip=False, symlinks=os.name != "nt")
    scripts = folder / name / ("Scripts" if os.name == "nt" else "bin")
    install(scripts / "python", f"napari-hmrf[all] @ {wheel.as_uri()}", *VERSIONS[name])
    run(scripts / "napari-hmrf", "selftest", folder=folder)
    run(scripts / "python", "-c", IN_NAPARI, folder=folder)


def main(names: list[str]) -> None:
    """Build the wheel, and check it with the given or all versions of its dependencies."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, ROOT)
        (wheel,) = folder.glob("*.whl")
        for versions in names or VERSIONS:
            print(f"\n{versions} versions", flush=True)
            check(wheel, versions, folder)
    print(f"{wheel.name} works with the {' and '.join(names or VERSIONS)} versions")


if __name__ == "__main__":
    main(sys.argv[1:])
