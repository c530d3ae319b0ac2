# SPDX-License-Identifier: Apache-2.0
"""A local HTTP server that streams motion JPEG, as network cameras do, or a video file."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path


class Stream:
    """What a server sends.

    Args:
        frames: JPEG files in order.
        fps: frames a second.
        stall: send nothing more after the last frame, instead of ending.
    """

    def __init__(self, frames: Sequence[bytes], fps: float, *, stall: bool = False) -> None:
        self.frames, self.fps, self.stall = frames, fps, stall
        self.over = threading.Event()


@contextmanager
def serving(content: Stream | Path) -> Iterator[str]:
    """The address of a server on this machine."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if isinstance(content, Path):
                data = content.read_bytes()
                self.send_response(200)
                self.send_header("Content-Type", "video/mp4")
                self.send_header("Content-Length", str(len(data)))
                self.end_headers()
                self.wfile.write(data)
                return
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
            self.end_headers()
            try:
                for data in content.frames:
                    self.wfile.write(b"--frame\r\nContent-Type: image/jpeg\r\n")
                    self.wfile.write(f"Content-Length: {len(data)}\r\n\r\n".encode() + data + b"\r\n")
                    time.sleep(1.0 / content.fps)
                if content.stall:
                    content.over.wait(30.0)
                self.wfile.write(b"--frame--\r\n")
            except OSError:  # the client has gone
                return

        def log_message(self, format: str, *args: object) -> None:
            return

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        if isinstance(content, Stream):
            content.over.set()
        server.shutdown()
        server.server_close()
