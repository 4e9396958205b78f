"""Tests of the repository: imports between subpackages, dependencies, metadata and README."""

import ast
import importlib.util
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable
from functools import cache
from graphlib import TopologicalSorter
from importlib.metadata import metadata
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

import napari_hmrf
from napari_hmrf.command_line import parser_of_commands
from tests.support.public_names import PACKAGES

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "napari_hmrf"
MODULES = sorted(PACKAGE.rglob("*.py"))
ALL_MODULES = set(MODULES)
TESTS = ROOT / "tests"
TEST_FILES = sorted(file for file in TESTS.rglob("*.py") if file.name != "__init__.py")
SUPPORT = Path("support")
#: Folders of tests/ without a counterpart in the package.
FOLDERS_OF_TESTS = {SUPPORT, Path("benchmarks"), Path("project")}
HEAVY = ("napari", "qtpy", "PyQt6", "PySide6", "superqt", "magicgui", "moderngl", "glcontext")
HEAVY += ("numba", "matplotlib", "vispy", "pandas")
HEAVY += ("scipy.ndimage", "scipy.optimize", "scipy.linalg", "scipy.sparse")

#: Subpackages in levels: each imports only from lower levels. No module imports the public modules
#: at the top.
ROOMS = (
    FACADES := {"cases", "data", "fields", "landmarks", "loads", "random"},
    {"ui"},
    {"layers"},
    {"samples", "augmentation"},
    {"io"},
    {"posterior"},
    {"registration"},
    {"study"},
    {"tissue", "field"},
    {"solver"},
    LEAVES := {
        *("arguments", "array_file", "atomic_write", "errors", "extras", "regular_file"),
        *("resources", "wording"),
    },
)
#: Modules that import from higher levels, in functions or for types only. A `Solution` has methods
#: for functions of a displacement, which supply spacing and tissue; a `Grid` is made from an image.
LATE = {
    "posterior/uncertainty.py": {"io", "study"},
    "solver/solution.py": {"field", "io", "study"},
    "study/study.py": {"io"},
    # Names of a public package, which is a level, too.
    "tissue/__init__.py": {"field", "io", "solver", "tissue"},
}
#: Modules started by users, napari and other processes.
ENTRIES = {"__init__", "__main__", "cli", "command_line", "compiling", "contributions"}

pytestmark = pytest.mark.skipif(
    not (ROOT / "pyproject.toml").exists(), reason="needs a checkout of the repository"
)


def tracked_files() -> list[Path]:
    try:
        command = ["git", "ls-files", "-z"]
        listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("needs a git checkout")
    files = [ROOT / name for name in listed.stdout.split("\0") if name]
    return [file for file in files if file.is_file()]


class Import(NamedTuple):
    """Import statement of a module."""

    line: int
    #: Full names of the imported objects.
    names: frozenset[str]
    #: True if the statement is in a function.
    in_function: bool
    #: True if the statement runs when the module is imported.
    on_import: bool


@cache
def import_statements(module: Path) -> tuple[Import, ...]:
    """Return the import statements of a module."""
    found = []
    # Only statements are visited: expressions, most of the tree, contain no imports.
    todo = [(each, False, True) for each in parsed(module).body]
    while todo:
        node, in_function, on_import = todo.pop()
        if isinstance(node, ast.Import):
            names = frozenset(alias.name for alias in node.names)
            found.append(Import(node.lineno, names, in_function, on_import))
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} has a relative import"
            names = frozenset(f"{node.module}.{alias.name}" for alias in node.names)
            found.append(Import(node.lineno, names, in_function, on_import))
        in_function |= isinstance(node, ast.FunctionDef)
        for_types = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        runs = isinstance(node, ast.If | ast.Try | ast.ExceptHandler) and not for_types
        todo += [(each, in_function, on_import and runs) for each in statements_in(node)]
    return tuple(found)


def parsed(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


def statements_in(node: ast.AST) -> list[ast.AST]:
    """Return the statements, handlers and cases directly in a statement, handler or case."""
    blocks = ("body", "orelse", "handlers", "finalbody", "cases")
    return [each for name in blocks for each in getattr(node, name, ())]


def imports(module: Path, *, top_level_only: bool = False) -> frozenset[str]:
    """Return the full names of the imports of a module."""
    statements = import_statements(module)
    names = (each.names for each in statements if each.on_import or not top_level_only)
    return frozenset().union(*names)


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


@cache
def private_names_defined_in(module: Path) -> frozenset[str]:
    """Return the private names that a module defines: functions, classes, attributes, constants."""
    found = set()
    for node in ast.walk(parsed(module)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found.add(node.id)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            found |= {node.attr} if ast.unparse(node.value) in ("self", "cls") else set()
    return frozenset(filter(is_private, found))


def foreign_private_names(module: Path) -> list[str]:
    """Return the private names of foreign objects used by a module, as `line: name`.

    A private name is foreign unless this module defines it. Behind `self`, it is foreign unless any
    module of the window defines it, because it may be inherited. The public methods of named
    tuples that begin with an underscore are allowed.
    """
    ours = private_names_defined_in(module) | {"_replace", "_asdict", "_fields", "_make"}
    inherited = ours.union(*map(private_names_defined_in, OF_WINDOW))
    found = []
    for node in ast.walk(parsed(module)):
        if isinstance(node, ast.Attribute):
            own = ast.unparse(node.value) in ("self", "cls", "super()")
            used = [] if node.attr in (inherited if own else ours) else [node.attr]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("attr", "attrgetter")):
            starts = [arg.values[0] if isinstance(arg, ast.JoinedStr) else arg for arg in node.args]
            words = [str(each.value) for each in starts if isinstance(each, ast.Constant)]
            used = [word for word in words if word not in ours]
        elif isinstance(node, ast.ImportFrom) and not str(node.module).startswith("napari_hmrf"):
            used = str(node.module).split(".") + [alias.name for alias in node.names]
        elif isinstance(node, ast.Import):
            used = [name for alias in node.names for name in alias.name.split(".")]
        else:
            used = []
        found += [f"{node.lineno}: {name}" for name in used if is_private(name)]
    return found


def packages(names: Iterable[str]) -> set[str]:
    return {name.partition(".")[0] for name in names}


def part(module: Path) -> str:
    return module.relative_to(PACKAGE).as_posix()


#: Modules of the folders of the window.
OF_WINDOW = [each for each in MODULES if part(each).startswith(("ui/", "layers/"))]


def test_only_listed_modules_import_napari_qt_and_opengl():
    for module in MODULES:
        known = packages(imports(module))
        where = part(module)
        beside_napari = where.startswith(("layers/", "ui/", "cli.py", "contributions.py"))
        if not where.startswith("solver/backends/opengl/"):
            assert not known & {"moderngl", "glcontext"}, where
        if not where.startswith("ui/"):
            assert not known & {"qtpy", "superqt", "vispy"}, where
        if not beside_napari:
            assert not known & {"napari", "magicgui"}, where
        bindings = {"PyQt5", "PyQt6", "PySide2", "PySide6"}
        assert not known & bindings, f"{where} imports Qt without qtpy"


def test_only_one_module_uses_private_names_of_napari_vispy_and_qt():
    for module in OF_WINDOW:
        if part(module) != "layers/compat.py":
            assert foreign_private_names(module) == [], part(module)


def test_a_subpackage_imports_only_from_lower_levels():
    def height(room: str) -> int:
        return next(n for n, level in enumerate(ROOMS) if room in level)

    known = {each.name for each in PACKAGE.iterdir() if each.is_dir()} | LEAVES | FACADES
    for module in MODULES:
        here = part(module).removesuffix(".py").split("/")[0]
        late = part(module) in LATE
        names = imports(module, top_level_only=late)
        rooms = known & {name.split(".")[1] for name in names if name.startswith("napari_hmrf.")}
        rooms -= LEAVES if here in LEAVES else {here}
        if here not in ENTRIES:
            assert not {room for room in rooms if height(room) <= height(here)}, part(module)


@pytest.mark.parametrize("module", LATE)
def test_late_imports_are_listed(module):
    path = PACKAGE / module
    late = imports(path) - imports(path, top_level_only=True)
    assert {name.split(".")[1] for name in late} == LATE[module]


def test_an_import_in_a_function_states_its_reason():
    extras, heavy = extra_modules(), {*HEAVY, *LATER, *HEAVY_FOLDERS}
    for module in MODULES:
        late = [each for each in import_statements(module) if each.in_function]
        lines = module.read_text(encoding="utf-8").splitlines() if late else []
        for statement in late:
            where = f"{part(module)}:{statement.line}"
            stated = re.search(r"# (heavy|optional|above): (\w+)$", lines[statement.line - 1])
            assert stated, f"{where}: move it to the top, or state why it is here: CONTRIBUTING.md"
            reason, name = stated.groups()
            ours = {each for each in statement.names if each.startswith("napari_hmrf.")}
            if reason == "above":
                assert {each.split(".")[1] for each in ours} == {name}, where
                assert name in LATE[part(module)], where
                continue
            assert name in modules_loaded_by(statement), f"{where} imports no {name}"
            known = extras if reason == "optional" else heavy
            assert name in known, f"{where}: {name} is not {reason}"


#: Libraries that take long to import, in addition to `HEAVY`, and such folders of the package.
LATER = ("PIL", "numpy", "pint", "scipy", "skimage", "tifffile")
HEAVY_FOLDERS = ("opengl", "ui")


def modules_loaded_by(statement: Import) -> set[str]:
    """Return the libraries and modules of the package that an import loads."""
    found, todo = set(), list(statement.names)
    while todo:
        name = todo.pop()
        if name in found:
            continue
        found |= {name, *name.split(".")[:-1]}
        file = PACKAGE.parent.joinpath(*name.split("."))
        files = [file.with_suffix(".py"), file / "__init__.py", file.parent.with_suffix(".py")]
        module = next((each for each in files if each in ALL_MODULES), None)
        if module is not None:
            todo += imports(module, top_level_only=True)
    return found


def extra_modules() -> set[str]:
    """Return the modules of the optional dependencies."""
    extras = tomllib.loads(read("pyproject.toml"))["project"]["optional-dependencies"]
    wanted = [*extras["medical"], *extras["film"], *extras["monai"], *extras["cluster"]]
    named = {"simpleitk": "SimpleITK", "imageio-ffmpeg": "imageio_ffmpeg"}
    packages = [re.match(r"[\w-]+", requirement)[0] for requirement in wanted]
    return {named.get(each, each) for each in packages}


#: Names of parameters and attributes that contain objects of the package.
OURS = {
    *("binding", "controller", "dock", "drawing", "form", "guide", "materials", "model"),
    *("palette", "problem", "prior", "row", "rows", "rules", "solution", "stroke", "study"),
    *("table", "undo", "view"),
}


def test_objects_of_the_package_have_a_precise_type_in_the_window():
    for module in OF_WINDOW:
        for node in ast.walk(parsed(module)):
            if isinstance(node, ast.arg) and node.annotation is not None:
                name, annotation = node.arg, node.annotation
            elif isinstance(node, ast.AnnAssign):
                name, annotation = ast.unparse(node.target), node.annotation
            else:
                continue
            if name.rpartition(".")[2].lstrip("_") in OURS:
                words = re.findall(r"\w+", ast.unparse(annotation))
                assert "Any" not in words, f"{part(module)}:{node.lineno}: {name}"


def test_no_file_name_occurs_twice_in_the_package():
    twins = ("solver/priors/", "solver/backends/")
    public = {f"{name}.py" for name in FACADES}
    internal = [each for each in MODULES if part(each) not in public]
    names = [each.name for each in internal if not part(each).startswith(twins)]
    assert {name for name in names if names.count(name) > 1} == {"__init__.py"}


#: Folders of the backends, each with the modules and folders above it.
ABOVE = {
    "opengl/programs": ("opengl.context", "opengl.images", "opengl.volumes", "opengl.backend"),
    "opengl/context": ("opengl.images", "opengl.volumes", "opengl.backend"),
    "opengl/images": ("opengl.volumes", "opengl.backend"),
    "opengl/volumes": ("opengl.images", "opengl.backend"),
    "cpu": ("host", "opengl", "arrays"),
    "arrays": ("host", "opengl", "cpu"),
    "compile_cache": ("cpu", "arrays", "opengl", "host"),
    "direct": ("rigid", "cpu", "arrays", "opengl", "host"),
    "rigid": ("direct", "cpu", "arrays", "opengl", "host"),
}


@pytest.mark.parametrize("folder", ABOVE)
def test_a_folder_of_the_backends_imports_no_folder_above_it(folder):
    backends = "napari_hmrf.solver.backends."
    found = {
        name.removeprefix(backends)
        for module in (PACKAGE / "solver" / "backends" / folder).glob("*.py")
        for name in imports(module)
        if name.startswith(backends)
    }
    above = tuple(f"{each}." for each in ABOVE[folder])
    assert not [name for name in found if f"{name}.".startswith(above)]


def test_the_readme_of_the_shaders_names_existing_files():
    text = (ROOT / "shaders" / "README.md").read_text(encoding="utf-8")
    places = ROOT, ROOT / "shaders", PACKAGE / "solver" / "backends"
    named = set(re.findall(r"[\w/]+\.(?:glsl|py)\b", text))
    assert len(named) > 20
    assert not {name for name in named if not any((place / name).is_file() for place in places)}


@pytest.mark.parametrize("package", ["io", "solver", "solver/backends", "study"])
def test_the_docstring_of_a_package_names_its_modules(package):
    folder = PACKAGE / package
    text = ast.get_docstring(ast.parse((folder / "__init__.py").read_text(encoding="utf-8")))
    modules = {
        ".".join(each.relative_to(folder).with_suffix("").parts)
        for each in MODULES
        if each.is_relative_to(folder)
    }
    modules |= {name.removesuffix(".__init__") for name in modules}
    names = set(re.findall(r"(?<!`)`([a-z_.]+)`(?!`)", text))
    assert len(names & modules) > 9
    assert names - modules <= {"material", "open_backend"}


def test_the_page_on_architecture_lists_the_current_subpackages():
    written = subprocess.run(
        [sys.executable, "scripts/structure.py"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    room_names = {room for row in ROOMS for room in row if (PACKAGE / room).is_dir()}
    assert room_names == set(re.findall(r"^\| `(\w+)/`", written, flags=re.MULTILINE))
    assert written in read("docs/development/architecture.md"), "run `make structure`"


def test_imports_have_no_cycles_even_for_types():
    named = {
        ".".join(module.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): module
        for module in MODULES
    }
    needed = {}
    for name, module in named.items():
        names = imports(module, top_level_only=part(module) in LATE)
        found = {each if each in named else each.rpartition(".")[0] for each in names}
        needed[name] = found & (named.keys() - {name})
    TopologicalSorter(needed).prepare()


def test_the_commands_start_without_napari():
    assert "napari" not in packages(imports(PACKAGE / "cli.py", top_level_only=True))


def test_importing_packages_loads_no_heavy_library():
    """Import all packages in one process: no package then loads a heavy library alone, either."""
    lines = ["import sys"]
    for package in PACKAGES:
        lines.append(f"from {package} import *")  # The names, too: some are loaded on first use.
        lines.append(f"print({package!r}, [n for n in {HEAVY!r} if n in sys.modules])")
    command = [sys.executable, "-c", "\n".join(lines)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [f"{package} []" for package in PACKAGES]


def test_tests_mirror_the_package_and_share_only_support_modules():
    places: dict[str, set[str]] = {}
    for module in MODULES:
        places.setdefault(module.name, set()).add(part(module.parent))
    for file in TEST_FILES:
        here = file.parent.relative_to(TESTS)
        if here not in FOLDERS_OF_TESTS:
            assert (PACKAGE / here).is_dir(), file
            of_module = places.get(file.name.removeprefix("test_"), {here.as_posix()})
            assert here.as_posix() in of_module, f"{file}: a module elsewhere has this name"
        if here != SUPPORT:
            assert file.name.startswith("test_") or file.name == "conftest.py", file
        shared = {name for name in imports(file) if name.startswith("tests.")}
        assert all(name.startswith("tests.support.") for name in shared), file


def test_tests_wait_for_events_instead_of_sleeping():
    timers = ("sleep", "bot.wait", "qWait")
    for file in TEST_FILES:
        text = file.read_text(encoding="utf-8")
        if any(f"{timer}(" in text for timer in timers):
            calls = (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call))
            timed = [name for call in calls if (name := ast.unparse(call.func)).endswith(timers)]
            assert timed == [], f"{file}: use at_rest(), waitUntil or waitSignal"


@pytest.mark.parametrize("folder", ["benchmarks", "scripts", "examples"])
def test_benchmarks_scripts_and_examples_import_existing_modules(folder):
    for file in ROOT.glob(f"{folder}/**/*.py"):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        modules = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
        for module in {each for each in modules if each and each.startswith("napari_hmrf")}:
            assert importlib.util.find_spec(module), f"{file.name} imports {module}"


def test_declared_dependencies_are_the_imported_packages():
    project = tomllib.loads(read("pyproject.toml"))["project"]
    extras = project["optional-dependencies"]
    wanted = [*project["dependencies"], *extras["medical"], *extras["film"]]
    wanted += [*extras["monai"], *extras["cluster"]]
    declared = {re.match(r"[\w-]+", requirement)[0].lower() for requirement in wanted}
    imported = set().union(*(packages(imports(module)) for module in MODULES))
    others = {name.lower() for name in imported - sys.stdlib_module_names - {"napari_hmrf"}}
    named = {"skimage": "scikit-image", "pil": "pillow", "imageio_ffmpeg": "imageio-ffmpeg"}
    assert {named.get(name, name) for name in others} == declared


def test_the_lower_bounds_of_dependencies_are_tested_versions():
    bounds = tomllib.loads(read("pyproject.toml"))["project"]["dependencies"]
    oldest = [line for line in read(".github/oldest.txt").splitlines() if "==" in line]
    assert [line.replace(">=", "==") for line in bounds] == oldest


def test_no_committed_file_contains_a_personal_path():
    somewhere = re.compile(rb"(/home/\w|/Users/\w|/root\b|[A-Z]:\\Users|/work/\w|/tmp/\w)")
    for file in tracked_files():
        if file.resolve() == Path(__file__).resolve():
            continue
        found = somewhere.search(file.read_bytes())
        assert found is None, f"{file.relative_to(ROOT)} names {found[0]!r}"


def test_the_version_is_the_same_everywhere():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["version"] == napari_hmrf.__version__
    assert f"\nversion: {napari_hmrf.__version__}\n" in read("CITATION.cff")
    # The environment may be older than an edit of pyproject.toml, so compare only the name.
    assert metadata("napari-hmrf")["Name"] == project["name"]


def test_the_citation_names_the_paper_and_the_licence_of_the_project():
    yaml = pytest.importorskip("yaml")
    citation = yaml.safe_load(read("CITATION.cff"))
    project = tomllib.loads(read("pyproject.toml"))["project"]
    assert citation["cff-version"] == "1.2.0"
    assert {"message", "title", "authors"} <= set(citation)
    assert citation["license"] == project["license"]
    paper = citation["preferred-citation"]
    assert paper["title"] == (
        "Hierarchical Markov Random Fields Applied to Model Soft Tissue Deformations on "
        "Graphics Hardware"
    )
    assert paper["authors"][0]["family-names"] == "Seiler"
    assert "BSD 3-Clause" in read("LICENSE")


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md", ".ci/run"])
def test_every_mentioned_make_command_exists(page):
    targets = set(re.findall(r"^([a-z-]+):", read("Makefile"), flags=re.MULTILINE))
    mentioned = set(re.findall(r"\bmake ([a-z][a-z-]+)\b", code_in(page)))
    assert mentioned
    assert mentioned <= targets


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md"])
def test_every_mentioned_napari_hmrf_command_can_be_parsed(page):
    lines = re.findall(r"napari-hmrf ((?:demo|selftest)[^`\n#]*)", code_in(page))
    for line in lines:
        arguments = [word for word in line.split() if not word.startswith("[")]
        assert parser_of_commands().parse_args(arguments).command == arguments[0]


def test_the_readme_names_the_menus_as_napari_shows_them():
    yaml = pytest.importorskip("yaml")
    manifest = yaml.safe_load((PACKAGE / "napari.yaml").read_text(encoding="utf-8"))
    plugin, what = manifest["display_name"], manifest["contributions"]
    menus = " ".join(" ".join(re.findall(r"\*\*([^*]+ > [^*]+)\*\*", read("README.md"))).split())
    for widget in what["widgets"]:
        assert f"Plugins > {widget['display_name']} ({plugin})" in menus
    opened = re.findall(r"File > Open Sample > ([^>]+) > (.+?)(?= File| Plugins|$)", menus)
    assert opened
    for name, sample in opened:
        assert name == plugin
        assert sample in [each["display_name"] for each in what["sample_data"]]


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md"])
def test_every_linked_file_exists(page):
    links = re.findall(r"\]\((?!https?:)([^)#]+)[^)]*\)", read(page))
    for link in links:
        assert (ROOT / link).exists(), link


def test_the_python_example_of_the_readme_gives_the_described_result():
    (example,) = re.findall(r"```python\n(.*?)```", read("README.md"), flags=re.DOTALL)
    names = {}
    exec(compile(example, "README.md", "exec"), names)
    displacement = names["solution"].displacement
    assert displacement[32, 40] == pytest.approx((0, 6), abs=1e-3), (
        "the arrow does not pull the tissue"
    )
    assert np.abs(displacement[:, [0, -1]]).max() < 1e-3, "the edge moves"
    assert names["moved"].shape == names["image"].shape


def test_the_readme_has_at_most_120_lines():
    assert len(read("README.md").splitlines()) <= 120


def read(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def code_in(page: str) -> str:
    """Return the code blocks and inline code of a page, or the whole text of another file."""
    text = read(page)
    if not page.endswith(".md"):
        return text
    blocks = re.findall(r"```\w*\n(.*?)```|`([^`\n]+)`", text, flags=re.DOTALL)
    return "\n".join(block or inline for block, inline in blocks)


def test_each_mutated_line_occurs_once():
    sys.path.insert(0, str(ROOT / "scripts"))
    try:
        from mutations import MUTATIONS
    finally:
        sys.path.pop(0)
    assert len(MUTATIONS) >= 20
    for mutation in MUTATIONS:
        text = (ROOT / "napari_hmrf" / mutation.file).read_text(encoding="utf-8")
        assert text.count(mutation.right) == 1, f"{mutation.file}: {mutation.right}"
        assert mutation.right != mutation.wrong
        for test in mutation.tests.split():
            assert (TESTS / test.partition("::")[0]).is_file(), test
