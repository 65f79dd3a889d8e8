"""The log that bags are made from, and what reading one of them must end in."""

from pathlib import Path

import pytest

from torchfsid.config.bags import BagConfig
from torchfsid.config.documents import validate
from torchfsid.errors import ConfigError, LogError
from torchfsid.logs.read import read_log

CSV = """t,robot,x,y,vx,vy,radius
0,ann,-1.4999999999999998,0.25,0.12499999999999999,-0.5,0.2
0,bob,1.1,0.3,-0.7,0.01,0.25
0.033,ann,-1.49,0.23,0.13,-0.49,0.2
0.033,bob,1.08,0.31,-0.69,0.02,0.25
0.066,ann,-1.48,0.21,0.14,-0.48,0.2
0.066,bob,1.06,0.32,-0.68,0.03,0.25
0.1,ann,-1.47,0.19,0.15,-0.47,0.2
0.1,bob,1.04,0.33,-0.67,0.04,0.25
"""


def section(**fields: object) -> BagConfig:
    return validate(fields, BagConfig, source="bag")


def refusal(path: Path, bag: BagConfig) -> str:
    """The message in which reading must end: one printable line."""
    with pytest.raises((LogError, ConfigError)) as caught:
        read_log(path, bag)
    message = str(caught.value)
    assert message.isprintable(), message
    return message
