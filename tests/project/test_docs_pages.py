"""Tests of the documentation pages: links, commands, notebooks, pictures and reference."""

import importlib.util
import re
import shlex
import sys
from pathlib import Path

import pytest

from napari_hmrf.command_line import parser_of_commands
from napari_hmrf.ui.motion.tools import TOOLS

ROOT = next(
    folder for folder in Path(__file__).resolve().parents if (folder / "pyproject.toml").exists()
)
DOCS = ROOT / "docs"
SHEET = DOCS / "reference" / "cheat-sheet.md"
NOTEBOOKS = sorted(DOCS.glob("notebooks/*.ipynb"))

pytestmark = pytest.mark.skipif(
    not (DOCS / "tutorials").exists(), reason="needs a checkout of the repository"
)


def read(file):
    return file.read_text(encoding="utf-8")


def name(file):
    return file.relative_to(ROOT).as_posix()


@pytest.fixture(scope="module")
def conf():
    """Return the module that configures the site; loading it does not require Sphinx."""
    spec = importlib.util.spec_from_file_location("conf_of_the_site", DOCS / "conf.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_pages_are_sorted_into_tutorials_guides_concepts_and_reference(conf):
    kinds = {"tutorials", "how-to", "concepts", "reference"}
    further = {"validation", "development", "notebooks", "examples"}
    folders = {path.parent.name for path in DOCS.glob("*/*.md")}
    assert folders == kinds | further
    menu = read(DOCS / "index.md")
    captions = re.findall(r"^:caption: (.*)$", menu, re.MULTILINE)
    assert captions[:4] == ["Tutorials", "How-to guides", "Concepts", "Reference"]
    for kind in kinds:
        assert f"{kind}/README" in menu


def test_sentences_are_about_software_and_begin_with_their_subject(conf):
    """Apply the rules for docstrings and messages to the pages that users read."""
    spec = importlib.util.spec_from_file_location("words_of_pages", ROOT / "scripts" / "words.py")
    words = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = words  # Dataclasses look the module up here.
    spec.loader.exec_module(words)
    folders = ("tutorials", "how-to", "concepts", "reference", "examples", "notebooks")
    pages = [page for folder in folders for page in DOCS.glob(f"{folder}/*.md")]
    texts = {page: read(page) for page in [*pages, DOCS / "index.md", DOCS / "method.md"]}
    texts |= {page: conf.notebook_page(read(page)) for page in NOTEBOOKS}
    found = []
    for page, text in texts.items():
        prose = re.sub(r"```.*?```|`[^`\n]*`", "", text, flags=re.DOTALL)
        for match in [*words.PEOPLE.finditer(prose), *FRONTED.finditer(prose)]:
            line = " ".join(prose[max(0, match.start() - 40) : match.end() + 40].split())
            if not re.search(
                r"napari(-hmrf)? asks|and asks for|readers who want|you do not want", line
            ):
                found.append(f"{name(page)}: ...{line}...")
    assert found == []


#: Sentence openings that hide the subject.
FRONTED = re.compile(r"(?:(?<=[.:!?] )|(?<=\n\n)|(?<=- ))(?:Whether|Have|Of (?!a patch))\b")


def test_a_link_to_a_file_outside_the_docs_becomes_a_download(conf):
    text = "[shaders](../../shaders/README.md#x), [page](../index.md), [code](../../docs/conf.py)"
    assert conf.offer_files(text, "development/contributing") == text.replace(
        "../../shaders", "path:../../shaders"
    )


# Shell


def shell_lines():
    """Yield each command line in the documentation that starts with `napari-hmrf`, and its page."""
    for page in [*DOCS.rglob("*.md"), ROOT / "README.md"]:
        if "_build" not in page.parts:
            for block in re.findall(r"```sh\n(.*?)```", read(page), flags=re.DOTALL):
                for line in block.replace("\\\n", " ").splitlines():
                    if line.strip().startswith("napari-hmrf "):
                        yield name(page), line.strip()


def test_each_command_line_of_the_documentation_can_be_parsed(capsys):
    lines = list(shell_lines())
    assert len(lines) > 15
    for page, line in lines:
        try:
            parser_of_commands().parse_args(shlex.split(line)[1:])
        except SystemExit:
            pytest.fail(f"{page}: {line}\n{capsys.readouterr().err}")


def test_the_shell_reference_has_every_command_and_option(conf):
    text = conf.shell_commands()
    parser = parser_of_commands()
    commands = parser._subparsers._group_actions[0].choices
    assert re.findall(r"^## (.*)$", text, re.MULTILINE) == list(commands)
    sections = dict(re.findall(r"^## (\S+)\n(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL))
    for command, options in commands.items():
        for action in options._actions:
            for option in action.option_strings or [action.metavar]:
                if option not in ("-h", "--help"):
                    assert f"{option}" in sections[command], f"{command}: {option}"
        assert "%(" not in sections[command]
        assert f"napari-hmrf {command}" in sections[command].split("Example:")[1]
    assert conf.SHELL_PAGE == "reference/shell"
    content = [read(DOCS / "reference" / "shell.md")]
    conf.show(None, conf.SHELL_PAGE, content)
    assert content[0].endswith(text)


# Cheat sheet


def rows(title):
    """Return the cells of the table under a heading of the cheat sheet."""
    section = read(SHEET).split(f"## {title}\n")[1].split("\n## ")[0]
    table = re.findall(r"^\| (.*) \|$", section, re.MULTILINE)
    return [[cell.strip() for cell in row.split(" | ")] for row in table[2:]]


def test_the_cheat_sheet_has_each_tool_with_its_key():
    sheet = [(tool.strip("*"), key.strip("`")) for tool, key, _ in rows("Tools")]
    assert sheet == [(tool.title, tool.key) for tool in TOOLS]


def test_the_cheat_sheet_has_each_key_that_is_bound():
    from napari_hmrf.layers.viewer_undo import KEYS
    from napari_hmrf.ui.motion.arrows import DEPTH_KEYS
    from napari_hmrf.ui.motion.pointer import Pointer
    from napari_hmrf.ui.result.result_form import BEFORE_KEY

    shown = {
        key for key, _ in rows("Keys anywhere in the viewer") for key in re.findall(r"`(.*?)`", key)
    }
    bound = {key.replace("Control", "Ctrl").replace("-", "+") for key in (*KEYS, BEFORE_KEY)}
    assert shown == bound | {"Ctrl+Shift+P"}
    keys = set(Pointer.keys.fget(_Anything())) - {tool.key for tool in TOOLS}
    shown = {
        key for key, _ in rows("Keys while a tool is active") for key in re.findall(r"`(.*?)`", key)
    }
    assert shown == keys | {"Shift", "Space", *DEPTH_KEYS}


class _Anything:
    """Object with any attribute, used as a pointer of which only the names of keys are read."""

    def __getattr__(self, name):
        return name if name.startswith("__") else self._do

    def _do(self, *_):
        """Do nothing."""


# Notebooks and pictures


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=name)
def test_a_notebook_runs_and_stores_no_outputs(notebook, conf, monkeypatch, tmp_path, capsys):
    import json

    import matplotlib as mpl

    cells = json.loads(read(notebook))["cells"]
    assert all(not cell.get("outputs") for cell in cells)
    assert len(read(notebook)) < 20_000
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(mpl, "rcParams", mpl.rcParams.copy())
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    names = {}
    try:
        for kind, source in conf.notebook_cells(read(notebook)):
            if kind == "code":
                exec(compile(source, notebook.name, "exec"), names)
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
    import numpy as np

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


def test_a_notebook_becomes_a_page_with_its_code(conf):
    (page,) = (path for path in NOTEBOOKS if path.stem == "growing-sphere")
    text = conf.notebook_page(read(page))
    assert text.startswith("# A growing sphere in 3-D\n")
    assert "```python\nimport matplotlib" in text
    listed = read(DOCS / "notebooks" / "README.md")
    for notebook in NOTEBOOKS:
        assert f"({notebook.name})" in listed


def test_links_of_notebooks_point_to_existing_files(conf):
    for notebook in NOTEBOOKS:
        text = conf.notebook_page(read(notebook))
        for target in re.findall(r"\]\((?!https?:)([^)#\s]+\.(?:md|png|ipynb))", text):
            assert (notebook.parent / target).exists(), f"{notebook.name}: {target}"


def test_each_example_and_notebook_has_a_small_picture():
    page = read(DOCS / "examples" / "README.md")
    pictures = [*DOCS.glob("examples/images/*.png"), *DOCS.glob("notebooks/images/*.png")]
    assert sum(picture.stat().st_size for picture in pictures) < 1_000_000
    drawn = {picture.stem for picture in DOCS.glob("examples/images/*.png")}
    assert drawn == {example.stem for example in ROOT.glob("examples/*.py")}
    for example in drawn:
        assert page.index(f"](images/{example}.png)") < page.index(f"../../examples/{example}.py")
    for notebook in NOTEBOOKS:
        assert f"](images/{notebook.stem}.png)" in read(notebook)
        assert (notebook.parent / "images" / f"{notebook.stem}.png").exists()
