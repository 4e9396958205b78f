"""Advice on tissue models: their uses and measured accuracy, in sentences for the user."""

from __future__ import annotations

from napari_hmrf.solver.model_names import ELASTIC, ModelName, Plane

# The figures are the same as in the README. `make paper` measures them. Times are for two
# cores without a GPU.
_WHEN: dict[ModelName, str] = {
    "elastic": "Tissue stretches and bulges as elastic material does. Boundaries of confidence 1 "
    "are held exactly.",
    "large motion": "Elastic tissue that may rotate and stretch without limit: no pixel folds. "
    "This model takes 8 to 36 times as long; use it if elastic tissue folds, or rotates by more "
    "than ten degrees. Bars stretched by 30 % are within 0.002 px of finite elements.",
    "paper": "The paper's model and schedule, which stops a little early. Squeezed tissue does not "
    "bulge.",
    "paper, converged": "The paper's model at convergence. Squeezed tissue does not bulge.",
}
_OFF: dict[ModelName, float] = {"elastic": 0.0002, "paper": 1.03, "paper, converged": 0.23}
_FROM_FEM = (
    "The sample brain moves by 7.4 px. Its field differs by {} px from a finite-element solution, "
    "the standard in engineering, with Poisson's ratio 0.3."
)
_WHEN_PLANE: dict[Plane, str] = {
    "stress": "Squeezed tissue can bulge out of the image, as in a thin section.",
    "strain": "Squeezed tissue can expand only within the image plane, as deep inside a body.",
}
_HOW_MUCH = (
    "Try both choices: their fields differ by a few per cent to more than half of the movement. "
    "They differ most where Poisson's ratio is near 0.5."
)
ABOUT_POISSON = (
    "Bulging of squeezed tissue: none at 0; at 0.499, so much that tissue hardly loses any "
    "volume.\n0.45 is common for soft tissue."
)


def when_to_take(model: ModelName, plane: Plane | None) -> str:
    """Return advice on when to use a model, with its measured accuracy.

    Parameters
    ----------
    model : {"elastic", "large motion", "paper", "paper, converged"}
    plane : {"stress", "strain"} or None
        None for a volume.
    """
    advice = f"{_WHEN[model]} {_FROM_FEM.format(_OFF[model])}" if model in _OFF else _WHEN[model]
    return f"{advice} {_WHEN_PLANE[plane]} {_HOW_MUCH}" if plane and model in ELASTIC else advice
