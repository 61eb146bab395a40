"""The `autocalib` command line: sub-commands, logging and error handling."""

from __future__ import annotations

import argparse
import logging
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NoReturn

from autocalib_ros import __version__
from autocalib_ros.commands import INTERRUPTED, WRONG_USE
from autocalib_ros.commands import benchmark_command as benchmark
from autocalib_ros.commands import compare_command as compare
from autocalib_ros.commands import demo_command as demo
from autocalib_ros.commands import docs_command as docs
from autocalib_ros.commands import evidence_command as evidence
from autocalib_ros.commands import export_command as export
from autocalib_ros.commands import picture_command as picture
from autocalib_ros.commands import rectify_command as rectify
from autocalib_ros.commands import replay_command as replay
from autocalib_ros.commands import simulate_command as simulate
from autocalib_ros.commands import topview_command as topview
from autocalib_ros.errors import AutocalibError, UsageError
from autocalib_ros.util.threads import limit_blas_threads

COMMANDS = {
    'replay': replay,
    'evidence': evidence,
    'compare': compare,
    'export': export,
    'rectify': rectify,
    'topview': topview,
    'picture': picture,
    'simulate': simulate,
    'demo': demo,
    'benchmark': benchmark,
    'docs': docs,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a sub-command and return the exit status.

    0 calibrated or done, 3 refused, 2 wrong usage or unreadable input, 130 interrupted.
    """
    limit_blas_threads()
    _silence_libraries()
    _replace_unencodable_characters()
    try:
        with _warnings_on_stderr():
            arguments = _parse_arguments(sys.argv[1:] if argv is None else list(argv))
            return arguments.run(arguments)
    except AutocalibError as error:
        print(f'autocalib: error: {error}', file=sys.stderr)
        return WRONG_USE
    except KeyboardInterrupt:
        print(file=sys.stderr)
        return INTERRUPTED
    except SystemExit as leave:  # argparse after --help and --version
        return int(leave.code or 0)


def _silence_libraries() -> None:
    """Suppress the log output of FFmpeg, OpenCV and matplotlib: errors are reported once, in one line."""
    os.environ.setdefault('OPENCV_FFMPEG_LOGLEVEL', '-8')
    os.environ.setdefault('OPENCV_LOG_LEVEL', 'OFF')
    logging.getLogger('matplotlib').setLevel(logging.ERROR)


def _replace_unencodable_characters() -> None:
    """Make stdout and stderr replace characters that their encoding lacks, such as the plus-minus sign."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, 'reconfigure'):
            stream.reconfigure(errors='replace')


@contextmanager
def _warnings_on_stderr() -> Iterator[None]:
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter('autocalib: warning: %(message)s'))
    handler.setLevel(logging.WARNING)
    logger = logging.getLogger('autocalib_ros')
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


class _Parser(argparse.ArgumentParser):
    """Argument parser that raises `UsageError`, so that `main` reports wrong usage in one line."""

    def error(self, message: str) -> NoReturn:
        """Raise UsageError."""
        raise UsageError(f'{message} (see {self.prog} --help)')


def _parse_arguments(argv: list[str]) -> argparse.Namespace:
    parser = _Parser(prog='autocalib', description='Calibrate a fixed roadside camera from traffic.')
    parser.add_argument('--version', action='version', version=f'autocalib {__version__}')
    commands = parser.add_subparsers(title='commands', metavar='COMMAND', required=True, parser_class=_Parser)
    for name, command in COMMANDS.items():
        own = commands.add_parser(name, help=command.HELP, description=command.DESCRIPTION)
        own.set_defaults(run=command.run)
        if name in argv:  # only the command in use: the options of `simulate` are slow to import
            command.add_arguments(own)
    return parser.parse_args(argv)


if __name__ == '__main__':
    sys.exit(main())
