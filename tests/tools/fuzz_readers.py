"""Damage files of every kind by the thousand: python tests/tools/fuzz_readers.py --count 20000 [KIND ...]."""

from __future__ import annotations

import argparse
import faulthandler
import logging
import multiprocessing
import os
import resource
import sys
import tempfile
import time
import traceback
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / 'helpers'))

from fuzzed_readers import TARGETS, fuzz, seeds_of

LIMIT_S = 10
"""Longest time that a reader may take for one file, seconds."""
LIMIT_MB = 1024
"""Most memory that it may take beside what it needs for whole files."""


def attempt(target: str, numbers: range, out: str) -> None:
    """Try damaged files in this process, which ends with status 1 at the first that is not answered as it should be."""
    if out:
        with open(out, 'ab') as stream:  # what OpenCV and FFmpeg say of each file
            os.dup2(stream.fileno(), 2)
    logging.disable(logging.CRITICAL)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for seed in seeds_of(target):
            path = folder / TARGETS[target].name
            path.write_bytes(seed)
            TARGETS[target].read(path)
        before_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        told, slowest_s = 0, 0.0
        for number in numbers:
            faulthandler.dump_traceback_later(LIMIT_S, exit=True, file=sys.stdout)
            started_s = time.perf_counter()
            try:
                told += fuzz(target, range(number, number + 1), folder)
            except Exception:
                print(traceback.format_exc())
                print(f'{target}: file number {number} is answered by a traceback')
                sys.exit(1)
            slowest_s = max(slowest_s, time.perf_counter() - started_s)
        faulthandler.cancel_dump_traceback_later()
        grown_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 - before_mb
        print(
            f'{target}: {len(numbers)} files, {told} refused, the slowest {slowest_s:.2f} s, {grown_mb:.0f} MB more',
            flush=True,
        )
        sys.exit(int(grown_mb > LIMIT_MB))


def main() -> int:
    """Run the readers one after another, each in a process of its own: a crash of a library is told too."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--count', type=int, default=500, help='damaged files of each kind (default: 500)')
    parser.add_argument('--first', type=int, default=0, help='number of the first one; each number gives one file')
    parser.add_argument('--log', default=os.devnull, help='file for what the libraries print')
    parser.add_argument('targets', nargs='*', metavar='KIND', help=f'of {", ".join(TARGETS)}; default: all')
    arguments = parser.parse_args()
    failed = []
    numbers = range(arguments.first, arguments.first + arguments.count)
    for target in arguments.targets or TARGETS:
        process = multiprocessing.get_context('spawn').Process(target=attempt, args=(target, numbers, arguments.log))
        process.start()
        process.join()
        if process.exitcode:
            failed.append(target)
            print(f'{target}: failed with status {process.exitcode}', flush=True)
    print(f'failed: {", ".join(failed)}' if failed else 'every file was read or refused in one line')
    return int(bool(failed))


if __name__ == '__main__':
    sys.exit(main())
