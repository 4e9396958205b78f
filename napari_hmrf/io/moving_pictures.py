"""Animations of a deformation, from the undeformed to the deformed image and back."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import checked_path, refuse_unless, require_kind
from napari_hmrf.atomic_write import temporary_beside, write_whole
from napari_hmrf.checks import Count, Samples, convert
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.errors import FileFormatError, HmrfError, ProblemError
from napari_hmrf.extras import how_to_install
from napari_hmrf.field.brightness import without_padding
from napari_hmrf.io.film_overlay import FilmOverlay
from napari_hmrf.results.animation import Motion
from napari_hmrf.results.moved_pictures import MovedPictures
from napari_hmrf.solver.solution import Solution

#: Suffixes of animation files.
MOVING_SUFFIXES = (".gif", ".mp4")
#: Percentile of the intensities that is mapped to white.
_WHITE = 99.9


def write_movie(
    path: str | os.PathLike[str],
    solution: Solution,
    image: npt.ArrayLike,
    *,
    frames: int = 24,
    per_second: int = 12,
    number: int | None = None,
    axis: int = 0,
    overlay: FilmOverlay | None = None,
) -> Path:
    """Write an animation in which an image is repeatedly deformed and restored.

    Parameters
    ----------
    path : str or path-like
        Path with the suffix .gif, or .mp4, which requires the extra ``film``.
    solution : Solution
    image : array_like, shape ([D,] H, W) or ([D,] H, W, 3 or 4)
        Undeformed image.
    frames : int
        Number of frames from the undeformed to the deformed image.
    per_second : int
        Number of frames per second.
    number : int, optional
        Index of the slice to show along `axis` of a volume; required for volumes.
    axis : int
        Axis of the volume perpendicular to the slice.
    overlay : FilmOverlay, optional
        Overlay to draw on the image, with its legend.

    Returns
    -------
    Path
        The written file.

    Raises
    ------
    FileFormatError
        If the path has a different suffix.
    ArgumentError
        If `solution` is not a Solution, if `frames` is less than 2 or `per_second` less than 1, or
        if the volume does not have the slice `number` or the axis `axis`.
    ProblemError
        If `number` is missing for a volume, or given for a slice.
    HmrfError
        If the package that writes .mp4 files is not installed, or fails.
    OSError
        If the file cannot be written.
    """
    target = Path(checked_path(path))
    require_kind(Solution, "solution", solution, "the result of solve()")
    if target.suffix.lower() not in MOVING_SUFFIXES:
        raise FileFormatError(
            f"{target.name}: animations cannot be written in this format. Use the suffix "
            f"{' or '.join(MOVING_SUFFIXES)}."
        )
    frames = convert(Samples, frames, "frames")
    per_second = convert(Count, per_second, "per_second")
    if solution.tissue.ndim == 2 and number is not None:
        raise ProblemError(
            "displacement", "belongs to a slice. Leave out the slice index (`number`)."
        )
    if solution.tissue.ndim != 2 and number is None:
        raise ProblemError(
            "displacement", "belongs to a volume. Give the index of a slice (`number`)."
        )
    steps = [moment / (frames - 1) for moment in range(frames)]
    if number is None:
        motion = Motion(solution, np.asarray(image))
        pictures = [_frame_at(motion, step) for step in steps]
    else:
        refuse_unless(axis in (0, 1, 2), "axis", axis, "0, 1 or 2")
        count = solution.tissue.shape[axis]
        refuse_unless(0 <= number < count, "number", number, f"from 0 to {count - 1}")
        pictures = _slice_frames(solution, np.asarray(image), axis, number, steps)
    spacing = solution.spacing
    if len(spacing) == 3:
        spacing = (*spacing[:axis], *spacing[axis + 1 :])
    forward_frames = _to_bytes(np.stack(pictures))
    if overlay is None:
        forward_frames = _square_pixels(forward_frames, spacing)
    else:
        plane = None if number is None else (number, axis)
        forward_frames = overlay.draw(forward_frames, steps, spacing, plane)
    loop = np.concatenate([forward_frames, forward_frames[-2:0:-1]])
    write_whole(target, _encode(target, loop, per_second))
    return target


def _slice_frames(
    solution: Solution,
    image: npt.NDArray[np.generic],
    axis: int,
    number: int,
    steps: Sequence[float],
) -> list[npt.NDArray[np.generic]]:
    """Return a slice of the deformed volume at each step of the motion."""
    pictures, d = MovedPictures(), solution.displacement

    def picture_at(step: float) -> npt.NDArray[np.generic]:
        removed = solution.removed if step else None
        part = replace(solution, displacement=d * np.float32(step), removed=removed)
        return pictures.plane(image, axis, number, part, part.tissue, part.spacing, every=1)

    return [compute_thread.result_of(partial(picture_at, step), "drawing") for step in steps]


def _frame_at(motion: Motion, fraction: float) -> npt.NDArray[np.generic]:
    moment = compute_thread.result_of(lambda: motion.at(fraction), "drawing")
    assert moment.image is not None
    return moment.image


def _to_bytes(pictures: npt.NDArray[np.generic]) -> npt.NDArray[np.uint8]:
    """Scale the intensities of all pictures to 0..255 with the same factor; drop the opacity."""
    values = pictures[..., :3] if pictures.ndim > 3 else pictures
    if values.dtype == np.uint8:
        return values.astype(np.uint8)
    finite = without_padding(np.nan_to_num(values.astype(float)))
    low, high = float(finite.min()), float(np.percentile(finite, _WHITE))
    scaled = (finite - low) / max(high - low, np.finfo(float).tiny)
    levels: npt.NDArray[np.uint8] = np.rint(255 * scaled.clip(0, 1)).astype(np.uint8)
    return levels


def _square_pixels(
    pictures: npt.NDArray[np.uint8], spacing: Sequence[float]
) -> npt.NDArray[np.uint8]:
    """Resample pictures to square pixels of the smaller pixel size."""
    from PIL import Image  # heavy: PIL

    rows, cols = (
        round(size * step / min(spacing))
        for size, step in zip(pictures.shape[1:3], spacing, strict=True)
    )
    if (rows, cols) == pictures.shape[1:3]:
        return pictures
    between = Image.Resampling.BILINEAR
    stretched = (Image.fromarray(each).resize((cols, rows), between) for each in pictures)
    return np.stack([np.asarray(each) for each in stretched])


def _encode(target: Path, pictures: npt.NDArray[np.uint8], per_second: int) -> bytes:
    """Return the bytes of a file in the format given by the suffix of the target."""
    import imageio.v3 as iio  # heavy: imageio

    if target.suffix.lower() == ".gif":
        buffer, duration = io.BytesIO(), round(1000 / per_second)
        iio.imwrite(buffer, pictures, extension=".gif", duration=duration, loop=0)
        return buffer.getvalue()
    try:
        import imageio_ffmpeg  # optional: imageio_ffmpeg
    except ImportError as error:
        raise HmrfError(
            ".mp4 files are written by imageio-ffmpeg, which is not installed: "
            f"{how_to_install('film')}; or write a .gif."
        ) from error
    # The codec only accepts even numbers of rows and columns.
    rows, cols = (2 * (size // 2) for size in pictures.shape[1:3])
    with temporary_beside(target, ".mp4") as file:
        try:
            iio.imwrite(
                file, pictures[:, :rows, :cols], fps=per_second, quality=8, macro_block_size=2
            )
            count, _ = imageio_ffmpeg.count_frames_and_secs(str(file))
        except (OSError, RuntimeError):  # ffmpeg does not say why it failed
            count = 0
        if count != len(pictures):
            raise HmrfError(
                f"{target}: ffmpeg has not written all frames. Check whether the disk is full."
            )
        return file.read_bytes()
