"""The paper's two tables, with results of this package."""

from __future__ import annotations

from run import PHANTOMS, available, speed_targets, table_1, table_2

from report.page import Section, Settings


def section(settings: Settings) -> Section:
    """Return the section with tables 1 and 2."""
    page = Section("The paper's tables")
    size = settings.choose(300, 48)
    page.say(
        f"""**Question.** Table 1: how far is the field from finite elements (bilinear quads on
        the pixel grid, plane stress, Poisson's ratio 0.3, scikit-fem), inside the body, at
        {size} x {size}? Each prior has its own energy; energies of different priors do not
        compare."""
    )
    rows, best = [], {}
    for name in PHANTOMS:
        results, reference = table_1(name, size)
        for result in results:
            run = result.solution
            rows.append(
                [
                    name,
                    result.method,
                    f"{run.mean_energy:.5f}",
                    f"{result.off:.4f} px",
                    run.iterations,
                    f"{run.provenance.seconds:.3f} s",
                ]
            )
            best[name, result.method] = result.off
        field = f"finite elements (field: {reference.motion:.2f} px rms)"
        rows.append([name, field, None, "0", None, f"{reference.seconds:.2f} s"])
        if not settings.quick:
            page.targets += [result.target for result in results]
    rows.append(["*the paper's*", "*HMRF, 70 sweeps a level*", 0.19404, "1.44 px", 700, "1.63 s"])
    page.table(["phantom", "method", "mean energy", "RMSD", "iterations", "time"], rows)
    page.say(
        """**Conclusion.** The paper's schedule stops far from convergence: most of its distance
        to finite elements does not come from the model. The distance of the converged field
        does, because its energy has no Poisson effect. The elastic prior has almost no distance,
        because it is the same discretisation; see *Finite elements* for an independent program,
        and *Analytic fields* for the error of any discretisation by pixels. The paper's phantom
        is not public, so its 1.44 px belongs to another geometry."""
    )
    backends = available(("opengl", "cpu"))
    sizes = settings.choose((300, 600, 1200), (48,))
    timings = [table_2(size, backends, settings.choose(7, 1)) for size in sizes]
    page.say(
        """**Question.** Table 2: how much faster are 70 sweeps on each level than on one thread
        of a processor? *Literal* is the algorithm as printed, compiled, on one thread; the
        others do the same sweeps. The times are medians in a warm process, with uploads and
        read-back; the literal program ran once. The paper reports 56 times, on a graphics card
        of 2006."""
    )
    page.table(
        ["image", *backends.values(), "literal"],
        [
            [
                f"{timing.size} x {timing.size}",
                *(
                    f"{seconds:.3f} s ({timing.literal / seconds:.0f} times faster)"
                    for seconds in timing.backends.values()
                ),
                f"{timing.literal:.1f} s",
            ]
            for timing in timings
        ],
    )
    page.say(
        """**Conclusion.** The paper's ratio compares two machines, this one two programs on one
        machine. Part of it comes from evaluating each clique once per site instead of once per
        candidate, which is independent of the device. Without a GPU, OpenGL is a software
        rasteriser."""
    )
    if not settings.quick:
        page.targets += speed_targets(timings)
    return page
