"""Tests of the documentation: reference, links, runnable blocks, examples and metadata."""

import ast
import doctest
import importlib.util
import os.path
import pydoc
import re
import textwrap
import tomllib
from pathlib import Path

import pytest

from tests.support.public_names import PACKAGES, public_names

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
REFERENCE = sorted(DOCS.glob("reference/*.md"))
EXAMPLES = sorted(ROOT.glob("examples/*.py"))
#: Pages with Python blocks that the tests run.
WITH_BLOCKS = [
    page
    for folder in ("tutorials", "how-to", "concepts")
    for page in sorted(DOCS.glob(f"{folder}/*.md"))
    if "```python" in page.read_text(encoding="utf-8")
]
#: Files at the top of the repository that are pages of the site.
AT_THE_TOP = [ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")]

pytestmark = pytest.mark.skipif(
    not (DOCS / "tutorials").exists(), reason="needs a checkout of the repository"
)


def read(file: Path) -> str:
    return file.read_text(encoding="utf-8")


def pages() -> list[Path]:
    """Return the source pages of the site, without built pages."""
    return sorted(page for page in DOCS.rglob("*.md") if "_build" not in page.parts)


def markdown_files() -> list[Path]:
    """Return all Markdown files of the repository, except built and installed files."""
    skipped = {"_build", "build", "dist", "node_modules"}
    files = [
        *ROOT.glob("*.md"),
        *(file for each in ROOT.glob("[a-z]*/") for file in each.rglob("*.md")),
    ]
    return [file for file in sorted(files) if not skipped & set(file.relative_to(ROOT).parts)]


def name(file: Path) -> str:
    return file.relative_to(ROOT).as_posix()


def without_code(text: str) -> str:
    return re.sub(r"```.*?```|`[^`\n]*`", "", text, flags=re.DOTALL)


def links(page: Path) -> list[tuple[str, str]]:
    """Return the links of a page within the repository, as pairs of file and heading."""
    found = re.findall(r"\]\(([^)\s]+)\)", without_code(read(page)))
    inside = [target for target in found if not target.startswith(("https:", "http:"))]
    return [(file, heading) for file, _, heading in (link.partition("#") for link in inside)]


def in_menu(page: Path) -> list[str]:
    """Return the pages that a page lists in its menu."""
    blocks = re.findall(r"```\{toctree\}\n(.*?)```", read(page), flags=re.DOTALL)
    lines = [line.strip() for block in blocks for line in block.splitlines()]
    entries = [line for line in lines if line and not line.startswith(":")]
    return [re.sub(r".*<(.*)>", r"\1", entry) + ".md" for entry in entries]


def headings(page: Path) -> set[str]:
    """Return the anchors of the headings of a page, as GitHub and the site make them."""
    titles = re.findall(r"^#+ (.*)$", re.sub(r"```.*?```", "", read(page), flags=re.DOTALL), re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.fixture(scope="module")
def conf():
    """Return the module that configures the site; loading it does not require Sphinx."""
    spec = importlib.util.spec_from_file_location("the_conf", DOCS / "conf.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def described() -> list[tuple[str, list[str]]]:
    """Return each name in the reference with the members listed there."""
    found = []
    for page in REFERENCE:
        for block in re.findall(r"```\{eval-rst\}\n(.*?)```", read(page), flags=re.DOTALL):
            (full,) = re.findall(r"^\.\. (?:auto|py:)\w+:: napari_hmrf\.(\S+)$", block, re.M)
            members = re.findall(r"^ +:(?:special-)?members: (.+)$", block, re.M)
            found.append((full, [each for some in members for each in some.split(", ")]))
    return found


def test_the_reference_describes_each_public_name_once():
    internal = ("solver.", "study.", "augmentation.", "io.")
    public = [full for full, _ in described() if not full.startswith(internal)]
    assert sorted(public) == sorted(public_names())


def test_each_name_in_the_reference_exists_and_has_a_docstring():
    for full, members in described():
        found = pydoc.locate(f"napari_hmrf.{full}")
        assert found is not None, full
        for member in members:
            assert getattr(found, member).__doc__, f"{full}.{member}"


def test_every_public_class_and_function_has_a_docstring():
    for public, found in public_names().items():
        if callable(found):
            assert ast.get_docstring(ast.parse(f'"""{found.__doc__}"""')), public
            assert not found.__doc__.startswith(f"{found.__name__}("), (
                f"{public}: default docstring of a dataclass"
            )


def test_links_point_to_existing_files_and_headings():
    assert {*pages(), *AT_THE_TOP} < set(markdown_files())
    for page in markdown_files():
        for file, heading in links(page):
            target = Path(os.path.normpath(page.parent / file)) if file else page
            assert target.exists(), f"{name(page)}: {file}"
            if heading:
                assert heading in headings(target), f"{name(page)}: {file}#{heading}"
        for file in in_menu(page):
            assert (page.parent / file).exists(), f"{name(page)}: {file}"


def test_every_page_is_linked_from_the_first_page():
    reached, todo = set(), [DOCS / "index.md"]
    while todo:
        page = todo.pop()
        if page in reached or page.suffix != ".md":
            continue
        reached.add(page)
        linked = [*(file for file, _ in links(page) if file), *in_menu(page)]
        todo += [Path(os.path.normpath(page.parent / file)) for file in linked]
    assert set(pages()) <= reached


def test_every_page_is_in_the_menu(conf):
    """Check the menu of the first page and the README of each folder, which the menu includes."""
    shown = {DOCS / "index.md", *(DOCS / file for file in in_menu(DOCS / "index.md"))}
    for readme in DOCS.rglob("README.md"):
        listed = re.findall(r"^([\w-]+)$", conf.contents(read(readme)), re.M)
        listed_pages = {readme.parent / f"{entry}.md" for entry in listed}
        shown |= {page for page in listed_pages if not page.with_suffix(".ipynb").exists()}
    assert shown == set(pages())


def test_links_of_the_site_point_to_the_files_of_the_repository(conf):
    places = {file: place for place, file in conf.SHOWN.items()}
    for page in (*pages(), *AT_THE_TOP):
        place = places.get(name(page), name(page).removeprefix("docs/").removesuffix(".md"))
        turned = conf.turned(without_code(read(page)), name(page), place)
        for target in re.findall(r"\]\((?!https?:)([^)#\s]+)", turned):
            there = Path(os.path.normpath((DOCS / place).parent / target))
            assert there.exists(), f"{name(page)}: {target}"
            assert there not in AT_THE_TOP, f"{name(page)}: {target} is a page of the site"


def test_the_pages_at_the_top_of_the_repository_are_on_the_site(conf):
    assert {ROOT / file for file in conf.SHOWN.values()} == set(AT_THE_TOP)


@pytest.mark.parametrize("page", WITH_BLOCKS, ids=name)
def test_python_blocks_of_the_pages_print_the_shown_output(page):
    """Run each ```python block; code that the tests cannot run is in a ```py block."""
    blocks = re.findall(r"^( *)```python\n(.*?)```", read(page), flags=re.DOTALL | re.M)
    assert all(">>> " in block for _, block in blocks)
    code = "\n".join(textwrap.dedent(block) for _, block in blocks)
    test = doctest.DocTestParser().get_doctest(code, {}, page.name, str(page), 0)
    said: list[str] = []
    doctest.DocTestRunner().run(test, out=said.append)
    assert said == []
    assert test.examples


def test_each_example_is_short_uses_public_names_and_is_on_the_site():
    assert len(EXAMPLES) == 15
    shown = re.findall(
        r"\{literalinclude\} ../../examples/(\w+\.py)$", read(DOCS / "examples/README.md"), re.M
    )
    assert sorted(shown) == [example.name for example in EXAMPLES]
    for example in EXAMPLES:
        text = read(example)
        assert len(text.splitlines()) <= 60, example.name
        tree = ast.parse(text)
        assert ast.get_docstring(tree), example.name
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module.startswith("napari_hmrf"):
                assert node.module in PACKAGES, f"{example.name}: {node.module}"
                assert {each.name for each in node.names} <= set(PACKAGES[node.module].__all__)


def test_the_site_is_built_with_declared_packages_and_warnings_as_errors():
    extras = tomllib.loads(read(ROOT / "pyproject.toml"))["project"]["optional-dependencies"]
    wanted = {re.match(r"[\w-]+", each)[0] for each in extras["docs"]}
    assert wanted == {"furo", "myst-parser", "sphinx"}
    versions = {line.split("==")[0].lower() for line in read(ROOT / "constraints.txt").splitlines()}
    assert wanted <= versions, "constraints.txt does not pin a package that builds the site"
    assert re.search(
        r"^docs: setup-for-docs\n\t.*sphinx -W --keep-going", read(ROOT / "Makefile"), re.M
    )
    assert "docs/_build/" in read(ROOT / ".gitignore").splitlines()
    for page in ("README.md", "CONTRIBUTING.md"):
        assert "`make docs`" in read(ROOT / page)


def test_each_given_address_is_valid():
    """Addresses are added by the owner; until then the fields are missing."""
    project = tomllib.loads(read(ROOT / "pyproject.toml"))["project"]
    for what, address in project.get("urls", {}).items():
        assert address.startswith("https://"), what
    citation = re.findall(r"^(repository-code|url|doi):(.*)$", read(ROOT / "CITATION.cff"), re.M)
    for what, value in citation:
        assert re.match(r' "?(https://|10\.)', value), what
    owner = read(DOCS / "development" / "owner.md")
    for named in ("pyproject.toml", "CITATION.cff", "PyPI", "conda-forge", "make docs", "Zenodo"):
        assert named in owner


def test_workflows_and_templates_are_valid_and_refer_to_existing_jobs():
    yaml = pytest.importorskip("yaml")
    files = [*ROOT.glob(".github/**/*.yml"), ROOT / ".pre-commit-config.yaml"]
    contents = {file.name: yaml.safe_load(read(file)) for file in files}
    hooks = [
        hook for repo in contents[".pre-commit-config.yaml"]["repos"] for hook in repo["hooks"]
    ]
    assert [hook["id"] for hook in hooks] == ["ruff-format", "ruff-check", "mypy"]
    assert {hook["language"] for hook in hooks} == {"system"}, "a hook is fetched"
    release = contents["release.yml"]["jobs"]
    assert release["publish"]["needs"] == "build"
    assert release["publish"]["permissions"] == {"id-token": "write"}
    assert "secrets" not in read(ROOT / ".github/workflows/release.yml")
    assert {"run": "make docs"} in contents["test.yml"]["jobs"]["docs"]["steps"]
    for template in ("bug_report.yml", "feature_request.yml"):
        assert {"name", "description", "body"} <= set(contents[template])
