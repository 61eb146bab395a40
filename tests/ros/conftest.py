"""Tests of the live shell run in ROS domains of their own, with rclpy's field checks on."""

import importlib.util
import os

import pytest

# Domains 1 to 100 are free of the port ranges that Linux hands out. Set before rclpy and messages are imported.
os.environ['ROS_DOMAIN_ID'] = str(os.getpid() % 100 + 1)
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'
HAS_ROS = all(importlib.util.find_spec(name) for name in ('rclpy', 'sensor_msgs', 'std_srvs'))


NEED_NO_ROS = ('test_cameras.py', 'test_log_throttle.py', 'test_node_log.py', 'test_watchdog.py', 'test_status.py')
"""Tests of modules of the live shell that need no ROS."""


class WithoutRos(pytest.Module):
    """A test module that is skipped with a reason."""

    def collect(self):
        pytest.skip("rclpy is not importable: pip install '.[ros]'", allow_module_level=True)


def pytest_pycollect_makemodule(module_path, parent):
    """Skip the modules of this folder without ROS."""
    return None if HAS_ROS or module_path.name in NEED_NO_ROS else WithoutRos.from_parent(parent, path=module_path)


@pytest.fixture(autouse=True)
def ros_home(quick_path, monkeypatch):
    """Keep the calibrations of a test's nodes in a folder of its own."""
    monkeypatch.setenv('ROS_HOME', str(quick_path))
    return quick_path


@pytest.fixture
def bench(monkeypatch):
    """Yield a running executor to put nodes on, with a client node beside them; nodes find a camera at once."""
    from autocalib_ros.ros import image_input
    from bench import Bench

    monkeypatch.setattr(image_input, 'PUBLISHER_POLL_S', 0.05)
    running = Bench()
    yield running
    running.close()
