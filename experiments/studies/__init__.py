"""Studies written for one page of the documentation each. No run needs them."""
