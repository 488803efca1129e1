# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A headless Chromium, spoken to over its DevTools pipe: no driver, no library."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

NAMES = ('chromium', 'chromium-browser', 'google-chrome', 'google-chrome-stable', 'chrome')
ANSWER_S = 30.0
OPTIONS = (
    '--headless', '--no-sandbox', '--disable-gpu', '--disable-dev-shm-usage', '--hide-scrollbars',
    '--no-first-run', '--disable-background-networking', '--disable-component-update',
    '--remote-debugging-pipe', 'about:blank',
)  # fmt: skip


def find_browser() -> str | None:
    """Path of a Chromium: `MAPMERGE_BROWSER`, or what is on PATH."""
    wanted = os.environ.get('MAPMERGE_BROWSER')
    return next(filter(None, map(shutil.which, [wanted] if wanted else NAMES)), None)


class Browser:
    """Messages to and from a browser, one JSON text each, ended by a zero byte."""

    def __init__(self, path: str, profile: Path) -> None:
        self._number = 0
        self._rest = b''
        self.events: list[dict[str, Any]] = []
        child_reads, self._writes = os.pipe()
        self._reads, child_writes = os.pipe()

        def place_pipes() -> None:
            # Moved out of the way first: they may be 3 and 4 already, the wrong way round.
            reads, writes = os.dup(child_reads), os.dup(child_writes)
            os.dup2(reads, 3)
            os.dup2(writes, 4)

        self.process = subprocess.Popen(
            [path, *OPTIONS[:-1], f'--user-data-dir={profile}', OPTIONS[-1]],
            close_fds=False,
            preexec_fn=place_pipes,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(child_reads)
        os.close(child_writes)

    def ask(self, method: str, session: str = '', **params: Any) -> dict[str, Any]:
        """Answer to a command; events that come in between are kept."""
        self._number += 1
        message = {'id': self._number, 'method': method, 'params': params}
        if session:
            message['sessionId'] = session
        os.write(self._writes, json.dumps(message).encode() + b'\0')
        until = time.monotonic() + ANSWER_S
        while True:
            answer = self._next(until)
            if answer.get('id') == self._number:
                if 'error' in answer:
                    raise RuntimeError(f'{method}: {answer["error"]["message"]}')
                return answer['result']
            if 'method' in answer:
                self.events.append(answer)

    def _next(self, until: float) -> dict[str, Any]:
        while b'\0' not in self._rest:
            ready, _, _ = select.select([self._reads], [], [], max(0.0, until - time.monotonic()))
            part = os.read(self._reads, 1 << 20) if ready else b''
            if not part:
                raise RuntimeError('the browser does not answer')
            self._rest += part
        text, _, self._rest = self._rest.partition(b'\0')
        return json.loads(text)

    def close(self) -> None:
        """End the browser."""
        with contextlib.suppress(RuntimeError, OSError):
            self.ask('Browser.close')
        try:
            self.process.wait(10.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        os.close(self._reads)
        os.close(self._writes)


@dataclass(eq=False)
class Tab:
    """One page in a browser."""

    browser: Browser
    session: str
    seen: list[dict[str, Any]] = field(default_factory=list)

    def ask(self, method: str, **params: Any) -> dict[str, Any]:
        return self.browser.ask(method, self.session, **params)

    def run(self, expression: str) -> Any:
        """Value of an expression of the page; promises are waited for."""
        found = self.ask(
            'Runtime.evaluate', expression=expression, returnByValue=True, awaitPromise=True
        )
        if 'exceptionDetails' in found:
            raise RuntimeError(found['exceptionDetails']['exception']['description'])
        return found['result'].get('value')

    def wait_until(self, expression: str, limit_s: float = 10.0) -> None:
        """Wait for the page."""
        until = time.monotonic() + limit_s
        while not self.run(expression):
            if time.monotonic() > until:
                raise RuntimeError(f'never true: {expression}')
            time.sleep(0.05)

    def settle(self) -> None:
        """Wait until what was asked for is drawn."""
        self.run('new Promise(done => requestAnimationFrame(() => setTimeout(done, 30)))')

    def resize(self, width: int, height: int, *, phone: bool = False, scale: float = 1.0) -> None:
        self.ask(
            'Emulation.setDeviceMetricsOverride',
            width=width, height=height, deviceScaleFactor=scale, mobile=phone,
        )  # fmt: skip
        self.ask('Emulation.setTouchEmulationEnabled', enabled=phone)
        self.settle()

    def open(self, page: Path) -> None:
        self.ask('Page.navigate', url=page.resolve().as_uri())
        self.wait_until("document.readyState === 'complete' && location.protocol === 'file:'")
        self.settle()

    def prefer(self, **features: str) -> None:
        """Set CSS media features, such as `prefers_color_scheme='dark'`."""
        pairs = [{'name': k.replace('_', '-'), 'value': v} for k, v in features.items()]
        self.ask('Emulation.setEmulatedMedia', features=pairs)
        self.settle()

    def box(self, selector: str) -> tuple[float, float, float, float]:
        """Left, top, width and height of an element, scrolled into view."""
        self.run(f"document.querySelector('{selector}').scrollIntoView({{block: 'center'}})")
        self.settle()
        found = self.run(
            f'(r => [r.left, r.top, r.width, r.height])'
            f"(document.querySelector('{selector}').getBoundingClientRect())"
        )
        left, top, width, height = found
        return left, top, width, height

    def screenshot(self, clip: Sequence[float] | None = None) -> bytes:
        """PNG of what is visible, or of a part of the whole page (left, top, width, height)."""
        params: dict[str, Any] = {'format': 'png'}
        if clip is not None:
            x, y, width, height = clip
            params['clip'] = {'x': x, 'y': y, 'width': width, 'height': height, 'scale': 1}
            params['captureBeyondViewport'] = True
        return base64.b64decode(self.ask('Page.captureScreenshot', **params)['data'])

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Mouse, left button."""
        for kind, (x, y) in (('Pressed', start), ('Moved', end), ('Released', end)):
            self.ask(
                'Input.dispatchMouseEvent', type=f'mouse{kind}', x=x, y=y, button='left',
                buttons=1, clickCount=1,
            )  # fmt: skip
        self.settle()

    def touch(self, *steps: Sequence[tuple[float, float]]) -> None:
        """Fingers: where they are at each step; they are lifted after the last."""
        for number, fingers in enumerate([*steps, []]):
            kind = 'Start' if not number else 'Move' if fingers else 'End'
            points = [{'x': x, 'y': y, 'id': k} for k, (x, y) in enumerate(fingers)]
            self.ask('Input.dispatchTouchEvent', type=f'touch{kind}', touchPoints=points)
        self.settle()

    def complaints(self) -> list[str]:
        """Errors and warnings of the console, and exceptions."""
        found = []
        for event in self.browser.events:
            params = event.get('params', {})
            if event.get('sessionId') != self.session:
                continue
            if event['method'] == 'Runtime.exceptionThrown':
                found.append(json.dumps(params['exceptionDetails']))
            elif event['method'] == 'Runtime.consoleAPICalled':
                found.append(json.dumps(params['args']))
            elif event['method'] == 'Log.entryAdded':
                found.append(params['entry']['text'])
        return found

    def requests(self) -> list[str]:
        """Everything that the page has asked for."""
        return [
            event['params']['request']['url']
            for event in self.browser.events
            if event['method'] == 'Network.requestWillBeSent'
            and event.get('sessionId') == self.session
        ]


@contextlib.contextmanager
def browsing(path: str, profile: Path) -> Iterator[Tab]:
    """Return a tab in a browser of its own."""
    browser = Browser(path, profile)
    try:
        target = browser.ask('Target.createTarget', url='about:blank')['targetId']
        session = browser.ask('Target.attachToTarget', targetId=target, flatten=True)['sessionId']
        tab = Tab(browser, session)
        for domain in ('Page', 'Runtime', 'Log', 'Network'):
            tab.ask(f'{domain}.enable')
        yield tab
    finally:
        browser.close()
