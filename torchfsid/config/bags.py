"""Where the bodies are in a ROS 2 bag: the section `bag` of an observe file."""

from __future__ import annotations

import reprlib

from pydantic import Field, model_validator

from torchfsid.config.documents import Strict, wrong
from torchfsid.config.quantities import BodyName, NonNegative, Positive


class BagConfig(Strict):
    """Where in a bag the bodies are, in the order in which the log has them.

    Attributes:
        topics: bodies by the topic of their Odometry or PoseStamped.
        frames: bodies by the child frame of their transform on /tf.
        rate: [Hz], of the clock onto which bodies are brought whose stamps differ, best the controllers' rate; default:
            the stamps of the first body. Stamps that are the same for all bodies are a clock already.
        radius: of every body [m].
    """

    topics: dict[str, BodyName] = Field(default_factory=dict)
    frames: dict[str, BodyName] = Field(default_factory=dict)
    rate: Positive | None = None
    radius: dict[BodyName, NonNegative] | None = None

    @property
    def origins(self) -> list[tuple[str, str]]:
        """Where each body's samples come from, in words, and the body."""
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
        if self.radius is not None and set(self.radius) != set(bodies):
            raise wrong(
                f"expected a radius for each of {reprlib.repr(bodies)}, got {reprlib.repr(self.radius)}", "radius"
            )
        return self
