"""The figure of an observed log: any names, any sizes, and one clear line where a file is missing or damaged."""

import csv
import json
import math
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text

from torchfsid.commands import figures
from torchfsid.commands.figure_style import MOST_POINTS, ROBOT_COLOURS
from torchfsid.commands.figures import draw_observation
from torchfsid.commands.map_panel import Marks
from torchfsid.errors import FigureError

TIMES = 5


@pytest.fixture(autouse=True)
def _no_warnings() -> Iterator[None]:
    """Nothing is to be said about glyphs, logarithms or layouts."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def write_results(
    out: Path, robots: Sequence[str], times: int = TIMES, diameter: float | str = 0.5, start: float = 0.0, **region: Any
) -> tuple[np.ndarray, np.ndarray, Sequence[str]]:
    """A results folder, and what else a figure takes."""
    final = {"vertices": [[0, 0], [1, 0], [0, 1]], "centroid": [1 / 3, 1 / 3], "diameter": math.sqrt(2), "status": "ok"}
    final |= region
    (out / "regions.json").write_text(json.dumps({"robots": dict.fromkeys(robots, final)}), encoding="utf-8")
    with (out / "estimates.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "robot", "case", "diameter"])
        for k in range(times):
            writer.writerows([start + 0.1 * k, robot, "ABCDE"[k % 5] if k else "", diameter] for robot in robots)
    x = np.cumsum(np.ones((times, len(robots), 2)), axis=0)
    return x, np.ones((times, len(robots)), dtype=bool), list(robots)


def draw(out: Path, robots: Sequence[str], **options: Any) -> None:
    paths = draw_observation(out, *write_results(out, robots, **options))
    assert [path.name for path in paths] == ["regions.png", "regions.pdf"]
    assert (out / "regions.png").read_bytes().startswith(b"\x89PNG")
    assert (out / "regions.pdf").read_bytes().rstrip().endswith(b"%%EOF")


def test_names_of_every_kind(tmp_path: Path) -> None:
    draw(tmp_path, ["机器人", "روبوت", "$x_{", "_hidden", "r" * 300, "a\nb", "🤖", "[bold]"])


def test_more_robots_than_a_legend_holds(tmp_path: Path) -> None:
    draw(tmp_path, [f"r{i}" for i in range(25)], times=2)


@pytest.mark.parametrize(
    "options",
    [
        {"diameter": 0.0, "vertices": [[1.0, 1.0]], "centroid": [1.0, 1.0]},
        {"diameter": "", "vertices": [[0, 0], [1, 0], [0, 1]], "centroid": [None, None]},
        {"vertices": [[0, 0, 0], [1, 0, 0], [0, 1, 1]], "centroid": [0.1, 0.2, 0.3]},
        {"times": 1},
    ],
    ids=["points", "empty sets", "not planar", "one sample"],
)
def test_sets_of_every_kind(tmp_path: Path, options: dict[str, Any]) -> None:
    draw(tmp_path, ["a", "b"], **options)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that are drawn, laid out but not rendered."""
    figures: list[Figure] = []

    def lay_out(figure: Figure, file: IO[bytes], **options: object) -> None:
        figure.draw_without_rendering()
        figures.append(figure)
        file.write(b"x")

    monkeypatch.setattr(Figure, "savefig", lay_out)
    return figures


def test_the_map_of_robots_parked_in_one_place_is_as_wide_as_any(tmp_path: Path, drawn: list[Figure]) -> None:
    point = {"vertices": [[1, 1], [1 + 1e-14, 1]], "centroid": [1, 1], "diameter": 1e-14}
    x, seen, bodies = write_results(tmp_path, ["a", "b"], **point)
    x[:] = [1, 1]
    draw_observation(tmp_path, x, seen, bodies)
    axes = drawn[0].axes[0]
    assert min(axes.bbox.width, axes.bbox.height) > 0.7 * max(axes.bbox.width, axes.bbox.height)
    for low, high in (axes.get_xlim(), axes.get_ylim()):
        assert 0.01 < high - low < 0.03
    assert axes.get_xlim()[1] - axes.get_xlim()[0] == pytest.approx(
        (axes.get_ylim()[1] - axes.get_ylim()[0]) * axes.bbox.width / axes.bbox.height, rel=0.01
    )


@pytest.mark.parametrize(("last", "scale"), [(0.5, "linear"), (0.26, "linear"), (0.24, "log"), (0.0, "linear")])
def test_sizes_are_on_a_logarithmic_scale_where_they_shrink_to_half(
    tmp_path: Path, drawn: list[Figure], last: float, scale: str
) -> None:
    arguments = write_results(tmp_path, ["a"])
    with (tmp_path / "estimates.csv").open("a") as file:
        file.write(f"9,a,A,{last}\n")
    draw_observation(tmp_path, *arguments)
    sizes = drawn[0].axes[1]
    assert sizes.get_yscale() == scale
    assert (sizes.get_ylim()[0] == 0) == (scale == "linear")
    assert sizes.get_ylim()[1] > 0.5


def test_a_set_that_is_not_ok_looks_and_is_called_so(tmp_path: Path, drawn: list[Figure]) -> None:
    arguments = write_results(tmp_path, ["a", "b", "c"])
    final = json.loads((tmp_path / "regions.json").read_text())
    final["robots"]["b"]["status"], final["robots"]["c"]["status"] = "inconsistent", "alarm"
    (tmp_path / "regions.json").write_text(json.dumps(final))
    draw_observation(tmp_path, *arguments)
    axes = drawn[0].axes[0]
    fills = [to_rgb(patch.get_facecolor()) for patch in axes.patches if patch.get_facecolor()[3] > 0]
    assert fills == [to_rgb(ROBOT_COLOURS[0]), (0.5, 0.5, 0.5), (0.5, 0.5, 0.5)]
    edges = [patch.get_linestyle() for patch in axes.patches if patch.get_edgecolor()[3] > 0]
    assert edges == ["solid", "--", "--"]
    assert [patch.get_hatch() for patch in axes.patches if patch.get_edgecolor()[3] > 0] == [None, "////", "////"]
    assert sum(line.get_marker() == "+" for line in axes.lines) == 1  # only the set that is trusted has a centroid
    assert [label.get_text() for label in axes.texts] == ["a: 1.4 m", "b: inconsistent", "c: alarm"]
    assert "region not trusted" in legend(axes)
    boxes = [Text.get_window_extent(label) for label in axes.texts]  # without their leaders
    assert not any(boxes[i].overlaps(boxes[j]) for i in range(3) for j in range(i))


def legend(axes: Axes) -> list[str]:
    return [text.get_text() for text in axes.get_legend().get_texts()]


def test_a_tiny_set_that_is_not_trusted_does_not_look_precise(tmp_path: Path, drawn: list[Figure]) -> None:
    """Its mark is a large grey disc, and its curve ends in dots at the first contradiction."""
    arguments = write_results(tmp_path, ["a"], times=11, events=[{"t": 0.4, "reset": False}], status="inconsistent")
    final = json.loads((tmp_path / "regions.json").read_text())
    final["robots"]["a"] |= {"vertices": [[1, 1], [1.001, 1], [1, 1.001]], "centroid": [1, 1], "diameter": 0.001}
    (tmp_path / "regions.json").write_text(json.dumps(final))
    draw_observation(tmp_path, *arguments)
    of_map, sizes, _ = drawn[0].axes
    assert max(line.get_markersize() for line in of_map.lines if line.get_marker() == "o") >= 20
    (line,) = (line for line in sizes.lines if line.get_linestyle() == "--" and len(line.get_xdata()) == 2)
    assert list(line.get_xdata()) == [0.4, 0.4]
    (dotted,) = (line for line in sizes.lines if line.get_linestyle() == ":" and len(line.get_xdata()))
    assert min(dotted.get_xdata()) == pytest.approx(0.5)
    assert {"first contradiction", "not trusted"} <= set(legend(sizes))


def test_stamps_since_1970_are_counted_from_the_first(tmp_path: Path, drawn: list[Figure]) -> None:
    arguments = write_results(tmp_path, ["a"], start=1764211200.25)
    draw_observation(tmp_path, *arguments)
    for axes in drawn[0].axes[1:]:
        assert axes.get_xlim()[0] == pytest.approx(0, abs=0.1)
        assert axes.get_xlim()[1] < 1
    assert drawn[0].axes[2].get_xlabel() == "t - t0 [s], t0 = 1764211200.25 s"


def test_a_flat_scene_has_the_width_of_the_page(tmp_path: Path, drawn: list[Figure]) -> None:
    x, seen, bodies = write_results(tmp_path, ["a", "b"], centroid=[0.5, 0.1], vertices=[[0, 0], [1, 0], [0, 0.1]])
    x[:] = np.linspace([[0, 0], [9, 0.3]], [[9, 0.2], [0, 0]], len(x))
    draw_observation(tmp_path, x, seen, bodies)
    flat = drawn[0].axes[0]
    assert flat.bbox.width > 0.85 * drawn[0].bbox.width
    assert np.ptp(flat.get_ylim()) < 4


@pytest.mark.parametrize(("prior", "is_seen"), [(4.0, True), (40.0, False)])
def test_prior_and_truth_are_marked_where_they_are_in_view(
    tmp_path: Path, drawn: list[Figure], prior: float, is_seen: bool
) -> None:
    arguments = write_results(tmp_path, ["a"])
    marks = Marks(prior=((-prior, -prior), (prior, prior)), truth={"a": [0.2, 0.3]})
    draw_observation(tmp_path, *arguments, marks)
    axes = drawn[0].axes[0]
    assert ("prior" in legend(axes)) == is_seen
    assert any(np.array_equal(line.get_xydata(), [[0.2, 0.3]]) for line in axes.lines if line.get_marker() == "*")
    assert {"start", "end", "region", "centroid", "truth"} <= set(legend(axes))
    assert axes.get_xlim()[1] < 12


def test_labels_are_inside_and_hide_no_path(tmp_path: Path, drawn: list[Figure]) -> None:
    """Four robots end where another one began, at the edges of the map."""
    x, seen, bodies = write_results(tmp_path, list("abcd"), times=60)
    places = np.array([[-1, 0], [1, 0], [0, 1], [0, -1]])
    x[:] = np.linspace(places, -places, len(x))
    final = json.loads((tmp_path / "regions.json").read_text())
    for region, place in zip(final["robots"].values(), places, strict=True):
        region |= {"centroid": (-place).tolist(), "vertices": (-place + 0.01 * places).tolist(), "diameter": 0.02}
    (tmp_path / "regions.json").write_text(json.dumps(final))
    draw_observation(tmp_path, x, seen, bodies)
    axes = drawn[0].axes[0]
    boxes = [Text.get_window_extent(label) for label in axes.texts]  # without their leaders
    assert len(boxes) == 4
    paths = np.concatenate([axes.transData.transform(line.get_xydata()) for line in axes.lines])
    for i, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:i])
        assert axes.bbox.x0 < box.x0 < box.x1 < axes.bbox.x1
        assert axes.bbox.y0 < box.y0 < box.y1 < axes.bbox.y1
        assert not box.count_contains(paths)


def test_logarithmic_sizes_have_plain_numbers(tmp_path: Path, drawn: list[Figure]) -> None:
    arguments = write_results(tmp_path, ["a"])
    with (tmp_path / "estimates.csv").open("a") as file:
        file.write("9,a,A,0.12\n")
    draw_observation(tmp_path, *arguments)
    axis = drawn[0].axes[1].yaxis
    low, high = drawn[0].axes[1].get_ylim()
    shown = [
        label.get_text()
        for label, at in zip(axis.get_ticklabels(), axis.get_ticklocs(), strict=True)
        if low <= at <= high
    ]
    assert len(shown) >= 3
    assert all(float(text) < 1 and "times" not in text for text in shown)


def test_long_logs_are_thinned_and_end_where_they_end(tmp_path: Path, drawn: list[Figure]) -> None:
    times = 3 * MOST_POINTS + 1
    x, seen, bodies = write_results(tmp_path, ["a"], times=times)
    draw_observation(tmp_path, x, seen, bodies)
    lines = [line for axes in drawn[0].axes for line in axes.lines if len(line.get_xdata()) > 1]
    assert len(lines) == 2
    for line, last in zip(lines, (float(x[-1, 0, 0]), 0.1 * (times - 1)), strict=True):
        assert len(line.get_xdata()) <= MOST_POINTS
        assert line.get_xdata()[-1] == pytest.approx(last)


@pytest.mark.parametrize(
    ("file", "change", "expected"),
    [
        ("estimates.csv", lambda text: None, "No such file"),
        ("estimates.csv", lambda text: "", "missing or damaged"),
        ("estimates.csv", lambda text: text.replace("diameter", "dia"), "missing or damaged"),
        ("estimates.csv", lambda text: text.rstrip()[:-4], "missing or damaged"),
        ("estimates.csv", lambda text: text.replace("0.5", "x", 1), "could not convert string to float: 'x'"),
        ("estimates.csv", lambda text: text.replace(",A,", ",Z,"), "missing or damaged"),
        ("estimates.csv", lambda text: text + "9,b,A,1\n", "not the same times"),
        ("estimates.csv", lambda text: text.splitlines()[0] + "\n", "not the same times, or none"),
        ("regions.json", lambda text: None, "No such file"),
        ("regions.json", lambda text: text[:-5], "missing or damaged"),
        ("regions.json", lambda text: text.replace("centroid", "centre"), "'centroid'"),
        ("regions.json", lambda text: "[]", "missing or damaged"),
    ],
)
def test_what_is_missing_or_damaged_is_named(tmp_path: Path, file: str, change, expected: str) -> None:
    arguments = write_results(tmp_path, ["a", "b"], times=6)
    changed = change((tmp_path / file).read_text())
    (tmp_path / file).unlink()
    if changed is not None:
        (tmp_path / file).write_text(changed)
    with pytest.raises(FigureError) as error:
        draw_observation(tmp_path, *arguments)
    assert str(error.value).startswith(f"{tmp_path / file}: ")
    assert expected in str(error.value)
    assert str(error.value).isprintable()
    assert not (tmp_path / "regions.png").exists()


def test_what_the_plotting_library_says_is_said_as_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: object) -> None:
        raise RuntimeError("no\nbackend")

    monkeypatch.setattr(figures, "draw_map", fail)
    with pytest.raises(FigureError, match=r"regions\.png: not drawn: no backend"):
        draw_observation(tmp_path, *write_results(tmp_path, ["a"]))
