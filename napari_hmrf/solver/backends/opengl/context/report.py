"""Description of the OpenGL device for bug reports."""

from __future__ import annotations

from typing import Any

import numpy as np

from napari_hmrf.errors import BackendError
from napari_hmrf.solver.backends.opengl.context.context import is_software_renderer
from napari_hmrf.solver.backends.opengl.context.device import Device, the_device

_FORMATS = {"R32F": 1, "RG32F": 2, "RGBA32F": 4}
_LIMITS = (
    "GL_MAX_TEXTURE_SIZE",
    "GL_MAX_VIEWPORT_DIMS",
    "GL_MAX_DRAW_BUFFERS",
    "GL_MAX_COLOR_ATTACHMENTS",
    "GL_MAX_TEXTURE_IMAGE_UNITS",
    "GL_MAX_COMPUTE_WORK_GROUP_COUNT",
    "GL_MAX_COMPUTE_WORK_GROUP_INVOCATIONS",
    "GL_MAX_COMPUTE_SHADER_STORAGE_BLOCKS",
    "GL_MAX_SHADER_STORAGE_BLOCK_SIZE",
)


def describe() -> dict[str, Any]:
    """Describe and test the OpenGL device.

    Call this function on the compute thread only.

    Returns
    -------
    dict
        Description with the keys ``vendor``, ``renderer``, ``version``, ``software`` (True
        without a GPU), ``made_by`` (how the context was created), ``context_seconds``, ``limits``,
        ``render_targets`` (texture formats that work), ``stages``, ``default_stage`` and
        ``canary`` (result of the test kernel for each stage).

    Raises
    ------
    BackendError
        If OpenGL cannot be used.
    """
    device = the_device()
    info = device.ctx.info
    return {
        "vendor": info["GL_VENDOR"],
        "renderer": info["GL_RENDERER"],
        "version": info["GL_VERSION"],
        "software": is_software_renderer(device.renderer),
        "made_by": device.way,
        "context_seconds": round(device.seconds, 3),
        "limits": {name: info[name] for name in _LIMITS if name in info},
        "render_targets": [name for name, k in _FORMATS.items() if _is_exact(device, k)],
        "stages": list(device.stages),
        "default_stage": device.best_stage,
        "canary": {stage: _canary(stage) for stage in device.stages},
    }


def _is_exact(device: Device, components: int) -> bool:
    """Return whether values can be written to a texture format and read back unchanged."""
    value = (0.1, -2e-30, 3e30, 7.0)
    made: list[Any] = []
    try:
        made.append(device.texture((3, 5), components))
        made.append(device.ctx.framebuffer(made[:1]))
        made[1].use()
        made[1].clear(*value)
        read = np.frombuffer(made[0].read(), np.float32).reshape(-1, components)
        return bool((read == np.array(value[:components], np.float32)).all())
    except Exception as error:
        if device.lost:
            raise BackendError(str(error)) from error
        return False
    finally:
        device.free(reversed(made))


def _canary(stage: Any) -> str:
    """Return "exact" if the test kernel passes, otherwise the error message.

    After an error, the device has been released.
    """
    try:
        the_device().canary(stage)
    except BackendError as error:
        return str(error)
    return "exact"
