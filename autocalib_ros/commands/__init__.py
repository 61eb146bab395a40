"""The sub-commands of `autocalib`, a module each: HELP, DESCRIPTION, add_arguments(parser), run(arguments) -> status.

Everything heavy (OpenCV, SciPy, rosbags, matplotlib) is imported where it is used, so that --help is quick.
"""

DONE, WRONG_USE, REFUSED, INTERRUPTED = 0, 2, 3, 130
"""Exit statuses: calibrated, or else what was asked for; wrong usage or unreadable input; refused; stopped by hand."""
MOVED = 3
"""Exit status where golden evidence gives other values than are expected of it."""
