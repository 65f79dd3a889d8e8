"""Exports of motion capture: what is written is read, gaps are gaps, a wrong file is one clear line."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from torchfsid.cli import main
from torchfsid.config.documents import validate
from torchfsid.config.motion_capture import LogConfig
from torchfsid.errors import ConfigError, LogError
from torchfsid.logs.read import read_log
from torchfsid.logs.table_log import read_csv

T = np.arange(6) / 120
PATHS = {
    "r1": np.stack([0.5 + 0.3 * T, -1 + 0.1 * T, np.full(6, 0.02)], axis=1),
    "r2": np.stack([2 - 0.3 * T, 0.25 + 0 * T, np.full(6, 0.03)], axis=1),
}
"""Positions seen from above, with a constant height."""

GAP = (2, 3)
"""Samples at which r2 is not seen."""


def form(**fields: object) -> LogConfig:
    return validate(fields, LogConfig, source="log")


def refusal(path: Path, of: LogConfig) -> str:
    """The message in which reading must end: one printable line."""
    with pytest.raises((LogError, ConfigError)) as caught:
        read_log(path, form=of)
    message = str(caught.value)
    assert message.isprintable(), message
    return message


def cells(body: str, k: int, unit: float = 1.0, up: str = "z") -> list[str]:
    """The position of a body as text, or empty cells."""
    if body == "r2" and k in GAP:
        return ["", "", ""]
    x, y, z = PATHS[body][k] / unit
    return [f"{v:.6f}" for v in ((x, z, -y) if up == "y" else (x, y, z))]


def optitrack(folder: Path, unit: str = "Meters", scale: float = 1.0) -> Path:
    """As Motive writes it: rigid bodies with a marker each, y up."""
    labels = {"Rotation": "XYZW", "Position": "XYZ"}
    columns = [(kind, body) for body in PATHS for kind in ("Rigid Body", "Rigid Body Marker")]
    rows = [
        ["Format Version", "1.23", "Take Name", "run", "Export Frame Rate", "120.000000", "Length Units", unit],
        [],
    ]
    header = [["", "Type"], ["", "Name"], ["", "ID"], ["", ""], ["Frame", "Time (Seconds)"]]
    for kind, body in columns:
        for group, axes in labels.items() if kind == "Rigid Body" else [("Position", "XYZ")]:
            name = body if kind == "Rigid Body" else f"{body}:Marker1"
            for row, values in zip(header, ([kind], [name], ["1A"], [group], axes), strict=True):
                row += list(values) * (len(axes) // len(values))
    for k in range(len(T)):
        row = [str(k), f"{T[k]:.6f}"]
        for kind, body in columns:
            position = cells(body, k, scale, "y")
            row += (
                (["0.0", "0.479425539", "0.0", "0.877582562"] if position[0] else [""] * 4)
                if kind == "Rigid Body"
                else []
            )
            row += position
        header.append(row)
    path = folder / "take.csv"
    path.write_text("\n".join(",".join(row) for row in rows + header) + "\n")
    return path


def vicon(folder: Path) -> Path:
    """As Nexus writes it: objects in mm, frames, and another section after them."""
    rows = ["Objects", "120", ",,r1:r1,,,,,,r2:r2,,,,,", "Frame,Sub Frame" + ",RX,RY,RZ,TX,TY,TZ" * 2]
    rows.append(",,rad,rad,rad,mm,mm,mm,rad,rad,rad,mm,mm,mm")
    for k in range(len(T)):
        turned = {body: ["0", "0", "1"] if cells(body, k)[0] else [""] * 3 for body in PATHS}
        rows.append(",".join([str(k), "0"] + [cell for body in PATHS for cell in turned[body] + cells(body, k, 1e-3)]))
    rows += ["", "Trajectories", "120", ",,m1,,", "Frame,Sub Frame,X,Y,Z", ",,mm,mm,mm", "0,0,1,2,3"]
    path = folder / "trial.csv"
    path.write_text("\n".join(rows) + "\n")
    return path


def tum(folder: Path, start: str = "") -> Path:
    """A folder of files, one per robot, with a repeated line."""
    (folder / "runs").mkdir()
    for body in PATHS:
        lines = ["# timestamp tx ty tz qx qy qz qw"]
        for k in range(len(T)):
            if cells(body, k)[0]:
                lines.append(" ".join([f"{start}{k / 100:.9f}"[-40:], *cells(body, k), "0 0 0.479425539 0.877582562"]))
        (folder / "runs" / f"{body}.txt").write_text("\n".join([*lines, lines[-1]]) + "\n")
    return folder / "runs"


def columns(folder: Path) -> tuple[Path, LogConfig]:
    """A table with two lines before its header, centimetres and milliseconds."""
    rows = ["exported by hand", "", "ms,r1 east,r1 north,r2 east,r2 north,yaw"]
    rows += [
        f"{T[k] * 1e3:.6f},{','.join(v for b in PATHS for v in cells(b, k, 1e-2)[:2])},{np.degrees(1):.9f}"
        for k in range(len(T))
    ]
    path = folder / "table.csv"
    path.write_text("\n".join(rows))
    bodies = {body: {"x": f"{body} east", "y": f"{body} north", "heading": "yaw"} for body in PATHS}
    return path, form(angle="deg", format="columns", header_line=3, time="ms", time_unit="ms", unit="cm", bodies=bodies)


def crazyswarm(folder: Path) -> tuple[Path, LogConfig]:
    """A folder with a file per drone, with the names that the firmware's log has, and velocities."""
    (folder / "flight").mkdir()
    names = [f"stateEstimate.{axis}" for axis in ("x", "y", "z", "vx", "vy")]
    bodies = {}
    for j, body in enumerate(PATHS):
        rows = [",".join(["timestamp", *names])]
        rows += [f"{10 * k},{','.join(cells(body, k))},0.3,0.1" for k in range(len(T)) if cells(body, k)[0]]
        (folder / "flight" / f"cf{j}.csv").write_text("\n".join(rows))
        bodies[body] = {"file": f"cf{j}.csv", **{name.rpartition(".")[2]: name for name in names}}
    return folder / "flight", form(format="columns", time="timestamp", time_unit="ms", bodies=bodies)


@pytest.mark.parametrize("kind", ["optitrack", "millimetres", "vicon", "tum", "columns", "crazyswarm"])
def test_what_is_written_is_read(tmp_path, kind):
    """Each log is the same motion, with r2 missing for two samples."""
    path, of = {
        "optitrack": lambda: (optitrack(tmp_path), form(format="optitrack")),
        "millimetres": lambda: (optitrack(tmp_path, "Millimeters", 1e-3), form(format="optitrack")),
        "vicon": lambda: (vicon(tmp_path), form(format="vicon", bodies={"r1": "r1:r1", "r2": "r2:r2"})),
        "tum": lambda: (tum(tmp_path), form(format="tum", radius={"r1": 0.1, "r2": 0.2})),
        "columns": lambda: columns(tmp_path),
        "crazyswarm": lambda: crazyswarm(tmp_path),
    }[kind]()
    log = read_log(path, form=of, heading="theta")
    step = {"tum": 0.01, "crazyswarm": 0.01}.get(kind, 1 / 120)
    np.testing.assert_allclose(log.t, step * np.arange(6), atol=2e-9)
    assert log.bodies == ("r1", "r2")
    assert log.seen[:, 0].all()
    assert log.seen[:, 1].tolist() == [k not in GAP for k in range(6)]
    unit = {"millimetres": 1e-9, "vicon": 1e-9, "columns": 1e-8}.get(kind, 1e-6)
    assert log.reading.rounding["position"] == pytest.approx(unit / 2**0.5 if unit > 1e-10 else 0.0)
    for j, body in enumerate(PATHS):
        off = np.linalg.norm(log.x[:, j] - PATHS[body][:, :2], axis=-1)[log.seen[:, j]]
        assert log.position_error is not None
        assert (off <= log.position_error[log.seen[:, j], j] + 1e-12).all()
    assert log.reading.duplicates == (2 if kind == "tum" else 0)
    assert (log.u is not None) == (kind == "crazyswarm")
    assert log.heading is not None
    assert log.oriented is not None
    if kind != "crazyswarm":
        assert log.oriented.tolist() == log.seen.tolist()
        np.testing.assert_allclose(log.heading[log.oriented], 1.0, atol=1e-8)
    assert (log.radius is not None) == (kind == "tum")


def test_files_with_other_times_are_resampled(tmp_path):
    """Stamps since 1970 are counted from the first, and keep their nanoseconds."""
    (tmp_path / "runs").mkdir()
    for j, body in enumerate(PATHS):
        lines = [f"1790000000.{10_000_000 * k + 3_000_000 * j:09d} {0.01 * k + j:.3f} 0 0.1 0 0 0 1" for k in range(9)]
        (tmp_path / "runs" / f"{body}.txt").write_text("\n".join(lines))
    log = read_log(tmp_path / "runs", form=form(format="tum"))
    np.testing.assert_array_equal(log.t, [k / 100 for k in range(9)])
    assert log.reading.to_json()["time_origin"] == 1790000000
    assert log.lost is not None
    assert log.lost[0].tolist() == [False, True]


def test_a_single_file_and_the_other_vertical(tmp_path):
    path = tmp_path / "robot.txt"
    path.write_text("0 1 0.5 2 0 0 0 1\n1 1 0.5 3 0 0 0 1\n")
    log = read_log(path, form=form(format="tum", up="y"))
    assert log.bodies == ("robot",)
    assert log.x[:, 0].tolist() == [[1, -2], [1, -3]]
    assert "the height changes from 2 to 3 m" in refusal(path, form(format="tum"))


def test_wrong_exports(tmp_path):
    """One wrong example of each kind, named by its line."""
    path = optitrack(tmp_path)
    text = path.read_text()
    assert refusal(path, form(format="optitrack", bodies={"a": "r9"})).endswith("called 'r9'; there are ['r1', 'r2']")
    assert "line 1: not an export of Vicon" in refusal(path, form(format="vicon"))
    path.write_text(text.replace("\n0,0.000000,0.0", "\n0,0.000000,oops", 1).replace("0.500000,", "half,", 1))
    assert "line 8: column 'r1 Position X': expected a finite number of at most 1e+12, got 'half'" in refusal(
        path, form(format="optitrack")
    )
    path.write_text(text.replace("Frame,Time", "Frames,Time"))
    assert "line 1: not an export of OptiTrack Motive with its header" in refusal(path, form(format="optitrack"))

    path = vicon(tmp_path)
    path.write_text(path.read_text().replace("\n2,0,0,0,1,", "\n2,0,0,0,1,,", 1))
    assert "line 8: " in refusal(path, form(format="vicon"))

    path = tum(tmp_path)
    (path / "r1.txt").write_text("0 1 1 0 0 0 0 1\n1 1 1 0 0 0 0\n")
    message = refusal(path, form(format="tum"))
    assert message.endswith("r1.txt line 2: expected 8 numbers, t x y z qx qy qz qw, got '1 1 1 0 0 0 0'")
    (path / "r1.txt").write_text("0 1 1 0 0 0 0 1\n0 1 2 0 0 0 0 1\n")
    assert "r1.txt line 2: another row has the same time and says something else" in refusal(path, form(format="tum"))
    (path / "r1.txt").write_text("0,5 1 1 0 0 0 0 1\n1 1 1 0 0 0 0 1\n")
    message = refusal(path, form(format="tum"))
    assert message.endswith("line 1: column 't': expected a time, got '0,5' (decimals with commas? Expected points)")
    (path / "r1.txt").write_text("2 1 1 0 0 0 0 1\n1 1 1 0 0 0 0 1\n")
    assert "line 2: times must not decrease, got 1.0 s after 2.0 s" in refusal(path, form(format="tum"))
    assert "no file .txt or .tum in this folder" in refusal(tmp_path, form(format="tum"))

    path, of = columns(tmp_path)
    text = path.read_text()
    path.write_text(text.replace(cells("r1", 1, 1e-2)[0], "", 1))
    assert "line 5: column 'r1 east' is empty, and others of 'r1' are not" in refusal(path, of)
    path.write_text(text.replace("r1 east", "r1 west"))
    assert "line 3: no column 'r1 east'" in refusal(path, of)
    path.write_text(text.replace(",", ";"))
    message = refusal(path, of)
    assert "line 3: no column 'ms', the header has ['ms;r1 east" in message
    assert "; is the separator another one? Expected commas" in message
    path.write_text("a,b\n1,2\n")
    assert "line 3: expected names of columns (log.header_line)" in refusal(path, of)


def test_a_file_of_none_of_these_hints_at_what_it_is(tmp_path):
    (tmp_path / "tum.txt").write_text("0 1 1 0 0 0 0 1\n1 1 1 0 0 0 0 1\n")
    hints = {
        optitrack(tmp_path): "OptiTrack? Declare log: {format: optitrack}",
        vicon(tmp_path): "Vicon? Declare log: {format: vicon}",
        tmp_path / "tum.txt": "a TUM file? Declare log: {format: tum}",
    }
    for path, hint in hints.items():
        with pytest.raises(LogError) as caught:
            read_csv(path)
        assert hint in str(caught.value)
        assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"format": "c3d"}, "log: format: "),
        ({"format": "columns", "time": "t"}, "log: bodies: required key is missing, with format 'columns'"),
        ({"format": "columns", "bodies": {"a": {"x": "x", "y": "y"}}}, "log: time: required key is missing"),
        ({"format": "tum", "time": "t"}, "log: time: format 'tum' has its own"),
        ({"format": "tum", "bodies": {"a": {"x": "x", "y": "y"}}}, "log: bodies.a: expected a name"),
        (
            {"format": "columns", "time": "t", "up": "y", "bodies": {"a": {"x": "x", "y": "y"}}},
            "log: bodies.a.z: required key is missing, the plane is x, z",
        ),
        ({"format": "columns", "time": "t", "bodies": {"a": {"x": "x", "yy": "y"}}}, "log: bodies.a.yy: unknown key"),
        ({"format": "tum", "bodies": {"a": "f"}, "radius": {"b": 1}}, "log: radius: expected a radius for each of"),
    ],
)
def test_wrong_sections(fields, expected):
    with pytest.raises(ConfigError) as caught:
        form(**fields)
    assert str(caught.value).startswith(expected)


def test_observe_reads_them(tmp_path, capsys):
    config = {
        "task": {"kind": "goal", "gain": 0.5},
        "barriers": [{"kind": "avoidance", "safety_distance": 0.1, "class_k": {"gain": 1}}],
        "prior": {"lower": [-5, -5], "upper": [5, 5]},
        "noise": {"velocity": 1.0, "position": 0.001},
        "velocity": "differentiated",
        "ukf": False,
        "log": {"format": "optitrack"},
    }
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(config))
    arguments = [str(optitrack(tmp_path)), "--config", str(tmp_path / "config.yaml"), "--out", str(tmp_path / "out")]
    assert main(["observe", *arguments]) == 0
    assert "decimals are rounded" in capsys.readouterr().out
    assert main(["observe", *arguments, "--set", "log.format=vicon"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
