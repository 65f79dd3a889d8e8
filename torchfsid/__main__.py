"""`python -m torchfsid` is the command `torchfsid`."""

import sys

from torchfsid.cli import main

sys.exit(main())
