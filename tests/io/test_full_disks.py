"""Whatever writes files leaves earlier ones as they are where there is no room."""

import ast
import os
from pathlib import Path

import full_disks
import pytest

import napari_hmrf

pytest.importorskip("SimpleITK")

PACKAGE = Path(napari_hmrf.__file__).parent
#: Verbs by which functions that write files are named, beside methods called `save`.
_VERBS = ("save_", "write_", "export_")
#: Functions of these names that write no file of their own: through another one of the list.
_THROUGH_OTHERS = {
    "atomic_write.write_whole",
    "samples.demo.write_results",
    "samples.volume_demo.write_volume_results",
}
#: Modules that may write to a disk themselves: all others write by `write_whole`.
_BY_THEMSELVES = ("atomic_write.py", "io/itk_decoder.py", "solver/backends/", "compiling.py")
_WAYS = (
    *("write_text", "write_bytes", "savez", "savez_compressed", "tofile", "savefig", "imsave"),
    *("imwrite", "WriteImage", "WriteTransform"),
)


@pytest.mark.skipif(os.name != "posix", reason="the limit of a file's size is of POSIX")
@pytest.mark.parametrize("writer", full_disks.writers(), ids=lambda each: each.name)
def test_a_file_that_may_not_grow_leaves_all_as_it_was(writer, tmp_path):
    """Full disks, and commands: `python benchmarks/full_disks.py --commands`."""
    writer.write(tmp_path)
    before = full_disks.contents(tmp_path)
    smallest = min(map(len, before.values()))
    for limit in (1, smallest // 2):
        with full_disks.limited(limit):
            assert full_disks.outcome(writer, tmp_path, before) == ""


def functions_that_write():
    for module in sorted(PACKAGE.rglob("*.py")):
        name = module.relative_to(PACKAGE).with_suffix("").as_posix().replace("/", ".")
        for node in ast.parse(module.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.FunctionDef) and node.name.startswith(_VERBS):
                yield f"{name}.{node.name}"
            elif isinstance(node, ast.ClassDef) and not name.startswith(("ui.", "layers.")):
                methods = (each for each in node.body if isinstance(each, ast.FunctionDef))
                yield from (
                    f"{name}.{node.name}.{each.name}" for each in methods if each.name == "save"
                )


def test_every_function_that_writes_is_tried():
    tried = {writer.name.split()[0] for writer in full_disks.writers()}
    assert set(functions_that_write()) - _THROUGH_OTHERS <= tried


def writes(module):
    """Lines of a module that write to a disk, or to the folder for temporary files."""
    for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names] + [getattr(node, "module", "") or ""]
            if "tempfile" in names:  # its folder may be full
                yield node.lineno
        if not isinstance(node, ast.Call):
            continue
        called = ast.unparse(node.func).rpartition(".")[2]
        given = [ast.unparse(each) for each in node.args]
        if called == "open" and isinstance(node.func, ast.Name):
            mode = given[1] if len(given) > 1 else "'r'"
            if set(mode) & set("wax+"):
                yield node.lineno
        elif called in _WAYS and not {"buffer", "file"} & set(given):  # names of what is in memory
            yield node.lineno


def test_all_is_written_in_the_one_way_that_keeps_what_is_there():
    found = {
        f"{where}:{line}"
        for module in sorted(PACKAGE.rglob("*.py"))
        if not (where := module.relative_to(PACKAGE).as_posix()).startswith(_BY_THEMSELVES)
        for line in writes(module)
    }
    assert not found
