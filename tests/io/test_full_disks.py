"""Tests of a full disk, on which no function that writes may change earlier files."""

import ast
import os
from pathlib import Path

import pytest

import napari_hmrf
from validation.studies import robustness

pytest.importorskip("SimpleITK")

PACKAGE = Path(napari_hmrf.__file__).parent
#: Writers of each kind: an archive, images that SimpleITK writes, and several files at once.
WRITERS = (
    "io.study_file.write_study",
    *(f"io.fields.write_field {suffix}" for suffix in (".nii.gz", ".mha", ".nrrd", ".h5")),
    "io.case.solve_case",
)
#: Modules that may write to a disk directly; all others use `write_whole`.
_BY_THEMSELVES = ("atomic_write.py", "io/itk_reader.py", "compute/compile_cache/", "compiling.py")
_WAYS = (
    *("write_text", "write_bytes", "savez", "savez_compressed", "tofile", "savefig", "imsave"),
    *("imwrite", "WriteImage", "WriteTransform"),
)


@pytest.mark.usefixtures("child_process")  # HDF5 may crash when this process ends
@pytest.mark.skipif(os.name != "posix", reason="needs the POSIX limit of file sizes")
@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_changes_no_earlier_file(name, tmp_path):
    """Limit the size of a file; `make disks` tries all writers."""
    write = robustness.writers()[name]
    write(tmp_path)
    before = robustness.contents(tmp_path)
    smallest = min(map(len, before.values()))
    for limit in (1, smallest // 2):
        with robustness.limited(limit):
            assert robustness.outcome(write, tmp_path, before) == ""


def modules_with(*words):
    """Yield the modules that contain one of some words, and their text."""
    for module in sorted(PACKAGE.rglob("*.py")):
        text = module.read_text(encoding="utf-8")
        if any(word in text for word in words):
            yield module, text


def writes(text):
    """Yield the lines of a module that write to a disk or use the folder for temporary files."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names] + [getattr(node, "module", "") or ""]
            if "tempfile" in names:  # The folder for temporary files may be full.
                yield node.lineno
        if not isinstance(node, ast.Call):
            continue
        called = getattr(node.func, "attr", getattr(node.func, "id", ""))
        if called == "open" and isinstance(node.func, ast.Name):
            mode = ast.unparse(node.args[1]) if len(node.args) > 1 else "'r'"
            if set(mode) & set("wax+"):
                yield node.lineno
        # These names denote buffers in memory.
        elif called in _WAYS and not {"buffer", "file"} & {ast.unparse(each) for each in node.args}:
            yield node.lineno


def test_all_modules_write_through_write_whole():
    found = {
        f"{where}:{line}"
        for module, text in modules_with("tempfile", "open(", *_WAYS)
        if not (where := module.relative_to(PACKAGE).as_posix()).startswith(_BY_THEMSELVES)
        for line in writes(text)
    }
    assert not found
