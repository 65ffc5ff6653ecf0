"""The command `armwright`, also as `python -m armwright`."""

import sys

from console.main import main

if __name__ == "__main__":
    sys.exit(main())
