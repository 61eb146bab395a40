"""Frames: the backdrop, and over it everything that moves."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import zip_longest

import cv2
import numpy as np

from autocalib_ros.offline.simulate import bodies, lamps, sensor
from autocalib_ros.offline.simulate import cyclist_actors as cyclists
from autocalib_ros.offline.simulate import pedestrian_actors as people
from autocalib_ros.offline.simulate.backdrop import draw_backdrop
from autocalib_ros.offline.simulate.bodies import body_faces, shadow_faces
from autocalib_ros.offline.simulate.cyclist_actors import Cyclist
from autocalib_ros.offline.simulate.faces import NO_MAP, SAMPLES_PER_PIXEL, Canvas, Drawing, Faces, PixelRect
from autocalib_ros.offline.simulate.ground_surface import paint_ground
from autocalib_ros.offline.simulate.lens import CameraPose, KannalaBrandtLens
from autocalib_ros.offline.simulate.microbolometer import Microbolometer
from autocalib_ros.offline.simulate.network import Network
from autocalib_ros.offline.simulate.options import SimulationOptions
from autocalib_ros.offline.simulate.palette import palette_for
from autocalib_ros.offline.simulate.pedestrian_actors import Pedestrian
from autocalib_ros.offline.simulate.scenery import build_scenery, street_lamp_positions
from autocalib_ros.offline.simulate.swaying import MovingScenery
from autocalib_ros.offline.simulate.vehicle_models import Vehicle, VehicleState
from autocalib_ros.offline.simulate.weather import FrameContext, Weather

_DRAWING_RANGE_M = 130.0
_VEHICLE_REACH_M = 14.0  # a bus and its beam, from its middle
_NEAR_MAP_M = 48.0
_FAR_MAP_M = 480.0
_CELL_PX = 16
_SHADOW_RANGE_M = 50.0
_NO_FACES = Faces(np.zeros((0, 3, 3)), ())


@dataclass(frozen=True)
class SceneState:
    """What a frame shows: the camera's state, the vehicles and the people.

    shake: rotation (3, 3) of the camera in its own frame, or None.  shut: a shutter hides the scene.
    """

    index: int
    time_s: float
    bumped: bool
    shake: np.ndarray | None
    vehicles: list[tuple[Vehicle, VehicleState]]
    people: list[tuple[Pedestrian, tuple[float, float, float]]]
    cyclists: list[tuple[Cyclist, tuple[float, float, float, float]]]
    shutter_closed: bool = False


@dataclass(frozen=True)
class _Backdrop:
    """The empty scene from one pose: samples, and pixels (h, w, 3); both with a margin."""

    canvas: Canvas
    picture: np.ndarray


class Renderer:
    """Draws frames; holds the large arrays, which are built once in each process."""

    def __init__(self, options: SimulationOptions, network: Network, pose: CameraPose, bumped: CameraPose) -> None:
        self._options = options
        self._network = network
        self._lens = options.lens
        self._poses = {False: pose, True: bumped}
        self._noise = sensor.SensorNoise(options)
        self._microbolometer = Microbolometer(options)
        self._margin = math.ceil(4 * options.shake_px) + 2 if options.shake_px else 0
        self._canvas = Canvas(self._lens, options.width_px, options.height_px)
        self._texels_per_m = bodies.FINE_TEXELS_PER_M if options.focal_px > 350 else bodies.COARSE_TEXELS_PER_M
        self._backdrops: dict[bool, _Backdrop] = {}
        troubles, size = options.troubles, (options.width_px, options.height_px)
        self._weather = Weather(options, network, self._poses) if troubles else None
        self._roadside = (
            MovingScenery(troubles, network, pose, self._lens, size, palette_for(options.thermal), options.seed)
            if troubles
            else None
        )

    def frame(self, scene: SceneState) -> np.ndarray:
        """Return BGR (h, w, 3) uint8, or for a thermal camera counts (h, w) uint16."""
        pose = self._poses[scene.bumped]
        if scene.shake is not None:
            pose = pose.rotated(scene.shake)
        picture, windows = self._picture(scene, pose)
        view = None
        if self._weather is not None:
            view = FrameContext(
                picture,
                self._depth(scene, windows),
                pose,
                self._visible_vehicles(scene, pose),
                scene.index,
                scene.time_s,
            )
            self._weather.apply_ground_effects(view, scene.bumped)
        noise = self._noise.of(scene.index)
        if self._options.thermal:
            return self._microbolometer.counts(picture, scene.time_s, noise, shutter_closed=scene.shutter_closed)
        if self._options.night:
            picture = sensor.darken(picture)
            lamps.add_lamps(picture, self._canvas, pose, self._visible_vehicles(scene, pose))
        if self._weather is not None and view is not None:
            view = replace(view, picture=picture)
            self._weather.add_light_sources(view, scene.bumped)
            picture = self._weather.apply_lens_effects(view)
        return cv2.add(picture, noise, dtype=cv2.CV_8U)

    def prepare(self) -> None:
        """Draw the backdrop ahead of the first frame, so that copies of the artist have it."""
        self._backdrop(bumped=False)

    def background_distance_m(self, bumped: bool, pixels: np.ndarray) -> np.ndarray:
        """Return the distance (n,) of whatever stands still behind pixels (n, 2) in the picture."""
        distance = self._backdrop(bumped).canvas.distance
        columns, rows = (np.round(pixels).astype(int) + self._margin).T * SAMPLES_PER_PIXEL
        return distance[rows, columns]

    def _depth(self, scene: SceneState, windows: list[PixelRect]) -> np.ndarray:
        """Return the distance (h, w) of what each pixel shows, movers included; shake left out."""
        size = (self._options.height_px, self._options.width_px)
        inner = slice(self._margin * SAMPLES_PER_PIXEL, None, SAMPLES_PER_PIXEL)
        depth = self._backdrop(scene.bumped).canvas.distance[inner, inner][: size[0], : size[1]].copy()
        for window in windows:
            rows, columns = (slice(s.start, s.stop, SAMPLES_PER_PIXEL) for s in window.samples())
            depth[window.pixels()] = self._canvas.distance[rows, columns]
        return depth

    def _picture(self, scene: SceneState, pose: CameraPose) -> tuple[np.ndarray, list[PixelRect]]:
        """Draw all movers over the backdrop; return pixels (h, w, 3) and the windows with movers."""
        view = _FrameBackdrop(self._backdrop(scene.bumped), self._lens, self._margin, scene.shake)
        picture = view.picture(self._options.width_px, self._options.height_px)
        gains, solids = self._project_movers(scene, pose)
        empty: list[Drawing] = []
        pairs = zip_longest(gains, solids, fillvalue=empty)
        windows = [PixelRect.around(pair) for a, b in pairs if (pair := [*a, *b])]
        for window in windows:
            view.restore(self._canvas, window)
        self._canvas.draw(drawing for group in gains for drawing in group)
        self._canvas.draw(drawing for group in solids for drawing in group)
        for window in windows:
            picture[window.pixels()] = self._canvas.resolve(window)
        return picture, windows

    def _project_movers(self, scene: SceneState, pose: CameraPose) -> tuple[list[list[Drawing]], list[list[Drawing]]]:
        """Return the drawings of shadows and beams, and those of the movers themselves."""
        thermal = self._options.thermal
        solids, flats = [], []
        for vehicle, state in self._visible_vehicles(scene, pose):
            place = (state.x, state.y, state.heading)
            body = body_faces(vehicle.kind, vehicle.colour, thermal, self._texels_per_m)
            solids.append(body.moved(*place))
            flat = shadow_faces(vehicle.kind, thermal)
            if self._options.night:
                flat = lamps.beam_faces(vehicle.kind)
            near = math.hypot(*(pose.position_m[:2] - place[:2])) < _SHADOW_RANGE_M
            flats.append(flat.moved(*place) if near or self._options.night else _NO_FACES)
        for person, place in scene.people:
            solids.append(people.figure_faces(person, place, pose.position_m[:2], thermal))
        for cyclist, place in scene.cyclists:
            solids.append(cyclists.figure_faces(cyclist, place, pose.position_m[:2], thermal))
        if self._roadside is not None:
            solids += self._roadside.at(scene.time_s)
        return self._canvas.project_faces(flats, pose, gain=True), self._canvas.project_faces(solids, pose)

    def _visible_vehicles(self, scene: SceneState, pose: CameraPose) -> list[tuple[Vehicle, VehicleState]]:
        """Return the vehicles that are near enough and may reach into the picture."""
        if not scene.vehicles:
            return []
        centres = np.array([(s.x, s.y, 1.0) for _, s in scene.vehicles])
        distance = np.linalg.norm(centres - pose.position_m, axis=1)
        pixels, _ = self._lens.project(pose.to_camera(centres))
        reach = (self._lens.focal_px * _VEHICLE_REACH_M / distance)[:, None] + 20.0
        size = np.array([self._options.width_px, self._options.height_px])
        seen = ((pixels > -reach) & (pixels < size + reach)).all(1) & (distance < _DRAWING_RANGE_M)
        return [scene.vehicles[i] for i in np.flatnonzero(seen)]

    def _backdrop(self, bumped: bool) -> _Backdrop:
        if bumped not in self._backdrops:
            self._backdrops[bumped] = self._draw_backdrop(self._poses[bumped])
        return self._backdrops[bumped]

    def _draw_backdrop(self, pose: CameraPose) -> _Backdrop:
        options = self._options
        palette = palette_for(options.thermal)
        # A texel of the near map is about a pixel wide where the road is closest.
        texel_m = min(max(2.5 * options.camera_height_m / options.focal_px, 0.035), 0.5)
        grounds = (
            paint_ground(self._network, palette, _FAR_MAP_M, 16 * texel_m, options.seed),
            paint_ground(self._network, palette, _NEAR_MAP_M, texel_m, options.seed),
        )
        canvas = self._canvas.empty_copy()
        if self._margin:
            canvas = Canvas(self._lens, options.width_px, options.height_px, self._margin)
        scenery = build_scenery(self._network, pose.position_m[:2], palette, options.seed)
        draw_backdrop(canvas, pose, grounds, scenery, palette)
        if options.night:
            pools = [lamps.light_pool().moved(*place, 0.0) for place in street_lamp_positions(self._network)]
            canvas.draw(d for group in canvas.project_faces(pools, pose, gain=True) for d in group)
        rows, columns = (n // SAMPLES_PER_PIXEL for n in canvas.distance.shape)
        return _Backdrop(canvas, canvas.resolve(PixelRect(0, 0, columns, rows)))


class _FrameBackdrop:
    """The backdrop as the camera sees it in one frame, turned a little when it shakes."""

    def __init__(self, backdrop: _Backdrop, lens: KannalaBrandtLens, margin: int, shake: np.ndarray | None) -> None:
        self._backdrop, self._lens, self._margin, self._shake = backdrop, lens, margin, shake
        self._shift: np.ndarray | None = None

    def picture(self, width: int, height: int) -> np.ndarray:
        """Return the pixels (h, w, 3) without movers."""
        if self._shake is None:
            return self._backdrop.picture.copy()
        self._shift = self._shifts(width, height, self._shake)
        grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1)
        places = (grid + self._shift + self._margin).astype(np.float32)
        return cv2.remap(self._backdrop.picture, places, NO_MAP, cv2.INTER_CUBIC)

    def restore(self, canvas: Canvas, window: PixelRect) -> None:
        """Clear the movers of the last frame out of a window of the canvas."""
        samples, source = window.samples(), self._backdrop.canvas
        if self._shift is None:
            canvas.colour[samples] = source.colour[samples]
            canvas.distance[samples] = source.distance[samples]
            return
        shift = self._shift[window.pixels()]
        shift = cv2.resize(shift, None, fx=SAMPLES_PER_PIXEL, fy=SAMPLES_PER_PIXEL) * SAMPLES_PER_PIXEL
        rows, columns = (np.arange(s.start, s.stop) for s in samples)
        grid = np.stack(np.meshgrid(columns, rows), -1)
        places = (grid + shift + self._margin * SAMPLES_PER_PIXEL).astype(np.float32)
        canvas.colour[samples] = cv2.remap(source.colour, places, NO_MAP, cv2.INTER_LINEAR)
        canvas.distance[samples] = cv2.remap(source.distance, places, NO_MAP, cv2.INTER_NEAREST)

    def _shifts(self, width: int, height: int, shake: np.ndarray) -> np.ndarray:
        """Return where each pixel's ray lies in the unshaken picture, as an offset (h, w, 2).

        The field is smooth: exact every _CELL_PX pixels, linear in between.
        """
        columns, rows = -(-width // _CELL_PX), -(-height // _CELL_PX)
        centre = (np.arange(max(columns, rows)) + 0.5) * _CELL_PX - 0.5
        grid = np.stack(np.meshgrid(centre[:columns], centre[:rows]), -1)
        rays = self._lens.bearings(grid) @ shake.T
        shift = (self._lens.project(rays)[0] - grid).astype(np.float32)
        shift = cv2.resize(shift, (columns * _CELL_PX, rows * _CELL_PX))
        return shift[:height, :width]
