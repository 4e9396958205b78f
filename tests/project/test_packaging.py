"""Campaign with the contents of the wheel; `make wheel` installs it."""

import re
import subprocess
import sys
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


def test_the_wheel_contains_only_the_package_and_its_data(tmp_path):
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir"]
    subprocess.run([*command, str(tmp_path), str(ROOT)], check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
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
