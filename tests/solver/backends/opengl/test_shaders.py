"""Source text of the shaders and its composition; tests that run without OpenGL."""

from __future__ import annotations

import math
import re
from types import SimpleNamespace

import pytest

from napari_hmrf import BackendError
from napari_hmrf.resources import resource_folder
from napari_hmrf.solver.backends.opengl.programs import source
from napari_hmrf.solver.backends.opengl.programs.programs import compile_program
from napari_hmrf.solver.backends.opengl.programs.source import KERNELS, STAGES, compose, vertices
from napari_hmrf.solver.backends.opengl.programs.volume_source import (
    GROUP,
    MOST_BUFFERS,
    VOLUME_KERNELS,
    bindings,
    compose_volume,
)

FILES = sorted(resource_folder("shaders").glob("*.glsl"))
SHARED = {
    "common",
    "cliques",
    "elements",
    "ends",
    "forces",
    "hexahedra",
    "interpolation",
    "pulls",
    "scalars",
    "stage_fragment",
    "stage_compute",
    "stage_volume",
    "triangle",
    "volume",
    "volume_scalars",
    "volume_tile",
}


def defines(name: str) -> dict[str, int]:
    return dict.fromkeys(KERNELS[name].defines, 1)


def file_of(name: str) -> str:
    """Return the text of the file of a kernel."""
    stem = KERNELS[name].text if name in KERNELS else name
    return (resource_folder("shaders") / f"{stem}.glsl").read_text(encoding="utf-8")


def header(text: str) -> str:
    """Return the comment at the beginning of a file."""
    lines = []
    for line in text.splitlines():
        if not line.startswith("//"):
            break
        lines.append(line)
    return "\n".join(lines)


def test_every_file_is_a_kernel_or_shared():
    kernels = {kernel.text for kernel in KERNELS.values()} | set(VOLUME_KERNELS)
    assert {path.stem for path in FILES} == kernels | SHARED


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_file_states_its_border_rule(path):
    assert "Border rule:" in header(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", KERNELS)
def test_the_header_of_a_kernel_names_all_inputs_and_outputs(name):
    text = file_of(name)
    inputs, outputs = header(text).split("// Inputs:")[1].split("// Outputs:")
    uniforms = re.findall(r"^uniform \w+ (\w+)", text, flags=re.MULTILINE)
    for word in (*KERNELS[name].inputs, *uniforms):
        assert re.search(rf"\b{word}\b", inputs), f"{word} is not among the inputs"
    for word in KERNELS[name].outputs:
        assert re.search(rf"\b{word}\b", outputs), f"{word} is not among the outputs"


@pytest.mark.parametrize("name", VOLUME_KERNELS)
def test_the_header_of_a_volume_kernel_names_all_inputs_and_outputs(name):
    text, kernel = file_of(name), VOLUME_KERNELS[name]
    inputs, outputs = header(text).split("// Inputs:")[1].split("// Outputs:")
    for word in re.findall(r"^uniform \w+ (\w+)", text, flags=re.MULTILINE):
        assert re.search(rf"\b{word}\b", inputs), f"{word} is not among the inputs"
    for field in kernel.all_fields:
        if field.name == "places":
            continue  # declared by the stage
        for part, access in ((inputs, "writeonly"), (outputs, "readonly")):
            assert field.access == access or re.search(rf"\b{field.name}\b", part), field.name


@pytest.mark.parametrize("name", VOLUME_KERNELS)
def test_a_volume_kernel_stays_within_the_buffer_limit(name):
    most = {"PARAMETERS": 2, "SPRINGS": 1}
    kernel = VOLUME_KERNELS[name]
    given = {define: most[define] for define in kernel.defines}
    assert sum(parts for _, parts in bindings(kernel, given)) <= MOST_BUFFERS
    text = compose_volume(name, given).text
    assert text.startswith("#version 430")
    assert text.count("#version") == 1
    assert text.count("layout(std430") == len(bindings(kernel, given))
    assert file_of(name) in text
    assert 32 <= math.prod(GROUP) <= 256


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_no_shader_uses_functions_that_differ_between_drivers(path):
    code = re.sub(r"//.*", "", path.read_text(encoding="utf-8"))
    for call in ("texture", "textureLod", "pow", "normalize", "isnan", "precise", "fma", "dFdx"):
        assert not re.search(rf"\b{call}\b *\(?", code.replace("textureSize", "")), call
    assert "vec3" not in code


@pytest.mark.parametrize("name", KERNELS)
def test_both_stages_contain_the_same_kernel_text(name):
    text = file_of(name)
    for stage in STAGES:
        assert text in compose(name, stage, defines(name)).text


@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize("name", KERNELS)
def test_the_version_comes_first_and_only_once(name, stage):
    text = compose(name, stage, defines(name)).text
    assert text.startswith({"fragment": "#version 330", "compute": "#version 430"}[stage])
    assert text.count("#version") == 1


@pytest.mark.parametrize("stage", STAGES)
def test_line_directives_map_each_line_to_its_file(stage):
    composed = compose("icm", stage, {"BLANKET": 1, "STEPS": 4, "SQUARE": 0})
    seen = set()
    place: tuple[str, int] | None = None
    for line in composed.text.splitlines():
        directive = re.fullmatch(r"#line (\d+) (\d+)", line)
        if directive:
            number = int(directive[1]) - 1000 * int(directive[2])
            place = (composed.files[int(directive[2])], number)
            continue
        if place is not None:
            name, number = place
            if name.endswith(".glsl"):
                path = resource_folder("shaders") / name
                assert path.read_text(encoding="utf-8").splitlines()[number - 1] == line
                seen.add(name)
            place = (name, number + 1)
    assert seen == {"common.glsl", "cliques.glsl", "ends.glsl", "icm.glsl", f"stage_{stage}.glsl"}


@pytest.mark.parametrize(
    "log", ["0:2014(3): error: no", "2(2014) : error C0000: no", "ERROR: 2:2014: 'x' : no"]
)
def test_a_compiler_message_names_the_source_file(log):
    composed = compose("sum", "fragment", {"BLOCK": 8})
    explained = composed.explain(log)
    assert re.search(r"sum\.glsl[:(]14", explained.splitlines()[0])
    fourteenth = (resource_folder("shaders") / "sum.glsl").read_text().splitlines()[13]
    assert re.search(rf"sum\.glsl:14 \| {re.escape(fourteenth)}", explained)


@pytest.mark.parametrize("name", KERNELS)
def test_a_compile_error_names_the_kernel_and_its_file(name: str) -> None:
    def refuse(text: str) -> None:
        raise RuntimeError("no")

    ctx = SimpleNamespace(compute_shader=refuse, info={"GL_RENDERER": "none"})
    with pytest.raises(BackendError, match=rf"the kernel '{name}' \(\w+\.glsl\)") as raised:
        compile_program(ctx, name, "compute", defines(name))
    file = re.search(r"\((\w+\.glsl)\)", str(raised.value))[1]
    assert (resource_folder("shaders") / file).is_file()


def test_the_vertex_shader_has_no_uniforms():
    text = vertices().text
    assert text.startswith("#version 330")
    assert "uniform" not in text


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("icn", "fragment", {}), ["icn", "icm"]),
        (("sum", "geometry", {"BLOCK": 8}), ["geometry", "compute"]),
        (("sum", "fragment", {}), ["sum", "BLOCK"]),
        (("project", "fragment", {"BLOCK": 8}), ["project", "PAIRS", "BLOCK"]),
    ],
)
def test_an_invalid_kernel_stage_or_define_is_named(arguments, words):
    with pytest.raises(BackendError) as raised:
        compose(*arguments)
    for word in words:
        assert word in str(raised.value)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "install napari-hmrf again"),
        ("#version 330\nvoid kernel(ivec2 site) {}\n", "#version"),
        ("void kernel(ivec2 site) {} // \u00fc\n", "ASCII"),
    ],
)
def test_a_missing_or_broken_file_is_named(tmp_path, monkeypatch, content, words):
    for path in FILES:
        (tmp_path / path.name).write_bytes(path.read_bytes())
    if content is None:
        (tmp_path / "sum.glsl").unlink()
    else:
        (tmp_path / "sum.glsl").write_text(content, encoding="utf-8")
    monkeypatch.setattr(source, "resource_folder", lambda _: tmp_path)
    monkeypatch.setattr(source, "_text", source._text.__wrapped__)
    with pytest.raises(BackendError, match=r"sum\.glsl") as raised:
        compose("sum", "fragment", {"BLOCK": 8})
    assert words in str(raised.value)
