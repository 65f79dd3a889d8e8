"""`{config-reference} module:Class` and `{experiment-files}`: keys of configuration files (`config_keys`) as pages."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module

from config_keys import Section, experiment_sections, label, sections
from docutils import nodes
from docutils.parsers.rst import directives
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective


def _markdown(section: Section, level: int) -> str:
    """A section as a heading, a paragraph and a list of definitions."""
    lines = [f"({label(section.model)})=", f"{'#' * level} {section.title}", "", section.meaning, ""]
    for key in section.keys:
        if key.name in section.form:  # said in the heading
            continue
        default = key.default if key.default in ("", "required") else f"default {key.default}"
        lines += [f"`{key.name}` — {'; '.join(filter(None, (key.values, default)))}", f": {key.meaning}", ""]
    return "\n".join(lines)


class ConfigReference(SphinxDirective):
    """The directive. Its argument is the class of the file.

    Options: `level` of the headings, `place` of the section in the file, `own` for this section without those below it.
    Sections that another page has are linked.
    """

    required_arguments = 1
    option_spec = {"level": int, "place": str, "own": directives.flag}  # noqa: RUF012

    def run(self) -> list[nodes.Node]:
        module, _, name = self.arguments[0].partition(":")
        found = sections(getattr(import_module(module), name), self.options.get("place", ""))
        return self._parsed(list(found)[: 1 if "own" in self.options else None], self.options.get("level", 2))

    def _parsed(self, found: Sequence[Section], level: int) -> list[nodes.Node]:
        text = "\n".join(_markdown(section, level) for section in found)
        return self.parse_text_to_nodes(text, allow_section_headings=True)


class ExperimentFiles(ConfigReference):
    """`{experiment-files}`: the sections of all kinds of files of `experiments`, but for those of observe files."""

    required_arguments = 0

    def run(self) -> list[nodes.Node]:
        return self._parsed(list(experiment_sections()), 2)


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("config-reference", ConfigReference)
    app.add_directive("experiment-files", ExperimentFiles)
    return {"parallel_read_safe": True}
