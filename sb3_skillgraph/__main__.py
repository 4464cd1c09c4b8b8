"""``python -m sb3_skillgraph``: the command line."""

import sys

from sb3_skillgraph.cli import main

sys.exit(main())
