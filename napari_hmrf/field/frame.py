"""Position of a slice or a volume in world coordinates, independent of the layer."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, ConfigDict, Field, TypeAdapter, ValidationError

from napari_hmrf.archive import first_fault
from napari_hmrf.errors import ProblemError
from napari_hmrf.field.units import is_unit, unit_factor, unit_symbol
from napari_hmrf.geometry import Geometry
from napari_hmrf.real_arrays import grid_in_words

Matrix = tuple[tuple[float, ...], ...]

#: Names of the world axes of a layer in patient coordinates. Each name is the side of the patient
#: towards which coordinates increase, with the letters of that side and of the opposite side.
PATIENT_AXES = {"superior": ("S", "I"), "posterior": ("P", "A"), "left": ("L", "R")}
#: Attributes of a layer, and keyword arguments of a new layer, that define its position.
PLACE = ("scale", "translate", "rotate", "shear", "affine", "units", "axis_labels")
#: Upper bound of a slice index in a file.
_FARTHEST = 2**31


@dataclass(frozen=True)
class Frame:
    """Position of a slice or volume in the world: its axes in a layer and the layer's transform.

    A volume has a depth axis before rows and columns. Below, "slice" also means a volume.

    Attributes
    ----------
    plane : (int, int) or (int, int, int)
        Axes of the layer that are the axes of the slice, (row, col), or of the volume, (depth,
        row, col).
    index : tuple of int
        Position of the slice along each axis of the layer; 0 for the axes in `plane`.
    scale, translate, rotate, shear, affine, units, axis_labels
        Attributes of the layer, as in napari.
    matrix : nested tuple of float, shape (D + 1, D + 1)
        Homogeneous transform from pixels of the layer to the world.
    file_axes : tuple of int
        Axis of the image file for each axis of the layer; () if a reader has not reordered them.
        Used only for landmarks that are stored along the axes of the file.
    sliders : tuple of (float, float)
        Start and step of the viewer's slider for each axis, in world units; empty without a
        viewer. Used only for the displayed number of the slice.
    """

    plane: tuple[int, ...]
    index: tuple[int, ...]
    scale: tuple[float, ...]
    translate: tuple[float, ...]
    rotate: Matrix
    shear: tuple[float, ...] | Matrix
    affine: Matrix
    units: tuple[str, ...]
    axis_labels: tuple[str, ...]
    matrix: Matrix
    file_axes: tuple[int, ...] = field(default=(), compare=False)
    sliders: Annotated[tuple[tuple[float, float], ...], Field(exclude=True)] = field(
        default=(), compare=False
    )

    # `TypeAdapter` applies this configuration when it validates the content of a file.
    __pydantic_config__ = ConfigDict(allow_inf_nan=False)

    @classmethod
    def at(
        cls,
        scale: Sequence[float],
        units: Sequence[str],
        *,
        index: Sequence[int] | None = None,
        affine: npt.ArrayLike | None = None,
        axis_labels: Sequence[str] | None = None,
        volume: bool = False,
    ) -> Frame:
        """Return the frame of a slice along the last two axes of an unrotated layer.

        Parameters
        ----------
        scale : sequence of float
            Size of a pixel along each axis.
        units, index, axis_labels
            As in the class attributes; by default the first slice, and axes without names.
        affine : array_like, shape (D + 1, D + 1), optional
            Homogeneous transform to the world that is applied after the scale.
        volume : bool
            If True, return the frame of a volume along the last three axes.

        Returns
        -------
        Frame
        """
        n = len(scale)
        turn = np.eye(n + 1) if affine is None else np.asarray(affine)
        return cls(
            plane=tuple(range(n))[-3 if volume else -2 :],
            index=tuple(index or (0,) * n),
            scale=as_tuples(scale),
            translate=(0.0,) * n,
            rotate=as_tuples(np.eye(n)),
            shear=(0.0,) * (n * (n - 1) // 2),
            affine=as_tuples(turn),
            units=tuple(units),
            axis_labels=tuple(axis_labels or map(str, range(-n, 0))),
            matrix=as_tuples(turn @ np.diag([*scale, 1.0])),
        )

    @classmethod
    def of_geometry(cls, geometry: Geometry, number: int = 0, *, volume: bool = False) -> Frame:
        """Return the frame of a layer on a grid in patient coordinates.

        Parameters
        ----------
        geometry : Geometry
        number : int
            Index of the slice of a volume.
        volume : bool
            True for the frame of a whole volume.
        """
        n = geometry.ndim
        turn = geometry.affine.copy()
        turn[:n, :n] = geometry.directions
        return cls.at(
            geometry.spacing,
            (geometry.unit,) * n,
            index=(number, *(0,) * (n - 1)) if n > 2 else None,
            affine=turn,
            axis_labels=tuple(PATIENT_AXES) if n == 3 else ("y", "x"),
            volume=volume,
        )

    def geometry(self, shape: Sequence[int]) -> Geometry:
        """Return the grid in patient coordinates; for a slice of a volume, a volume of one slice.

        The world coordinates of the layer are assumed to be patient coordinates: the axes z, y and
        x point to superior, posterior and left, as for medical images opened with this package.

        Parameters
        ----------
        shape : sequence of int
            Shape of the slice or volume.

        Raises
        ------
        ProblemError
            If the unit of an axis is not a unit of length.
        """
        matrix, plane = np.array(self.matrix), list(self.plane)
        # Millimetres per unit of each world axis; 1 for pixels, 0 for units that are not lengths.
        sizes = np.nan_to_num(
            [1.0 if unit == "pixel" else unit_factor(unit, "millimeter") for unit in self.units]
        )
        others = [axis for axis in self.others if sizes[axis]]
        axes = plane if len(plane) == 3 else [*others[-1:], *plane]
        if not sizes[axes].all():
            raise ProblemError(
                "displacement",
                f"is measured in {', '.join(self.units)}. Use a unit of length, such as mm.",
            )
        # The rows are world axes, z first; the columns are image axes.
        world, n = sorted(axes), len(axes)
        affine = np.eye(n + 1)
        affine[:n, :n] = matrix[np.ix_(world, axes)] * sizes[world][:, None]
        affine[:n, n] = (matrix @ [*self.index, 1.0])[world] * sizes[world]
        shape = (*(1,) * (n - len(shape)), *shape)
        return Geometry(shape, affine, "pixel" if self.unit == "pixel" else "millimeter")

    def __repr__(self) -> str:
        sizes = f"{grid_in_words(self.spacing)} {self.unit}"
        where = f"{self.slice_name}, " if self.slice_name else ""
        return f"Frame({where}axes {self.plane} of {self.ndim}, pixels of {sizes})"

    @property
    def ndim(self) -> int:
        """Number of axes of the layer."""
        return len(self.index)

    @property
    def others(self) -> tuple[int, ...]:
        """Axes of the layer that are perpendicular to the slice."""
        return tuple(axis for axis in range(self.ndim) if axis not in self.plane)

    @property
    def unit(self) -> str:
        """Unit of length of `spacing`, which is the unit of the row axis."""
        return self.units[self.plane[-2]]

    @property
    def spacing(self) -> tuple[float, ...]:
        """Size of a pixel along ([depth,] row, col) in the world, in `unit`."""
        return tuple(np.linalg.norm(self._steps(), axis=0).tolist())

    @property
    def skew(self) -> float:
        """Largest deviation of the angles between pixel axes from 90 degrees, in degrees."""
        steps = self._steps()
        sides = steps / np.linalg.norm(steps, axis=0)
        cosine = np.abs(np.triu(sides.T @ sides, k=1)).max()
        return float(np.degrees(np.arcsin(min(cosine, 1))))

    def _steps(self) -> npt.NDArray[np.float64]:
        """Return the world step of one pixel along each axis of the plane, as columns in `unit`."""
        linear = np.array(self.matrix)[:-1, list(self.plane)]
        factors = np.array([unit_factor(unit, self.unit) for unit in self.units])
        # World axes without a unit of length, such as time, are ignored.
        steps: npt.NDArray[np.float64] = linear * np.nan_to_num(factors)[:, None]
        return steps

    @property
    def slice_name(self) -> str:
        """Name of the slice from its index, such as "z = 12"; "" for a whole layer.

        If the slice has a single perpendicular axis, and this axis has no name, the name of the
        slice is of the form "slice 12".
        """
        return self._named(self.index)

    @property
    def slice_seen(self) -> str:
        """Displayed name of the slice; in patient coordinates its position, such as "S 22 mm".

        For other layers the name contains the number on the viewer's slider. This number can differ
        from the index for two reasons. The slider starts at the lowest world coordinate, which
        belongs to the last slice if an axis is reversed. A study that was saved and opened again
        has a single slice, with index 0.
        """
        world = np.array(self.matrix) @ np.array([*self.index, 1.0])
        seen = list(self.index)
        for axis in self.others if self.sliders else ():
            start, step = self.sliders[axis]
            seen[axis] = round((float(world[axis]) - start) / step) if step else seen[axis]
        return self._named(seen, placed=True)

    def _in_patient(self, axis: int) -> str:
        """Return the position of the slice along a patient axis; "" for other axes."""
        letters, unit = PATIENT_AXES.get(self.axis_labels[axis]), self.units[axis]
        if letters is None or unit == "pixel":
            return ""
        # The position along the normal is the same for all points of an oblique slice.
        matrix = np.array(self.matrix)
        normal = np.linalg.inv(matrix)[axis, :-1]
        towards = math.copysign(float(np.linalg.norm(normal)), normal[axis])
        far = float(normal @ (matrix @ [*self.index, 1.0])[:-1]) / towards
        # Round to a hundredth of the distance between slices, or finer.
        digits = max(2 + math.ceil(math.log10(abs(towards))), 0)
        # The first rounding removes rounding errors in the file and in the inverse matrix.
        far = round(round(far, digits + 4), digits)
        return f"{letters[int(far < 0)]} {abs(far):.12g} {unit_symbol(unit)}"

    def _named(self, numbers: Sequence[int], placed: bool = False) -> str:
        names = []
        for axis in self.others:
            if placed and (place := self._in_patient(axis)):
                names.append(place)
                continue
            label = self.axis_labels[axis]
            named = not label.lstrip("-").isdigit()
            if not named and len(self.others) == 1:
                return f"{'volume' if len(self.plane) == 3 else 'slice'} {numbers[axis]}"
            names.append(f"{label if named else f'axis {axis}'} = {numbers[axis]}")
        return ", ".join(names)

    def plane_at(self, across: int, number: int) -> Frame:
        """Return the frame of one plane of this volume, given its index along the axis `across`."""
        index = list(self.index)
        index[self.plane[across]] = number
        plane = (*self.plane[:across], *self.plane[across + 1 :])
        return replace(self, plane=plane, index=tuple(index))

    @property
    def pixels(self) -> tuple[int | slice, ...]:
        """Index that selects the slice from the data of a layer."""
        return tuple(slice(None) if n in self.plane else at for n, at in enumerate(self.index))

    def take(self, data: Any) -> npt.NDArray[Any]:
        """Copy the slice from the data of a layer, with axes in the order of the plane.

        A colour axis remains the last axis.
        """
        part = data[self.pixels]
        if hasattr(part, "compute"):  # converting a dask array with NumPy would lose a mask
            part = part.compute()
        # Preserve the mask: the caller raises an error for a masked layer, with the layer's name.
        masked = isinstance(part, np.ma.MaskedArray)
        picture: npt.NDArray[Any] = np.ma.array(part, copy=True) if masked else np.array(part)
        return _ordered(picture, np.argsort(np.argsort(self.plane)))

    def put_image(self, picture: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return an image of the slice, ([D,] H, W[, colours]), with all axes of the layer.

        Axes perpendicular to the slice have length 1.
        """
        picture = _ordered(picture, np.argsort(self.plane))
        return np.ascontiguousarray(np.expand_dims(picture, self.others))

    def put_field(self, steps: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
        """Return a field of the slice, ([D,] H, W, n) in pixels, with all axes of the layer.

        The field has a component along each axis of the layer, 0 perpendicular to the slice.
        """
        placed = np.zeros((*steps.shape[:-1], self.ndim))
        placed[..., list(self.plane)] = steps
        return self.put_image(placed)

    def put_vectors(self, arrows: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
        """Return arrows of the slice, (N, 2, n), as arrows of the layer, (N, 2, D).

        Arrows are (start, step) in pixels. If a two-dimensional layer would have no arrows, one
        invisible arrow of length 0 is returned, because napari cannot draw an empty layer in 3D.
        """
        if not len(arrows) and self.ndim == 2:
            arrows = np.zeros((1, 2, 2))
        placed = np.zeros((len(arrows), 2, self.ndim), dtype=np.float32)
        placed[:, 0] = self.index
        placed[:, :, list(self.plane)] = arrows
        return placed

    def placement(self, image: bool = False) -> dict[str, Any]:
        """Return keyword arguments that put a new layer at the position of its source layer.

        Parameters
        ----------
        image : bool
            True if the data of the new layer are the output of `put_image`, which starts at the
            slice.

        Returns
        -------
        dict
        """
        translate = np.array(self.translate)
        if image:
            world = np.array(self.matrix) @ np.array([*self.index, 1.0])
            translate = (np.linalg.inv(np.array(self.affine)) @ world)[:-1]
        return {
            "scale": np.array(self.scale),
            "translate": translate,
            "rotate": np.array(self.rotate),
            "shear": np.array(self.shear),
            "affine": np.array(self.affine),
            "units": self.units,
            "axis_labels": self.axis_labels,
        }

    def same_place(self, other: Frame, shape: tuple[int, ...]) -> bool:
        """Return whether a slice with the given shape covers the same region in both frames.

        Only the axes that both layers have are compared, because napari shows a layer with fewer
        dimensions on all slices.
        """
        to = self.from_pixels_of(other)
        if to is None or len(self.plane) != len(other.plane):
            return False
        # Both grids in pixels of this layer, from the first pixel of this slice.
        sizes, theirs = np.ones(self.ndim, int), np.eye(self.ndim + 1)
        sizes[list(self.plane)] = shape
        theirs[:-1, list(self.plane)] = to[:, list(other.plane)]
        theirs[:-1, -1] = to @ [*other.index, 1.0] - self.index
        own = Geometry.at_origin(sizes.tolist())
        return Geometry(own.shape, theirs).same_as(own)

    def slice_in(self, other: Frame, sizes: Sequence[int], shape: tuple[int, ...]) -> Frame | None:
        """Return the slice of another layer that covers the same region of the world, or None.

        Parameters
        ----------
        other : Frame
            Frame of any slice of the other layer, which may have more or fewer axes.
        sizes : sequence of int
            Number of pixels of the other layer along each axis.
        shape : tuple of int
            Shape of this slice.

        Returns
        -------
        Frame or None
        """
        more = other.ndim - self.ndim
        plane = tuple(axis + more for axis in self.plane)
        if min(plane) < 0 or tuple(sizes[axis] for axis in plane) != shape:
            return None
        index = ((0,) * more + self.index)[-other.ndim :]
        index = tuple(min(at, size - 1) for at, size in zip(index, sizes, strict=True))
        frame = replace(other, plane=plane, index=index)
        return frame if self.same_place(frame, shape) else None

    def has(self, pixels: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
        """Return a mask of the points, (N, D) in pixels of the layer, that are on the slice."""
        others = list(self.others)
        on = np.rint(pixels[:, others]) == np.array(self.index)[others]
        return np.asarray(on.all(axis=1))

    def place_of(
        self, pixel: npt.NDArray[np.float64], shape: tuple[int, ...]
    ) -> tuple[float, ...] | None:
        """Return the position of a layer point on the slice, or None if the point is not on it.

        Parameters
        ----------
        pixel : ndarray, shape (D,)
            Position in pixels of the layer.
        shape : tuple of int
            Shape of the slice.

        Returns
        -------
        tuple of float or None
            ([depth,] row, col); whole numbers are pixel centres.
        """
        index, axes, others = np.floor(np.nan_to_num(pixel) + 0.5), list(self.plane), self.others
        on = all(index[axis] == self.index[axis] for axis in others)
        inside = on and ((index[axes] >= 0) & (index[axes] < shape)).all()
        return tuple(pixel[axes].tolist()) if inside else None

    def from_pixels_of(
        self, other: Frame, axes: Iterable[int] | None = None
    ) -> npt.NDArray[np.float64] | None:
        """Return the transform from pixels of another layer to pixels of this layer.

        Parameters
        ----------
        other : Frame
            Frame of the other layer, which may have more or fewer axes.
        axes : iterable of int, optional
            Axes of this layer to transform; by default all axes that both layers have. Along the
            remaining axes the result is the position of the slice.

        Returns
        -------
        ndarray, shape (D, n + 1), or None
            Matrix that is applied to homogeneous pixels of the other layer, (n + 1,); None if the
            units cannot be converted.
        """
        more = other.ndim - self.ndim
        shared = [axis for axis in axes or range(self.ndim) if axis + more >= 0]
        theirs = [axis + more for axis in shared]
        units = [(other.units[a], self.units[b]) for a, b in zip(theirs, shared, strict=True)]
        factors = np.array([unit_factor(*pair) for pair in units])
        if not np.isfinite(factors).all():
            return None
        matrix = np.array(self.matrix)
        world = np.zeros((self.ndim, other.ndim + 1))
        world[:, -1] = (matrix @ [*self.index, 1.0])[:-1]
        world[shared] = np.array(other.matrix)[theirs] * factors[:, None]
        world[:, -1] -= matrix[:-1, -1]
        transform: npt.NDArray[np.float64] = np.linalg.inv(matrix[:-1, :-1]) @ world
        return transform

    def as_dict(self) -> dict[str, Any]:
        """Return the frame as a dictionary of JSON types, as in `Solution.frame`."""
        return dict(_PLACES.dump_python(self))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Frame:
        """Create a frame from a dictionary with the items of `as_dict`; others are ignored.

        Raises
        ------
        ValueError
            If a value is missing or invalid, or if no layer can have this frame.
        """
        try:
            return _PLACES.validate_python(values)
        except ValidationError as error:
            raise ValueError(f"invalid slice position: {first_fault(error)}") from error

    def checked(self) -> Frame:
        """Return the frame; raise a ValueError if no layer can have this frame."""
        ndim, plane = self.ndim, self.plane
        known = len(plane) in (2, 3) and len({*plane}) == len(plane)
        if not known or not all(0 <= axis < ndim for axis in plane):
            raise ValueError(f"its plane {plane} is invalid for {ndim} axes")
        if not all(abs(at) < _FARTHEST for at in self.index):
            raise ValueError(f"its index {self.index} is out of range")
        if sorted(self.file_axes) not in ([], [*range(ndim)]):
            raise ValueError(f"its file axes {self.file_axes} are not those of {ndim} axes")
        square = np.ndim(self.shear) == 2
        for name, size in {
            **dict.fromkeys(("scale", "translate", "units", "axis_labels"), (ndim,)),
            "shear": (ndim, ndim) if square else (ndim * (ndim - 1) // 2,),
            "rotate": (ndim, ndim),
            "affine": (ndim + 1, ndim + 1),
            "matrix": (ndim + 1, ndim + 1),
        }.items():
            found = np.shape(getattr(self, name))
            if found != size:
                raise ValueError(f"its {name} has shape {found}, not {size}")
        if 0 in self.scale:
            raise ValueError(f"its scale {self.scale} contains 0")
        for name in ("rotate", "affine", "matrix"):
            values = np.array(getattr(self, name))
            if len(values) > ndim and values[-1].tolist() != [0.0] * ndim + [1.0]:
                raise ValueError(f"the last row of its {name} is {values[-1].tolist()}")
            if is_flat(values[:ndim, :ndim]):
                raise ValueError(f"its {name} is singular")
        factors = [unit_factor(self.units[axis], self.unit) for axis in plane]
        if not all(is_unit(unit) for unit in self.units) or np.isnan(factors).any():
            raise ValueError(f"its units {self.units} are unknown or incompatible")
        return self


#: Frame that is checked when it is read from a file.
StoredFrame = Annotated[Frame, AfterValidator(Frame.checked)]
_PLACES = TypeAdapter(StoredFrame)


def _ordered(picture: npt.NDArray[Any], axes: npt.NDArray[np.intp]) -> npt.NDArray[Any]:
    """Return an image with its axes in another order; a colour axis remains last."""
    return picture.transpose(*axes, *range(len(axes), picture.ndim))


def as_tuples(values: Any) -> Any:
    """Return an array of any dimension as nested tuples of float."""
    return _nested(np.asarray(values, float).tolist())


def _nested(values: Any) -> Any:
    return tuple(map(_nested, values)) if isinstance(values, list) else values


def is_flat(linear: npt.NDArray[np.float64]) -> bool:
    """Return whether a square matrix is singular, regardless of the lengths of its columns."""
    lengths = np.linalg.norm(linear, axis=0)
    if not ((lengths > 0) & np.isfinite(lengths)).all():
        return True
    return bool(np.linalg.matrix_rank(linear / lengths) < len(linear))
