"""How long a new user waits: the first field of a fresh process whose caches are empty.

    python benchmarks/first.py [--models elastic ...] [--backends cpu opengl] [--size 300]
    python benchmarks/first.py --takeover [--size 300] [--caches FOLDER]
    python benchmarks/first.py --window

Every model of the linear solver on every backend has a process of its own, with numba's cache and
the driver's in new folders. Printed are the seconds to import the package, to the first field and
to the second, and those of compiling; at the end what each loop cost of all that
``python -m napari_hmrf.compiling`` compiles, pictures and rigid bodies among them.
With ``--takeover`` a patch is dragged by shaders until the loops take over: those of a folder that
``NUMBA_CACHE_DIR=FOLDER python -m napari_hmrf.compiling`` has filled, after eight seconds, or those
that the compiler makes meanwhile, which takes minutes.
With ``--window`` napari is opened with a sample, and what is waited for is the first picture of
tissue that has moved, after the button and after the press of the mouse; on a virtual display where
there is none.
Beside it stands how long a plain loop of the interpreter takes here: about a second on a quick
machine.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

#: What is solved, by name: prior and optimizer.
MODELS: dict[str, Callable[[], tuple[Any, Any]]] = {
    "schedule": lambda: _paper("centred", False),
    "converged": lambda: _paper("centred", True),
    "blanket": lambda: _paper("blanket", True),
    "elastic": lambda: _elastic(0.45, "stress"),
    "slipping": lambda: _elastic(0.45, "stress", penalty=100.0),
    "strain": lambda: _elastic(0.499, "strain"),
}
BACKENDS = ("opengl", "cpu")
_EVERYTHING = "everything"
#: What all compiling of the linear solver may take on one quiet core, in seconds.
BUDGET = 60.0
#: In how many seconds a picture is to be there, in the window.
SOON = 8.0
_TURNS = 20_000_000
# What tells where to keep what is compiled, or chosen.
_FOLDERS = ("NUMBA_CACHE_DIR", "MESA_SHADER_CACHE_DIR", "XDG_CACHE_HOME", "XDG_CONFIG_HOME")


def _paper(conditional: Any, converged: bool) -> tuple[Any, Any]:
    from napari_hmrf import ICM, Multigrid, SeilerPrior

    return SeilerPrior(conditional=conditional), Multigrid() if converged else ICM()


def _elastic(poisson: float, plane: Any, **more: Any) -> tuple[Any, Any]:
    from napari_hmrf import ElasticPrior, Multigrid

    return ElasticPrior(poisson, plane=plane, **more), Multigrid()


@dataclass(frozen=True)
class First:
    """What a fresh process took, in seconds; `compiled` says which loop took how many."""

    importing: float
    first: float
    second: float
    compiled: dict[str, float]


def watch_compiler() -> Callable[[], dict[str, float]]:
    """Have numba's compiler watched; the result says what each loop took without its callees."""
    from numba.core import event

    taken: dict[str, float] = {}
    running: list[list[float]] = []

    class Watch(event.Listener):
        def on_start(self, happening: Any) -> None:
            running.append([time.perf_counter(), 0.0])

        def on_end(self, happening: Any) -> None:
            begun, within = running.pop()
            whole = time.perf_counter() - begun
            if running:
                running[-1][1] += whole
            loop = happening.data["dispatcher"].py_func
            name = f"{loop.__module__.rpartition('.')[2]}.{loop.__name__}"
            name += f" {hash(str(happening.data['args'])) & 0xFFFF:04x}"
            taken[name] = taken.get(name, 0.0) + whole - within

    event.register("numba:compile", Watch())
    return lambda: taken


def child(model: str, backend: str, size: int) -> First:
    """Solve twice, here."""
    begun = time.perf_counter()
    import napari_hmrf

    importing = time.perf_counter() - begun
    problem = napari_hmrf.data.phantom("expansion", size).problem
    prior, optimizer = MODELS[model]()
    taken = watch_compiler()
    seconds = []
    for _ in range(2):
        begun = time.perf_counter()
        napari_hmrf.solve(problem, prior, optimizer=optimizer, backend=backend)
        seconds.append(time.perf_counter() - begun)
    return First(importing, *seconds, taken())


def everything() -> dict[str, float]:
    """Do all jobs of the compiler, here; what each loop took."""
    from napari_hmrf import compiling
    from napari_hmrf.solver.backends.thread import compute_thread

    taken = watch_compiler()
    for job in compiling.jobs():
        compute_thread.submit(job.run).result()
    return taken()


def fresh(model: str, backend: str, size: int) -> Any:
    """Run a child whose caches are empty; what it printed."""
    # What loops cost is seen where they are compiled.
    told = {"NAPARI_HMRF_COMPILE": "here" if backend == "cpu" else "", "PYTHONHASHSEED": "0"}
    given = [sys.executable, __file__, "--child", model, "--backends", backend]
    return _printed([*given, "--size", str(size)], told)


def _printed(command: list[str], told: dict[str, str]) -> Any:
    """What a command prints where all caches are empty, and nothing is remembered."""
    with tempfile.TemporaryDirectory() as folder:
        caches = dict.fromkeys(_FOLDERS, folder)
        ran = subprocess.run(
            command,
            env={**os.environ, **caches, **told},
            check=True,
            capture_output=True,
            text=True,
        )
    return json.loads(ran.stdout.splitlines()[-1])


def window() -> None:
    """Print how long the first pictures in napari's window take."""
    print(f"{'after':10} {'command':>8} {'picture':>8} {'blocked':>8}   (at most {SOON:.0f} s)")
    here = Path(__file__)
    show = ["sh", str(here.parents[1] / "scripts" / "headless.sh")]
    for way in ("button", "mouse"):
        command = [sys.executable, str(here.with_name("first_window.py")), way]
        found = _printed([*(show if sys.platform == "linux" else []), *command], {})
        cells = " ".join(f"{found[name]:8.2f}" for name in ("command", "first", "blocked"))
        print(f"{way:10} {cells}", flush=True)


def speed() -> float:
    """Seconds for a loop of the interpreter."""
    begun, total = time.perf_counter(), 0
    for turn in range(_TURNS):
        total += turn
    return time.perf_counter() - begun


def main(arguments: Sequence[str] | None = None) -> int:
    """Print what was found; 0 whatever it is."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--models", nargs="+", choices=MODELS, default=list(MODELS))
    parser.add_argument("--backends", nargs="+", choices=BACKENDS, default=list(BACKENDS))
    parser.add_argument("--size", type=int, default=300)
    parser.add_argument("--child", choices=[*MODELS, _EVERYTHING], help=argparse.SUPPRESS)
    parser.add_argument("--takeover", action="store_true")
    parser.add_argument("--window", action="store_true")
    parser.add_argument("--caches", help="where the loops lie compiled, for --takeover")
    parser.add_argument("--drag", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.drag:
        from takeover import drag

        drag(options.size, options.caches is not None)
        return 0
    if options.takeover:
        with tempfile.TemporaryDirectory() as folder:
            caches = options.caches or folder
            given = [sys.executable, __file__, "--drag", "--size", str(options.size)]
            given += [] if options.caches is None else ["--caches", caches]
            told = {"NUMBA_CACHE_DIR": caches, "MESA_SHADER_CACHE_DIR": caches}
            return subprocess.call(given, env={**os.environ, **told})
    if options.window:
        window()
        return 0
    if options.child == _EVERYTHING:
        print(json.dumps(everything()))
        return 0
    if options.child:
        found = child(options.child, options.backends[0], options.size)
        print(json.dumps(found.__dict__))
        return 0
    print(f"a loop of {_TURNS:.0e} turns takes {speed():.2f} s here")
    print(f"{'model':10} {'on':7} {'import':>7} {'first':>7} {'second':>7} {'compiling':>10}")
    for backend in options.backends:
        for model in options.models:
            found = First(**fresh(model, backend, options.size))
            compiling = sum(found.compiled.values())
            cells = (found.importing, found.first, found.second, compiling)
            print(
                f"{model:10} {backend:7} " + " ".join(f"{cell:7.2f}" for cell in cells), flush=True
            )
    if "cpu" not in options.backends:
        return 0
    all_loops: dict[str, float] = fresh(_EVERYTHING, "cpu", options.size)
    print(f"\nall loops: {sum(all_loops.values()):.1f} s (at most {BUDGET:.0f})")
    loops: dict[str, list[float]] = {}
    for name, taken in all_loops.items():
        loops.setdefault(name.rpartition(" ")[0], []).append(taken)
    for name, each in sorted(loops.items(), key=lambda item: -sum(item[1])):
        print(f"{sum(each):7.2f} s  {len(each):2} kinds  {name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
