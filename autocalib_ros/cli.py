"""The `autocalib` command line: sub-commands, logging and error handling."""

from __future__ import annotations

import argparse
import codecs
import logging
import os
import re
import sys
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from typing import NoReturn

from autocalib_ros import __version__
from autocalib_ros.commands import INTERRUPTED, NOBODY_READS, WRONG_USE
from autocalib_ros.commands import benchmark_command as benchmark
from autocalib_ros.commands import compare_command as compare
from autocalib_ros.commands import demo_command as demo
from autocalib_ros.commands import docs_command as docs
from autocalib_ros.commands import evidence_command as evidence
from autocalib_ros.commands import export_command as export
from autocalib_ros.commands import index_command as index
from autocalib_ros.commands import picture_command as picture
from autocalib_ros.commands import rectify_command as rectify
from autocalib_ros.commands import replay_command as replay
from autocalib_ros.commands import simulate_command as simulate
from autocalib_ros.commands import topview_command as topview
from autocalib_ros.errors import AutocalibError, UsageError
from autocalib_ros.util.plain_text import in_ascii
from autocalib_ros.util.threads import limit_blas_threads

COMMANDS = {
    'replay': replay,
    'evidence': evidence,
    'compare': compare,
    'export': export,
    'index': index,
    'rectify': rectify,
    'topview': topview,
    'picture': picture,
    'simulate': simulate,
    'demo': demo,
    'benchmark': benchmark,
    'docs': docs,
}
PLAIN = 'autocalib_plain'
"""Name of the handler for characters that an encoding lacks."""
COMPLETION = '_ARGCOMPLETE'
"""Environment variable that argcomplete sets while a shell completes a line."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a sub-command and return the exit status.

    0 calibrated or done, 3 refused, 2 wrong usage or unreadable input, 130 interrupted, 141 nobody reads the output.
    """
    limit_blas_threads()
    _silence_libraries()
    _replace_unencodable_characters()
    try:
        with _warnings_on_stderr():
            words = sys.argv[1:] if argv is None else list(argv)
            if not words and COMPLETION not in os.environ:
                _parsers(())[0].print_help()
                return WRONG_USE
            arguments = _parse_arguments(words)
            status: int = arguments.run(arguments)
            sys.stdout.flush()  # here, where a broken pipe is caught
            return status
    except AutocalibError as error:
        print(f'autocalib: error: {error}', file=sys.stderr)
        return WRONG_USE
    except KeyboardInterrupt:
        print(file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # as of `autocalib ... | head`; what is left goes nowhere, Python would complain at its end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return NOBODY_READS
    except SystemExit as leave:  # argparse after --help and --version
        return int(leave.code or 0)


def _silence_libraries() -> None:
    """Suppress the log output of FFmpeg, OpenCV and matplotlib: errors are reported once, in one line."""
    os.environ.setdefault('OPENCV_FFMPEG_LOGLEVEL', '-8')
    os.environ.setdefault('OPENCV_LOG_LEVEL', 'OFF')
    logging.getLogger('matplotlib').setLevel(logging.ERROR)


def _replace_unencodable_characters() -> None:
    """Make stdout and stderr write characters that their encoding lacks otherwise, as +- for the plus-minus sign."""
    codecs.register_error(PLAIN, _in_plain_characters)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, 'reconfigure'):
            stream.reconfigure(errors=PLAIN)


def _in_plain_characters(error: UnicodeError) -> tuple[str, int]:
    """Return what stands for characters that cannot be encoded, and where to go on."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return in_ascii(error.object[error.start : error.end]), error.end


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
        """Raise UsageError, with the command that was probably meant."""
        unknown = re.match(r"argument COMMAND: invalid choice: '([^']*)'", message)
        if unknown:
            message = f"there is no command '{unknown[1]}'{_meant(unknown[1], COMMANDS)}"
        raise UsageError(f'{message} (see {self.prog} --help)')


def _meant(word: str, known: Iterable[str]) -> str:
    """Return a question for the nearest of the known words; '' if none is near."""
    near = get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f"; did you mean '{near[0]}'?" if near else ''


def _parse_arguments(argv: list[str]) -> argparse.Namespace:
    words = {*argv, *os.environ.get('COMP_LINE', '').split()}  # while a shell completes, the line is there
    parser, own = _parsers(words)
    if COMPLETION in os.environ:
        _complete(parser)
    arguments, left = parser.parse_known_args(argv)
    if left:
        used = own[arguments.command]
        known = [name for action in used._actions for name in action.option_strings]
        first = left[0].partition('=')[0]
        raise UsageError(f'unrecognized arguments: {" ".join(left)}{_meant(first, known)} (see {used.prog} --help)')
    return arguments


def _parsers(words: Collection[str]) -> tuple[_Parser, dict[str, _Parser]]:
    """Return the parser, and those of the commands by name; only commands among the words get their options."""
    parser = _Parser(prog='autocalib', description='Calibrate a fixed roadside camera from traffic.')
    parser.add_argument('--version', action='version', version=f'autocalib {__version__}')
    commands = parser.add_subparsers(
        title='commands', metavar='COMMAND', required=True, parser_class=_Parser, dest='command'
    )
    own = {}
    for name, command in COMMANDS.items():
        own[name] = commands.add_parser(name, help=command.HELP, description=command.DESCRIPTION)
        own[name].set_defaults(run=command.run)
        if name in words:  # only the command in use: the options of `simulate` are slow to import
            command.add_arguments(own[name])
    return parser, own


def _complete(parser: argparse.ArgumentParser) -> None:
    """Answer the shell that completes a line, and leave; nothing without argcomplete."""
    try:
        import argcomplete
    except ImportError:
        return
    argcomplete.autocomplete(parser)


if __name__ == '__main__':
    sys.exit(main())
