"""The documentation against the program: generated pages, links, code blocks, names."""

import argparse
import ast
import importlib.util
import inspect
import itertools
import json
import pkgutil
import re
import shlex
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
import yaml

import autocalib_ros
from autocalib_ros.cli import _parse_arguments, main
from autocalib_ros.commands.reference_pages import (
    command_parsers,
    documented_constants,
    outdated,
    reference_pages,
    refusal_page,
    table,
    usage,
)
from autocalib_ros.commands.solve_options import options_from_arguments
from autocalib_ros.config import NodeOptions, Options, walk_options, with_overrides
from autocalib_ros.errors import UsageError
from autocalib_ros.lens.camera import Camera
from autocalib_ros.node_interface import (
    AUTOCALIB_NODE,
    DIAGNOSTIC_LEVELS,
    DIAGNOSTIC_VALUES,
    GROUND_POINTS_NODE,
)
from autocalib_ros.offline.parameter_file import parse_assignments
from autocalib_ros.perception.images import PACKED_ENCODINGS, PLANAR_ENCODINGS, YUV422_ENCODINGS
from autocalib_ros.results.calibration_json import to_json, write_calibration_json
from autocalib_ros.results.refusals import REFUSALS
from autocalib_ros.results.statements import ASSUMPTIONS, CHECKS, UNKNOWN_KIND
from autocalib_ros.ros.status import Counts, Situation, status
from synthetic_results import full_result, junction_evidence, refusal

ROOT = Path(__file__).parent.parent
DOCS = ROOT / 'docs'
PACKAGE = ROOT / 'autocalib_ros'
PAGES = [*ROOT.glob('*.md'), ROOT / 'examples' / 'README.md', *sorted(DOCS.rglob('*.md'))]
LANGUAGES = {'sh', 'text', 'python', 'yaml', 'xml', 'math', 'json'}
FENCE = re.compile(r'^```(\w*)\n(.*?)^```$', re.MULTILINE | re.DOTALL)
LINK = re.compile(r'!?\[[^\]]*\]\(([^)\s]+)(?: "[^"]*")?\)')
HEADING = re.compile(r'^#+ (.*)$', re.MULTILINE)
OPTION = re.compile(r'(?<!-)--[a-z][a-z-]+')
OPTIONS_OF_OTHERS = {
    '--dist',
    '--ros-args',
    '--params-file',
    '--skip-keys',
    '--from-paths',
    '--once',
    '--fix-aspect-ratio',
    '--zero-tangent-dist',
    '--help',
    '--version',
}
"""Options of ROS, rosdep and camera_calibration, and those that every parser has."""
SHELL_WORDS = {
    'python',
    'python3',
    'pip',
    '.',
    'ros2',
    'rviz2',
    'sed',
    'export',
    'rosdep',
    'autocalib',
    'autocalib_node',
    'ground_points_node',
    'tests/tools/tf2_msgs/build.sh',
    '.venv/bin/pip',
    '.venv/bin/python',
    '.venv/bin/ruff',
    '.venv/bin/mypy',
    '.venv/bin/autocalib',
}
NAMES = {item.name for options in (Options(), NodeOptions()) for item in walk_options(options)}
GROUPS = {name.partition('.')[0] for name in NAMES if '.' in name}


class Block(NamedTuple):
    page: Path
    language: str
    text: str


def text_of(page: Path) -> str:
    return page.read_text(encoding='utf-8')


def blocks(*languages: str) -> list[Block]:
    found = [Block(page, *match.groups()) for page in PAGES for match in FENCE.finditer(text_of(page))]
    return [block for block in found if block.language in languages] if languages else found


def without_blocks(text: str) -> str:
    return FENCE.sub('', text)


def code_spans(page: Path) -> list[str]:
    return re.findall(r'`([^`]+)`', without_blocks(text_of(page)))


def shell_lines() -> Iterator[tuple[Path, list[str]]]:
    """Yield the commands of all shell blocks as words, split at &&."""
    for block in blocks('sh'):
        for line in block.text.splitlines():
            for part in line.split('&&'):
                if part.strip():
                    yield block.page, shlex.split(part, comments=True)


def slug(heading: str) -> str:
    """Return the anchor that GitHub gives to a heading."""
    text = re.sub(r'\[([^\]]*)\]\([^)]*\)', r'\1', heading).strip().lower()
    return re.sub(r'[^\w\- ]', '', text).replace(' ', '-')


def anchors(page: Path) -> set[str]:
    return {slug(heading) for heading in HEADING.findall(without_blocks(text_of(page)))}


# Pages


def test_readme_fits_on_a_few_screens():
    assert len(text_of(ROOT / 'README.md').splitlines()) <= 150


@pytest.mark.render
def test_generated_pages_are_those_of_the_code():
    assert outdated(DOCS) == [], 'run `autocalib docs`'


def test_a_percent_sign_is_a_single_one_in_help():
    """argparse formats the help of options, and not descriptions: a sign that is doubled there stays doubled."""
    assert '%%' not in (DOCS / 'reference' / 'cli.md').read_text(encoding='utf-8')


@pytest.mark.render
def test_docs_command_writes_and_checks(tmp_path, capsys):
    assert main(['docs', '--check', str(tmp_path)]) == 3
    assert not list(tmp_path.iterdir())
    assert main(['docs', str(tmp_path)]) == 0
    (tmp_path / 'reference' / 'cli.md').write_text('old')
    capsys.readouterr()
    assert main(['docs', '--check', str(tmp_path)]) == 3
    told = capsys.readouterr().out.strip()
    assert told.endswith('cli.md: out of date') and told.count('out of date') == 1  # the others are up to date


def test_every_page_is_in_the_index():
    index = DOCS / 'README.md'
    linked = {(DOCS / link.partition('#')[0]).resolve() for link in LINK.findall(text_of(index))}
    assert {page for page in DOCS.rglob('*.md')} - {index} <= linked


def test_relative_links_lead_somewhere():
    broken = []
    for page in PAGES:
        for link in LINK.findall(without_blocks(text_of(page))):
            path, _, anchor = link.partition('#')
            target = (page.parent / path).resolve() if path else page
            if '://' in link:
                continue
            if not target.exists() or (anchor and anchor not in anchors(target)):
                broken.append(f'{page.relative_to(ROOT)}: {link}')
    assert broken == []


@pytest.mark.render
def test_figures_of_the_method_are_drawn(tmp_path):
    spec = importlib.util.spec_from_file_location('draw_figures', DOCS / 'explanation' / 'draw_figures.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.FOLDER = tmp_path
    shutil.copy(DOCS / 'explanation' / 'grades.csv', tmp_path)
    for draw in (module.straight, module.turning, module.loss, module.grades, module.cost):
        draw()
        name = f'{draw.__name__}.svg'
        sizes = [
            ElementTree.parse(folder / name).getroot().get('viewBox') for folder in (tmp_path, DOCS / 'explanation')
        ]
        assert sizes[0] == sizes[1]


def test_citation_is_of_this_version():
    citation = yaml.safe_load(text_of(ROOT / 'CITATION.cff'))
    assert citation['version'] == autocalib_ros.__version__
    assert f'\n{autocalib_ros.__version__} (' in text_of(ROOT / 'CHANGELOG.rst')


def test_table_cells_cannot_break_a_table():
    assert table(('a',), [('`x|y` <t>',)]).splitlines()[-1] == r'| `x\|y` &lt;t&gt; |'


# Code blocks


def test_blocks_name_a_language():
    assert {block.language for block in blocks()} <= LANGUAGES


def test_commands_of_shell_blocks_are_known():
    assert {words[0] for _, words in shell_lines()} <= SHELL_WORDS


def test_autocalib_commands_parse_and_their_options_are_valid(monkeypatch):
    monkeypatch.chdir(ROOT)  # they name files of config/
    count = 0
    for page, words in shell_lines():
        if Path(words[0]).name == 'autocalib':
            count += 1
            try:
                arguments = _parse_arguments(words[1:])
                if hasattr(arguments, 'param'):
                    options_from_arguments(arguments)
            except UsageError as error:
                pytest.fail(f'{page.relative_to(ROOT)}: {shlex.join(words)}: {error}')
    assert count > 20


def test_ros_parameters_in_commands_are_valid():
    for _, words in shell_lines():
        if '--ros-args' in words:
            values = parse_assignments([value for flag, value in itertools.pairwise(words) if flag == '-p'])
            core = {item.name for item in walk_options(Options())}
            with_overrides(Options(), {name: value for name, value in values.items() if name in core})
            with_overrides(NodeOptions(), {name: value for name, value in values.items() if name not in core})


def test_launch_commands_use_arguments_of_the_launch_file():
    for page, words in shell_lines():
        if words[:2] == ['ros2', 'launch']:
            file = ROOT / words[2] if words[2].endswith('.py') else ROOT / 'launch' / words[3]
            for name in (word.partition(':=')[0] for word in words if ':=' in word):
                assert f"'{name}'" in text_of(file), f'{page}: {name}'


def test_python_blocks_compile_and_import():
    for block in blocks('python'):
        tree = ast.parse(block.text, str(block.page))
        imports = [node for node in tree.body if isinstance(node, (ast.Import, ast.ImportFrom))]
        exec(compile(ast.Module(imports, []), str(block.page), 'exec'), {})


def test_yaml_json_and_xml_blocks_parse():
    for block in blocks('yaml', 'json', 'xml'):
        {'yaml': yaml.safe_load, 'json': json.loads, 'xml': ElementTree.fromstring}[block.language](block.text)


def wide_result() -> Any:
    """Return a hand-made calibration of a camera of 1280x720."""
    return replace(full_result(junction_evidence()), camera=Camera.equidistant(1280, 720, 560.0))


def test_the_example_of_a_tracker_runs(tmp_path, monkeypatch):
    (block,) = [block for block in blocks('python') if 'tracker.measure' in block.text]
    (tmp_path / 'results').mkdir()
    write_calibration_json(tmp_path / 'results' / 'calibration.json', wide_result())
    monkeypatch.chdir(tmp_path)
    measured = []
    names = {'tracker': SimpleNamespace(measure=lambda place, noise: measured.append((place.shape, noise.shape)))}
    exec(compile(block.text, str(block.page), 'exec'), names)
    assert measured == [((2,), (2, 2))] * 2
    assert names['seen'].shape == (2,) and (names['found'].sigma_m > 0).all()


@pytest.mark.parametrize('page', ['README.md', 'docs/how-to/python-api.md'])
def test_the_example_of_the_python_api_runs(page, tmp_path, monkeypatch, capsys):
    block = next(block for block in blocks('python') if block.page == ROOT / page)
    video = tmp_path / 'recording.avi'
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*'MJPG'), 10.0, (64, 48))
    for _ in range(5):
        writer.write(np.full((48, 64, 3), 90, np.uint8))
    writer.release()
    exec(compile(block.text.replace('recording/', str(video)), page, 'exec'), {})
    assert capsys.readouterr().out.startswith('no_motion ')


def test_public_names_are_imported_when_used_and_documented():
    page = text_of(DOCS / 'how-to' / 'python-api.md')
    for name in autocalib_ros.__all__:
        assert getattr(autocalib_ros, name).__name__ == name
        assert f'`{name}' in page
    with pytest.raises(AttributeError):
        _ = autocalib_ros.nothing


# Names


def test_parameters_that_pages_name_exist():
    unknown = {
        f'{page.relative_to(ROOT)}: {span}'
        for page in PAGES
        for span in code_spans(page)
        if re.fullmatch(r'[a-z]+\.[a-z0-9_]+', span.partition('=')[0].partition(':')[0])
        and span.partition('.')[0] in GROUPS
        and not span.endswith('.py')
        and re.split('[=:]', span)[0] not in NAMES
    }
    assert unknown == set()


def test_options_that_pages_name_exist():
    parsers = list(command_parsers().values())
    for parser in parsers:
        parsers += [
            child
            for action in parser._actions
            if isinstance(action, argparse._SubParsersAction)
            for child in action.choices.values()
        ]
    known = OPTIONS_OF_OTHERS | {flag for parser in parsers for flag in parser._option_string_actions}
    assert {
        f'{page.relative_to(ROOT)}: {flag}'
        for page in PAGES
        for span in code_spans(page)
        for flag in OPTION.findall(span)
        if flag not in known
    } == set()


def test_paths_that_pages_name_exist():
    made = {line.strip('/') for line in text_of(ROOT / '.gitignore').splitlines()}  # by the commands of the pages
    folders = (path.name for path in ROOT.iterdir() if path.is_dir() and not path.name.startswith('.'))
    tops = tuple(f'{name}/' for name in folders if name not in made)
    missing = {
        f'{page.relative_to(ROOT)}: {span}'
        for page in PAGES
        for span in code_spans(page)
        if span.startswith(tops) and ' ' not in span and not (ROOT / span).exists()
    }
    assert missing == set()


def test_python_names_that_pages_name_exist():
    for page in PAGES:
        for span in code_spans(page):
            if re.match(r'autocalib_ros\.\w', span):
                pkgutil.resolve_name(span.partition('(')[0])


def test_constants_that_are_explained_exist():
    made = {
        name
        for path in PACKAGE.rglob('*.py')
        for name in re.findall(r'^([A-Z][A-Z0-9_, ]+) = ', text_of(path), re.MULTILINE)
    }
    names = {name for line in made for name in line.split(', ')}
    rows = re.findall(r'^\| (`[^|]*`) \|', text_of(DOCS / 'explanation' / 'constants.md'), re.MULTILINE)
    named = {name for row in rows for name in re.findall(r'`([A-Za-z0-9_.]+)`', row)}
    assert len(named) > 40
    assert {name for name in named if name not in names and name not in NAMES} == set()


# Generated pages say what the code has


@pytest.fixture(scope='module')
def pages() -> dict[str, str]:
    """Return the generated pages, made once."""
    return reference_pages()


@pytest.mark.render
def test_every_option_has_a_row_with_its_default(pages):
    page = pages['reference/parameters.md']
    for item in [*walk_options(Options()), *walk_options(NodeOptions())]:
        (row,) = re.findall(rf'^\| `{re.escape(item.name)}` .*$', page, re.MULTILINE)
        default = str(item.default).lower() if isinstance(item.default, bool) else str(item.default) or "''"
        assert f'| `{default}` |' in row
        assert all(f'`{choice}`' in row for choice in item.choices)
        assert ' '.join(item.doc.split())[1:20].replace('<', '&lt;').replace('>', '&gt;') in row


@pytest.mark.render
def test_every_argument_of_every_command_has_a_row(pages):
    page = pages['reference/cli.md']
    for name, parser in command_parsers().items():
        assert f'\n## autocalib {name}\n' in page
        for action in parser._actions:
            if action.dest != 'help' and not isinstance(action, argparse._SubParsersAction):
                assert f'| {usage(action)} |'.replace('|', r'\|')[2:-3] in page.replace('|', r'\|')


def test_commands_of_the_page_are_those_of_the_program():
    from autocalib_ros.cli import COMMANDS

    assert set(command_parsers()) == set(COMMANDS)


def made_endpoints(paths: list[Path]) -> set[tuple[str, str]]:
    """Return name and message type of what is made in modules; '' where the type is not a plain name."""
    found = set()
    for path in paths:
        for node in ast.walk(ast.parse(text_of(path))):
            if isinstance(node, ast.Call):
                function = getattr(node.func, 'attr', getattr(node.func, 'id', ''))
                if function.startswith('create_') or function.endswith('_publisher'):
                    words = [
                        argument.value
                        for argument in node.args
                        if isinstance(argument, ast.Constant) and isinstance(argument.value, str)
                    ]
                    kinds = [
                        argument.id
                        for argument in node.args
                        if isinstance(argument, ast.Name) and argument.id[:1].isupper() and not argument.id.isupper()
                    ]
                    found.update((word, kinds[0] if kinds else '') for word in words)
    return found


def test_topics_and_services_of_the_code_are_those_of_the_table():
    (ground_points,) = (path for path in (PACKAGE / 'ros').glob('ground_points*.py'))
    others = [path for path in (PACKAGE / 'ros').glob('*.py') if path != ground_points]
    for paths, endpoints in (([ground_points], GROUND_POINTS_NODE), (others, AUTOCALIB_NODE)):
        table_types = {item.name: item.type.partition('/')[2] for item in endpoints}
        made = made_endpoints(paths)
        assert len(made) >= 4
        for name, kind in made:
            assert name in table_types, name
            assert kind in ('', table_types[name]), name
        source = ''.join(text_of(path) for path in paths)
        for name in table_types:
            assert f"'{name}'" in source, name


def test_values_of_diagnostics_are_those_of_the_code():
    assert list(DIAGNOSTIC_VALUES) == [key for key, _ in status(Situation(topic='', counts=Counts())).values]
    assert [level for level, _ in DIAGNOSTIC_LEVELS] == ['OK', 'WARN', 'ERROR']


def test_refusal_codes_of_the_code_are_in_the_table():
    codes = [item.code for item in REFUSALS]
    assert len(set(codes)) == len(codes)
    source = ''.join(text_of(path) for path in PACKAGE.rglob('*.py') if path.name != 'refusals.py')
    used = set(re.findall(r"\breason\(\s*'(\w+)'", source)) | {'too_little_turning', 'too_little_curvature'}
    assert used == set(codes)
    assert not re.findall(r"\bReason\(\s*'", source), 'a refusal is made outside of the table'
    assert all(getattr(item, name).strip() for item in REFUSALS for name in ('cause', 'limit', 'remedy'))
    page = refusal_page(REFUSALS)
    assert all(f'\n| `{code}` |' in page for code in codes)


def test_constants_are_read_with_their_descriptions():
    found = list(documented_constants('A, B = 1, 2.5\n"""Two numbers."""\nC = 3\nlower = 1\n"""No."""\n'))
    assert found == [(('A', 'B'), '`1, 2.5`', 'Two numbers.')]


# Hand-written reference pages


def keys(document: Any) -> Iterator[str]:
    if isinstance(document, dict):
        for key, value in document.items():
            yield key
            yield from keys(value if key != 'values' else None)  # these are named in the tables of statements


def test_every_key_of_calibration_json_is_documented():
    evidence = junction_evidence()
    page = text_of(DOCS / 'reference' / 'calibration-json.md')
    numbers = {'10', '20', '40'}
    for result in (full_result(evidence), refusal(evidence)):
        assert {key for key in keys(to_json(result)) if f'`{key}`' not in page} <= numbers


def test_every_kind_of_statement_is_documented():
    page = text_of(DOCS / 'reference' / 'calibration-json.md')
    assert [kind for kind in (*ASSUMPTIONS, *CHECKS, UNKNOWN_KIND) if f'`{kind}`' not in page] == []


def test_every_image_encoding_is_documented():
    listed = set(re.findall(r'`([^`]+)`', text_of(DOCS / 'reference' / 'image-encodings.md')))
    assert listed - {'CompressedImage'} == {*PACKED_ENCODINGS, *YUV422_ENCODINGS, *PLANAR_ENCODINGS}


def test_detector_layouts_are_documented():
    layouts = set(next(item.choices for item in walk_options(Options()) if item.name == 'detector.layout'))
    page = text_of(DOCS / 'how-to' / 'use-a-detector.md')
    assert {layout for layout in layouts if f'`{layout}`' not in page} == set()


def test_scenes_and_disturbances_of_the_simulator_are_documented():
    from autocalib_ros.offline.simulate.options import SCENES, TROUBLES

    page = text_of(DOCS / 'how-to' / 'simulate-traffic.md')
    assert {name for name in (*SCENES, *TROUBLES) if f'`{name}`' not in page} == set()


def test_replay_takes_what_the_page_says():
    from autocalib_ros.offline.replay_recording import replay

    assert list(inspect.signature(replay).parameters)[:2] == ['recording', 'options']
