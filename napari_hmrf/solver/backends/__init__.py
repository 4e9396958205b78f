"""Backends: devices that run the kernels, and the choice between them.

A solve uses a backend in five steps:

1. *Choice.* `job` describes the requirements of a solve, and `choice` chooses a device that meets
   them. `compute.compile_cache` compiles the loops for the processor and stores them on disk.
2. *Model.* A backend (protocol: `base`) copies the tissue to its device: `cpu` as arrays, `opengl`
   as textures or buffers. Until the loops are compiled, `arrays` does the work of the host in
   NumPy. The result is a `linear` model, or a `finite` model for large motion.
3. *Levels.* The model builds its coarser levels. Vectors and scalars are stored on the device.
   Fields on the host are `planes`, and `host` processes the displacement there in double precision.
4. *Kernels.* An optimizer calls the methods of a level. Each method runs one or two kernels:
   compiled loops in `cpu`, shaders from the folder `shaders/` in `opengl`. `rigid` constrains the
   motion of rigid bodies, and `direct` factorizes the system if cycles are not reliable.
5. *Result.* The optimizer reads the displacement back as planes. `earlier_results` stores
   properties of the system for later solves.

All of these steps run on the compute thread, because OpenGL and numba both require it.
"""

from typing import Literal, get_args

#: Names of the backends. "opengl" uses compute shaders if the driver supports them, and fragment
#: shaders otherwise.
BackendName = Literal["auto", "opengl", "opengl:fragment", "opengl:compute", "cpu"]
BACKEND_NAMES: tuple[str, ...] = get_args(BackendName)
