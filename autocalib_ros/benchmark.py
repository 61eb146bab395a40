"""`python -m autocalib_ros.benchmark` is the `autocalib benchmark` command."""

import sys

from autocalib_ros.cli import main  # noqa: TID251  an entry point stands above all rooms

if __name__ == '__main__':  # worker processes import this module again
    sys.exit(main(['benchmark', *sys.argv[1:]]))
