"""The documentation: its code runs, its configurations are valid, all that is public is there, links lead somewhere."""

from __future__ import annotations

import importlib
import inspect
import re
import shlex
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from torch import nn

import torchfsid
from torchfsid.cli import main
from torchfsid.config.models import HypothesisConfig, load_models
from torchfsid.config.observe import ObserveConfig
from torchfsid.robots.barriers import Barrier
from torchfsid.robots.tasks import Task

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.glob("*.md")), *sorted(DOCS.glob("[a-z]*/*.md"))]
sys.path.insert(0, str(DOCS / "_ext"))

OWN_TEST = {"your_own_controller.md"}
"""Pages whose code has a test of its own."""


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)


def named(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("page", [p for p in PAGES if blocks(p, "python") and p.name not in OWN_TEST], ids=named)
def test_python_runs(page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All code of a page, one block after the other, from the checkout's folder."""
    monkeypatch.chdir(ROOT)
    names: dict[str, Any] = {"__name__": page.stem}
    for block in blocks(page, "python"):
        exec(compile(block, str(page), "exec", dont_inherit=True), names)


MODEL = {
    "task": {"kind": "goal", "gain": 0.8},
    "barriers": [{"kind": "avoidance", "safety_distance": 0.5, "class_k": {"gain": 2.0}}],
    "prior": {"lower": [-3, -3], "upper": [3, 3]},
    "noise": {"velocity": 0.01},
}
"""What a block leaves out."""


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "yaml")], ids=named)
def test_configurations_are_valid(page: Path, tmp_path: Path) -> None:
    """Each block is a part of an observe file, whose other parts are those of `MODEL`."""
    for i, block in enumerate(blocks(page, "yaml")):
        given = yaml.safe_load(block)
        others = {key: value for key, value in MODEL.items() if not (key == "task" and "tasks" in given)}
        file = tmp_path / f"{i}.yaml"
        file.write_text(yaml.safe_dump(others | given))
        assert load_models(file)


@pytest.mark.usefixtures("undrawn")
def test_the_first_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Its commands do what the page says."""
    shutil.copytree(ROOT / "examples" / "data", tmp_path / "examples" / "data")
    monkeypatch.chdir(tmp_path)
    commands = [shlex.split(block) for block in blocks(DOCS / "start" / "first_log.md", "sh")[:3]]
    assert [command[1] for command in commands] == ["observe", "report", "check"]
    for command in commands:
        assert main(command[1:]) == 0
    said = capsys.readouterr().out
    assert "velocity >= 0.00399 m/s" in said
    assert "no shift by 1 or 2 samples fits much better" in said


def test_every_public_name_is_described() -> None:
    """It has a docstring, its methods too, and a place in the reference."""
    reference = "".join(page.read_text() for page in (DOCS / "reference").glob("*.md"))
    for name in torchfsid.__all__:
        value = getattr(torchfsid, name)
        of_module = f"|automodule:: {re.escape(value.__module__)}"
        assert re.search(rf"(auto(class|function):: torchfsid\.{name}{of_module})$", reference, re.MULTILINE), name
        assert undescribed(value, name) == []


def test_every_name_of_the_reference_is_described() -> None:
    reference = "".join(page.read_text() for page in (DOCS / "reference").glob("*.md"))
    for path in re.findall(r"auto(?:class|function|exception):: torchfsid\.(\w+\.[\w.]+)$", reference, re.MULTILINE):
        module, _, name = path.rpartition(".")
        assert undescribed(getattr(importlib.import_module(f"torchfsid.{module}"), name), path) == []


def undescribed(value: Any, name: str) -> list[str]:
    """The names without a docstring: of the thing itself, and of the public methods and properties that it defines.

    A class's own docstring may describe its members, and a protocol those of its implementations.
    """
    told = (
        f"{Barrier.__doc__} {Task.__doc__} {value.__doc__} {' '.join([*vars(Barrier), *vars(Task), *vars(nn.Module)])}"
    )
    described = set(re.findall(r"\w+", told))
    found = [name] if not inspect.getdoc(value) else []
    members = vars(value).items() if inspect.isclass(value) else ()
    for member, of in members:
        is_ours = inspect.isfunction(of) or isinstance(of, classmethod | staticmethod | property)
        if (
            not member.startswith("_")
            and member not in described
            and is_ours
            and not inspect.getdoc(getattr(value, member))
        ):
            found.append(f"{name}.{member}")
    return found


def test_every_key_is_described() -> None:
    """Of all sections of observe files and experiments, by the docstrings from which their reference is made."""
    from config_keys import experiment_sections, sections  # type: ignore[import-not-found]

    found = [*sections(ObserveConfig), *sections(HypothesisConfig), *experiment_sections()]
    assert [f"{s.title}: {key.name}" for s in found for key in s.keys if not key.meaning] == []
    assert [section.title for section in found if not section.meaning] == []


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_links_lead_somewhere(page: Path) -> None:
    """Files that are linked, or named as `docs/page.md`, exist. `make docs` also checks headings."""
    text = page.read_text()
    for target in re.findall(r"\]\((?!https?:|#)([^)#\s]+)", text):
        place = (page.parent / target).resolve()
        if place.parent == DOCS / "notebooks":
            place = ROOT / "examples" / place.name
        assert place.exists(), target
    for target in re.findall(r"`?(docs/[\w/]+\.\w+)`?", text):
        assert (ROOT / target).exists(), target
