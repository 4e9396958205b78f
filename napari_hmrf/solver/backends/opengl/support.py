"""Limits of the shaders: reasons why they do not support a job, an image or a volume."""

from __future__ import annotations

import math

from napari_hmrf.solver.backends.job import SolveJob
from napari_hmrf.solver.backends.opengl.context.device import Device
from napari_hmrf.solver.backends.opengl.programs.volume_source import MOST_BUFFERS
from napari_hmrf.solver.backends.opengl.volumes.volume_passes import BYTES_PER_VOXEL
from napari_hmrf.solver.priors import SeilerPrior

#: Memory per pixel, in bytes: stiffness 8, stiffness ratios 32, mask 2, observation 16,
#: displacement 2 x 8, energy 2; plus one third for the coarser levels.
BYTES_PER_PIXEL = 76 * 4 / 3


def missing_shaders(job: SolveJob) -> str | None:
    """Return the reason why no shaders exist for a job, or None if shaders exist.

    This function does not use OpenGL.
    """
    kinds = {
        "large motion": job.has_large_motion,
        "volumes with the paper's prior": job.is_volume and isinstance(job.prior, SeilerPrior),
        "volumes with loads": job.is_volume and job.has_loads,
        "volumes with rigid tissue": job.is_volume and job.has_rigid_tissue,
        "volumes in which tissue may slip": job.is_volume and job.can_slip,
        "problems with a precision or uncertain landmarks": job.has_data,
        "parts that slide along each other": job.has_sliding_parts,
    }
    missing = next((kind for kind, is_so in kinds.items() if is_so), None)
    return None if missing is None else f"only the compiled loops solve {missing}"


def image_refusal(device: Device, shape: tuple[int, ...]) -> str | None:
    """Return the reason why an image of (H, W) pixels is too large for a device, or None."""
    height, width = shape
    if max(height, width) <= device.largest:
        return None
    size = height * width * BYTES_PER_PIXEL / 2**30
    return (
        f"the image has {height} x {width} pixels, but {device.renderer} supports at most "
        f"{device.largest} x {device.largest}; a solve would take about {size:.1f} GiB there. "
        'Downsample or crop the image, or use the compiled loops (`backend="cpu"`).'
    )


def volume_refusal(device: Device, stage: str, shape: tuple[int, ...]) -> str | None:
    """Return the reason why a device cannot solve a volume of (D, H, W) voxels, or None."""
    renderer, most = device.renderer, device.largest_buffer
    if "compute" not in device.stages:
        return (
            f"volumes require compute shaders (OpenGL 4.3), but the device is {renderer}. Use "
            'the compiled loops (`backend="cpu"`).'
        )
    if stage != "compute":
        return (
            "fragment shaders solve images only. For a volume, use compute shaders "
            '(`backend="opengl:compute"`) or the compiled loops (`backend="cpu"`).'
        )
    if device.most_buffers < MOST_BUFFERS:
        return (
            f"{renderer} supports {device.most_buffers} storage buffers in a compute shader, but "
            f'volumes need {MOST_BUFFERS}. Use the compiled loops (`backend="cpu"`).'
        )
    values = math.prod(size + 4 for size in shape)
    if 8 * values <= most:
        return None
    size = " x ".join(map(str, shape))
    whole = values * BYTES_PER_VOXEL / 2**30
    return (
        f"the volume has {size} voxels, so a component takes {8 * values / 2**20:.0f} MiB, but "
        f"{renderer} has buffers of at most {most / 2**20:.0f} MiB (a solve would take "
        f"{whole:.1f} GiB in total). Downsample or crop the volume, or use the compiled loops "
        '(`backend="cpu"`).'
    )
