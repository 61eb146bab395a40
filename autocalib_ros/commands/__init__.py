"""Sub-commands of `autocalib`: each module has HELP, DESCRIPTION, add_arguments(parser) and run(arguments) -> status.

Heavy modules (OpenCV, SciPy, rosbags, matplotlib) are imported inside the functions that use them: --help is fast.
"""

DONE, WRONG_USE, REFUSED, INTERRUPTED = 0, 2, 3, 130
"""Exit statuses: success; wrong usage or unreadable input; refused; interrupted by the user (128 + SIGINT)."""
NOBODY_READS = 141
"""Exit status if the reader of stdout went away (128 + SIGPIPE)."""
MOVED = 3
"""Exit status of `benchmark golden` if a result differs from the expected one."""
