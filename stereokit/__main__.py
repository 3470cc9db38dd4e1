"""`python -m stereokit`."""

import sys

from stereokit.cli import main

if __name__ == "__main__":
    sys.exit(main())
