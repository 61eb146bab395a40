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
from autocalib_ros.offline.simulate.bodies import body_of, shadow_of
from autocalib_ros.offline.simulate.cyclist_actors import Cyclist
from autocalib_ros.offline.simulate.faces import NO_MAP, SAMPLES, Canvas, Drawing, Faces, Window
from autocalib_ros.offline.simulate.ground_surface import paint_ground
from autocalib_ros.offline.simulate.lens import CameraPose, Lens
from autocalib_ros.offline.simulate.microbolometer import Microbolometer
from autocalib_ros.offline.simulate.network import Network
from autocalib_ros.offline.simulate.options import SimulationOptions
from autocalib_ros.offline.simulate.palette import palette_of
from autocalib_ros.offline.simulate.pedestrian_actors import Person
from autocalib_ros.offline.simulate.scenery import lamp_places, scenery_of
from autocalib_ros.offline.simulate.swaying import Roadside
from autocalib_ros.offline.simulate.vehicle_models import Vehicle, VehicleState
from autocalib_ros.offline.simulate.weather import View, Weather

_DRAWN_RANGE_M = 130.0
_REACH_M = 14.0  # a bus and its beam, from its middle
_NEAR_MAP_M = 48.0
_FAR_MAP_M = 480.0
_CELL_PX = 16
_SHADOW_RANGE_M = 50.0
_NOTHING = Faces(np.zeros((0, 3, 3)), ())


@dataclass(frozen=True)
class Scene:
    """What a frame shows: the camera's state, the vehicles and the people.

    shake: rotation (3, 3) of the camera in its own frame, or None.  shut: a shutter hides the scene.
    """

    index: int
    time_s: float
    bumped: bool
    shake: np.ndarray | None
    vehicles: list[tuple[Vehicle, VehicleState]]
    people: list[tuple[Person, tuple[float, float, float]]]
    cyclists: list[tuple[Cyclist, tuple[float, float, float, float]]]
    shut: bool = False


@dataclass(frozen=True)
class _Backdrop:
    """The empty scene from one pose: samples, and pixels (h, w, 3); both with a margin."""

    canvas: Canvas
    picture: np.ndarray


class Artist:
    """Draws frames; holds the large arrays, which are built once in each process."""

    def __init__(
        self, options: SimulationOptions, network: Network, pose: CameraPose, bumped: CameraPose
    ) -> None:
        self._options = options
        self._network = network
        self._lens = options.lens
        self._poses = {False: pose, True: bumped}
        self._noise = sensor.Noise(options)
        self._core = Microbolometer(options)
        self._margin = math.ceil(4 * options.shake_px) + 2 if options.shake_px else 0
        self._canvas = Canvas(self._lens, options.width_px, options.height_px)
        self._texels_per_m = bodies.FINE if options.focal_px > 350 else bodies.COARSE
        self._backdrops: dict[bool, _Backdrop] = {}
        troubles, size = options.troubles, (options.width_px, options.height_px)
        self._weather = Weather(options, network, self._poses) if troubles else None
        self._roadside = Roadside(
            troubles, network, pose, self._lens, size, palette_of(options.thermal), options.seed) if troubles else None

    def frame(self, scene: Scene) -> np.ndarray:
        """Return BGR (h, w, 3) uint8, or for a thermal camera counts (h, w) uint16."""
        pose = self._poses[scene.bumped]
        if scene.shake is not None:
            pose = pose.rotated(scene.shake)
        picture, windows = self._picture(scene, pose)
        view = None
        if self._weather is not None:
            view = View(picture, self._depth(scene, windows), pose, self._near(scene, pose), scene.index, scene.time_s)
            self._weather.on_ground(view, scene.bumped)
        noise = self._noise.of(scene.index)
        if self._options.thermal:
            return self._core.counts(picture, scene.time_s, noise, shut=scene.shut)
        if self._options.night:
            picture = sensor.darken(picture)
            lamps.add_lamps(picture, self._canvas, pose, self._near(scene, pose))
        if self._weather is not None and view is not None:
            view = replace(view, picture=picture)
            self._weather.lights(view, scene.bumped)
            picture = self._weather.on_lens(view)
        return cv2.add(picture, noise, dtype=cv2.CV_8U)

    def prepare(self) -> None:
        """Draw the backdrop ahead of the first frame, so that copies of the artist have it."""
        self._backdrop(bumped=False)

    def static_distance_m(self, bumped: bool, pixels: np.ndarray) -> np.ndarray:
        """Return the distance (n,) of whatever stands still behind pixels (n, 2) in the picture."""
        distance = self._backdrop(bumped).canvas.distance
        columns, rows = (np.round(pixels).astype(int) + self._margin).T * SAMPLES
        return distance[rows, columns]

    def _depth(self, scene: Scene, windows: list[Window]) -> np.ndarray:
        """Return the distance (h, w) of what each pixel shows, movers included; shake left out."""
        size = (self._options.height_px, self._options.width_px)
        inner = slice(self._margin * SAMPLES, None, SAMPLES)
        depth = self._backdrop(scene.bumped).canvas.distance[inner, inner][:size[0], :size[1]].copy()
        for window in windows:
            rows, columns = (slice(s.start, s.stop, SAMPLES) for s in window.samples())
            depth[window.pixels()] = self._canvas.distance[rows, columns]
        return depth

    def _picture(self, scene: Scene, pose: CameraPose) -> tuple[np.ndarray, list[Window]]:
        """Draw all movers over the backdrop; return pixels (h, w, 3) and the windows with movers."""
        view = _BackdropView(self._backdrop(scene.bumped), self._lens, self._margin, scene.shake)
        picture = view.picture(self._options.width_px, self._options.height_px)
        gains, solids = self._plan(scene, pose)
        empty: list[Drawing] = []
        pairs = zip_longest(gains, solids, fillvalue=empty)
        windows = [Window.around(pair) for a, b in pairs if (pair := [*a, *b])]
        for window in windows:
            view.restore(self._canvas, window)
        self._canvas.draw(drawing for group in gains for drawing in group)
        self._canvas.draw(drawing for group in solids for drawing in group)
        for window in windows:
            picture[window.pixels()] = self._canvas.resolved(window)
        return picture, windows

    def _plan(
        self, scene: Scene, pose: CameraPose
    ) -> tuple[list[list[Drawing]], list[list[Drawing]]]:
        """Return the drawings of shadows and beams, and those of the movers themselves."""
        thermal = self._options.thermal
        solids, flats = [], []
        for vehicle, state in self._near(scene, pose):
            place = (state.x, state.y, state.heading)
            body = body_of(vehicle.kind, vehicle.colour, thermal, self._texels_per_m)
            solids.append(body.moved(*place))
            flat = shadow_of(vehicle.kind, thermal)
            if self._options.night:
                flat = lamps.beam_of(vehicle.kind)
            near = math.hypot(*(pose.position_m[:2] - place[:2])) < _SHADOW_RANGE_M
            flats.append(flat.moved(*place) if near or self._options.night else _NOTHING)
        for person, place in scene.people:
            solids.append(people.faces_of(person, place, pose.position_m[:2], thermal))
        for cyclist, place in scene.cyclists:
            solids.append(cyclists.faces_of(cyclist, place, pose.position_m[:2], thermal))
        if self._roadside is not None:
            solids += self._roadside.at(scene.time_s)
        return self._canvas.plan(flats, pose, gain=True), self._canvas.plan(solids, pose)

    def _near(
        self, scene: Scene, pose: CameraPose
    ) -> list[tuple[Vehicle, VehicleState]]:
        """Return the vehicles that are near enough and may reach into the picture."""
        if not scene.vehicles:
            return []
        centres = np.array([(s.x, s.y, 1.0) for _, s in scene.vehicles])
        distance = np.linalg.norm(centres - pose.position_m, axis=1)
        pixels, _ = self._lens.project(pose.to_camera(centres))
        reach = (self._lens.focal_px * _REACH_M / distance)[:, None] + 20.0
        size = np.array([self._options.width_px, self._options.height_px])
        seen = ((pixels > -reach) & (pixels < size + reach)).all(1) & (distance < _DRAWN_RANGE_M)
        return [scene.vehicles[i] for i in np.flatnonzero(seen)]

    def _backdrop(self, bumped: bool) -> _Backdrop:
        if bumped not in self._backdrops:
            self._backdrops[bumped] = self._draw_backdrop(self._poses[bumped])
        return self._backdrops[bumped]

    def _draw_backdrop(self, pose: CameraPose) -> _Backdrop:
        options = self._options
        palette = palette_of(options.thermal)
        # A texel of the near map is about a pixel wide where the road is closest.
        texel_m = min(max(2.5 * options.camera_height_m / options.focal_px, 0.035), 0.5)
        grounds = (
            paint_ground(self._network, palette, _FAR_MAP_M, 16 * texel_m, options.seed),
            paint_ground(self._network, palette, _NEAR_MAP_M, texel_m, options.seed),
        )
        canvas = self._canvas.cleared()
        if self._margin:
            canvas = Canvas(self._lens, options.width_px, options.height_px, self._margin)
        scenery = scenery_of(self._network, pose.position_m[:2], palette, options.seed)
        draw_backdrop(canvas, pose, grounds, scenery, palette)
        if options.night:
            pools = [lamps.pool().moved(*place, 0.0) for place in lamp_places(self._network)]
            canvas.draw(d for group in canvas.plan(pools, pose, gain=True) for d in group)
        rows, columns = (n // SAMPLES for n in canvas.distance.shape)
        return _Backdrop(canvas, canvas.resolved(Window(0, 0, columns, rows)))


class _BackdropView:
    """The backdrop as the camera sees it in one frame, turned a little when it shakes."""

    def __init__(
        self, backdrop: _Backdrop, lens: Lens, margin: int, shake: np.ndarray | None
    ) -> None:
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

    def restore(self, canvas: Canvas, window: Window) -> None:
        """Clear the movers of the last frame out of a window of the canvas."""
        samples, source = window.samples(), self._backdrop.canvas
        if self._shift is None:
            canvas.colour[samples] = source.colour[samples]
            canvas.distance[samples] = source.distance[samples]
            return
        shift = self._shift[window.pixels()]
        shift = cv2.resize(shift, None, fx=SAMPLES, fy=SAMPLES) * SAMPLES
        rows, columns = (np.arange(s.start, s.stop) for s in samples)
        grid = np.stack(np.meshgrid(columns, rows), -1)
        places = (grid + shift + self._margin * SAMPLES).astype(np.float32)
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
