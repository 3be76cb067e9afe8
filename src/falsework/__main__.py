"""Run the command line as `python -m falsework`."""

import sys

from falsework.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
