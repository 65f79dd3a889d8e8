"""The style of the figures: Okabe and Ito's colours for the colour-blind, and one line style per quantity."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.typing import RcKeyType

    from experiments.runs.config import SceneConfig

STYLE: dict[RcKeyType, Any] = {
    "font.size": 8.5,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.labelsize": 8.5,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.color": "0.92",
    "grid.linewidth": 0.6,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "lines.solid_capstyle": "round",
    "mathtext.fontset": "dejavusans",
    "savefig.dpi": 200,
    "pdf.fonttype": 42,
}

ROBOT = "#D55E00"
REGION = "#009E73"
INVERSE_OPTIMAL = "#0072B2"
UKF = "#CC79A7"
HYBRID = "#E69F00"
ACTIVE, INACTIVE = "0.25", "0.82"
TEAM = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F5539", "#4D4D4D")
"""One colour per robot, reused in turn beyond eight."""


def team_colours(config: SceneConfig) -> list[str]:
    """The colours of the robots of a team."""
    return [TEAM[i % len(TEAM)] for i in range(len(config.robots))]


SET_COLOURS = {"critical_region": REGION, "inverse_optimal": INVERSE_OPTIMAL}
SET_NAMES = {"critical_region": "paper's region", "inverse_optimal": "inverse-optimal set"}


CURVES: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("critical_region sqrt_area", "region √area", {"color": REGION, "lw": 1.6}),
    ("critical_region diameter", "region diameter", {"color": REGION, "lw": 1.1, "ls": (0, (4, 1.5))}),
    ("inverse_optimal sqrt_area", "inv.-opt. √area", {"color": INVERSE_OPTIMAL, "lw": 1.6}),
    ("inverse_optimal diameter", "inv.-opt. diameter", {"color": INVERSE_OPTIMAL, "lw": 1.1, "ls": (0, (4, 1.5))}),
    ("ukf", "UKF error", {"color": UKF, "lw": 1.8}),
    ("hybrid", "hybrid error", {"color": HYBRID, "lw": 1.4, "ls": (0, (1, 1))}),
)
"""The comparison of sizes and errors: name in `Results.lengths`, label, options of matplotlib."""

UNITS = ((1.0, "m"), (1e-3, "mm"), (1e-6, "µm"), (1e-9, "nm"))


def length(metres: float) -> str:
    """A length [m] as text with a suitable unit: 14 m, 0.11 m, 3.2 mm, 1.1 µm."""
    unit, name = next((unit for unit in UNITS if metres >= 0.1 * unit[0]), UNITS[-1])
    return f"{metres / unit:.2g} {name}"
