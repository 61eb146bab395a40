"""Tests run as the programs do: with one thread for linear algebra."""

from autocalib_ros.threads import use_one_thread_for_linear_algebra

use_one_thread_for_linear_algebra()
