"""The log tells of progress, not of time."""

import pytest

from autocalib_ros.calibrator import CalibrationProgress

pytestmark = pytest.mark.dds


def test_progress_is_told_when_it_changed(bench, capfd):
    node = bench.start()
    node._worker.counters.used = 1

    def told(percent: float, *missing: str) -> bool:
        node._worker.progress = CalibrationProgress(percent, missing, f'about {percent} min more')
        capfd.readouterr()
        node._log_progress()
        return 'collecting' in ''.join(capfd.readouterr())

    assert told(3, '40 tracks')
    assert not told(3, '40 tracks') and not told(12, '31 tracks')
    assert told(14, '30 tracks') and not told(14, '30 tracks')
