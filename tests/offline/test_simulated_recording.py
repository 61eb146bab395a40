"""A recording that is read while it is simulated."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.offline import simulated_recording
from autocalib_ros.offline.ground_truth import read_truth
from autocalib_ros.offline.recordings.open import open_source
from autocalib_ros.offline.simulate.options import SimulationOptions
from autocalib_ros.offline.simulate.simulation import Simulation
from autocalib_ros.offline.simulated_recording import SimulatedRecording

pytestmark = pytest.mark.render


@cache
def simulation(**options) -> Simulation:
    """Return a small simulation, whose world takes longer to build than its images."""
    return Simulation(SimulationOptions(width_px=96, height_px=64, duration_s=0.4, **options))


def recording(bag, *, compressed=True) -> SimulatedRecording:
    return SimulatedRecording(bag, simulation(compressed=compressed))


def test_it_gives_the_images_that_the_bag_has_afterwards(tmp_path):
    source = recording(tmp_path / 'bag')
    read = list(source.frames())
    written = open_source(tmp_path / 'bag')
    assert [frame.stamp_ns for frame in read] == [frame.stamp_ns for frame in written.frames()]
    assert all(np.array_equal(one.image, other.image) for one, other in zip(read, written.frames(), strict=True))
    assert (source.topic, source.image_type, source.total) == (written.topic, written.image_type, len(read))
    assert read_truth(tmp_path / 'bag' / 'truth.json')['vehicles'] == source.truth['vehicles']


def test_a_reader_that_stops_leaves_no_bag(tmp_path, monkeypatch):
    monkeypatch.setattr(simulated_recording, 'MAX_WAITING', 1)
    frames = recording(tmp_path / 'bag').frames()
    next(frames)
    frames.close()
    assert not (tmp_path / 'bag').exists()


def test_what_ends_the_simulation_reaches_the_reader(tmp_path):
    (tmp_path / 'file').touch()
    with pytest.raises(InputError, match='cannot write'):
        list(recording(tmp_path / 'file' / 'bag').frames())


def test_it_is_not_for_raw_images_and_not_for_copying(tmp_path):
    with pytest.raises(UsageError, match='compressed'):
        recording(tmp_path / 'bag', compressed=False)
    with pytest.raises(UsageError, match='being simulated'):
        recording(tmp_path / 'bag').stored()
