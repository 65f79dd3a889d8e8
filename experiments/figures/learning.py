"""One figure of learned gains: errors over time at each level of noise, the training, the outputs of the network."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from matplotlib.figure import Figure

from experiments.design.config import LearnedObserverConfig
from experiments.figures.drawing import headline, name_panel
from experiments.figures.style import HYBRID, INVERSE_OPTIMAL, REGION, ROBOT, UKF
from experiments.results import read_columns

OBSERVERS = {
    "centroid": ("0.45", "-"),
    "ukf": (UKF, "-"),
    "hybrid": (HYBRID, "-"),
    "constant": ("#56B4E9", "-"),
    "RLS": (REGION, "-"),
    "RLS with pull": ("#7F5539", "-"),
    "network": (INVERSE_OPTIMAL, "--"),
    "network with pull": (ROBOT, "-"),
    "RLS, not projected": (REGION, ":"),
}
"""Those that are drawn: colour and dashes. The others are in the tables."""

CASES = {"A": "0.8", "B": INVERSE_OPTIMAL, "D": ROBOT}


def draw_learning(folder: Path, config: LearnedObserverConfig) -> Iterator[tuple[str, Figure]]:
    """The figure, with its name."""
    levels = config.unseen_noise
    figure = Figure(figsize=(3.4 * max(len(levels), 3), 5.2), layout="constrained")
    grid = figure.add_gridspec(2, 6, height_ratios=(1.25, 1))
    curves, width = read_columns(folder / "curves.csv"), 6 // max(len(levels), 1)
    shared = None
    for i, noise in enumerate(levels):
        axes = figure.add_subplot(grid[0, i * width : (i + 1) * width], sharey=shared)
        shared = shared or axes
        for name, (colour, dashes) in OBSERVERS.items():
            of = curves.where(observer=name, noise=noise)
            looks = {"color": colour, "ls": dashes, "lw": 1.4, "label": name.replace("ukf", "UKF")}
            axes.semilogy(of.numbers("t"), of.numbers("error"), **looks)
        axes.set(xlabel="t [s]", ylabel="mean error [m]" if i == 0 else "")
        name_panel(axes, i, f"unseen teams, δ = {noise:g} m/s")
        axes.grid(True, which="both")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=9, fontsize=7)

    training = figure.add_subplot(grid[1, :3])
    epochs = read_columns(folder / "training.csv")
    for name, colour in (("constant, learned", "#56B4E9"), ("network", INVERSE_OPTIMAL), ("network with pull", ROBOT)):
        for column, dashes in (("training", "-"), ("validation", ":")):
            values = epochs.where(gain=name).numbers(column)
            label = name if column == "training" else None
            training.plot(values, color=colour, ls=dashes, lw=1.3, label=label)
    training.set(xlabel="epoch", ylabel="mean error [m]")
    name_panel(training, len(levels), "training (solid) and validation (dotted)")
    training.grid(True)
    training.legend(fontsize=7, loc="center right", bbox_to_anchor=(1, 0.38))

    pull = figure.add_subplot(grid[1, 3:])
    answers = read_columns(folder / "answers.csv")
    for letter, colour in CASES.items():
        for noise, dashes in zip(config.noise, ("-", "--", ":"), strict=False):
            of = answers.where(case=letter, noise=noise)
            label = f"case {letter}" if dashes == "-" else None
            looks = {"color": colour, "ls": dashes, "lw": 4 if letter == "A" else 1.3}
            pull.semilogx(of.numbers("area"), of.numbers("pull"), label=label, **looks)
    pull.set(xlabel="area of Θ [m²]", ylabel="pull to the centroid", ylim=(0, 1))
    name_panel(pull, len(levels) + 1, "what the network has learned (solid: least noise)")
    pull.grid(True)
    pull.legend(fontsize=7)
    headline(figure, config.title)
    yield "figure", figure
