"""Measure live nodes over DDS: images lost, processor time, times of callbacks; one node and one driver a camera.

    python tests/ros/measure.py VIDEO --cameras 4 --rate 10 --seconds 60
    python tests/ros/measure.py VIDEO --rate 30 --always-solve
    python tests/ros/measure.py VIDEO --rate 15 --watch debug_image,top_view,image_rect

A driver plays the first seconds of the video forwards and backwards, so that the traffic never jumps. Needs ROS.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import resource
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np

FRAMES = 150
"""Images of the video that are played: 400 MB at 1280x720."""
SETTLE_S = 5.0
"""Real time for discovery before images are sent, and for what is left after."""
PATIENCE_S = 60.0


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('video', type=Path)
    parser.add_argument('--cameras', type=int, default=1)
    parser.add_argument('--rate', type=float, default=30.0)
    parser.add_argument('--seconds', type=float, default=60.0)
    parser.add_argument('--best-effort', action='store_true', help='the driver publishes best effort')
    parser.add_argument('--always-solve', action='store_true', help='a solution runs all the time')
    parser.add_argument('--depth', type=int, help='queue of the image subscription; the default is that of the node')
    parser.add_argument('--bare', action='store_true', help='images are only counted: what transport and machine lose')
    parser.add_argument('--solve-in-thread', action='store_true', help='solve in a thread of the node, to compare')
    parser.add_argument('--params-file', type=Path)
    parser.add_argument('--watch', default='', help='pictures that another process subscribes, with commas between')
    parser.add_argument('--role', choices=('driver', 'node', 'watcher'), help=argparse.SUPPRESS)
    parser.add_argument('--namespace', default='', help=argparse.SUPPRESS)
    return parser.parse_args()


def drive(options: argparse.Namespace) -> dict:
    """Publish images at the rate; return how many, and the cost."""
    import cv2
    import rclpy
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import Image

    capture, messages = cv2.VideoCapture(str(options.video)), []
    step = max(1, round(capture.get(cv2.CAP_PROP_FPS) / options.rate))
    while len(messages) < FRAMES and capture.grab():
        if int(capture.get(cv2.CAP_PROP_POS_FRAMES)) % step:
            continue
        picture = capture.retrieve()[1]
        message = Image(width=picture.shape[1], height=picture.shape[0], step=3 * picture.shape[1], encoding='bgr8')
        message.header.frame_id = 'optical'
        message.data.frombytes(memoryview(picture).cast('B'))
        messages.append(message)
    messages += messages[-2:0:-1]
    rclpy.init()
    node = rclpy.create_node('driver', namespace=options.namespace)
    reliability = ReliabilityPolicy.BEST_EFFORT if options.best_effort else ReliabilityPolicy.RELIABLE
    publisher = node.create_publisher(Image, 'image', QoSProfile(depth=10, reliability=reliability))
    deadline = time.monotonic() + PATIENCE_S
    while not publisher.get_subscription_count() and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(SETTLE_S)
    began, cpu, late_s = time.monotonic(), cpu_s(), 0.0
    count = int(options.seconds * options.rate)
    for number in range(count):
        due = began + number / options.rate
        time.sleep(max(0.0, due - time.monotonic()))
        late_s = max(late_s, time.monotonic() - due)
        message = messages[number % len(messages)]
        message.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(message)
    measured = {'sent': count, 'latest_s': late_s, 'cores': (cpu_s() - cpu) / (time.monotonic() - began)}
    time.sleep(SETTLE_S)
    node.destroy_node()
    rclpy.shutdown()
    return measured


def watch(options: argparse.Namespace) -> dict:
    """Subscribe pictures until this is interrupted; return how many of each arrived, and their age."""
    import rclpy
    from rclpy.executors import ExternalShutdownException
    from rclpy.qos import QoSProfile
    from sensor_msgs.msg import Image

    rclpy.init()
    node = rclpy.create_node('watcher', namespace=options.namespace)
    ages_ms: dict[str, list[float]] = {topic: [] for topic in options.watch.split(',')}
    for topic, ages in ages_ms.items():

        def take(message: Image, ages=ages) -> None:
            stamp = message.header.stamp
            ages.append(1e3 * (time.time() - stamp.sec - stamp.nanosec * 1e-9))

        node.create_subscription(Image, f'autocalib/{topic}', take, QoSProfile(depth=1))
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)
    return {topic: quantiles(ages or [0.0]) for topic, ages in ages_ms.items()}


def cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


class Timed:
    """Wraps methods and keeps how long each call took, and whether a solution was running."""

    def __init__(self) -> None:
        self.calls: dict[str, list[tuple[float, bool]]] = {}
        self.solving = False

    def wrap(self, owner: type, name: str) -> None:
        original, calls = getattr(owner, name), self.calls.setdefault(f'{owner.__name__}.{name}', [])

        def timed(*given, **named):
            began = time.perf_counter()
            try:
                return original(*given, **named)
            finally:
                calls.append((time.perf_counter() - began, self.solving))

        setattr(owner, name, timed)

    def summary(self) -> dict:
        measured = {}
        for name, calls in self.calls.items():
            for solving in (False, True):
                times_ms = [1e3 * took for took, during in calls if during == solving]
                if times_ms:
                    measured[f'{name}{" while solving" if solving else ""}'] = quantiles(times_ms)
        return measured


def quantiles(values: list[float]) -> dict:
    median, p99 = np.percentile(values, (50, 99))
    return {
        'n': len(values),
        'median': round(float(median), 2),
        'p99': round(float(p99), 2),
        'max': round(max(values), 2),
    }


def run_node(options: argparse.Namespace) -> dict:  # noqa: C901  one clock after the other
    """Run a node with clocks in it until it is interrupted."""
    from autocalib_ros.util.threads import limit_blas_threads

    limit_blas_threads()
    from autocalib_ros import solver_process as solver
    from autocalib_ros.estimation.estimate import solve
    from autocalib_ros.ros import autocalib_node, diagnostics, image_input, node, worker

    timed, latencies_ms, solved_s, ends = Timed(), [], [], []
    if options.depth:
        image_input.QUEUE_DEPTH = options.depth
    start: list[tuple[float, float]] = []
    own_take = image_input.ImageInput.take

    def take(self, message):
        start or start.append((time.monotonic(), cpu_s()))
        stamp = message.header.stamp
        latencies_ms.append(1e3 * (time.time() - stamp.sec - stamp.nanosec * 1e-9))
        own_take(self, message)
        ends[:] = [(time.monotonic(), cpu_s())]

    image_input.ImageInput.take = take
    timed.wrap(autocalib_node.AutocalibNode, '_on_image')
    timed.wrap(diagnostics.Diagnostics, '_publish')
    timed.wrap(image_input.ImageInput, '_check_publishers')
    timed.wrap(worker.CalibrationWorker, '_process_image')
    if options.watch:
        from autocalib_ros.pictures import live_overlay as live
        from autocalib_ros.ros.live_pictures import LivePictures

        for owner, name in (
            (LivePictures, 'image_used'),
            (LivePictures, '_show'),
            (live.DebugPicture, 'draw'),
            (live.TopPicture, 'draw'),
            (live.RectifiedPicture, 'draw'),
        ):
            timed.wrap(owner, name)
    if options.bare:
        worker.CalibrationWorker._process_image = lambda self, stamp_ns, message: None

    own_solve = solver.SolverProcess.__call__

    def solve_timed(solver_process, *given, **named):
        began, timed.solving = time.perf_counter(), True
        try:
            if options.solve_in_thread:
                return solve(*given, **named)
            return own_solve(solver_process, *given, **named)
        finally:
            timed.solving = False
            solved_s.append(time.perf_counter() - began)

    solver.SolverProcess.__call__ = solve_timed

    class Measured(autocalib_node.AutocalibNode):
        def __init__(self, **more):
            super().__init__(**more)
            nodes.append(self)
            if options.always_solve:
                threading.Thread(target=solve_always, args=(self._worker,), daemon=True).start()

    def solve_always(running):
        while not running._closed:
            if running.counters.used > 5 * options.rate:
                running.solve_now().result()
            time.sleep(0.1)

    nodes: list[Measured] = []
    autocalib_node.AutocalibNode = Measured
    given = ['--params-file', str(options.params_file)] if options.params_file else []
    node.main(['autocalib_node', '--ros-args', *given, '-p', 'camera_height:=8.0', '-r', f'__ns:={options.namespace}'])
    (began, cpu_before), (ended, cpu_after) = start[0], ends[0]
    counters = nodes[0]._worker.counters
    child = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        **vars(counters),
        'lost_by_dds': nodes[0]._input.lost,
        'cores': (cpu_after - cpu_before) / (ended - began),
        'ms_of_processor_for_an_image_used': round(1e3 * (cpu_after - cpu_before) / max(counters.used, 1), 2),
        'cores_solving': (child.ru_utime + child.ru_stime) / (ended - began),
        'state': 'calibrated' if nodes[0].publication.published else 'collecting',
        'solutions_s': quantiles(solved_s or [0.0]),
        'latency_ms': quantiles(latencies_ms),
        'ms': timed.summary(),
        'memory_mb': resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def processor_shares() -> np.ndarray:
    """Return the ticks that all processors spent, by kind, as Linux counts them."""
    return np.array(Path('/proc/stat').read_text(encoding='ascii').splitlines()[0].split()[1:9], float)


def measure(options: argparse.Namespace) -> None:
    """Start all processes, wait for the drivers, interrupt the nodes, print the results of each."""
    environment = {
        **os.environ,
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'ROS_DOMAIN_ID': str(os.getpid() % 100 + 1),
    }

    def start(role: str, number: int) -> subprocess.Popen:
        command = [sys.executable, __file__, *sys.argv[1:], '--role', role, '--namespace', f'/cam{number}']
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)

    processor_before = processor_shares()
    nodes = [start('node', number) for number in range(1, options.cameras + 1)]
    watchers = [start('watcher', number) for number in range(1, options.cameras + 1) if options.watch]
    drivers = [start('driver', number) for number in range(1, options.cameras + 1)]
    outputs = [driver.communicate() for driver in drivers]
    spent = processor_shares() - processor_before
    idle, stolen = 100 * spent[[3, 7]] / spent.sum()
    print(f'the machine while measuring: {idle:.0f} % idle, {stolen:.0f} % stolen by its host')
    for process in (*watchers, *nodes):
        process.terminate()
    for number, watcher in enumerate(watchers, 1):
        print(f'cam{number}: pictures that came, and their age in ms: {watcher.communicate()[0].strip()}')
    for number, (node, (sent, complaint)) in enumerate(zip(nodes, outputs, strict=True), 1):
        measured, log = node.communicate()
        if node.returncode or not sent or not measured:
            sys.exit(f'{complaint}\n{log}')
        driver, node_output = json.loads(sent), json.loads(measured)
        print(
            f'cam{number}: sent {driver["sent"]}, lost on the way {driver["sent"] - node_output["received"]}, '
            f'dropped by the node {node_output["dropped"]}, node {node_output["cores"]:.2f} cores and '
            f'{node_output["cores_solving"]:.2f} for solutions, '
            f'driver {driver["cores"]:.2f} cores, at most {driver["latest_s"] * 1e3:.0f} ms late'
        )
        for key, value in node_output.items():
            print(f'  {key}: {json.dumps(value) if key != "ms" else ""}')
            for name, times in value.items() if key == 'ms' else ():
                print(f'    {name}: {json.dumps(times)}')


if __name__ == '__main__':
    chosen = arguments()
    if chosen.role is None:
        measure(chosen)
    else:
        print(json.dumps({'driver': drive, 'node': run_node, 'watcher': watch}[chosen.role](chosen)))
