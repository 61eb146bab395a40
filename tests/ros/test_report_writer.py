"""The report of a live node: written next to the calibration by a child process."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from autocalib_ros.config import Options
from autocalib_ros.results.store import Store
from autocalib_ros.ros.report_writer import ReportPaths, ReportWriter
from bench import SIZE, calibration, wait_for
from synthetic_results import full_result, grey_road, junction_evidence
from test_node import calibrated
from test_persistence import focal

OPTIONS = Options(camera_height=8.0)


@pytest.fixture
def log_lines():
    return []


@pytest.fixture
def reports(log_lines):
    made = ReportWriter(lambda text, good: log_lines.append((text, good)))
    yield made
    made.close()


def test_save_writes_the_report_beside_the_calibration(bench, ros_home):
    store = Store(ros_home / 'camera_info' / 'north.yaml')
    calibrated(bench, focal(311.0), camera_name='north', autosave=False)
    answer = bench.ask('save')
    assert answer.success and str(store.report) in answer.message
    wait_for(store.report.exists, 'the report', 120.0)
    text = store.report.read_text()
    assert 'focal length 311.0 ± 1.0 px' in text and 'north, live on /image' in text
    assert (store.figures / 'ground_grid.png').exists()
    assert 'Convergence' not in text  # of one solution there is nothing to compare


def test_a_report_shows_the_evidence_that_the_calibration_rests_on(reports):
    evidence = junction_evidence()
    result = full_result(evidence)
    later = replace(evidence, frames=evidence.frames + 1)
    reports.set_evidence(result, evidence)
    assert reports.scene(result, (later, grey_road()), OPTIONS, '').evidence is evidence
    other = full_result(evidence)
    assert reports.scene(other, (later, grey_road()), OPTIONS, '').evidence is later
    reports.forget()
    assert reports.scene(result, (later, grey_road()), OPTIONS, '').evidence is later


def test_a_restored_calibration_before_any_image_has_no_traffic(reports):
    result = full_result(junction_evidence())
    scene = reports.scene(result, (None, None), OPTIONS, '')
    assert (scene.evidence.track_count, scene.evidence.image_size, scene.background) == (0, (320, 180), None)


def test_images_of_another_size_are_not_shown(reports):
    evidence = junction_evidence()
    result = calibration(replace(evidence, image_size=SIZE))
    assert reports.scene(result, (evidence, grey_road()), OPTIONS, '').background is None


@pytest.mark.dds
def test_a_report_that_cannot_be_written_is_reported(reports, log_lines, tmp_path):
    (tmp_path / 'file').touch()
    scene = reports.scene(full_result(junction_evidence()), (None, None), OPTIONS, '')
    reports.write(ReportPaths(tmp_path / 'file' / 'page.html', tmp_path / 'file' / 'figures'), scene)
    wait_for(lambda: log_lines, 'the complaint', 120.0)
    ((text, good),) = log_lines
    assert text.startswith('the report was not written: InputError: cannot write') and not good


def test_a_node_that_ends_gives_the_report_up(reports, log_lines, tmp_path):
    scene = reports.scene(full_result(junction_evidence()), (None, np.zeros((180, 320), np.uint8)), OPTIONS, '')
    reports.write(ReportPaths(tmp_path / 'page.html', tmp_path / 'figures'), scene)
    assert not reports.close()  # the node says so
    assert not log_lines and not (tmp_path / 'page.html').exists()
    assert reports.close()


@pytest.mark.dds
def test_the_node_starts_without_what_only_report_and_solver_need():
    heavy = {'matplotlib', 'jinja2', 'scipy.stats', 'autocalib_ros.estimation.estimate', 'autocalib_ros.report.scene'}
    program = f'import sys, autocalib_ros.ros.autocalib_node; print(sorted({heavy} & set(sys.modules)))'
    done = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout == "['autocalib_ros.report.scene']\n"
