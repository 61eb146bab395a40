"""Kill a process in the middle of its saves, repeatedly, and check the files it leaves: FOLDER KILLS [SEED].

Prints how often each kind of leaving was found. Ends with an error as soon as a file cannot be read, a calibration is
none that was saved, or an older one than was there before comes back.
"""

import os
import random
import signal
import sys
import time
from collections import Counter
from pathlib import Path

from autocalib_ros.lens.camera_info_yaml import read_camera_info
from autocalib_ros.results.store import Store, StoreState, stored_json
from stored_results import calibration, stored

LONGEST_LIFE_S = 0.08
"""Long enough for several saves."""


def numbered(number: int):
    """Return a calibration with a number and a lens of its own."""
    return stored(calibration(300.0 + 0.01 * number, number=number))


def save_until_killed(store: Store, number: int) -> None:
    while True:
        number += 1
        store.save(numbered(number))


def check(store: Store, last: int) -> tuple[StoreState, int]:
    """Return state and number of the stored calibration; fail if a file is unreadable or too old."""
    read_camera_info(store.path)
    store.remove_leftovers()
    found = store.load()
    assert found.stored is not None, found
    number = found.stored.calibration.evidence.frames
    assert number >= last, f'{number} after {last}'
    assert stored_json(found.stored) == stored_json(numbered(number)), 'not what was saved'
    left = [path.name for path in store.path.parent.iterdir() if path.name.startswith('.')]
    assert not left, left
    return found.state, number


def main(folder: Path, kills: int, seed: int) -> None:
    """Fork a writer, kill it and check its files, `kills` times."""
    lives, states = random.Random(seed), Counter()
    store, last = Store(folder / 'north.yaml'), 0
    store.save(numbered(last))
    for _ in range(kills):
        child = os.fork()
        if child == 0:
            save_until_killed(store, last)
        time.sleep(lives.uniform(0.0, LONGEST_LIFE_S))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        state, last = check(store, last)
        states[state.value] += 1
    # the first save after an interrupted one is intact again
    store.save(numbered(last + 1))
    state, last = check(store, last + 1)
    assert state is StoreState.INTACT
    print(f'{kills} kills, {last} saves: {dict(sorted(states.items()))}')


if __name__ == '__main__':
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) > 3 else 0)
