"""Kernels for volumes: their fields, and the source text of their shaders.

The kernels are compute shaders (OpenGL 4.3) on storage buffers. Each component of a field has a
separate buffer, because drivers limit the size of a buffer and a component on 256^3 sites requires
67 MiB. A kernel is a function ``kernel(int)`` of a site's index (``volume.glsl``) that reads and
writes buffers. This module handles only text and does not use OpenGL.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from napari_hmrf.errors import BackendError
from napari_hmrf.solver.backends.opengl.programs.source import VERSIONS, Source, joined

#: Size of a work group in sites, (cols, rows); each invocation computes several planes.
GROUP = (32, 4)
#: Number of invocations of a work group that adds the totals of all groups, or clears a buffer.
TOGETHER = 256
#: Limits of the kernel that smooths a level in one pass with a single work group: number of sites,
#: number of steps, and number of values of a component (a level of 5^3 sites with its border).
SITES, MOST_STEPS, TILE = 128, 128, 9**3
#: Largest number of storage buffers used by a kernel.
MOST_BUFFERS = 16


@dataclass(frozen=True)
class Field:
    """Field of a kernel: one or more buffers with the same name.

    Attributes
    ----------
    name : str
    access : str
        GLSL qualifier "readonly" or "writeonly", or "" for read and write access.
    parts : int or str
        Number of buffers, or name of the preprocessor definition that specifies the number.
    kind : str
        GLSL type of the values.
    where : str
        Name of a preprocessor definition that is 0 if the kernel does not have the field; "" if
        it always has the field.
    """

    name: str
    access: str
    parts: int | str = 3
    kind: str = "float"
    where: str = ""


@dataclass(frozen=True)
class VolumeKernel:
    """Inputs and outputs of a kernel for volumes.

    Attributes
    ----------
    name : str
    fields : tuple of Field
    defines : tuple of str
        Names of preprocessor definitions that require a value.
    shared : tuple of str
        Names of the files that the kernel includes besides ``volume.glsl``.
    shares : bool
        True if each work group computes a total and a largest value.
    exact : bool
        True if the kernel computes in double precision.
    alone : bool
        True if the kernel runs as a single work group, not over the sites of a grid.
    """

    name: str
    fields: tuple[Field, ...]
    defines: tuple[str, ...] = ()
    shared: tuple[str, ...] = ()
    shares: bool = False
    exact: bool = False
    alone: bool = False

    @property
    def all_fields(self) -> tuple[Field, ...]:
        """Fields of the kernel, followed by the fields that the stage adds."""
        shares = (Field("shares", "writeonly", 1, "REAL"),) if self.shares else ()
        places = () if self.alone else (Field("places", "readonly", 1, "int"),)
        return *self.fields, *shares, *places


def _reads(*names: str) -> tuple[Field, ...]:
    return tuple(Field(name, "readonly") for name in names)


def _writes(name: str) -> Field:
    return Field(name, "writeonly")


_LAME = Field("lame", "readonly", "PARAMETERS")
_SPRINGS = Field("springs", "readonly", 1, where="SPRINGS")
_SCALARS = Field("scalars", "readonly", 1)
_AROUND = ("PARAMETERS", "SPRINGS")

#: All kernels for volumes, by name.
VOLUME_KERNELS: Mapping[str, VolumeKernel] = {
    kernel.name: kernel
    for kernel in (
        VolumeKernel(
            "volume_elements",
            (
                Field("stiffness", "readonly", 1),
                Field("poisson", "readonly", 1),
                Field("lame", "writeonly", "PARAMETERS"),
            ),
            ("PARAMETERS",),
        ),
        VolumeKernel(
            "volume_coarsen", (Field("fine", "readonly", 1), Field("coarse", "writeonly", 1))
        ),
        VolumeKernel("volume_diagonal", (_LAME, _writes("diagonal")), ("PARAMETERS",)),
        VolumeKernel("volume_hold", (Field("inverse", ""), *_reads("pins")), shares=True),
        VolumeKernel(
            "volume_spring",
            (Field("inverse", ""), Field("pins", ""), Field("springs", "writeonly", 1)),
            shares=True,
        ),
        VolumeKernel("volume_begin", (*_reads("load", "inverse"), _writes("begun"))),
        VolumeKernel(
            "volume_smooth",
            (*_reads("displacement", "load", "inverse"), _LAME, _SPRINGS, Field("other", "")),
            _AROUND,
            ("hexahedra",),
        ),
        VolumeKernel(
            "volume_finish",
            (*_reads("load", "inverse"), _LAME, _SPRINGS, _writes("correction")),
            _AROUND,
            ("volume_tile", "hexahedra"),
            alone=True,
        ),
        VolumeKernel(
            "volume_residual",
            (*_reads("displacement", "load", "inverse"), _LAME, _SPRINGS, _writes("rest")),
            _AROUND,
            ("hexahedra",),
        ),
        VolumeKernel(
            "volume_apply",
            (*_reads("displacement", "inverse"), _LAME, _SPRINGS, _writes("image")),
            _AROUND,
            ("hexahedra",),
            shares=True,
        ),
        VolumeKernel(
            "volume_balance",
            (
                Field("displacement", "readonly", kind="double"),
                *_reads("inverse"),
                _LAME,
                _writes("rest"),
            ),
            ("PARAMETERS",),
            ("hexahedra",),
            shares=True,
            exact=True,
        ),
        VolumeKernel(
            "volume_work",
            (Field("displacement", "readonly", kind="double"), _LAME),
            ("PARAMETERS",),
            ("hexahedra",),
            shares=True,
            exact=True,
        ),
        VolumeKernel("volume_restrict", (*_reads("fine"), _writes("coarse"))),
        VolumeKernel("volume_interpolate", (Field("correction", ""), *_reads("coarse", "inverse"))),
        VolumeKernel(
            "volume_turn",
            (*_reads("steepest"), Field("direction", ""), _SCALARS),
            shared=("volume_scalars",),
        ),
        VolumeKernel(
            "volume_advance",
            (
                Field("found", ""),
                Field("rest", ""),
                *_reads("direction", "image"),
                _SCALARS,
            ),
            shared=("volume_scalars",),
            shares=True,
        ),
        VolumeKernel("volume_weigh", _reads("one", "other"), shares=True),
        VolumeKernel("volume_clear", (Field("values", "writeonly", 1),), alone=True),
        VolumeKernel(
            "volume_total",
            (Field("shares", "readonly", 1), Field("scalars", "writeonly", 1)),
            alone=True,
        ),
    )
}


def bindings(kernel: VolumeKernel, defines: Mapping[str, int]) -> list[tuple[Field, int]]:
    """Return the fields of a kernel for given definitions, with the number of buffers of each."""
    found = []
    for field in kernel.all_fields:
        if not field.where or defines[field.where]:
            parts = field.parts if isinstance(field.parts, int) else defines[field.parts]
            found.append((field, parts))
    return found


def compose_volume(name: str, defines: Mapping[str, int] | None = None) -> Source:
    """Compose the compute shader of a kernel for volumes.

    Parameters
    ----------
    name : str
        One of `VOLUME_KERNELS`.
    defines : mapping of str to int, optional
        Value for each name in the kernel's ``defines``.

    Raises
    ------
    BackendError
        If the definitions do not match those of the kernel, or if a file is missing.
    """
    kernel, given = VOLUME_KERNELS[name], dict(defines or {})
    if set(given) != set(kernel.defines):
        raise BackendError(
            f"kernel {name!r} needs values for {sorted(kernel.defines)}, "
            f"but {sorted(given)} were given"
        )
    given |= {"GROUP_COLS": GROUP[0], "GROUP_ROWS": GROUP[1], "TOGETHER": TOGETHER}
    given |= {"SITES": SITES, "MOST_STEPS": MOST_STEPS, "TILE": TILE}
    given |= {"FORCES": int("hexahedra" in kernel.shared), "SHARES": int(kernel.shares)}
    head = [f"#define {key} {value}" for key, value in given.items()]
    head.append(f"#define REAL {'double' if kernel.exact else 'float'}")
    first = 0
    for field, parts in bindings(kernel, given):
        several = f"[{parts}]" if field.parts != 1 else ""
        head.append(
            f"layout(std430, binding = {first}) {field.access} restrict buffer {field.name}_buffer "
            f"{{ {field.kind} at[]; }} {field.name}{several};"
        )
        first += parts
    if kernel.shares:
        head.append("REAL total = REAL(0); REAL most = REAL(0);")
    stage = () if kernel.alone else ("stage_volume",)
    return joined(VERSIONS["compute"], head, ["volume", *kernel.shared, name, *stage])
