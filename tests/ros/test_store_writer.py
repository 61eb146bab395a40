"""The thread that writes calibrations."""

import threading

import numpy as np
import pytest

from autocalib_ros.perception.view_file import read_views
from autocalib_ros.perception.view_watch import KnownView
from autocalib_ros.results.history import read_history
from autocalib_ros.results.store import Store, calibration_checksum
from autocalib_ros.ros.side_files import SideFiles
from autocalib_ros.ros.store_writer import SAVE_PERIOD_S, StoreWriter
from bench import PATIENCE_S, wait_for
from stored_results import calibration, stored

NEVER_S = 1e6
FIRST, SECOND, THIRD = (stored(calibration(300.0 + number, number=number)) for number in range(3))


@pytest.fixture
def store(quick_path) -> Store:
    return Store(quick_path / 'camera_info' / 'north.yaml')


@pytest.fixture
def warnings() -> list[str]:
    return []


@pytest.fixture
def start(warnings):
    started = []

    def make(period_s: float = NEVER_S) -> StoreWriter:
        started.append(StoreWriter(warnings.append, period_s))
        return started[-1]

    yield make
    for store_writer in started:
        store_writer.close(PATIENCE_S)


def kept(store: Store) -> int | None:
    found = store.load()
    return None if found.stored is None else found.stored.calibration.evidence.frames


def test_first_offer_is_written_at_once_and_of_later_ones_the_newest_at_the_end(start, store):
    store_writer = start()
    store_writer.offer(store, FIRST)
    wait_for(lambda: kept(store) == 0, 'the first')
    store_writer.offer(store, SECOND)
    store_writer.offer(store, THIRD)
    assert not threading.Event().wait(0.2)
    assert kept(store) == 0
    assert store_writer.close(PATIENCE_S)
    assert kept(store) == 2


def test_offers_are_written_after_a_while(start, store):
    store_writer = start(0.1)
    for number, offered in enumerate((FIRST, SECOND, THIRD)):
        store_writer.offer(store, offered)
        wait_for(lambda wanted=number: kept(store) == wanted, f'offer {number}')


def test_what_is_withdrawn_is_not_written(start, store):
    store_writer = start()
    store_writer.offer(store, FIRST)
    wait_for(lambda: kept(store) == 0, 'the first')
    store_writer.offer(store, SECOND)
    store_writer.withdraw()
    store_writer.close(PATIENCE_S)
    assert kept(store) == 0


def test_step_runs_at_once_and_gives_its_result_or_error(start, store):
    store_writer = start()
    assert store_writer.run(lambda: store.save(SECOND)).result(PATIENCE_S) is None
    assert kept(store) == 1
    assert 'ZeroDivisionError' in str(store_writer.run(lambda: 1 / 0).result(PATIENCE_S))
    assert store_writer.run(lambda: 5).result(PATIENCE_S) == 5


def test_fault_is_reported_once_and_the_offer_is_tried_again(start, store, warnings, quick_path):
    (quick_path / 'camera_info').touch()
    store_writer = start(0.02)
    store_writer.offer(store, FIRST)
    wait_for(lambda: warnings, 'the fault')
    assert not threading.Event().wait(0.2)  # ten more tries
    assert len(warnings) == 1 and 'cannot write' in warnings[0] and store_writer.fault == warnings[0]
    (quick_path / 'camera_info').unlink()
    wait_for(lambda: kept(store) == 0, 'the calibration')
    wait_for(lambda: not store_writer.fault, 'the end of the fault')


def test_history_and_views_that_could_not_be_written_are_written_later(start, store, quick_path):
    (quick_path / 'camera_info').touch()
    now = [0.0]
    side = SideFiles(start(), lambda: now[0])
    views, found = (KnownView(np.full((36, 64), 7, np.uint8), None),), calibration()

    def look() -> bool:
        now[0] += SAVE_PERIOD_S
        side.catch_up()
        side.keep_views(store, found, views)
        return store.views.exists() and store.history.exists()

    side.remember(store, {'time': 'first'})
    side.remember(store, {'time': 'second'})
    assert not any(look() for _ in range(3))
    (quick_path / 'camera_info').unlink()
    wait_for(look, 'both files')
    wait_for(lambda: len(read_history(store.history)) == 2, 'both versions')
    assert [entry['time'] for entry in read_history(store.history)] == ['first', 'second']
    assert len(read_views(store.views, calibration_checksum(found))) == 1


def test_closed_writer_takes_no_more_steps(start):
    store_writer = start()
    store_writer.close(PATIENCE_S)
    assert 'shutting down' in str(store_writer.run(lambda: 5).result(PATIENCE_S))
