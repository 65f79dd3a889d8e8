"""Open a log: the suffix chooses the reader."""

from __future__ import annotations

from pathlib import Path

from torchfsid.config.bags import BagConfig
from torchfsid.config.motion_capture import LogConfig
from torchfsid.errors import ConfigError, LogError
from torchfsid.logs.bags import read_bag
from torchfsid.logs.log import Log
from torchfsid.logs.motion_capture import read_motion_capture
from torchfsid.logs.table_log import read_csv, read_parquet


def read_log(
    path: str | Path,
    bag: BagConfig | None = None,
    heading: str | None = None,
    form: LogConfig | None = None,
    in_space: bool = False,
) -> Log:
    """The log at `path`: a rosbag2 folder, .mcap, .db3 or .parquet. Any other suffix is read as CSV.

    Args:
        path: the file or folder.
        bag: where the bodies are in a ROS bag. Other logs ignore it.
        heading: the column of headings, if they are wanted. Bags and motion capture have orientations instead.
        form: the form of a log of motion capture. None: the suffix decides.
        in_space: robots of bags and of motion capture are in space. Otherwise their height has to stay the same. Tables
            are in space if they have a column z.

    Raises:
        LogError: it cannot be read, or is not what its suffix says.
        ConfigError: it is a ROS bag, and `bag` is missing or does not fit it.
    """
    path = Path(path)
    if form is not None:
        return read_motion_capture(path, form, with_headings=heading is not None, in_space=in_space)
    suffix = path.suffix.lower()
    is_folder = path.is_dir()
    if is_folder and not (path / "metadata.yaml").exists():
        raise LogError(
            f"{path}: cannot be read: a folder without metadata.yaml is not a ROS bag (TUM files: log.format)"
        )
    if is_folder or suffix in (".mcap", ".db3"):
        if bag is None:
            raise ConfigError("bag: required to read a ROS bag, e.g. bag: {topics: {/r1/odom: r1, /r2/odom: r2}}")
        return read_bag(path, bag, with_headings=heading is not None, in_space=in_space)
    return read_parquet(path, heading) if suffix == ".parquet" else read_csv(path, heading)
