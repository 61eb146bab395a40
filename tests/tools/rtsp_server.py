"""Serve a GStreamer pipeline over RTSP on the loopback until stdin closes; run with the Python that has gi.

    python3 rtsp_server.py 'videotestsrc is-live=true ! jpegenc ! rtpjpegpay name=pay0'

Prints the address. Debian: apt-get install gir1.2-gst-rtsp-server-1.0 python3-gi gstreamer1.0-plugins-good.
"""

import sys

import gi

gi.require_version('Gst', '1.0')
gi.require_version('GstRtspServer', '1.0')
from gi.repository import GLib, Gst, GstRtspServer  # noqa: E402

Gst.init(None)
server = GstRtspServer.RTSPServer()
server.set_address('127.0.0.1')
server.set_service('0')
factory = GstRtspServer.RTSPMediaFactory()
factory.set_launch(f'( {sys.argv[1]} )')
server.get_mount_points().add_factory('/camera', factory)
server.attach(None)
print(f'rtsp://127.0.0.1:{server.get_bound_port()}/camera', flush=True)
loop = GLib.MainLoop()
GLib.io_add_watch(sys.stdin.fileno(), GLib.IO_HUP, lambda *_: loop.quit())
loop.run()
