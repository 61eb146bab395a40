"""Detectors of every layout: recognition, preprocessing and decoding."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import onnx_models
from autocalib_ros.config import DetectorOptions
from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.perception.detector.detector import VehicleDetector, _names, open_detector
from autocalib_ros.perception.detector.layouts import LAYOUTS
from autocalib_ros.util.input_limits import MAX_CLASS_TEXT, MAX_CLASSES
from onnx_models import CAR, PERSON, SCORE, SeeingModel, picture

BGR_255 = {'order': 'bgr', 'white': 255.0}
MODELS = {
    'yolox': ('yolox', BGR_255),
    'yolox_decoded': ('yolox_decoded', BGR_255),
    'yolov3': ('yolov3', {'size': ('any', 'any'), 'size_input': ('image_shape', 'tensor(float)')}),
    'tiny_yolov3': ('yolov3', {'size': ('any', 'any'), 'size_input': ('image_shape', 'tensor(float)')}),
    'yolov5': ('yolov5', {'size': (640, 640)}),
    'yolov7_end2end': ('yolov7_end2end', {'size': (640, 640)}),
    'yolov8': ('yolov8', {'size': (640, 640)}),
    'yolov8_with_masks': ('yolov8', {'size': (640, 640)}),
    'end_to_end': ('end_to_end', {'size': (640, 640), 'meta': {'end2end': 'True'}}),
    'yolo_nas': ('yolo_nas', {'size': (640, 640)}),
    'rtdetr': ('rtdetr', {'size': (640, 640), 'size_input': ('orig_target_sizes', 'tensor(int64)')}),
    'ultralytics_rtdetr': ('ultralytics_rtdetr', {'size': (640, 640)}),
    'rfdetr': ('detr', {'size': (560, 560), 'imagenet': True}),
    'detr': ('detr', {'size': (800, 800), 'imagenet': True}),
    'tf_od': ('tf_od', {'size': ('any', 'any'), 'white': 255.0, 'kind': 'tensor(uint8)', 'channels_last': True}),
    'detection_output': ('detection_output', {'size': (512, 512), **BGR_255}),
}
BOXES = {CAR: [(300, 200, 420, 260), (60, 300, 160, 350)], PERSON: [(500, 100, 530, 170)]}


def model(name: str, **how: object) -> SeeingModel:
    return SeeingModel(getattr(onnx_models, name), **{**MODELS[name][1], **how})


def options_for(name: str, **how: object) -> DetectorOptions:
    ids = {'class_ids': '3 / 1'} if name == 'detection_output' else {}
    return DetectorOptions(**{**ids, **how})


def test_every_layout_is_tried() -> None:
    assert {layout for layout, _ in MODELS.values()} == set(LAYOUTS)


@pytest.mark.parametrize('name', MODELS)
def test_a_layout_is_recognised_and_its_boxes_are_where_they_were_drawn(name: str) -> None:
    detector = VehicleDetector(model(name), options_for(name))
    assert detector.layout == MODELS[name][0]
    found = detector.detect(picture((640, 400), BOXES))
    expected = [*BOXES[CAR], *BOXES[PERSON]]
    order = np.lexsort((found.edges_px[:, 0], found.people))
    assert len(found.scores) == 3
    np.testing.assert_allclose(
        found.edges_px[order], sorted(expected[:2]) + expected[2:], atol=2.5
    )  # px of the image: one and a half of the smallest input
    np.testing.assert_array_equal(found.people[order], [False, False, True])
    np.testing.assert_allclose(found.scores, SCORE, atol=1e-5)


@pytest.mark.parametrize('name', ['yolox', 'yolov8', 'rtdetr'])
@pytest.mark.parametrize('size', [(1920, 1080), (352, 288), (400, 700)])
def test_images_of_any_shape_come_back_in_their_own_pixels(name: str, size: tuple[int, int]) -> None:
    box = (size[0] // 4, size[1] // 4, size[0] // 2, size[1] // 3)
    found = VehicleDetector(model(name), options_for(name)).detect(picture(size, {CAR: [box]}))
    np.testing.assert_allclose(found.edges_px, [box], atol=1.5 * max(1.0, max(size) / 416))


def test_a_model_of_any_size_gets_the_native_size_in_multiples_of_32() -> None:
    seeing = model('yolox', size=('any', 'any'))
    detector = VehicleDetector(seeing, DetectorOptions())
    for size in ((640, 360), (352, 288), (1920, 1080)):
        detector.detect(picture(size, BOXES))
    assert seeing.fed[1:] == [(1, 3, 384, 640), (1, 3, 288, 352), (1, 3, 736, 1280)]


def test_the_longest_side_may_be_less() -> None:
    seeing = model('yolox', size=('any', 'any'))
    VehicleDetector(seeing, DetectorOptions(input_size=416)).detect(picture((1280, 720), BOXES))
    assert seeing.fed[-1] == (1, 3, 256, 416)


@pytest.mark.parametrize('name', ['yolox', 'yolov8', 'rtdetr'])
def test_nothing_is_enlarged(name: str) -> None:
    seen: list[np.ndarray] = []

    def encode(found: onnx_models.Found, size: tuple[int, int]) -> dict[str, np.ndarray]:
        seen.extend(edges for edges, _ in found)
        return getattr(onnx_models, name)(found, size)

    seeing = SeeingModel(encode, **MODELS[name][1])
    VehicleDetector(seeing, DetectorOptions()).detect(picture((200, 160), {CAR: [(40, 40, 100, 80)]}))
    np.testing.assert_array_equal(seen[0][2:] - seen[0][:2], [60, 40])


def test_two_classes_of_one_van_are_one_vehicle_and_two_vans_are_two() -> None:
    detector = VehicleDetector(model('yolox'), DetectorOptions())
    side_by_side = {CAR: [(100, 100, 160, 140), (164, 100, 224, 140)]}
    assert len(detector.detect(picture((416, 416), side_by_side)).scores) == 2


def test_detections_below_the_least_score_are_dropped() -> None:
    image = picture((416, 416), {CAR: [(100, 100, 160, 140)]})
    assert len(VehicleDetector(model('yolox'), DetectorOptions(confidence=0.7)).detect(image).scores) == 1
    assert len(VehicleDetector(model('yolox'), DetectorOptions(confidence=0.75)).detect(image).scores) == 0


def test_grey_images_are_taken() -> None:
    image = picture((416, 416), {})[:, :, 0]
    assert len(VehicleDetector(model('yolox'), DetectorOptions()).detect(np.ascontiguousarray(image)).scores) == 0


@pytest.mark.parametrize(
    ('how', 'says'),
    [
        ({'channel_order': 'rgb'}, 'rgb up to 255'),
        ({'input_scale': 1.0}, 'bgr up to 1,'),
        ({'mean_std': 'imagenet'}, 'normalised by ImageNet'),
        ({'resize_mode': 'centred'}, 'centred'),
        ({'layout': 'yolox_decoded'}, 'layout yolox_decoded'),
    ],
)
def test_options_override_the_recognised_layout(how: dict, says: str) -> None:
    assert says in str(VehicleDetector(model('yolox'), DetectorOptions(**how)))


def test_colours_in_another_order_are_other_classes() -> None:
    image = picture((416, 416), {CAR: [(100, 100, 160, 140)]})
    assert VehicleDetector(model('yolox'), DetectorOptions(channel_order='rgb')).detect(image).people.tolist() == [True]


def test_class_names_in_the_model_select_the_vehicles() -> None:
    names = {0: 'Van', 1: 'tree', 2: 'pedestrian'}
    seeing = SeeingModel(
        lambda found, size: onnx_models.yolov8([(edges, 2 if kind == PERSON else 0) for edges, kind in found], size, 3),
        meta={'names': repr(names)},
    )
    detector = VehicleDetector(seeing, DetectorOptions())
    assert 'vehicles are classes 0, people 2' in str(detector)
    assert sorted(
        detector.detect(picture((416, 416), {CAR: [(9, 9, 99, 80)], PERSON: [(200, 9, 220, 80)]})).people
    ) == [False, True]


@pytest.mark.parametrize(
    ('end2end', 'values', 'layout'),
    [('True', 0.5, 'end_to_end'), ('', 1.0, 'end_to_end'), ('', 0.5, 'ultralytics_rtdetr')],
)
def test_six_columns_are_classes_or_probabilities(end2end: str, values: float, layout: str) -> None:
    seeing = SeeingModel(
        lambda found, size: {'output0': np.full((1, 300, 6), values, np.float32)},
        meta={'names': "['car', 'bus']", 'end2end': end2end},
    )
    assert VehicleDetector(seeing, DetectorOptions()).layout == layout


@pytest.mark.parametrize(
    ('outputs', 'options', 'says'),
    [
        ({'a': (1, 255, 52, 52), 'b': (1, 255, 26, 26), 'c': (1, 255, 13, 13)}, {}, r'raw heads.*\[1, 255, 52, 52\].*'),
        ({'a': (1, 10)}, {}, r'layout is unknown.*a \[1, 10\].*detector.layout'),
        ({'a': (1, 5000, 85)}, {}, r'layout is unknown.*\[1, 5000, 85\]'),
        ({'a': (1, 84, 3549)}, {'layout': 'tf_od'}, r'not of the layout tf_od.*\[1, 84, 3549\]'),
        ({'a': (1, 84, 3549)}, {'layout': 'yolox'}, r'not of the layout yolox '),
        ({'a': (1, 12, 3549)}, {}, "does not name its classes, 8 of them: set 'detector.class_ids'"),
        ({'a': (1, 1, 200, 7)}, {}, "does not name its classes: set 'detector.class_ids'"),
        ({'a': (1, 12, 3549)}, {'class_ids': '8'}, "class 8 of 'detector.class_ids' is not in the model"),
        ({'a': (1, 84, 3549)}, {'input_size': 640}, 'this one takes 416x416'),
    ],
)
def test_an_unsupported_model_is_a_usage_error_at_the_start(outputs: dict, options: dict, says: str) -> None:
    seeing = SeeingModel(lambda found, size: {name: np.zeros(shape, np.float32) for name, shape in outputs.items()})
    with pytest.raises(UsageError, match=says):
        VehicleDetector(seeing, DetectorOptions(**options))


def test_names_without_a_vehicle_are_listed() -> None:
    seeing = SeeingModel(lambda found, size: onnx_models.yolov8(found, size, 2), meta={'names': "['cat', 'dog']"})
    with pytest.raises(UsageError, match=r'known as a vehicle \(cat, dog\)'):
        VehicleDetector(seeing, DetectorOptions())


def test_an_input_that_is_no_picture_is_wrong_usage() -> None:
    seeing = model('yolox')
    seeing.get_inputs = lambda: [SimpleNamespace(name='x', shape=[1, 10], type='tensor(float)')]
    with pytest.raises(UsageError, match=r'must have one image input.*x \[1, 10\]'):
        VehicleDetector(seeing, DetectorOptions())


def test_a_model_that_fails_later_is_an_error_in_words() -> None:
    detector = VehicleDetector(model('yolox', size=('any', 'any')), DetectorOptions())
    detector._session.run = lambda *_: (_ for _ in ()).throw(RuntimeError('out of\nmemory'))
    with pytest.raises(InputError, match='failed on an image of 640x360: out of memory'):
        detector.detect(picture((640, 360), {}))


def test_no_model_is_no_detector() -> None:
    assert open_detector(DetectorOptions()) is None


def test_a_model_that_is_no_file_is_wrong_usage(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"'detector.model' is .*none.onnx, which is not a file"):
        open_detector(DetectorOptions(model=str(tmp_path / 'none.onnx')))


def test_without_onnxruntime_the_error_has_one_line_with_a_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / 'model.onnx').touch()
    monkeypatch.setitem(sys.modules, 'onnxruntime', None)
    with pytest.raises(UsageError, match=r'needs onnxruntime.*pip install onnxruntime') as caught:
        open_detector(DetectorOptions(model=str(tmp_path / 'model.onnx')))
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    ('how', 'says'),
    [
        ({}, 'cannot be loaded'),
        (
            {'providers': 'TensorrtExecutionProvider, NoSuchExecutionProvider'},
            r'asks for \w+ExecutionProvider; this onnxruntime has .*CPUExecutionProvider',
        ),
        ({'providers': ''}, 'asks for none; this onnxruntime has'),
    ],
)
def test_a_model_that_onnxruntime_cannot_run_is_a_usage_error(tmp_path: Path, how: dict, says: str) -> None:
    pytest.importorskip('onnxruntime', reason='onnxruntime is not installed')
    (tmp_path / 'model.onnx').write_bytes(b'no model at all')
    with pytest.raises(UsageError, match=says):
        open_detector(DetectorOptions(model=str(tmp_path / 'model.onnx'), **how))


@pytest.mark.parametrize('text', ['two', '2 3 / x', '-1', '/ 0'])
def test_class_ids_that_are_no_numbers_are_wrong_usage(text: str) -> None:
    with pytest.raises(UsageError, match='whole numbers in one text, vehicles first'):
        DetectorOptions(class_ids=text)


def test_class_ids_may_be_a_number_or_two_lists() -> None:
    assert DetectorOptions(class_ids=2).chosen_classes == ((2,), ())
    assert DetectorOptions(class_ids='2, 3 5 / 0 1').chosen_classes == ((2, 3, 5), (0, 1))


@pytest.mark.parametrize(
    'names',
    [
        '(' * 100_000,
        '-' * 100_000 + '1',
        str({10**9: 'car'}),
        str({-1: 'car'}),
        str(['car'] * (MAX_CLASSES + 1)),
        "{0: 'car'} ".ljust(MAX_CLASS_TEXT + 1),
        "{1e999: 'car'}",
        "__import__('os').getcwd()",
        '5',
        '',
    ],
    ids=lambda text: text[:8],
)
def test_hostile_class_names_are_as_good_as_none(names):
    assert _names({'names': names}) == {}


def test_half_characters_in_class_names_can_be_printed():
    assert _names({'names': repr(['car', 'x']).replace('x', r'\ud800')}) == {0: 'car', 1: r'\ud800'}


def test_a_model_with_an_absurd_input_is_refused() -> None:
    session = SimpleNamespace(
        get_inputs=lambda: [SimpleNamespace(name='images', shape=[1, 3, 640, 10**9], type='tensor(float)')]
    )
    with pytest.raises(UsageError, match='takes images of 1000000000x640 pixels; sides up to 8192'):
        VehicleDetector(session, DetectorOptions())
