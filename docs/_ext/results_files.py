"""`{results-files}`: the files that each kind of experiment writes, from the table that experiments themselves use."""

from __future__ import annotations

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from experiments.results import FILES


class ResultsFiles(SphinxDirective):
    """A list for each kind of file in configs/."""

    def run(self) -> list[nodes.Node]:
        lines = []
        for kind, files in FILES.items():
            lines += [f"`kind: {kind}`", ""]
            lines += [f"- `{file.name}`: {file.holds}" for file in files]
            lines.append("")
        return self.parse_text_to_nodes("\n".join(lines))


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("results-files", ResultsFiles)
    return {"parallel_read_safe": True}
