"""`python -m autocalib_ros` is the `autocalib` command."""

import sys

from autocalib_ros.cli import main  # noqa: TID251  an entry point stands above all rooms

sys.exit(main())
