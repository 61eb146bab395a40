"""A network camera on the loopback: MJPEG over HTTP, as many cameras send it."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np


@contextmanager
def mjpeg_server(
    images: list[np.ndarray], fps: float = 50.0, *, drop_after: int | None = None, is_snapshot: bool = False
) -> Iterator[str]:
    """Yield the address of a stream that shows images once, at a rate; it drops connections after so many images.

    An address of snapshots gives one JPEG to each request.
    """
    encoded = [cv2.imencode('.jpg', image)[1].tobytes() for image in images]
    shown = iter(encoded)

    class Camera(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            if is_snapshot:
                self.send_header('Content-Type', 'image/jpeg')
                self.end_headers()
                self.wfile.write(next(shown))
                return
            self.send_header('Content-Type', 'multipart/x-mixed-replace; boundary=image')
            self.end_headers()
            for count, data in enumerate(shown, start=1):
                head = f'--image\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n'
                try:
                    self.wfile.write(head.encode() + data + b'\r\n')
                except OSError:
                    return
                time.sleep(1.0 / fps)
                if count == drop_after:
                    return

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(('127.0.0.1', 0), Camera)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={'poll_interval': 0.02}, daemon=True)
    thread.start()
    try:
        yield f'http://127.0.0.1:{server.server_port}/video.mjpg'
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
