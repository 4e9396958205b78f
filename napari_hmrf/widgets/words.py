"""What the widget says about a result."""

from __future__ import annotations

from napari_hmrf.layers.inputs import Inputs
from napari_hmrf.layers.outputs import Outputs


def report(outputs: Outputs, inputs: Inputs, changed: bool = False) -> str:
    """One paragraph: what ran, how long, how well, and what to beware of.

    Parameters
    ----------
    outputs : Outputs
    inputs : Inputs
        What it was computed from.
    changed : bool
        Whether the layers say something else by now.
    """
    solution = outputs.solution
    run = solution.provenance
    seconds = f"{run.seconds:.2g} s"
    if run.preparation_seconds >= 0.1:
        seconds += f" (after {run.preparation_seconds:.1f} s of preparation)"
    where = f"Slice {inputs.frame.slice_name}: " if inputs.frame.slice_name else ""
    parts = [
        f"{where}{solution.iterations} sweeps in {seconds} on {run.renderer}.",
        f"Mean energy {solution.mean_energy:.3g} pixels².",
    ]
    if changed:
        parts.append("Inputs changed since start: deform again to see them.")
    if outputs.folds:
        share = f"{outputs.folds} pixel{'s' if outputs.folds > 1 else ''}"
        parts.append(
            f"Warning: the tissue folds over itself at {share}; smaller motion or a wider "
            "boundary avoids this."
        )
    if outputs.overlaps:
        share = f"{outputs.overlaps} pixel{'s' if outputs.overlaps > 1 else ''}"
        parts.append(
            f"Warning: at {share} one part of the tissue has moved onto another and hides it; "
            "parts do not feel each other across a gap."
        )
    if inputs.ignored:
        parts.append(f"{inputs.ignored} boundary pixels outside tissue were ignored.")
    parts += [f"{note[0].upper()}{note[1:]}." for note in inputs.notes]
    return " ".join(parts)
