"""The section `body` of an observe file: robots that do not follow their commands as single integrators do."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import model_validator

from torchfsid.config.documents import Strict, wrong
from torchfsid.config.quantities import BodyName, Flag, Positive


class UnicycleConfig(Strict):
    """Unicycles, and the map by which they follow the command of a single integrator (`logs.unicycles`).

    Attributes:
        heading: the column with the headings [rad]. Bags have the orientations of the poses instead.
        map: `si_to_uni` turns towards the command. `look_ahead` moves a point in front of the robot by it.
        linear_gain: of `si_to_uni`: the forward speed, divided by the command's share along the heading.
        scaled_angle: of `si_to_uni` with a gain: the angle is that of the scaled command, as in rps 1 and where robots
            may drive backwards. Otherwise it is that of the command, as in rps 2.
        angular_limit: of `si_to_uni`: the turn rate where the command is across the heading; default pi. Of
            `look_ahead`: the largest turn rate, as in rps 1; default: none [rad/s].
        distance: of `look_ahead`: the distance of the point from the robot [m].
        wheel_limit: the largest speed of a wheel along the ground [m/s]. Default: none.
        wheel_base: the distance of the wheels from each other [m].
    """

    kind: Literal["unicycle"]
    heading: BodyName = "theta"
    map: Literal["si_to_uni", "look_ahead"]
    linear_gain: Positive = 1.0
    scaled_angle: Flag = False
    angular_limit: Positive | None = None
    distance: Positive | None = None
    wheel_limit: Positive | None = None
    wheel_base: Positive | None = None

    @model_validator(mode="after")
    def _has_what_its_map_needs(self) -> UnicycleConfig:
        if self.map == "look_ahead" and self.distance is None:
            raise wrong("required key is missing, for map 'look_ahead'", "distance")
        if self.map == "si_to_uni" and self.distance is not None:
            raise wrong("map 'si_to_uni' has none", "distance")
        for name, default in (("linear_gain", 1.0), ("scaled_angle", False)):
            if self.map == "look_ahead" and getattr(self, name) != default:
                raise wrong("map 'look_ahead' has none", name)
        for name, other in (("wheel_base", "wheel_limit"), ("wheel_limit", "wheel_base")):
            if getattr(self, name) is None and getattr(self, other) is not None:
                raise wrong(f"required key is missing, with {other}", name)
        return self

    @property
    def rate_across(self) -> float:
        """The turn rate of `si_to_uni` where the command is across the heading [rad/s]."""
        return math.pi if self.angular_limit is None else self.angular_limit
