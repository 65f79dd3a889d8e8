"""The tests, and the type checker that runs under them: shapes as annotated, an int where a float is wanted."""

from beartype import BeartypeConf, beartype

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
