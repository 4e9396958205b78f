"""Fields of the tools; only the fields of the current tool are visible."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, cast

from magicgui.widgets import ComboBox, Widget

from napari_hmrf.field.directions import Directions
from napari_hmrf.tissue.boundary_rules import Material, stiffness_in_words
from napari_hmrf.tissue.drawing.marks import Point
from napari_hmrf.tissue.material_presets import PLAIN, PRESETS, Palette, Preset
from napari_hmrf.ui.forms import Form, length, menu, narrow, share, show_choices, show_quietly
from napari_hmrf.ui.motion.tool import Tool, ToolSettings
from napari_hmrf.ui.motion.tools import BY_NAME

#: Lowest confidence that can be chosen; a mark of confidence 0 would have no effect.
_LEAST_CONFIDENCE = 0.05
#: Last sentence of the tooltips of fields that change the selected mark.
_SELECTED = (
    "This also changes the selected mark, such as the last mark drawn. To keep that mark, press "
    "Escape on the canvas first."
)
_SURE = (
    "Confidence in this motion: 1 holds tissue exactly; below 1, tissue slips if holding it would "
    f"strain it by more than about this value. {_SELECTED}"
)
_UNUSED = "Not used: the landmark has an uncertainty (±). At an uncertainty of 0, it is exact"
_UNSURE = (
    "Standard deviation of the landmark's displacement. 0: exact, so that tissue within the radius "
    "moves to the target. Above 0: only the tissue at the point is moved, not a patch, and it may "
    "miss the target by about this distance if this reduces its strain; for the elastic model and "
    "large motion"
)
#: Attributes of marks by the name of the field that sets them, if the names differ.
_ATTRIBUTES = {"stroke_confidence": "confidence", "material": "label"}
#: Usual values of the fields that are visible only on request or with another value.
_FURTHER = {"confidence": 1.0, "components": "both"}
#: Fields for the displacement along the row axis and the column axis.
_STEPS = ("by_row", "by_col")


class ToolFields(Form):
    """Settings of the tools, for new marks and for the selected mark.

    Attributes
    ----------
    radius, by_row, by_col, amount, sd : FloatSpinBox
    confidence, stroke_confidence, softness : FloatSlider
    components, preset, material : ComboBox
        Widgets. `Tool.fields` lists the widgets that a tool uses; `preset` is shown with
        `material`.
    """

    def __init__(self) -> None:
        self.radius = length(
            "radius",
            "Radius of the pulled patch or of the brush ([ makes it smaller, ] makes it larger)",
            least=0.0,
            value=10.0,
            step=1.0,
        )
        self._ways = Directions()
        self.by_row, self.by_col = (length(self._ways.label(axis), "") for axis in (0, 1))
        self.amount = length(
            "outward",
            "Distance by which the outline moves along its normal, in the unit of the image; a "
            "negative distance shrinks the patch",
        )
        self.confidence = share("confidence", _SURE, value=1.0, min=_LEAST_CONFIDENCE)
        self.sd = length("uncertainty ±", _UNSURE, least=0.0)
        self.stroke_confidence = share(
            "confidence",
            "New confidence of held and moved tissue under the brush, from 0 (free) to 1 (held "
            "exactly)",
        )
        self.softness = share(
            "softness",
            "Fraction of the radius over which the brush fades out, from 0 (hard edge) to 1 (fades "
            "out from the centre)",
        )
        self.components = ComboBox(
            choices=_components(self._ways),
            label="direction",
            tooltip="Directions in which the motion is set; tissue is free in the other directions",
        )
        self.preset = menu(
            "tissues of",
            {each: each.name for each in (*PRESETS, PLAIN)},
            "Tissues to paint with, because the tissue has no table. The first of these tissues is "
            "as stiff as unpainted tissue, or as its median where stiffness varies. The other "
            "stiffnesses keep their ratios to the first",
        )
        tip = (
            "Tissue to paint, from the table of the tissue layer or from the presets. In brackets: "
            "its stiffness"
        )
        self.material = ComboBox(choices=[], label="new tissue", tooltip=tip)
        for choices in (self.preset, self.components):
            narrow(choices)
        for each in (self.stroke_confidence, self.softness, self.components, self.material):
            each.tooltip = f"{each.tooltip}. {_SELECTED}"
        self._own_table = self._shows_further = False
        # Radius of new marks until the user sets one.
        self._suggested_radius = self.radius.value
        self._radius_is_set = False
        # Smallest and largest value of each length; and why the last typed length was replaced.
        self._ranges: dict[Any, tuple[float, float]] = {}
        self._unit, self._refusal = "px", ""
        lengths = (self.radius, self.by_row, self.by_col, self.amount, self.sd)
        for each in lengths:
            # Connected before the container, so that tools never receive a length out of range.
            each.changed.connect(partial(self._on_length, each))
        # Tools refer to a field by its name, which is the name of the attribute.
        fields = {name: each for name, each in vars(self).items() if isinstance(each, Widget)}
        for name, field in fields.items():
            field.name = name
        super().__init__([*fields.values()])
        self._tool = BY_NAME["pull"]
        self._labels = {field: str(field.label) for field in lengths}
        self._about = {field: str(field.tooltip) for field in lengths}
        self.sd.changed.connect(lambda _: self._describe_patch())
        self.show_for(self._tool)
        self.show_place("px", self._ways)

    @property
    def settings(self) -> ToolSettings:
        """Settings for new marks of the current tool."""
        values = {
            _ATTRIBUTES.get(name, name): getattr(self, name).value
            for name in self._tool.fields
            if name not in _STEPS
        }
        if "radius" in values:
            values["radius"] = self.patch_radius
        if values.get("label", 0) is None:  # there are no tissues to choose yet
            del values["label"]
        if self._has_step:
            values["by"] = self._by
        return cast(ToolSettings, values)

    @property
    def shown_settings(self) -> ToolSettings:
        """Settings in the fields, for the selected mark."""
        shown = self.settings
        if "radius" in shown:
            shown["radius"] = float(max(self.radius.value, self.radius_range[0]))
        return shown

    @property
    def _has_step(self) -> bool:
        """True if the current tool sets a displacement."""
        return not set(_STEPS).isdisjoint(self._tool.fields)

    @property
    def _by(self) -> Point:
        """Displacement in the fields, in the order of the image axes."""
        return self._ways.from_display((self.by_row.value, self.by_col.value))

    @property
    def words(self) -> str:
        """Short description of the current tool and its settings."""
        words, which = self._tool.title, self.components.value
        if self._has_step:
            *deep, row, col = self._by
            step = (*deep, 0.0 if which == "col" else row, 0.0 if which == "row" else col)
            seen = tuple(round(part, 2) + 0.0 for part in self._ways.to_display(step))
            words = f"{words} {self._ways.step(seen)}"
        if "components" not in self._tool.fields or which == "both":
            return words
        axis = ("row", "col").index(which)
        return f"{words}, {self._ways.only(axis).partition(' (')[0]}"

    def show_for(self, tool: type[Tool]) -> None:
        """Show the fields of a tool, and hide all other fields."""
        self._tool = tool
        is_volume = len(self._ways.order) == 3
        if is_volume:  # a mark in a volume prescribes all components
            self.components.value = "both"
        for field in self:
            is_used = field.name in tool.fields and not (is_volume and field is self.components)
            is_usual = field.name in _FURTHER and field.value == _FURTHER[field.name]
            field.visible = is_used and (self._shows_further or not is_usual)
        self.preset.visible = "material" in tool.fields and not self._own_table
        self._describe_patch()

    def show_further(self, is_shown: bool) -> None:
        """Show all fields of the tools, or hide those that have their usual values."""
        self._shows_further = is_shown
        self.show_for(self._tool)

    def show_settings(self, settings: ToolSettings) -> None:
        """Show the settings of the selected mark, without changing the mark or other fields."""
        values: dict[str, Any] = dict(settings)
        if "by" in settings:
            *_, values["by_row"], values["by_col"] = self._ways.to_display(settings["by"])
        for name in self._tool.fields:
            field, attribute = getattr(self, name), _ATTRIBUTES.get(name, name)
            value = values.get(attribute, field.value)
            if name == "confidence":
                value = max(value, _LEAST_CONFIDENCE)
            if name != "material" or value in field.choices:
                show_quietly(field, value)
        self.show_for(self._tool)

    @property
    def unit(self) -> str:
        """Unit of the lengths."""
        return self._unit

    @property
    def patch_radius(self) -> float:
        """Radius of a new patch, in the range of radii."""
        # The field may show the radius of the selected mark, also of a file and rounded to 0.
        radius = self.radius.value if self._radius_is_set else self._suggested_radius
        return float(max(radius, self.radius_range[0]))

    @property
    def radius_range(self) -> tuple[float, float]:
        """Smallest and largest radius."""
        return self._ranges.get(self.radius, (0.5, math.inf))

    def limit(
        self, smallest: float, largest: float, radius: float, step: float, spread: float
    ) -> None:
        """Set the range of the lengths for an image, in the unit of the image.

        Parameters
        ----------
        smallest, largest : float
            Smallest radius, and largest length in any field; see `length_range`.
        radius, step : float
            Default radius and growth, which replace values out of range.
        spread : float
            Largest uncertainty of a landmark.
        """
        decimals = min(max(2, 1 + math.ceil(-math.log10(smallest))), 12)
        for field, least, most, usual, pixels in (
            (self.radius, smallest, largest, radius, 1.0),
            (self.by_row, -largest, largest, 0.0, 0.5),
            (self.by_col, -largest, largest, 0.0, 0.5),
            (self.amount, -largest, largest, step, 0.5),
            (self.sd, 0.0, spread, 0.0, 0.5),
        ):
            self._ranges[field] = least, most
            field.native.setDecimals(decimals)
            field.step = float(f"{2 * smallest * pixels:.1g}")
            if not least <= field.value <= most:
                show_quietly(field, min(max(usual, least), most))
        self._describe_ranges()

    def _describe_ranges(self) -> None:
        """Add the range of each length to its tooltip."""
        for field, about in self._about.items():
            if field in self._ranges:
                least, largest = self._ranges[field]
                field.tooltip = f"{about}. From {least:g} to {largest:g} {self._unit}. {_SELECTED}"
        self._describe_patch()

    def _describe_patch(self) -> None:
        """Disable the fields of the patch if the landmark has an uncertainty, with the reason."""
        is_exact = "sd" not in self._tool.fields or self.sd.value == 0
        if self.confidence.enabled != is_exact:
            self.radius.enabled = self.confidence.enabled = is_exact
            self.confidence.tooltip = _SURE if is_exact else _UNUSED
            if is_exact:
                self._describe_ranges()
        if not is_exact:
            self.radius.tooltip = _UNUSED

    def pop_refusal(self) -> str:
        """Return why the last typed length was replaced, once; "" if it was not."""
        refusal, self._refusal = self._refusal, ""
        return refusal

    def _on_length(self, field: Any, value: float) -> None:
        """Replace a length out of range by the nearest length in the range."""
        if field is self.radius:
            self._radius_is_set = True
        if field not in self._ranges:
            return
        least, largest = self._ranges[field]
        nearest = min(max(value, least), largest)
        if nearest != value:
            show_quietly(field, nearest)
            unit, name = self._unit, self._labels[field]
            self._refusal = (
                f"'{name}' must be from {least:g} to {largest:g} {unit} in this image; it was set "
                f"to {nearest:g} {unit}."
            )

    def suggest_radius(self, radius: float) -> None:
        """Set the radius of new marks, unless the user has set one."""
        if not self._radius_is_set:
            self._suggested_radius = radius

    def show_new_radius(self) -> None:
        """Show the radius of new marks, because no mark is selected."""
        show_quietly(self.radius, self.patch_radius)

    def begin_with(self, step: float) -> None:
        """Set the default growth for an image, so that the tool *Grow* has an immediate effect.

        A displacement has no good default direction, so it stays 0 until the user sets it.
        """
        self.amount.value = self.amount.value or step

    def show_place(self, unit: str, ways: Directions) -> None:
        """Show the unit of length and the directions of the rows and columns.

        The displacement stays the same; only the labels and signs of its fields change.
        """
        self._unit, by, steps = unit, self._by, (self.by_row, self.by_col)
        turned, self._ways = ways != self._ways, ways
        for axis, field in enumerate(steps):
            self._labels[field], self._about[field] = ways.label(axis), ways.about(axis)
            field.tooltip = f"{ways.about(axis)}; in the unit of the image"
        self._describe_ranges()
        for field, words in self._labels.items():
            field.label = f"{words} ({unit})"
        self.show_for(self._tool)
        if turned:
            for field, length in zip(steps, ways.to_display(by)[-2:], strict=True):
                show_quietly(field, length)
            show_choices(self.components, _components(ways), self.components.value)

    def offer_presets(self, usual: Preset, chosen: Preset | None = None) -> None:
        """Offer all presets, and choose one.

        Parameters
        ----------
        usual : Preset
            Default, which is listed first.
        chosen : Preset, optional
            Preset to choose, such as one from a study, which may be unknown to the menu. By
            default, `usual` is chosen.
        """
        presets = dict.fromkeys((usual, *PRESETS, PLAIN, chosen or usual))
        choices = [(each.name, each) for each in presets]
        show_choices(self.preset, choices, chosen or usual)

    def offer(self, palette: Palette) -> None:
        """Offer tissues to paint, and keep the chosen tissue if the palette contains it."""
        rows = palette.materials
        choices = [(_in_words(row, palette.unit), row.label) for row in rows]
        labels = [label for _, label in choices]
        # The default is the last deformable tissue, because tables begin with common tissues.
        solid = [row.label for row in rows if row.is_deformable]
        before, usual = self.material.value, (solid or labels)[-1]
        show_choices(self.material, choices, before if before in labels else usual)
        self._own_table = palette.is_table
        self.show_for(self._tool)


def _in_words(row: Material, unit: str) -> str:
    stiffness = stiffness_in_words(row.stiffness, unit) if row.stiffness > 0 else "no tissue"
    return f"{row.name or row.label} ({stiffness})"


def _components(ways: Directions) -> list[tuple[str, str]]:
    """Return the menu entries for the components that a mark prescribes."""
    return [("any", "both"), (ways.only(0), "row"), (ways.only(1), "col")]
