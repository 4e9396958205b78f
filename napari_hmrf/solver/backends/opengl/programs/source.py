"""Source text of shaders, composed from the files of kernels.

A kernel is a function ``kernel(ivec2)`` that reads textures and assigns its outputs: the values of
one texel, which represents a site or a pair of sites (``common.glsl``). The same text becomes a
fragment shader (OpenGL 3.3; outputs are render targets) or a compute shader (OpenGL 4.3; outputs
are images). This module handles only text and does not use OpenGL.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal, get_args

from napari_hmrf.errors import BackendError
from napari_hmrf.resources import resource_folder

Stage = Literal["fragment", "compute"]
STAGES: tuple[str, ...] = get_args(Stage)
Define = int

#: Size of a compute work group in texels, (rows, cols).
GROUP = (16, 8)

#: GLSL version of each stage.
VERSIONS = {"vertex": 330, "fragment": 330, "compute": 430}
_TYPES = {1: "float", 2: "vec2", 4: "vec4"}
# Line numbers of file k begin at 1000 k + 1 so that they identify the file, which some compilers do
# not report.
_FILE_LINES = 1000
# Position in a log: "0:2014(3): error", "2(2014) : error" or "ERROR: 2:2014: ...".
_PLACE = re.compile(r"\b\d+([:(])(\d+)\b")


@dataclass(frozen=True)
class Kernel:
    """Inputs and outputs of a kernel.

    Attributes
    ----------
    name : str
    inputs : tuple of str
        Names of the textures that the kernel reads, in the order of their texture units.
    outputs : mapping of str to int
        Number of components (1, 2 or 4) of each variable that the kernel assigns, in target order.
    defines : tuple of str
        Names of preprocessor definitions that require a value.
    shared : tuple of str
        Names of the files that the kernel includes besides ``common.glsl``.
    tissue : bool
        True if the kernel runs only in tissue, because its outputs are 0 elsewhere. An invocation
        of the compute stage may then compute several vertically adjacent texels.
    carries : bool
        True if an invocation reuses values of each texel for the next. These kernels have a
        function ``enter``.
    sums, peaks : tuple of str
        Outputs of one component of which an invocation stores only the sum, or the largest value,
        of its texels.
    optional : mapping of str to str
        Outputs that the kernel has only if the given definition is not 0.
    of : str
        Name of another kernel that uses the same file but includes other files; empty if the
        kernel has a separate file.
    """

    name: str
    inputs: tuple[str, ...]
    outputs: Mapping[str, int]
    defines: tuple[str, ...] = ()
    shared: tuple[str, ...] = ()
    tissue: bool = False
    carries: bool = False
    sums: tuple[str, ...] = ()
    peaks: tuple[str, ...] = ()
    optional: Mapping[str, str] = field(default_factory=dict)
    of: str = ""

    @property
    def text(self) -> str:
        """Name of the kernel's file, without ``.glsl``."""
        return self.of or self.name

    def outputs_of(self, defines: Mapping[str, Define]) -> dict[str, int]:
        """Return the outputs of the kernel for given definitions."""
        return {
            name: components
            for name, components in self.outputs.items()
            if name not in self.optional or defines[self.optional[name]]
        }


_CLIQUES = ("displacement", "straight", "diagonal")
_HELD = ("inverse_diagonal", "springs")
_READING = ("BLANKET", "SQUARE")


def _around(*shared: str) -> dict[str, Any]:
    """Return the attributes of a kernel that reads the neighbours of a site."""
    return {"shared": shared, "tissue": True, "carries": True}


#: All kernels for images, by name.
KERNELS: Mapping[str, Kernel] = {
    kernel.name: kernel
    for kernel in (
        Kernel("project", ("finest",), {"values": 4}, ("PAIRS",)),
        Kernel("prolong", ("coarse", "coarse_stiffness", "stiffness"), {"fine": 4}),
        Kernel("ratios", ("stiffness",), {"straight": 4, "diagonal": 4}),
        Kernel(
            "icm",
            (*_CLIQUES, "observation"),
            {"moved": 4, "share": 1},
            (*_READING, "STEPS"),
            **_around("cliques", "ends"),
        ),
        Kernel(
            "energy",
            (*_CLIQUES, "observation"),
            {"share": 1},
            ("SQUARE",),
            **_around("cliques"),
        ),
        Kernel(
            "smooth",
            ("displacement", "load", "lame", *_HELD, "last", "coarse"),
            {"corrected": 4, "taken": 4},
            ("START", "SPRINGS", "CONTINUES", "MOMENTUM"),
            **_around("elements", "forces", "interpolation"),
            optional={"taken": "CONTINUES"},
        ),
        Kernel(
            "smooth_cliques",
            ("displacement", "load", "straight", "diagonal", *_HELD, "last", "coarse"),
            {"corrected": 4, "taken": 4},
            ("START", "SPRINGS", "CONTINUES", "MOMENTUM", *_READING),
            **_around("cliques", "ends", "pulls", "interpolation"),
            optional={"taken": "CONTINUES"},
            of="smooth",
        ),
        Kernel(
            "begin",
            ("displacement", "load", "inverse_diagonal", "coarse"),
            {"begun": 4, "taken": 4},
            ("START",),
            shared=("interpolation",),
            tissue=True,
        ),
        Kernel(
            "restrict",
            ("correction", "load", "lame", *_HELD),
            {"coarse_load": 4},
            ("SPRINGS",),
            **_around("elements"),
        ),
        Kernel(
            "residual",
            ("displacement", "load", "straight", "diagonal", *_HELD),
            {"rest": 4},
            ("SPRINGS", *_READING),
            **_around("cliques", "ends", "pulls"),
        ),
        Kernel(
            "residual_elements",
            ("displacement", "load", "lame", *_HELD),
            {"rest": 4},
            ("SPRINGS",),
            **_around("elements", "forces"),
            of="residual",
        ),
        Kernel(
            "prescribe",
            ("observed", "inverse_diagonal", *(f"solution_{k}" for k in range(4))),
            {"begun": 4},
            tissue=True,
        ),
        Kernel("gather", ("rest", "even"), {"coarse_load": 4}, ("EVEN",), tissue=True),
        Kernel(
            "apply",
            ("displacement", "lame", "inverse_diagonal"),
            {"image": 4, "share": 1},
            **_around("elements", "forces"),
            sums=("share",),
        ),
        Kernel(
            "apply_cliques",
            (*_CLIQUES, "inverse_diagonal"),
            {"image": 4, "share": 1},
            _READING,
            **_around("cliques", "ends", "pulls"),
            sums=("share",),
            of="apply",
        ),
        Kernel(
            "advance",
            ("found", "rest", "direction", "image", "above", "below"),
            {"further": 4, "left": 4, "share": 1},
            ("SIGNED",),
            shared=("scalars",),
            tissue=True,
            carries=True,
            sums=("share",),
        ),
        Kernel(
            "turn",
            ("steepest", "direction", "above", "below"),
            {"turned": 4},
            shared=("scalars",),
            tissue=True,
            carries=True,
        ),
        Kernel(
            "lean",
            ("rest", "direction", "image", "share", "stride"),
            {"leaned": 4},
            tissue=True,
        ),
        Kernel("quotient", ("above", "above_by", "below", "below_by"), {"value": 1}),
        Kernel("at_once", ("load", "matrix", "number", "places"), {"corrected": 4}),
        Kernel("product", ("first", "second"), {"share": 1}, tissue=True, sums=("share",)),
        Kernel(
            "weigh",
            ("first", "second"),
            {"share": 1, "peak": 1},
            tissue=True,
            sums=("share",),
            peaks=("peak",),
        ),
        Kernel("sum", ("share",), {"total": 1}, ("BLOCK",)),
        Kernel("weighed", ("share", "peak"), {"total": 1, "most": 1}, ("BLOCK",)),
        Kernel("canary", ("numbers",), {"first": 4, "second": 2, "third": 1}),
    )
}


@dataclass(frozen=True)
class Source:
    """Full text of a shader, with the names of the source files.

    Attributes
    ----------
    text : str
        Text for the compiler.
    files : tuple of str
        File names, in the order of their numbers in ``#line`` directives. Line l of file k has the
        number 1000 k + l.
    """

    text: str
    files: tuple[str, ...]

    def numbered(self) -> str:
        """Return the text with the file name and line number before each line."""
        lines = []
        number = 0
        for line in self.text.splitlines():
            directive = re.match(r"#line (\d+)", line)
            place = "" if directive or not number else ":".join(self._position(number))
            lines.append(f"{place:>24} | {line}")
            number = int(directive[1]) if directive else number + bool(number)
        return "\n".join(lines)

    def explain(self, log: str) -> str:
        """Return a compiler's log with file names inserted, followed by the numbered text."""

        def named(match: re.Match[str]) -> str:
            name, line = self._position(int(match[2]))
            return f"{name}{match[1]}{line}"

        return f"{_PLACE.sub(named, log.strip())}\n\n{self.numbered()}"

    def _position(self, number: int) -> tuple[str, str]:
        """Return the file name and line for a line number of the compiler."""
        file, line = divmod(number, _FILE_LINES)
        return self.files[min(file, len(self.files) - 1)], str(line)


def compose(
    name: str, stage: Stage, defines: Mapping[str, Define] | None = None, rows: int = 1
) -> Source:
    """Compose the shader of a kernel.

    Parameters
    ----------
    name : str
        One of `KERNELS`.
    stage : {"fragment", "compute"}
    defines : mapping of str to int, optional
        Value for each name in the kernel's ``defines``.
    rows : {1, 2, 4, 8}
        Number of vertically adjacent texels that an invocation of the compute stage computes, if
        `Kernel.tissue` is True. A larger number reduces both reads and parallelism.

    Raises
    ------
    BackendError
        If the kernel or the stage is unknown, the definitions do not match, or a file is missing.
    """
    if name not in KERNELS:
        raise BackendError(f"there is no kernel {name!r}; use one of {', '.join(KERNELS)}")
    if stage not in STAGES:
        raise BackendError(f"there is no shader stage {stage!r}; use one of {', '.join(STAGES)}")
    kernel = KERNELS[name]
    given = dict(defines or {})
    if set(given) != set(kernel.defines):
        raise BackendError(
            f"kernel {name!r} needs values for {sorted(kernel.defines)}, "
            f"but {sorted(given)} were given"
        )
    head = [f"#define {key} {value}" for key, value in given.items()]
    head.append(f"#define TISSUE {int(kernel.tissue)}")
    head.append(f"#define CARRIES {int(kernel.carries)}")
    if stage == "compute":
        head += _group(rows if kernel.tissue else 1)
    head += [f"uniform sampler2D {texture};" for texture in kernel.inputs]
    head += _outputs(kernel, stage, given)
    files = ["common", *kernel.shared, kernel.text, f"stage_{stage}"]
    return joined(VERSIONS[stage], head, files)


def vertices() -> Source:
    """Return the vertex shader that all fragment shaders use."""
    return joined(VERSIONS["vertex"], [], ["triangle"])


def _group(rows: int) -> list[str]:
    """Return the definitions for a work group with `rows` texels per invocation."""
    runs = " ".join(f"run(at + ivec2(0, {row}));" for row in range(rows))
    return [
        f"#define GROUP_ROWS {GROUP[0]}",
        f"#define GROUP_COLS {GROUP[1]}",
        f"#define ROWS {rows}",
        f"#define LOCAL_ROWS {GROUP[0] // rows}",
        f"#define RUN_ROWS(at) {runs}",
    ]


def _outputs(kernel: Kernel, stage: Stage, defines: Mapping[str, Define]) -> list[str]:
    """Return the declarations of a kernel's outputs: render targets, or variables and images."""
    outputs = kernel.outputs_of(defines)
    if stage == "fragment":
        return [
            f"layout(location = {target}) out {_TYPES[components]} {name};"
            for target, (name, components) in enumerate(outputs.items())
        ]
    lines = [f"{_TYPES[components]} {name};" for name, components in outputs.items()]
    each, whole = [], []
    for target, name in enumerate(outputs):
        lines.append(f"layout(binding = {target}) uniform writeonly image2D {name}_image;")
        if name in (*kernel.sums, *kernel.peaks):
            lines.append(f"float whole_{name} = 0.0;")
            both = f"whole_{name}, {name}"
            combined = f"max({both})" if name in kernel.peaks else both.replace(",", " +")
            each.append(f"whole_{name} = {combined};")
            whole.append(f"imageStore({name}_image, at, texel(whole_{name}));")
        else:
            each.append(f"imageStore({name}_image, at + origin, texel({name}));")
    stores = f"#define STORE_OUTPUTS(at) {' '.join(each)}"
    return [*lines, stores, f"#define STORE_TOTALS(at) {' '.join(whole)}"]


def joined(version: int, head: list[str], names: list[str]) -> Source:
    """Join header lines and files into a source, with ``#line`` directives for each file."""
    files = ["(declarations)", *(f"{name}.glsl" for name in names)]
    parts = [f"#version {version} core", "#line 1 0", *head]
    for number, name in enumerate(names, start=1):
        parts += [f"#line {number * _FILE_LINES + 1} {number}", _text(name).rstrip("\n")]
    return Source("\n".join(parts) + "\n", tuple(files))


@cache
def _text(name: str) -> str:
    path = Path(resource_folder("shaders"), f"{name}.glsl")
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise BackendError(
            f"the shader {path.name} cannot be read ({error.strerror}); install napari-hmrf again"
        ) from error
    if not text.isascii():
        raise BackendError(f"the shader {path.name} contains characters other than ASCII")
    if "#version" in text:
        raise BackendError(f"the shader {path.name} must not contain #version; the loader adds it")
    return text
