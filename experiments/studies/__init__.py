"""Studies, each for one page of the documentation. No run needs them."""
