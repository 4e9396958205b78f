"""OpenGL backend: whole solves, cancellation, limits and memory."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from napari_hmrf import ICM, BackendError, Cancelled, ElasticPrior, Problem, SeilerPrior, solve
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.solver.backends.choice import open_backend
from napari_hmrf.solver.backends.job import SolveJob
from napari_hmrf.solver.backends.opengl import OpenGLBackend, describe, is_software_renderer
from napari_hmrf.solver.backends.opengl.context.device import the_device
from napari_hmrf.solver.backends.opengl.context.pace import Pace
from napari_hmrf.solver.backends.opengl.programs import source
from napari_hmrf.solver.backends.opengl.programs.programs import compile_program
from napari_hmrf.solver.quadtree import levels
from tests.support.opengl import count_looks, on_compute_thread, require_opengl
from tests.support.timeouts import LONG

CLOSED_FORM = ICM(iterations=30, steps=None)
IMAGE = SolveJob((9, 9), (1.0, 1.0), SeilerPrior(), CLOSED_FORM)


@pytest.fixture
def opengl() -> None:
    require_opengl()


def body(size: tuple[int, int] = (45, 61)) -> Problem:
    """Return a soft ellipse in void with a stiff, off-centre core and a rim pushed outwards."""
    place = (np.moveaxis(np.indices(size), 0, -1) + 0.5) / np.array(size) * 2 - 1
    radius = np.hypot(place[..., 0], place[..., 1])
    m = np.where(radius < 0.9, 20.0, 0.0)
    m[np.hypot(place[..., 0] - 0.2, place[..., 1] + 0.1) < 0.3] = 40
    rim = (radius < 0.9) & (radius > 0.75)
    return Problem(
        observed=place * 3, confidence=np.repeat(rim[..., None], 2, axis=-1), stiffness=m
    )


class Ledger:
    """Record of all OpenGL objects that are created, and of those not yet released."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        import moderngl

        self.made: list[object] = []
        for kind in ("texture", "framebuffer", "buffer", "renderbuffer", "query"):
            monkeypatch.setattr(
                moderngl.Context, kind, self._noted(getattr(moderngl.Context, kind))
            )

    def _noted(self, make):
        def noted(ctx, *args, **kwargs):
            made = make(ctx, *args, **kwargs)
            self.made.append(made)
            return made

        return noted

    @property
    def left(self) -> int:
        return sum(type(made.mglo).__name__ != "InvalidObject" for made in self.made)


@pytest.fixture
def ledger(opengl, monkeypatch) -> Ledger:
    on_compute_thread(the_device)
    return Ledger(monkeypatch)


# Solves ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stage", "size", "conditional"),
    [
        ("compute", (45, 61), "blanket"),
        ("fragment", (45, 61), "centred"),
        ("compute", (2, 9), "centred"),
        ("fragment", (1, 30), "blanket"),
        *(
            pytest.param(stage, (64, 64), conditional, marks=pytest.mark.campaign)
            for stage in ("compute", "fragment")
            for conditional in ("centred", "blanket")
        ),
    ],
    indirect=["stage"],
)
def test_a_body_moves_the_same_on_every_backend(stage, size, conditional):
    prior = SeilerPrior(conditional=conditional)
    loops = solve(body(size), prior, optimizer=CLOSED_FORM, backend="cpu")
    shaders = solve(body(size), prior, optimizer=CLOSED_FORM, backend=f"opengl:{stage}")
    largest = np.abs(loops.displacement).max()
    assert largest > 1
    np.testing.assert_allclose(shaders.displacement, loops.displacement, atol=1e-4 * largest)
    np.testing.assert_allclose(shaders.energy, loops.energy, rtol=1e-2, atol=1e-6)
    assert shaders.levels == loops.levels
    assert shaders.provenance.backend == f"opengl:{stage}"


def test_a_body_moves_similarly_on_every_backend_with_the_candidate_set(stage):
    loops = solve(body(), SeilerPrior(), backend="cpu")
    shaders = solve(body(), SeilerPrior(), backend=f"opengl:{stage}")
    off = shaders.displacement - loops.displacement
    # Rounding decides between equally good candidates, so only the energies are comparable.
    assert np.sqrt((off**2).mean()) < 0.01
    assert shaders.mean_energy == pytest.approx(loops.mean_energy, rel=0.1)


def test_the_renderer_is_described_with_its_version(opengl):
    words = solve(
        body(), SeilerPrior(), optimizer=CLOSED_FORM, backend="opengl"
    ).provenance.renderer
    told = on_compute_thread(describe)
    assert told["renderer"] in words
    assert told["version"] in words


def test_the_default_stage_is_compute_if_available(opengl):
    told = on_compute_thread(describe)
    expected = "compute" if "compute" in told["stages"] else "fragment"
    assert told["default_stage"] == expected
    solution = solve(body((9, 9)), SeilerPrior(), optimizer=CLOSED_FORM, backend="opengl")
    assert solution.provenance.backend == f"opengl:{expected}"


def test_auto_uses_the_shaders_only_on_a_gpu(opengl):
    def choice() -> tuple[str, str]:
        backend, reason = open_backend(IMAGE, "auto", lambda: None)
        backend.close()
        return backend.name, reason

    name, reason = on_compute_thread(choice)
    software = on_compute_thread(describe)["software"]
    assert name.startswith("cpu" if software else "opengl")
    assert ("software" in reason) == software


@pytest.mark.parametrize(
    ("renderer", "software"),
    [
        ("llvmpipe (LLVM 15.0.6, 256 bits), OpenGL 4.5", True),
        ("softpipe", True),
        ("GDI Generic", True),
        ("D3D12 (Microsoft Basic Render Driver)", True),
        ("Apple Software Renderer", True),
        ("NVIDIA H100 PCIe/PCIe/SSE2, OpenGL 4.6.0", False),
        ("Mesa Intel(R) UHD Graphics 620 (KBL GT2)", False),
        ("AMD Radeon RX 6600 (radeonsi, navi23, LLVM 15.0.6, DRM 3.49)", False),
        ("Apple M2", False),
    ],
)
def test_software_renderers_are_distinguished_from_gpus(renderer, software):
    assert is_software_renderer(renderer) is software


def test_the_description_reports_a_working_device(opengl):
    told = on_compute_thread(describe)
    assert told["render_targets"] == ["R32F", "RG32F", "RGBA32F"]
    assert set(told["canary"].values()) == {"exact"}
    assert set(told["canary"]) == set(told["stages"])
    assert told["limits"]["GL_MAX_TEXTURE_SIZE"] >= 1024
    assert told["context_seconds"] > 0


# Memory and cancellation ----------------------------------------------------------------------


def test_a_solve_frees_all_textures(ledger):
    solve(body(), SeilerPrior(), optimizer=CLOSED_FORM, backend="opengl")
    assert len(ledger.made) > 20
    assert ledger.left == 0


def test_the_next_solve_of_the_same_tissue_copies_only_the_edit(ledger, monkeypatch):
    import moderngl

    problem, written = body(), []
    first = solve(problem, ElasticPrior(), backend="opengl")
    assert ledger.left > 0, "the model is kept"
    write = moderngl.Texture.write
    numbers = (7, 5), (5, 7)  # textures of the test kernel

    def spied(self, data, viewport=None):
        if self.size not in numbers:
            written.append(viewport or (0, 0, *self.size))
        write(self, data, viewport)

    monkeypatch.setattr(moderngl.Texture, "write", spied)
    again = solve(replace(problem), ElasticPrior(), backend="opengl")
    np.testing.assert_array_equal(again.displacement, first.displacement)
    assert not written

    row, col, component = np.argwhere(problem.known)[-1]
    pushed = problem.observed.copy()
    pushed[row, col, component] += 1
    edited = replace(problem, observed=pushed)
    warm = solve(edited, ElasticPrior(), backend="opengl", initial=[again, first])
    assert written == [(col // 2, row, 1, 1)]
    assert warm.displacement[row, col, component] == pushed[row, col, component]
    back = solve(replace(problem), ElasticPrior(), backend="opengl", initial=[warm])
    assert back.displacement[row, col, component] == problem.observed[row, col, component]
    cold = solve(edited, ElasticPrior(), backend="cpu")
    assert np.abs(warm.displacement - cold.displacement).max() < 2e-3

    solve(replace(problem, stiffness=2 * problem.stiffness), ElasticPrior(), backend="opengl")
    on_compute_thread(lambda: the_device().forget_model())
    assert ledger.left == 0


def test_an_error_frees_all_textures(ledger):
    def fail(_):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        solve(body(), SeilerPrior(), backend="opengl", progress=fail)
    on_compute_thread(lambda: None)
    assert ledger.left == 0


def test_a_cancelled_solve_frees_memory_and_does_not_affect_the_next(
    stage, ledger, every_pass_a_batch
):
    def count_batches(stop_at=None):
        return count_looks(stage, ICM(iterations=12), body(), SeilerPrior(), stop_at)

    how = {"optimizer": CLOSED_FORM, "backend": f"opengl:{stage}"}
    before = solve(body(), SeilerPrior(), **how)
    looks = count_batches()
    assert looks > len(levels((45, 61)))
    for where in (0.0, 0.03, 0.5, 0.999):
        with pytest.raises(Cancelled):
            count_batches(stop_at=int(where * looks))
        assert ledger.left == 0
    after = solve(body(), SeilerPrior(), **how)
    np.testing.assert_array_equal(after.displacement, before.displacement)
    np.testing.assert_array_equal(after.energy, before.energy)


def test_one_context_serves_all_solves(opengl):
    device = on_compute_thread(the_device)
    solve(body(), SeilerPrior(), optimizer=CLOSED_FORM, backend="opengl")
    assert on_compute_thread(the_device) is device


def test_the_default_context_of_moderngl_is_not_set(opengl):
    import moderngl

    on_compute_thread(the_device)
    assert moderngl._store.default_context is None


def test_the_context_is_released_when_the_compute_thread_ends(opengl):
    device = on_compute_thread(the_device)
    assert compute_thread.stop(timeout=LONG)
    assert device.lost
    before = threading.active_count()
    assert solve(body(), SeilerPrior(), optimizer=CLOSED_FORM, backend="opengl").mean_energy >= 0
    assert threading.active_count() <= before + 1
    assert on_compute_thread(the_device) is not device


class FakeContext:
    """Context that records whether it was released."""

    def __init__(self, renderer: str) -> None:
        self.ctx = self
        self.info = {"GL_RENDERER": renderer}
        self.released = False

    def release(self) -> None:
        self.released = True


@pytest.mark.parametrize(
    ("devices", "taken", "released"),
    [
        (["AMD"], "AMD", []),
        (["llvmpipe"], "llvmpipe", []),
        (["llvmpipe", "NVIDIA"], "NVIDIA", ["llvmpipe"]),
        (["NVIDIA", "llvmpipe"], "NVIDIA", []),
        ([None, "Intel"], "Intel", []),
        (["llvmpipe", None], "llvmpipe", ["llvmpipe"]),
        (["llvmpipe", "softpipe"], "llvmpipe", ["llvmpipe", "softpipe"]),
    ],
)
def test_a_gpu_is_preferred_to_a_software_renderer(monkeypatch, devices, taken, released):
    from napari_hmrf.solver.backends.opengl.context import context

    opened = []

    def way(index: int):
        return context._Way(f"device {index}", lambda: None, {}, others=len(devices) > 1)

    def fake_open(this):
        renderer = devices[int(this.name.split()[1])]
        if renderer is None:
            raise RuntimeError("eglInitialize failed (0x3001)")
        opened.append(FakeContext(renderer))
        return opened[-1]

    monkeypatch.setattr(context, "_ways", lambda: map(way, range(len(devices))))
    monkeypatch.setattr(context, "_open", fake_open)
    chosen = context.open_context()
    assert chosen.info["GL_RENDERER"] == taken
    assert not chosen.released
    assert [each.info["GL_RENDERER"] for each in opened if each.released] == released


# Errors ---------------------------------------------------------------------------------------


def test_opengl_is_rejected_outside_the_compute_thread(opengl):
    with pytest.raises(RuntimeError, match="compute thread"):
        OpenGLBackend(lambda: None)
    assert not threading.current_thread().name.startswith("napari-hmrf")


def test_an_unknown_stage_is_rejected():
    with pytest.raises(BackendError, match="geometry"):
        OpenGLBackend(lambda: None, "geometry")


@pytest.mark.parametrize("axis", [0, 1])
def test_an_image_beyond_the_limit_is_rejected_before_any_allocation(ledger, axis):
    def job() -> int:
        backend = OpenGLBackend(lambda: None)
        largest = backend._device.largest
        shape = [2, 2]
        shape[axis] = largest + 1
        canary = len(ledger.made)
        try:
            with pytest.raises(BackendError) as raised:
                backend.upload(np.zeros((*shape, 2), np.float32))
        finally:
            backend.close()
        for word in (str(largest + 1), str(largest), "GiB", "Downsample", 'backend="cpu"'):
            assert word in str(raised.value)
        return len(ledger.made) - canary

    assert on_compute_thread(job) == 0


def test_running_out_of_memory_raises_an_error(opengl):
    def job() -> None:
        device = the_device()
        device.largest = 2**30  # so that the driver reports the error
        with pytest.raises(BackendError, match="failed while allocating an image"):
            device.texture((2**20, 2**20), 4)
        assert device.lost

    on_compute_thread(job)
    assert solve(body(), SeilerPrior(), optimizer=CLOSED_FORM, backend="opengl").mean_energy >= 0


def test_an_opengl_error_drops_the_result_and_the_context(opengl):
    device = on_compute_thread(the_device)
    broken = False

    def stray_error() -> None:
        nonlocal broken
        if not broken:
            device.ctx.texture((-1, 5), 1)  # sets GL_INVALID_VALUE, but raises nothing
            broken = True

    def job() -> None:
        backend = OpenGLBackend(stray_error)
        try:
            ICM(iterations=3).run(body(), SeilerPrior(), backend, lambda _: None)
        finally:
            backend.close()

    with pytest.raises(BackendError, match="GL_INVALID_VALUE") as raised:
        on_compute_thread(job)
    assert "next solve" in str(raised.value)
    assert device.lost
    assert on_compute_thread(the_device) is not device
    assert solve(body(), SeilerPrior(), optimizer=CLOSED_FORM, backend="opengl").mean_energy >= 0


def test_a_device_with_wrong_results_is_rejected(stage):
    class Lazy:
        def run(self, *_args: object) -> None:
            """Draw nothing."""

        def release(self) -> None:
            """Do nothing."""

    def job() -> None:
        device = the_device()
        device.ensure(stage)
        key = ("canary", stage, device.rows)
        device._programs.pop(key).release()
        device._programs[key] = Lazy()
        with pytest.raises(BackendError, match="cannot be trusted"):
            device.canary(stage)
        assert device.lost

    on_compute_thread(job)
    solution = solve(body(), SeilerPrior(), optimizer=CLOSED_FORM, backend=f"opengl:{stage}")
    assert np.isfinite(solution.displacement).all()


def test_a_shader_compile_error_shows_the_source_lines(stage, monkeypatch):
    original = source._text
    broken = original("sum").replace("total += along;", "total += alone;")
    line = broken.splitlines().index("        total += alone;") + 1
    monkeypatch.setattr(source, "_text", lambda name: broken if name == "sum" else original(name))

    def job() -> None:
        with pytest.raises(BackendError) as raised:
            compile_program(the_device().ctx, "sum", stage, {"BLOCK": 8})
        words = str(raised.value)
        assert "alone" in words
        assert f"sum.glsl:{line} |         total += alone;" in words
        log = words.split("#version")[0]
        assert f"sum.glsl:{line}" in log or f"sum.glsl({line})" in log

    on_compute_thread(job)


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("file", "right", "wrong"),
    [
        ("cliques", "ratio.y * s + u", "ratio.y * s - u"),
        ("cliques", "steep.y * first + steep.x * second", "steep.x * first + steep.y * second"),
        ("icm", "0.5 * share", "1.0 * share"),
        ("ratios", "exists ? m * inverse", "true ? m * inverse"),
        ("ratios", "in_image(site, size) ? inverse : 0.0", "inverse"),
        ("common", "VERTICAL = ivec2(0, 1)", "VERTICAL = ivec2(1, 0)"),
        ("common", "row[2] = both.zw", "row[2] = both.xy"),
        ("cliques", "here = below", "here = above"),
    ],
)
def test_a_wrong_sign_or_border_in_a_shader_is_detected(stage, monkeypatch, file, right, wrong):
    original = source._text
    assert right in original(file)
    problem = body((21, 26))
    stiff = problem.stiffness.copy()
    stiff[5:9, :] *= 3  # stiffness differs on both sides of a site and at the border of the image
    problem = Problem(
        observed=problem.observed,
        confidence=problem.confidence,
        stiffness=np.where(stiff > 0, stiff, 5),
    )
    prior = SeilerPrior(penalty=5.0)  # observations and stiffness then compete
    loops = solve(problem, prior, optimizer=CLOSED_FORM, backend="cpu")
    monkeypatch.setattr(
        source,
        "_text",
        lambda name: original(name).replace(right, wrong) if name == file else original(name),
    )
    largest = np.abs(loops.displacement).max()
    try:
        on_compute_thread(lambda: the_device().release())
        shaders = solve(problem, prior, optimizer=CLOSED_FORM, backend=f"opengl:{stage}")
        noticed = np.abs(shaders.displacement - loops.displacement).max() > 1e-3 * largest
    except BackendError as error:
        noticed = "NaN or infinite" in str(error)  # solve() itself detected the error
    finally:
        on_compute_thread(lambda: the_device().release())
    assert noticed


# Pace -----------------------------------------------------------------------------------------


def _pace(seconds_per_site: float, looks: list[float], monkeypatch) -> Pace:
    """Return a pace for a simulated device of a given speed, with a simulated clock."""
    clock = [0.0]
    queued = [0]

    def finish() -> None:
        clock[0] += queued[0] * seconds_per_site
        queued[0] = 0

    from napari_hmrf.solver.backends.opengl.context import pace as module

    monkeypatch.setattr(module.time, "perf_counter", lambda: clock[0])
    pace = Pace(finish, lambda: looks.append(clock[0]))
    pace.queued = queued
    return pace


@pytest.mark.parametrize("seconds_per_site", [1e-10, 2e-8, 1e-6, 1e-5])
def test_cancellation_is_checked_about_once_per_batch_at_any_device_speed(
    seconds_per_site, monkeypatch
):
    looks: list[float] = []
    pace = _pace(seconds_per_site, looks, monkeypatch)
    grid = (300, 300)
    for _ in range(400):
        for rows in pace.strips(grid):
            begin, end = rows or (0, grid[0])
            pace.queued[0] += (end - begin) * grid[1]
    # The pace measures the speed of the device during the first passes.
    gaps = np.diff(looks)[8:]
    assert gaps.size == 0 or gaps.max() < 0.3
    assert gaps.size < 10 or gaps.mean() > 0.02


def test_strips_cover_every_row_once(monkeypatch):
    looks: list[float] = []
    pace = _pace(1e-5, looks, monkeypatch)
    covered = np.zeros(997, int)
    for rows in pace.strips((997, 4000)):
        begin, end = rows or (0, 997)
        pace.queued[0] += (end - begin) * 4000
        covered[begin:end] += 1
    assert (covered == 1).all()
    assert len(looks) > 100
