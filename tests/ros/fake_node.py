"""The real node with a solver that returns what the arguments say, after a time that they give: FOCAL_PX SECONDS ...

With FAKE_NODE_SYNC_S, files take as many seconds to reach the disk.
"""

import os
import sys
import time
from functools import partial

from autocalib_ros.ros import autocalib_node, node
from bench import calibration


def main() -> int:
    focal_px, seconds = float(sys.argv.pop(1)), float(sys.argv.pop(1))

    def solve(evidence, options, *, lens):
        print('solving', file=sys.stderr, flush=True)
        end = time.monotonic() + seconds
        while time.monotonic() < end:  # busy, as a solver is
            sum(range(1000))
        return calibration(evidence, focal_px, height_m=options.camera_height)

    slow_s = float(os.environ.get('FAKE_NODE_SYNC_S', '0'))
    if slow_s:
        os.fsync = lambda _: time.sleep(slow_s)
    autocalib_node.AutocalibNode = partial(autocalib_node.AutocalibNode, solve=solve)
    return node.main()


if __name__ == '__main__':
    sys.exit(main())
