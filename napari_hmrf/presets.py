"""Materials to begin with, from published models."""

from __future__ import annotations

from dataclasses import dataclass

from napari_hmrf.annotation import Material


@dataclass(frozen=True)
class Preset:
    """Materials that belong together, and where their values come from.

    The stiffnesses of one preset share a unit and must not be mixed with those of another.
    Poisson's ratios are those of the source, if it has any.
    """

    name: str
    unit: str
    source: str
    materials: tuple[Material, ...]


#: Published stiffnesses differ by orders of magnitude between studies; ratios within one agree
#: better, and only ratios matter here.
PRESETS: tuple[Preset, ...] = (
    Preset(
        "Paper: normal 20, soft 10, tumour 40",
        "MPa",
        "Seiler et al., Hierarchical Markov Random Fields Applied to Model Soft Tissue "
        "Deformations on Graphics Hardware, section 2; it has no Poisson's ratio, so that is 0.45, "
        "common for soft tissue",
        (
            Material(1, "normal tissue", 20.0),
            Material(2, "soft tissue", 10.0),
            Material(3, "tumour", 40.0),
        ),
    ),
    Preset(
        "Brain with tumour: healthy 2.1, fluid 0.1, tumour 8",
        "kPa",
        "parameters of the tumour growth solver GLIA (Subramanian, Biros and others), Poisson's "
        "ratios 0.4, 0.1 and 0.45; fluid is modelled there as very soft tissue",
        (
            Material(1, "white and grey matter", 2.1, 0.4),
            Material(2, "cerebrospinal fluid", 0.1, 0.1),
            Material(3, "tumour", 8.0, 0.45),
        ),
    ),
    Preset(
        "Brain: white and grey matter 3, fluid 1",
        "kPa",
        "parameters of the glioma growth library glimslib (Abler, Büchler and others), Poisson's "
        "ratio 0.45 for both",
        (
            Material(1, "white and grey matter", 3.0, 0.45),
            Material(2, "cerebrospinal fluid", 1.0, 0.45),
        ),
    ),
)
