"""What stands behind a contradiction: the constraint by name, and the keys of the configuration that make it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from torchfsid.config.observe import ObserveConfig

PRIOR = "prior"
NOMINAL_CONTROL = "nominal control"


def constraint_name(source: int, labels: Sequence[str]) -> str:
    """The name of the constraint behind a `source` of `critical_region` or `inverse_optimal_set`.

    Args:
        source: the index.
        labels: labels of the rows of the model. Without them, the number is the name.
    """
    if source < 0:
        return PRIOR
    if not labels:
        return f"row {source}"
    return labels[source % len(labels)] if source < 2 * len(labels) else NOMINAL_CONTROL


def keys_behind(constraint: str, config: ObserveConfig, rows: Sequence[Sequence[str]]) -> list[str]:
    """The keys that make a constraint, as `--set` takes them.

    Args:
        constraint: its name, see `constraint_name`.
        config: the declared model.
        rows: labels of the rows of each barrier.
    """
    if constraint == PRIOR:
        return ["prior"]
    if constraint == NOMINAL_CONTROL:
        return [f"task.{key}" for key in config.task.suspects] + ["prior"]
    return [
        f"barriers.{i}.{key}"
        for i, (barrier, labels) in enumerate(zip(config.barriers, rows, strict=True))
        if constraint in labels
        for key in barrier.suspects
    ]


def where_to_look(constraints: Iterable[str], config: ObserveConfig, rows: Sequence[Sequence[str]]) -> str:
    """The keys behind contradicting constraints in words, the likeliest first, and the bound on controls last.

    The prior comes first where it is among them: one that is too small is an easy mistake.
    """
    named = sorted(dict.fromkeys(constraints), key=lambda name: name != PRIOR)
    keys = dict.fromkeys(key for name in named for key in keys_behind(name, config, rows))
    if PRIOR in named:
        del keys["prior"]
    first = "prior too small? Otherwise look at " if PRIOR in named else "look at "
    return first + ", ".join([*keys, f"noise.{config.noise.quantity}"])
