"""The tests, and the type checker that runs under them: shapes as annotated, an int where a float is wanted."""

from collections import Counter
from collections.abc import Callable
from functools import cache, wraps
from typing import Any

from beartype import BeartypeConf, beartype

CALLS = 50
"""How many calls of a function are checked in each test. Loops repeat the same shapes, and checks are slow."""

calls: Counter[Callable] = Counter()
"""The checked calls of each function in the present test."""

strictly = cache(beartype(conf=BeartypeConf(is_pep484_tower=True)))


def checked(function: Callable) -> Callable:
    """The function, with types that are checked when it is called. It does nothing else (`jaxtyping` made it).

    The check is made when it is first needed: most test files use a small part of the package. Functions within
    functions are private, and would be made anew, with their checks, whenever the outer one is called.
    """
    if "<locals>" in function.__qualname__:
        return function

    @wraps(function)
    def check(*arguments: Any, **named: Any) -> None:
        if calls[function] < CALLS:
            calls[function] += 1
            strictly(function)(*arguments, **named)

    return check
