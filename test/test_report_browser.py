# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The report in a real headless browser: drawn, turned by hand, readable on a phone."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapmerge_ros.fusion import Fusion, fuse
from mapmerge_ros.io.report import report_html
from mapmerge_ros.io.summary import summarise

from browser import Tab, browsing, find_browser  # isort: skip
from reported import SECTIONS, large_fusion, moved_fusion, submaps  # isort: skip

BROWSER = find_browser()
image_module = pytest.importorskip('PIL.Image', reason='Pillow is missing: pip install pillow')
pytestmark = pytest.mark.skipif(
    BROWSER is None,
    reason='no Chromium on PATH (apt-get install chromium, or MAPMERGE_BROWSER=/path/to/it)',
)

Pixels = np.ndarray[Any, np.dtype[np.int64]]
ZOOM = 'pictures[0].camera.zoom / pictures[0].camera.home.zoom'
MAP, CHANGES = '[data-picture=map]', '[data-picture=changes]'


@pytest.fixture(scope='module')
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    with browsing(str(BROWSER), tmp_path_factory.mktemp('profile')) as found:
        yield found


@pytest.fixture(scope='module')
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(moved_fusion(), tmp_path_factory.mktemp('page'))


@pytest.fixture
def opened(tab: Tab, page: Path) -> Tab:
    tab.browser.events.clear()
    tab.prefer(prefers_reduced_motion='reduce')
    tab.resize(1000, 800)
    tab.open(page)
    return tab


def written(fusion: Fusion, folder: Path, title: str = 'a.mcap') -> Path:
    path = folder / 'report.html'
    path.write_bytes(report_html(fusion, summarise(fusion), title))
    return path


def pixels(tab: Tab, selector: str) -> Pixels:
    """RGB (height, width, 3) of an element, as the screen has it."""
    tab.settle()
    left, top, width, height = tab.box(selector)
    clip = (left, top + tab.run('scrollY'), width, height)
    with image_module.open(io.BytesIO(tab.screenshot(clip))) as image:
        return np.asarray(image.convert('RGB')).astype(np.int64)


def kinds(shown: Pixels) -> int:
    """Number of different colours."""
    return len(np.unique(shown.reshape(-1, 3), axis=0))


def canvas(tab: Tab, selector: str) -> str:
    """What is drawn, without what lies about it."""
    tab.settle()
    return str(tab.run(f"document.querySelector('{selector} canvas').toDataURL()"))


def coloured(shown: Pixels) -> int:
    """Pixels that are not grey."""
    return int((np.ptp(shown, axis=-1) > 60).sum())


def switch(tab: Tab, value: int) -> None:
    """Before (0) or after the merge (1)."""
    tab.run(f"document.querySelectorAll('input[name=when]')[{value}].click()")
    tab.wait_until(f'pictures[0].blend === {value}')


def nearly(shown: Pixels, colour: tuple[int, int, int]) -> int:
    """Pixels of a colour."""
    return int((np.abs(shown - np.array(colour)).max(axis=-1) < 12).sum())


def test_page_opens_without_errors_and_without_the_network(opened: Tab, page: Path) -> None:
    assert opened.complaints() == []
    assert opened.requests() == [page.resolve().as_uri()]


def test_both_pictures_are_drawn(opened: Tab) -> None:
    """The map has the colours of both robots; arrows have that of their p-value."""
    shown = pixels(opened, MAP)
    assert kinds(shown) > 50
    assert 0.01 < (np.abs(shown - shown[0, 0]).max(axis=-1) > 20).mean() < 0.6
    assert nearly(pixels(opened, CHANGES), (0x4B, 0x0D, 0x6B)) > 50


@pytest.mark.parametrize('width', [320, 390, 1280])
def test_all_sections_fit_the_screen(opened: Tab, width: int) -> None:
    opened.resize(width, 844, phone=width < 600, scale=3.0 if width < 600 else 1.0)
    opened.settle()
    for name in SECTIONS:
        box = f"document.getElementById('{name}').getBoundingClientRect()"
        assert opened.run(f'{box}.height') > 60, name
        assert opened.run(f'{box}.right') <= width, name
    assert opened.run('document.documentElement.scrollWidth') == width
    wide = "[...document.querySelectorAll('.wide')].filter(e => e.scrollWidth > e.clientWidth)"
    assert opened.run(f'{wide}.length') == 0
    assert kinds(pixels(opened, MAP)) > 50


def test_mouse_turns_moves_and_zooms(opened: Tab) -> None:
    start = canvas(opened, MAP)
    left, top, width, height = opened.box(MAP)
    middle = (left + width / 2, top + height / 2)
    opened.drag(middle, (middle[0] + 80, middle[1] + 20))
    assert canvas(opened, MAP) != start
    wheel = {'x': middle[0], 'y': middle[1], 'deltaX': 0, 'deltaY': -300}
    opened.ask('Input.dispatchMouseEvent', type='mouseWheel', **wheel)
    opened.wait_until(f'{ZOOM} > 1.3')
    opened.run("document.querySelector('#map [data-do=reset]').click()")
    assert canvas(opened, MAP) == start


def test_wheel_scrolls_the_page_until_the_picture_is_clicked(opened: Tab) -> None:
    opened.run('scrollTo(0, 0)')
    opened.ask('Input.dispatchMouseEvent', type='mouseWheel', x=500, y=500, deltaX=0, deltaY=200)
    opened.wait_until('scrollY > 50')
    assert opened.run(ZOOM) == 1


def test_keys_turn_move_and_zoom(opened: Tab) -> None:
    start = canvas(opened, MAP)
    opened.run("document.querySelector('#map canvas').focus()")
    for key in ('ArrowLeft', 'ArrowUp', '+'):
        opened.ask('Input.dispatchKeyEvent', type='keyDown', key=key)
    assert canvas(opened, MAP) != start
    opened.ask('Input.dispatchKeyEvent', type='keyDown', key='0')
    assert canvas(opened, MAP) == start


def test_fingers_turn_and_pinch(opened: Tab) -> None:
    opened.resize(390, 844, phone=True)
    left, top, width, height = opened.box(MAP)
    x, y = left + width / 2, top + height / 2
    before = opened.run('pictures[0].camera.turn')
    opened.touch([(x, y)], [(x + 20, y)], [(x + 60, y)])
    assert opened.run('pictures[0].camera.turn') < before - 0.2
    opened.touch([(x - 20, y), (x + 20, y)], [(x - 40, y), (x + 40, y)])
    assert opened.run(ZOOM) == pytest.approx(2.0, rel=0.05)
    assert opened.complaints() == []


def test_switch_shows_the_sub_maps_as_they_were_sent(opened: Tab) -> None:
    drawn, after = canvas(opened, MAP), pixels(opened, MAP)
    switch(opened, 0)
    before = pixels(opened, MAP)
    assert coloured(before) > 2 * coloured(after)  # what several have is grey once merged
    switch(opened, 1)
    assert canvas(opened, MAP) == drawn


def test_robots_can_be_hidden(opened: Tab) -> None:
    shown = canvas(opened, MAP)
    button = "document.querySelector('button[data-maps]')"
    opened.run(f'{button}.click()')
    assert canvas(opened, MAP) != shown
    assert opened.run(f'{button}.ariaPressed') == 'false'
    opened.run(f'{button}.click()')
    assert canvas(opened, MAP) == shown


def test_objects_are_visited(opened: Tab) -> None:
    opened.run('pictures[1].camera.magnify(0.3); pictures[1].camera.target = [9, 9, 9]')
    opened.run("document.querySelector('[data-object]').click()")
    assert nearly(pixels(opened, CHANGES), (0x4B, 0x0D, 0x6B)) > 50


def test_dark_pages_are_dark(opened: Tab) -> None:
    light = pixels(opened, '#map')
    opened.prefer(prefers_color_scheme='dark', prefers_reduced_motion='reduce')
    dark = pixels(opened, '#map')
    assert np.median(light) > 240
    assert np.median(dark) < 50
    assert kinds(dark) > 50
    opened.prefer(prefers_color_scheme='light')


def test_without_scripts_a_drawing_is_there(opened: Tab, page: Path) -> None:
    opened.ask('Emulation.setScriptExecutionDisabled', value=True)
    try:
        opened.ask('Page.reload')
        time.sleep(0.5)
    finally:
        opened.ask('Emulation.setScriptExecutionDisabled', value=False)
    assert opened.run("document.querySelectorAll('#map svg path').length") > 1
    assert opened.run("getComputedStyle(document.querySelector('.bar')).display") == 'none'


def test_names_from_outside_run_nothing(opened: Tab, tmp_path: Path) -> None:
    evil = '</script><img src=x onerror=hacked=1><script>window.hacked=1</script>'
    first = replace(submaps()[0], map_id=evil, robot_id=evil, sources=submaps()[0].sources)
    opened.open(written(fuse([first, submaps()[1]]), tmp_path, evil))
    assert opened.run('typeof hacked') == 'undefined'
    assert opened.complaints() == []
    assert kinds(pixels(opened, MAP)) > 50


def test_one_sub_map_alone_is_shown_as_sent(opened: Tab, tmp_path: Path) -> None:
    opened.open(written(fuse(submaps()[:1]), tmp_path))
    assert opened.complaints() == []
    assert kinds(pixels(opened, MAP)) > 20
    assert opened.run("document.querySelector('input[name=when]')") is None


def test_fifty_thousand_landmarks_stay_usable(opened: Tab, tmp_path: Path) -> None:
    path = written(large_fusion(25_000), tmp_path)
    assert path.stat().st_size < 1_500_000
    begin = time.monotonic()
    opened.open(path)
    assert time.monotonic() - begin < 10.0
    assert opened.run('cloud.owners.length') > 48_000
    turns = (
        'pictures[0].camera.orbit(0.05, 0); pictures[0].draw(); times.push(pictures[0].speed_ms)'
    )
    times = opened.run(
        f'(times => {{ for (let k = 0; k < 15; k++) {{ {turns} }} return times }})([])'
    )
    # 10 to 20 ms on an idle desktop; the limit is for a busy one
    assert min(times) < 200.0
    assert kinds(pixels(opened, MAP)) > 20
