"""Campaigns that run the code of the documentation: blocks of the pages, commands, notebooks."""

import doctest
import json
import re
import shlex
import textwrap
from pathlib import Path

import numpy as np
import pytest

import napari_hmrf
from napari_hmrf.cli import read_command

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
#: Pages with Python blocks.
WITH_BLOCKS = [
    page
    for folder in ("tutorials", "how-to", "concepts")
    for page in sorted(DOCS.glob(f"{folder}/*.md"))
    if "```python" in page.read_text(encoding="utf-8")
]
NOTEBOOKS = sorted(DOCS.glob("notebooks/*.ipynb"))

pytestmark = [
    pytest.mark.campaign,
    pytest.mark.skipif(not WITH_BLOCKS, reason="needs a checkout of the repository"),
]


def read(file: Path) -> str:
    return file.read_text(encoding="utf-8")


def name(file: Path) -> str:
    return file.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("page", WITH_BLOCKS, ids=name)
def test_python_blocks_of_the_pages_print_the_shown_output(page):
    """Run each ```python block; code that cannot be run here is in a ```py block."""
    blocks = re.findall(r"^( *)```python\n(.*?)```", read(page), flags=re.DOTALL | re.M)
    assert all(">>> " in block for _, block in blocks)
    code = "\n".join(textwrap.dedent(block) for _, block in blocks)
    test = doctest.DocTestParser().get_doctest(code, {}, page.name, str(page), 0)
    said: list[str] = []
    doctest.DocTestRunner().run(test, out=said.append)
    assert said == []
    assert test.examples


def test_the_example_of_the_package_prints_the_shown_output():
    (example,) = doctest.DocTestFinder(recurse=False).find(napari_hmrf)
    said: list[str] = []
    doctest.DocTestRunner().run(example, out=said.append)
    assert said == []


def test_the_python_example_of_the_readme_gives_the_described_result():
    (example,) = re.findall(r"```python\n(.*?)```", read(ROOT / "README.md"), flags=re.DOTALL)
    names = {}
    exec(compile(example, "README.md", "exec"), names)
    displacement = names["solution"].displacement
    assert displacement[32, 40] == pytest.approx((0, 6), abs=1e-3), (
        "the arrow does not pull the tissue"
    )
    assert np.abs(displacement[:, [0, -1]]).max() < 1e-3, "the edge moves"
    assert names["moved"].shape == names["image"].shape


def command_lines():
    """Yield each command line in the documentation that starts with `napari-hmrf`, and its page."""
    for page in [*DOCS.rglob("*.md"), ROOT / "README.md"]:
        if "_build" not in page.parts:
            for block in re.findall(r"```sh\n(.*?)```", read(page), flags=re.DOTALL):
                for line in block.replace("\\\n", " ").splitlines():
                    if line.strip().startswith("napari-hmrf "):
                        yield name(page), line.strip()


def test_each_command_line_of_the_documentation_can_be_parsed(capsys):
    lines = list(command_lines())
    assert len(lines) > 15
    for page, line in lines:
        try:
            read_command(shlex.split(line)[1:])
        except SystemExit:
            pytest.fail(f"{page}: {line}\n{capsys.readouterr().err}")


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=name)
def test_a_notebook_runs_and_draws_what_it_claims(notebook, monkeypatch, tmp_path, capsys):
    import matplotlib as mpl

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(mpl, "rcParams", mpl.rcParams.copy())
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    names = {}
    try:
        for cell in json.loads(read(notebook))["cells"]:
            if cell["cell_type"] == "code":
                exec(compile("".join(cell["source"]), notebook.name, "exec"), names)
        assert plt.get_fignums()
    finally:
        plt.close("all")
    CLAIMS[notebook.stem](names, capsys.readouterr().out)


def _growing_sphere(names, printed):
    assert names["error"] < 0.05 * names["exact"].max(), (
        "the error exceeds that of the voxel staircase"
    )
    assert 8 < names["ball"].size_change < names["free"]
    assert "voxels that fold: 0" in printed


def _landmarks(names, _):
    def rms(where, model):
        return np.sqrt(np.mean(names["errors"][where, model][names["tissue"]] ** 2))

    assert rms("on edges", "elastic") < rms("on edges", "paper, converged")
    assert rms("on edges", "paper, converged") < rms("on edges", "paper")
    assert rms("anywhere", "paper, converged") < rms("anywhere", "elastic"), (
        "the order of the models differs from the text"
    )


def _augmentation(names, printed):
    assert len(names["samples"]) == 5
    assert len(re.findall("folds at 0$", printed, re.MULTILINE)) == 5
    for labels in names["labels"]:
        assert set(labels.ravel()) <= {0, 1, 2, 3}


#: Checks of the claims that the text of each notebook makes about its results.
CLAIMS = {
    "growing-sphere": _growing_sphere,
    "landmarks": _landmarks,
    "augmentation": _augmentation,
}
