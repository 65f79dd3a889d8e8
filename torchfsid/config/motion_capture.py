"""The section `log` of an observe file: logs in the forms in which motion capture exports them.

    log: {format: optitrack}           an export of Motive, CSV; bodies: {r1: "Rigid Body 1"} takes some and names them
    log: {format: vicon}               an export of Nexus or Tracker, CSV; likewise
    log: {format: tum}                 a folder of files t x y z qx qy qz qw, one per robot; bodies: {r1: a.txt}
    log:                               any other table, by the names of its columns
      format: columns
      header_line: 7
      time: "Time (Seconds)"
      unit: mm
      bodies: {r1: {x: "r1 X", y: "r1 Y", heading: "r1 yaw"}, cf2: {file: cf2.csv, x: state.x, y: state.y}}

All other keys are optional.
"""

from __future__ import annotations

import reprlib
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, model_validator

from torchfsid.config.documents import Strict, wrong
from torchfsid.config.quantities import BodyName, NonNegative

ColumnName = Annotated[str, Field(min_length=1)]

SCALES = {"m": 0, "cm": -2, "mm": -3}
"""Units of length, as powers of ten of a metre."""

TIME_UNITS = {"s": 9, "ms": 6, "us": 3, "ns": 0}
"""Units of time, as powers of ten of a nanosecond."""


class BodyColumns(Strict):
    """The columns of one body, with axes as in the export. Velocities, and in the plane the vertical, are optional.

    Attributes:
        file: file in the folder LOG, if the body has one of its own.
        x: position.
        y: position.
        z: position.
        vx: velocity [unit of length per s].
        vy: velocity.
        vz: velocity.
        heading: heading, counterclockwise seen from above [`angle`].
    """

    file: ColumnName | None = None
    x: ColumnName | None = None
    y: ColumnName | None = None
    z: ColumnName | None = None
    vx: ColumnName | None = None
    vy: ColumnName | None = None
    vz: ColumnName | None = None
    heading: ColumnName | None = None


def _name_or_columns(value: Any) -> str:
    return "<name>" if isinstance(value, str) else "<columns>"


class LogConfig(Strict):
    """The form of a log that is no table with columns t, robot, x, y.

    Attributes:
        format: `optitrack`, `vicon`, `tum`, or any table by its `columns`.
        bodies: for each body its columns, or its name in the export, or its file in the folder LOG. Default: all rigid
            bodies, objects or files.
        time: column of times, for `columns`.
        time_unit: unit of these times, or of those of `tum`.
        header_line: line of the file with the names of the columns, for `columns`.
        up: vertical axis of the export. With `y` the plane is (x, -z), seen from above. Default: `y` for `optitrack`,
            otherwise `z`.
        unit: unit of length. Default: what the export says, otherwise `m`.
        angle: unit of headings in `columns`.
        radius: radius of every body [m].
    """

    format: Literal["optitrack", "vicon", "tum", "columns"]
    bodies: dict[
        BodyName,
        Annotated[
            Annotated[ColumnName, Tag("<name>")] | Annotated[BodyColumns, Tag("<columns>")],
            Discriminator(_name_or_columns),
        ],
    ] = Field(default_factory=dict)
    time: ColumnName | None = None
    time_unit: Literal["s", "ms", "us", "ns"] = "s"
    header_line: Annotated[int, Field(strict=True, ge=1)] = 1
    up: Literal["y", "z"] | None = None
    unit: Literal["m", "cm", "mm"] | None = None
    angle: Literal["rad", "deg"] = "rad"
    radius: dict[BodyName, NonNegative] | None = None

    @property
    def vertical(self) -> Literal["y", "z"]:
        """The vertical axis of the export."""
        return self.up or ("y" if self.format == "optitrack" else "z")

    @property
    def plane(self) -> tuple[str, str]:
        """The axes of the export that span the plane."""
        return ("x", "z") if self.vertical == "y" else ("x", "y")

    @model_validator(mode="after")
    def _fits_the_format(self) -> LogConfig:
        by_columns = self.format == "columns"
        if by_columns and not self.bodies:
            raise wrong("required key is missing, with format 'columns'", "bodies")
        if by_columns and self.time is None:
            raise wrong("required key is missing, with format 'columns'", "time")
        if not by_columns and self.time is not None:
            raise wrong(f"format {self.format!r} has its own", "time")
        if not by_columns and self.header_line != 1:
            raise wrong(f"format {self.format!r} finds it", "header_line")
        for body, given in self.bodies.items():
            if isinstance(given, BodyColumns) != by_columns:
                expected = "columns, such as {x: .., y: ..}" if by_columns else "a name"
                raise wrong(f"expected {expected} with format {self.format!r}", f"bodies.{body}")
            if isinstance(given, BodyColumns):
                self._has_its_columns(body, given)
        if self.radius is not None and self.bodies and set(self.radius) != set(self.bodies):
            raise wrong(f"expected a radius for each of {reprlib.repr(list(self.bodies))}", "radius")
        return self

    def _has_its_columns(self, body: str, given: BodyColumns) -> None:
        velocities = [f"v{axis}" for axis in self.plane]
        has_velocity = any(getattr(given, axis) for axis in velocities)
        for axis in (*self.plane, *(velocities if has_velocity else ())):
            if getattr(given, axis) is None:
                raise wrong(f"required key is missing, the plane is {', '.join(self.plane)}", f"bodies.{body}.{axis}")
