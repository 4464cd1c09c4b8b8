"""``python -m sb3_skillgraph``: the command line."""

import sys

from sb3_skillgraph.cli import main

if __name__ == "__main__":
    sys.exit(main())
