"""The page of a results folder, driven in a browser as a reader would: what it shows is what the files say."""

import csv
import json
import math
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from playwright.sync_api import Browser, Page

from tests.browser import browser
from tests.logs import write_config, write_log
from torchfsid.cli import main
from torchfsid.commands.page import content as contents
from torchfsid.commands.page import sets
from torchfsid.commands.page.content import content
from torchfsid.commands.page.write import run_page, tables_page
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import GoalTask

ROBOTS, SAMPLES = 10, 600
NAMES = [*(f"r{i}" for i in range(8)), "</script><b>nine", "ten & <i>more</i>"]
LIAR = 3
CONFIG = {
    "task": {"kind": "goal", "gain": 0.35},
    "barriers": [{"kind": "avoidance", "distance": "squared", "safety_distance": 0.5, "class_k": {"gain": 1.5}}],
    "prior": {"lower": [-6, -6], "upper": [6, 6]},
    "noise": {"velocity": 0.004},
    "obstacles": ["pillar"],
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of ten robots on a circle, one of which moves for a second as its task does not say."""
    random = torch.Generator().manual_seed(4)
    angles = torch.arange(ROBOTS, dtype=torch.float64) * (2 * math.pi / ROBOTS)
    start = 4 * torch.stack([angles.cos(), angles.sin()], dim=-1)
    goals = 0.85 * start.roll(4, 0) + 0.6 * torch.rand(ROBOTS, 2, generator=random, dtype=torch.float64)
    controller = CbfQpController(
        GoalTask(0.35), [CollisionAvoidance(ClassK(1.5), safety_distance=0.5, distance="squared")]
    )
    run = simulate(controller, goals, start, dt=0.05, steps=SAMPLES - 1, obstacles=torch.tensor([[0.3, 0.2]]))
    errors = 0.005 * (torch.rand(run.u.shape, generator=random, dtype=torch.float64) - 0.5)
    errors[240:260, LIAR] += 0.05
    out = tmp_path_factory.mktemp("page")
    log = write_log(out / "log.csv", run, [*NAMES, "pillar"], errors)
    config = write_config(out / "config.yaml", CONFIG)
    command = [
        sys.executable,
        "-m",
        "torchfsid.cli",
        "observe",
        log,
        "--config",
        config,
        "--out",
        out / "run",
        "--report",
    ]
    subprocess.run(command, check=True, capture_output=True)  # apart from us: the checks of shapes would take minutes
    return out / "run"


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    with browser() as opened:
        yield opened


@pytest.fixture
def page(chromium: Browser, folder: Path) -> Iterator[Page]:
    """The page in a wide window. Whatever it asks for or complains about fails the test."""
    with opened(chromium, folder / "report.html", 1280) as shown:
        yield shown


class opened:  # noqa: N801
    """A page of this width [px], with checks that it loads nothing and logs no error."""

    def __init__(self, chromium: Browser, path: Path, width: int):
        self.page = chromium.new_page(viewport={"width": width, "height": 860})
        self.asked, self.complaints = [], []
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("console", lambda message: self.complaints.append(message.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.goto(path.as_uri())
        self.page.wait_for_load_state()
        self.address = path.as_uri()

    def __enter__(self) -> Page:
        return self.page

    def __exit__(self, *_: object) -> None:
        self.page.close()
        assert not self.complaints
        assert [url for url in self.asked if not url.startswith("data:")] == [self.address]


def estimates(folder: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((folder / "estimates.csv").open()))


def go(page: Page, k: int) -> None:
    page.locator("#slider").fill(str(k))
    page.wait_for_function("k => torchfsid.state.k === k", arg=k)
    drawn(page)


def drawn(page: Page) -> None:
    """Wait until what was asked for is drawn."""
    page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")


def values(page: Page) -> dict[str, str]:
    """What the page says on the chosen robot."""
    names, cells = (page.locator(f"#values {tag}").all_inner_texts() for tag in ("dt", "dd"))
    return dict(zip(names, cells, strict=True))


def numbers(text: str) -> list[float]:
    return [float(number) for number in re.findall(r"[-\d.]+", text.replace("−", "-"))]


def test_the_page_is_one_small_file(page: Page, folder: Path) -> None:
    assert (folder / "report.html").stat().st_size < 6e6
    assert page.locator("#names tr").count() == ROBOTS
    assert page.locator("#lead").inner_text().startswith(f"{ROBOTS} robots, {SAMPLES} samples from 0 s to 29.95 s.")


def test_the_slider_shows_what_estimates_csv_says(page: Page, folder: Path) -> None:
    table = estimates(folder)
    for k in (0, 70, 251, SAMPLES - 1):
        go(page, k)
        for i in (0, LIAR):
            page.locator("#names button").nth(i).click()
            drawn(page)
            row, shown = table[k * ROBOTS + i], values(page)
            assert row["robot"] == NAMES[i]
            assert numbers(shown["time"])[0] == pytest.approx(float(row["t"]))
            for name, columns in (("centroid", "centroid"), ("filter (UKF)", "ukf"), ("hybrid", "hybrid")):
                truth = [float(row[f"{columns}_0"]), float(row[f"{columns}_1"])]
                assert numbers(shown[name]) == pytest.approx(truth, abs=float(row["diameter"]) / 10)
            assert shown["case"][0] == row["case"]


def test_a_facet_under_the_pointer_is_named(page: Page, folder: Path) -> None:
    facets = json.loads((folder / "regions.json").read_text())["robots"]["r0"]["facets"]
    page.locator("#names button").first.click()
    drawn(page)
    lens = page.locator("#lens canvas")
    lens.scroll_into_view_if_needed()
    times = set()
    for hit in page.evaluate("torchfsid.lens[0].hits.filter(hit => hit.facet)"):
        lens.hover(position={axis: (hit["from"][i] + hit["to"][i]) / 2 for i, axis in enumerate("xy")})
        first, *others = page.locator("#tip").inner_text().split("\n")
        assert first.startswith("r0: ")
        times.add(numbers(others[0])[0])
    assert times <= {round(facet["time"], 4) for facet in facets}
    assert len(times) >= 3


def test_playing_goes_on_and_stops(page: Page) -> None:
    page.keyboard.press("Home")
    page.locator("#speed").select_option("8")
    page.get_by_role("button", name="Play").click()
    page.wait_for_function("() => torchfsid.state.k > 20")
    page.get_by_role("button", name="Pause").click()
    k = page.evaluate("torchfsid.state.k")
    drawn(page)
    assert page.evaluate("torchfsid.state.k") == k < SAMPLES - 1
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("ArrowRight")
    assert page.evaluate("torchfsid.state.k") == k + 1


def test_a_click_into_the_sizes_goes_there(page: Page) -> None:
    box = page.locator("#sizes").bounding_box()
    assert box is not None
    page.mouse.click(box["x"] + page.evaluate("torchfsid.sizes.px(12)"), box["y"] + 60)
    assert page.evaluate("torchfsid.data.t[torchfsid.state.k]") == pytest.approx(12, abs=0.051)


def test_the_verdict_has_its_evidence(page: Page, folder: Path) -> None:
    events = json.loads((folder / "regions.json").read_text())["robots"][f"r{LIAR}"]["events"]
    assert page.locator("#verdict-title").inner_text() == f"r{LIAR}: inconsistent"  # chosen at first: look here
    assert "not to be trusted" in page.locator("#verdict").inner_text()
    told = page.locator("#evidence").inner_text()
    for row in events[0]["rows"]:
        assert f"{row['time']:g} s" in told
    page.locator("#evidence button").first.click()
    assert page.evaluate("torchfsid.data.t[torchfsid.state.k]") == pytest.approx(events[0]["t"])
    crosses = page.evaluate("torchfsid.maps[0].hits.filter(hit => hit.first === 3).length")
    assert crosses == len(events[0]["rows"])


def test_robots_can_be_switched_off(page: Page) -> None:
    named = "torchfsid.maps[0].hits.filter(hit => hit.first === 2).map(hit => hit.lines[0])"
    assert page.evaluate(named) == [*NAMES, "pillar"]
    page.locator("#names input").nth(1).uncheck()
    drawn(page)
    assert page.evaluate(named) == [NAMES[0], *NAMES[2:], "pillar"]


def test_names_are_text_and_nothing_else(page: Page) -> None:
    assert page.locator("#names button").all_inner_texts() == NAMES
    assert page.locator("b:text('nine')").count() == 0
    assert page.locator("#names i").count() == 0


def test_the_page_fits_a_telephone(chromium: Browser, folder: Path) -> None:
    with opened(chromium, folder / "report.html", 400) as narrow:
        assert narrow.evaluate("document.documentElement.scrollWidth") == 400
        assert narrow.evaluate("torchfsid.maps[0].width") > 300


def test_sets_are_those_of_the_files(folder: Path) -> None:
    final = json.loads((folder / "regions.json").read_text())["robots"]
    for robot in content(folder)["robots"]:
        region = final[robot["name"]]
        t, vertices, meeting, facets = robot["sets"][-1]
        size = region["diameter"]
        assert t == pytest.approx(29.95)
        here, there = torch.tensor(vertices).double(), torch.tensor(region["vertices"]).double()
        assert torch.cdist(here, there).amin(-1).max() < 1e-3 * size
        assert torch.cdist(there, here).amin(-1).max() < 1e-3 * size
        assert [time for _, time in facets] == pytest.approx([facet["time"] for facet in region["facets"]])
        A, b = torch.tensor(region["A"]).double(), torch.tensor(region["b"]).double()
        for vertex, at in zip(here, meeting, strict=True):
            assert len(at) >= 2
            assert (A[at] @ vertex - b[at]).abs().max() < 1e-3 * size * A.norm(dim=-1).max()


def test_what_is_left_out_is_said(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = content(folder)
    monkeypatch.setattr(contents, "MOST_TIMES", 50)
    monkeypatch.setattr(sets, "MOST_FACETS", 500)
    some = content(folder)
    changed = next(robot for robot in some["robots"] if robot["status"] != "ok")["statuses"][1][0]
    assert len(some["t"]) <= 52
    assert {some["t"][0], some["t"][-1], changed} == {0.0, 29.95, changed} & set(some["t"])
    assert f"{len(some['t'])} of the {SAMPLES} times in estimates.csv are shown, evenly chosen." in some["notes"]
    counts = [sum(len(robot["sets"]) for robot in record["robots"]) for record in (some, whole)]
    assert f"{counts[0]} of the {counts[1]} sets in sets.csv are shown, evenly chosen for each robot." in some["notes"]
    for few, all_of in zip(some["robots"], whole["robots"], strict=True):
        assert few["sets"][-1] == all_of["sets"][-1]


def test_older_folders_show_what_they_have(folder: Path, tmp_path: Path, chromium: Browser) -> None:
    for name in ("estimates.csv", "regions.json"):
        shutil.copy(folder / name, tmp_path)
    assert main(["report", str(tmp_path)]) == 0
    with opened(chromium, tmp_path / "report.html", 1280) as old:
        notes = old.locator("#notes").inner_text()
        for name in ("sets.csv", "motion.csv", "config.yaml"):
            assert f"{name} is missing" in notes
        assert len(old.evaluate("torchfsid.lens[0].hits.filter(hit => hit.facet)")) >= 3


@pytest.mark.parametrize("name", ["estimates.csv", "regions.json"])
def test_a_folder_that_lacks_a_file_gets_no_page(
    folder: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for file in {"estimates.csv", "regions.json"} - {name}:
        shutil.copy(folder / file, tmp_path)
    assert main(["report", str(tmp_path)]) == 2
    assert f"{name}: missing or damaged" in capsys.readouterr().err
    assert not (tmp_path / "report.html").exists()


def test_sets_in_space_have_three_views(tmp_path: Path, chromium: Browser) -> None:
    """An octahedron: its shadow on every plane of two axes is a square, each edge on two of its eight facets."""
    signs = [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    facets = [{"time": float(k), "source": k, "constraint": f"avoid {k}"} for k in range(8)]
    region: dict[str, Any] = {"A": signs, "b": [1.0] * 8, "facets": facets, "status": "ok", "events": []}
    (tmp_path / "regions.json").write_text(json.dumps({"robots": {"a": region}}))
    centroid = ",".join(f"centroid_{i}" for i in range(3))
    (tmp_path / "estimates.csv").write_text(f"t,robot,case,volume,diameter,{centroid},status\n0,a,A,1.33,2,0,0,0,ok\n")
    (tmp_path / "motion.csv").write_text("t,robot,x,y,z,vx,vy,vz,active\n0,a,2,1,1.5,0,0,0,\n")
    (tmp_path / "config.yaml").write_text("task: {kind: goal, gain: 1}\n")
    (tmp_path / "report.html").write_text(run_page(tmp_path))
    with opened(chromium, tmp_path / "report.html", 1280) as page:
        assert page.locator("#map canvas").count() == 3
        assert page.locator("#lens canvas").count() == 3
        for view in range(3):
            edges = page.evaluate(f"torchfsid.lens[{view}].hits.filter(hit => hit.facet)")
            assert len(edges) == 4
            assert all(len(edge["lines"]) == 4 for edge in edges)


def test_tables_are_sorted_and_searched(tmp_path: Path, chromium: Browser) -> None:
    rows = [["b", 2.5, ["there", "b/report.html"]], ["a", None, ["here", "a/report.html"]], ["c", 10, "<i>no page"]]
    table = {"title": "Runs", "columns": ["name", "number", "page"], "rows": rows}
    (tmp_path / "report.html").write_text(tables_page({"title": "A sweep", "lead": "Three runs.", "tables": [table]}))
    with opened(chromium, tmp_path / "report.html", 400) as page:

        def column(k: int) -> list[str]:
            return page.locator(f"tbody td:nth-child({k})").all_inner_texts()

        assert column(1) == ["b", "a", "c"]
        page.get_by_role("button", name="number").click()
        assert column(2) == ["2.5", "10", ""]  # numbers as numbers, nothing last
        page.get_by_role("button", name="number").click()
        assert column(2) == ["10", "2.5", ""]
        page.get_by_role("searchbox").fill("here")
        assert column(3) == ["there", "here"]
        assert page.get_by_role("link", name="there", exact=True).get_attribute("href") == "b/report.html"
        page.get_by_role("searchbox").fill("no page")
        assert column(3) == ["<i>no page"]
        assert page.evaluate("document.documentElement.scrollWidth") == 400
