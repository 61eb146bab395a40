"""Chromium without a window, driven through its own pipe: nothing but Python's library is needed."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

NAMES = ('chromium', 'chromium-browser', 'google-chrome', 'google-chrome-stable')
PATIENCE_S = 120.0
"""A busy machine starts a browser slowly."""


def chromium() -> str | None:
    """Return the path of a browser, None where there is none."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Browser:
    """One page in a browser that speaks the DevTools protocol: JSON messages, ended by a zero byte."""

    def __init__(self, write: int, read: int) -> None:
        self._write, self._read, self._left, self._number = write, read, b'', 0
        self.complaints: list[str] = []
        """What the page wrote to its console as warnings or errors, exceptions, and what could not be loaded."""
        target = self.send('Target.createTarget', url='about:blank')['targetId']
        self._session = self.send('Target.attachToTarget', targetId=target, flatten=True)['sessionId']
        for domain in ('Page', 'Runtime', 'Log', 'Network'):
            self.send(f'{domain}.enable')

    def send(self, method: str, **arguments: Any) -> dict[str, Any]:
        """Give a command and return its answer; RuntimeError where the browser refuses it."""
        self._number += 1
        session = {'sessionId': self._session} if hasattr(self, '_session') else {}
        command = {'id': self._number, 'method': method, 'params': arguments, **session}
        os.write(self._write, json.dumps(command).encode() + b'\0')
        while True:
            message = self._next()
            if message.get('id') == self._number:
                if 'error' in message:
                    raise RuntimeError(f'{method}: {message["error"]}')
                return message['result']
            self._hear(message)

    def open(self, path: Path, width: int, height: int = 900) -> None:
        """Show a file in a screen so wide, wait until it is loaded."""
        self.send(
            'Emulation.setDeviceMetricsOverride', width=width, height=height, deviceScaleFactor=1, mobile=width < 600
        )
        self.send('Page.navigate', url=path.resolve().as_uri())
        deadline = time.monotonic() + PATIENCE_S
        while self.value('document.readyState + location.protocol') != 'completefile:':
            if time.monotonic() > deadline:
                raise TimeoutError(f'{path} was not loaded')
            time.sleep(0.05)

    def value(self, script: str) -> Any:
        """Return the value of a JavaScript expression."""
        answer = self.send('Runtime.evaluate', expression=script, returnByValue=True, awaitPromise=True)
        if 'exceptionDetails' in answer:
            raise RuntimeError(f'{script}: {answer["exceptionDetails"]}')
        return answer['result'].get('value')

    def screenshot(self) -> bytes:
        """Return the whole page as PNG."""
        size = self.send('Page.getLayoutMetrics')['cssContentSize']
        clip = {'x': 0, 'y': 0, 'width': size['width'], 'height': size['height'], 'scale': 1}
        return base64.b64decode(self.send('Page.captureScreenshot', clip=clip, captureBeyondViewport=True)['data'])

    def _next(self) -> dict[str, Any]:
        while b'\0' not in self._left:
            part = os.read(self._read, 1 << 20)
            if not part:
                raise RuntimeError('the browser has ended')
            self._left += part
        message, _, self._left = self._left.partition(b'\0')
        return json.loads(message)

    def _hear(self, message: dict[str, Any]) -> None:
        method, told = message.get('method'), message.get('params', {})
        if method == 'Runtime.consoleAPICalled' and told['type'] in ('error', 'warning', 'assert'):
            self.complaints.append(f'console.{told["type"]}: {told["args"]}')
        elif method == 'Runtime.exceptionThrown':
            self.complaints.append(f'exception: {told["exceptionDetails"]}')
        elif method == 'Log.entryAdded' and told['entry']['level'] in ('error', 'warning'):
            self.complaints.append(f'log: {told["entry"]}')
        elif method == 'Network.requestWillBeSent' and not told['request']['url'].startswith(('data:', 'file:')):
            self.complaints.append(f'asks the network for {told["request"]["url"]}')


@contextmanager
def browser() -> Iterator[Browser]:
    """Start Chromium, and end it."""
    (child_in, write), (read, child_out) = os.pipe(), os.pipe()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as home:  # a browser that ends still writes
        # the pipe is on descriptors 3 and 4 of the browser
        command = (
            f'exec {chromium()} --headless=new --no-sandbox --disable-gpu --disable-dev-shm-usage --no-first-run'
            f' --disable-extensions --disable-background-networking --hide-scrollbars --user-data-dir={home}'
            f' --remote-debugging-pipe 3<&{child_in} 4>&{child_out}'
        )
        process = subprocess.Popen(
            ['bash', '-c', command],
            pass_fds=(child_in, child_out),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(child_in)
        os.close(child_out)
        try:
            yield Browser(write, read)
        finally:
            os.close(write)
            process.terminate()
            process.wait(PATIENCE_S)
            os.close(read)
