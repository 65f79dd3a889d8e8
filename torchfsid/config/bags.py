"""The section `bag` of an observe file: where the bodies are in a ROS 2 bag."""

from __future__ import annotations

import reprlib
from typing import Annotated

from pydantic import Field, model_validator

from torchfsid.config.documents import Strict, wrong
from torchfsid.config.quantities import BodyName, NonNegative, Positive


class BagConfig(Strict):
    """The bodies of a bag, in the order in which the log has them.

    Attributes:
        topics: topic of an Odometry or PoseStamped, to the name of the body.
        frames: child frame of a transform on /tf, to the name of the body. With `fixed_frame` any frame of the tree.
        fixed_frame: frame to which chains of transforms on /tf and /tf_static lead, such as map. Default: none, all
            positions are given in the same frame.
        rate: rate [Hz] of the common clock, best the controllers' rate. It is used only if the bodies' stamps differ.
            Default: the stamps of the first body.
        accelerations: topic of an AccelStamped, to the name of the body. In the frame of the positions.
        radius: radius of every body [m].
        covariance_multiple: number of standard deviations, from the covariances of Odometry, that bound the errors of
            positions and velocities. Default: covariances are not used.
    """

    topics: dict[str, BodyName] = Field(default_factory=dict)
    frames: dict[str, BodyName] = Field(default_factory=dict)
    accelerations: dict[str, BodyName] = Field(default_factory=dict)
    fixed_frame: Annotated[str, Field(min_length=1)] | None = None
    rate: Positive | None = None
    radius: dict[BodyName, NonNegative] | None = None
    covariance_multiple: Positive | None = None

    @property
    def origins(self) -> list[tuple[str, str]]:
        """Pairs of a topic or frame, described in words, and its body."""
        topics = [(f"topic {topic!r}", body) for topic, body in self.topics.items()]
        return topics + [(f"frame {frame!r}", body) for frame, body in self.frames.items()]

    @model_validator(mode="after")
    def _maps_every_body_once(self) -> BagConfig:
        bodies = [body for _, body in self.origins]
        if not bodies:
            raise wrong("expected topics (topic: robot), frames (child frame: robot), or both")
        for body in bodies:
            if bodies.count(body) > 1:
                raise wrong(f"{bodies.count(body)} topics or frames are mapped to {body!r}")
        for topic, body in self.accelerations.items():
            if body not in bodies or list(self.accelerations.values()).count(body) > 1:
                raise wrong(f"expected one topic for each of {reprlib.repr(bodies)} at most", f"accelerations.{topic}")
        if self.radius is not None and set(self.radius) != set(bodies):
            raise wrong(
                f"expected a radius for each of {reprlib.repr(bodies)}, got {reprlib.repr(self.radius)}", "radius"
            )
        return self
