"""The results folder: one owner at a time, nothing of an earlier run left, nothing of anybody else's touched."""

import errno
import json
import math
import os
from pathlib import Path

import pytest

from torchfsid.commands.results_folder import MANIFEST, ResultsFolder, named, write_json, write_whole
from torchfsid.errors import ConfigError

CONFIG = "task: {kind: velocity}\n"


def folder(path: Path, kind: str | None = "observe") -> ResultsFolder:
    return ResultsFolder(path, kind)


def contents(path: Path) -> set[str]:
    return {str(file.relative_to(path)) for file in path.rglob("*") if file.is_file()} - {MANIFEST}


def test_only_one_command_at_a_time(tmp_path: Path) -> None:
    first, second = folder(tmp_path), folder(tmp_path)
    first.claim(["a.csv"], CONFIG)
    write_whole(tmp_path / "a.csv", "mine")
    with pytest.raises(ConfigError, match="another command is writing there"):
        second.claim(["a.csv"], CONFIG)
    with pytest.raises(ConfigError, match="another command is writing there"):
        folder(tmp_path, None).claim(["check.json"])
    assert not second.claimed
    assert contents(tmp_path) == {"config.yaml", "a.csv"}
    first.release()
    second.claim(["b.csv"], CONFIG)
    assert second.claimed
    second.release()


def test_a_fresh_run_removes_what_an_earlier_one_wrote_and_nothing_else(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    first = folder(out)
    first.claim(["a.csv", "goal/a.csv", "orbit/a.csv"], CONFIG)
    (out / "goal").mkdir()
    (out / "orbit").mkdir()
    for name in ("a.csv", "goal/a.csv", "orbit/a.csv", "notes.txt", "orbit/notes.txt"):
        write_whole(out / name, "old")
    first.release()
    second = folder(out)
    second.claim(["b.csv"], CONFIG)
    second.release()
    assert contents(out) == {"config.yaml", "notes.txt", "orbit/notes.txt"}
    assert not (out / "goal").exists()


@pytest.mark.parametrize("name", ["config.yaml", "regions.json"])
def test_a_file_that_no_run_left_is_never_replaced(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(CONFIG)
    with pytest.raises(ConfigError, match=f"{name} is there, and no run left it"):
        folder(tmp_path).claim(["regions.json"], CONFIG)
    assert (tmp_path / name).read_text() == CONFIG
    assert os.listdir(tmp_path) == [name]


@pytest.mark.parametrize("kind", ["observe", None])
def test_a_subfolder_that_a_run_wrote_is_no_folder_of_its_own(
    tmp_path: Path, kind: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    nest = folder(tmp_path / "nest")
    nest.claim(["near/a.csv", "far/a.csv"], CONFIG)
    nest.release()
    (tmp_path / "nest" / "far").mkdir()
    monkeypatch.chdir(tmp_path / "nest" / "far")
    for path in (tmp_path / "nest" / "far", tmp_path / "nest" / "near", Path(".")):
        with pytest.raises(ConfigError, match=r"belongs to the results in .*nest; choose another --out$"):
            folder(path, kind).claim(["a.csv"])
    other = folder(tmp_path / "nest" / "farther", kind)
    other.claim(["a.csv"])
    other.release()


def test_a_list_cannot_lead_out_of_the_folder(tmp_path: Path) -> None:
    out, other = tmp_path / "out", tmp_path / "other.txt"
    other.write_text("keep")
    out.mkdir()
    (out / MANIFEST).write_text(f"../other.txt\n{other}\n\n.\n")
    claimed = folder(out)
    claimed.claim(["a.csv"], CONFIG)
    claimed.release()
    assert other.read_text() == "keep"


@pytest.mark.parametrize(
    ("held", "kind", "named_kind"),
    [
        ("kind: sweep\n", "observe", "'sweep'"),
        ("kind: scene\n", "observe", "'scene'"),
        ("kind: sweep\n", "scene", "'sweep'"),
        (CONFIG, "scene", "'observe'"),
        ("tasks: []\n", "sweep", "'observe'"),
        ("a: [", "observe", "not of a run"),
        ("colour: blue\n", "observe", "not of a run"),
    ],
)
def test_a_folder_of_something_else_is_refused(tmp_path: Path, held: str, kind: str, named_kind: str) -> None:
    (tmp_path / "config.yaml").write_text(held)
    for ask in (ResultsFolder.require_ours, lambda refused: refused.claim(["config.yaml"], CONFIG)):
        with pytest.raises(ConfigError, match=named_kind) as error:
            ask(folder(tmp_path, kind))
        assert "\n" not in str(error.value)
    assert (tmp_path / "config.yaml").read_text() == held
    assert contents(tmp_path) == {"config.yaml"}


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("")
    with pytest.raises(ConfigError, match="is not a folder"):
        folder(path).claim([], CONFIG)


def test_a_run_that_goes_on_keeps_what_is_there(tmp_path: Path) -> None:
    for _ in range(2):
        sweep = folder(tmp_path, "sweep")
        sweep.claim(["records.jsonl"], "kind: sweep\n", resume=True)
        with (tmp_path / "records.jsonl").open("a") as file:
            file.write("x\n")
        sweep.release()
    assert (tmp_path / "records.jsonl").read_text() == "x\nx\n"
    assert (tmp_path / MANIFEST).read_text().split() == ["config.yaml", "records.jsonl"]
    with pytest.raises(ConfigError, match="holds another sweep"):
        folder(tmp_path, "sweep").claim(["records.jsonl"], "kind: sweep\nseed: 1\n", resume=True)
    assert (tmp_path / "records.jsonl").read_text() == "x\nx\n"


def test_what_adds_to_a_folder_leaves_its_results_alone(tmp_path: Path) -> None:
    first = folder(tmp_path)
    first.claim(["a.csv"], CONFIG)
    write_whole(tmp_path / "a.csv", "results")
    first.release()
    added = folder(tmp_path, None)
    added.claim(["check.json"])
    write_json(tmp_path / "check.json", {})
    added.release()
    assert contents(tmp_path) == {"config.yaml", "a.csv", "check.json"}


def test_a_file_is_written_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.json"
    write_whole(path, "old")

    def fail(*args: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(OSError, match="No space left") as error:
        write_whole(path, "new")
    assert error.value.filename == str(path)
    assert path.read_text() == "old"
    assert contents(tmp_path) == {"a.json"}


def test_what_is_not_finite_is_null(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"a": math.nan, "b": [1.5, math.inf, (-math.inf, 2)], "c": {"d": None, "e": True}})
    read = json.loads((tmp_path / "a.json").read_text())
    assert read == {"a": None, "b": [1.5, None, [None, 2]], "c": {"d": None, "e": True}}


def test_an_error_that_names_its_file_keeps_the_name(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError) as error, named(tmp_path):
        (tmp_path / "missing").read_text()
    assert error.value.filename == str(tmp_path / "missing")
