"""The fields of the tools: of each only those that it needs are seen."""

from __future__ import annotations

from typing import cast

from magicgui.widgets import ComboBox, Container, Widget

from napari_hmrf.field.directions import Directions
from napari_hmrf.tissue.boundary_rules import Material, stiffness_in_words
from napari_hmrf.tissue.drawing import Arrow, Landmark, Mark, Stroke
from napari_hmrf.tissue.drawing.marks import Action
from napari_hmrf.tissue.material_presets import PRESETS, Palette
from napari_hmrf.ui.forms import length, menu, narrow, share
from napari_hmrf.ui.motion.tools import BY_NAME, Tool

#: The lowest confidence that is asked for; below, it says nothing.
_LEAST_CONFIDENCE = 0.05
_SURE = (
    "How sure that is. 1: tissue is held exactly. Below, it slips where holding it would strain "
    "it by more than about that"
)
#: What a field says of a mark, where that has another name than the field.
_SAYS = {"sure": "confidence", "material": "label"}


class ToolFields(Container):
    """How the tools draw."""

    def __init__(self) -> None:
        self.radius = length(
            "radius",
            "Of the patch that is taken hold of, or of the brush, in the unit of the image "
            "([ and ] make it smaller and larger)",
            least=0.001,
            value=10.0,
            step=1.0,
        )
        self._ways = Directions()
        self.by_row, self.by_col = (length(self._ways.label(axis), "") for axis in (0, 1))
        self.amount = length(
            "outward",
            "How far the outline moves along its normal; below 0 inward: it shrinks; in the unit "
            "of the image",
        )
        self.confidence = share("confidence", _SURE, value=1.0, min=_LEAST_CONFIDENCE)
        self.sure = share(
            "becomes",
            "How sure it is what is held or moved under the brush. 1: exactly so, "
            "0: that says nothing any more",
        )
        self.softness = share(
            "softness",
            "Across which part of its radius the brush fades out. 0: hard edge, "
            "1: from its middle on",
        )
        self.components = ComboBox(
            choices=_components(self._ways),
            label="moves",
            tooltip="In which directions this says where tissue goes; in the other it is free",
        )
        self.preset = menu(
            "tissues of",
            {each: each.name for each in PRESETS},
            "Published tissues to paint with, as the tissue layer has no table of its own; what is "
            "not painted behaves as the first of them",
        )
        tip = "Of the tissue's own table, or of the presets"
        self.material = ComboBox(choices=[], label="becomes", tooltip=tip)
        for offered in (self.preset, self.components):
            narrow(offered)
        self._own_table = False
        # Each is called by its attribute: so the tools say which they need.
        fields = {name: each for name, each in vars(self).items() if isinstance(each, Widget)}
        for name, field in fields.items():
            field.name = name
        super().__init__(widgets=[*fields.values()])
        lengths = (self.radius, self.by_row, self.by_col, self.amount)
        for field in lengths:  # what is being typed is no length yet
            field.native.setKeyboardTracking(False)
        self.margins = (0, 0, 0, 0)
        self._tool = BY_NAME["pull"]
        self._labels = {field: str(field.label) for field in lengths}
        self.show_for(self._tool)
        self.show_place("px", self._ways)

    @property
    def how(self) -> Mark:
        """A mark as the tool that is shown makes it; where it lies does not count."""
        tool, somewhere = self._tool, (0.0,) * len(self._ways.order)
        values = {_SAYS.get(name, name): getattr(self, name).value for name in tool.fields}
        if values.get("label", 0) is None:  # there are no tissues to choose yet
            del values["label"]
        if "by_row" in values:
            del values["by_row"], values["by_col"]
            values["by"] = self._by
        if tool.is_brush:
            return Stroke(cast(Action, tool.name), ((somewhere,),), **values)
        return (Landmark if tool.name == "landmark" else Arrow)(somewhere, somewhere, **values)

    @property
    def _by(self) -> tuple[float, ...]:
        """What is typed as a step, along (rows, columns)."""
        return self._ways.along((self.by_row.value, self.by_col.value))

    @property
    def words(self) -> str:
        """What the tool that is shown does, in a few words."""
        words, which = self._tool.title, self.components.value
        if self._tool.name == "move":
            *deep, row, col = self._by
            step = (*deep, 0.0 if which == "col" else row, 0.0 if which == "row" else col)
            seen = tuple(round(part, 2) + 0.0 for part in self._ways.seen(step))
            words = f"{words} {self._ways.step(seen)}"
        if "components" not in self._tool.fields or which == "both":
            return words
        axis = ("row", "col").index(which)
        return f"{words}, {self._ways.only(axis).partition(' (')[0]}"

    def show_for(self, tool: Tool) -> None:
        """Show the fields of a tool, and no others."""
        self._tool = tool
        for field in self:
            field.visible = field.name in tool.fields
        if len(self._ways.order) == 3:  # of a volume a mark speaks of all its axes
            self.components.visible, self.components.value = False, "both"
        self.preset.visible = "material" in tool.fields and not self._own_table

    def show_how(self, how: Mark) -> None:
        """Show how the selected mark was made, without changing it."""
        said = {"components": "both", **vars(how)}
        if isinstance(how, Stroke):
            *_, said["by_row"], said["by_col"] = self._ways.seen(how.by)
            # The size of the brush is nothing of the stroke's that is changed with it.
            del said["radius"]
        for name in self._tool.fields:
            field, what = getattr(self, name), _SAYS.get(name, name)
            value = said.get(what, field.value)
            if name == "confidence":
                value = max(value, _LEAST_CONFIDENCE)
            if name != "material" or value in field.choices:
                with field.changed.blocked():
                    field.value = value

    def begin_with(self, radius: float, step: float) -> None:
        """Have lengths that suit an image, so that what is to expand does.

        A step has a direction, which nobody can guess: it stays 0 until it is given.
        """
        self.radius.value = radius
        self.amount.value = self.amount.value or step

    def show_place(self, unit: str, ways: Directions) -> None:
        """Say in which unit lengths are, and which way the rows and columns run.

        What is typed keeps its meaning, along the rows and columns: words and angles change.
        """
        by, steps = self._by, (self.by_row, self.by_col)
        turned, self._ways = ways != self._ways, ways
        for axis, field in enumerate(steps):
            self._labels[field] = ways.label(axis)
            field.tooltip = f"{ways.about(axis)}; in the unit of the image"
        for field, words in self._labels.items():
            field.label = f"{words} ({unit})"
        self.show_for(self._tool)
        if turned:
            for field, length in zip(steps, ways.seen(by)[-2:], strict=True):
                with field.changed.blocked():
                    field.value = length
            before = self.components.value
            with self.components.changed.blocked():
                self.components.choices = _components(ways)
                self.components.value = before

    def offer(self, palette: Palette) -> None:
        """Have these tissues to be painted; the one chosen stays, if it is among them."""
        rows = palette.materials
        choices = [(_in_words(row, palette.unit), row.label) for row in rows]
        labels = [label for _, label in choices]
        before = self.material.value
        with self.material.changed.blocked():
            # Else those of the same name would come first.
            self.material.choices = []
            self.material.choices = choices
            # What is painted first is a tissue, the last of them: it is what is special.
            solid = [row.label for row in rows if row.is_deformable]
            usual = (solid or labels)[-1]
            self.material.value = before if before in labels else usual
        self._own_table = palette.own
        self.show_for(self._tool)


def _in_words(row: Material, unit: str) -> str:
    stiffness = stiffness_in_words(row.stiffness, unit) if row.stiffness > 0 else "no tissue"
    return f"{row.name or row.label} ({stiffness})"


def _components(ways: Directions) -> list[tuple[str, str]]:
    """In which directions a mark may speak."""
    return [("both directions", "both"), (ways.only(0), "row"), (ways.only(1), "col")]
