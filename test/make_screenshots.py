# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Make the README's pictures of the report. Usage: make_screenshots.py (needs Chromium)."""

import io
import sys
import tempfile
from pathlib import Path

from PIL import Image

from mapmerge_ros.cli.main import main as mapmerge

from browser import browsing, find_browser  # isort: skip

ROOT = Path(__file__).parents[1]
FIGURES = ROOT / 'docs' / 'figures'
MOVED = ['--drones', '6', '--moved', '2', '--removed', '1', '--seed', '7']
COLOURS, RARE_TOO = 256, Image.Quantize.MAXCOVERAGE
LARGEST_BYTES = 200_000


def main():
    """Replay the shipped recording and one in which objects moved; take pictures of both."""
    path = find_browser()
    if path is None:
        sys.exit('no Chromium on PATH: apt-get install chromium')
    with tempfile.TemporaryDirectory() as folder, browsing(path, Path(folder) / 'p') as tab:
        demo, moved = Path(folder) / 'demo', Path(folder) / 'moved'
        bag = str(ROOT / 'bags' / 'four_drones.mcap')
        mapmerge(['replay', bag, '--out', str(demo)])
        mapmerge(['simulate', f'{moved}.mcap', *MOVED])
        mapmerge(['replay', f'{moved}.mcap', '--out', str(moved)])
        tab.prefer(prefers_reduced_motion='reduce')
        tab.resize(900, 900, scale=1.5)
        tab.open(demo / 'report.html')
        save('report_map', tab.screenshot((0, 0, 900, bottom(tab, '#map .legend') + 8)))
        tab.run("document.querySelectorAll('input[name=when]')[0].click()")
        tab.wait_until('pictures[0].blend === 0')
        save('report_before', tab.screenshot(clip(tab, '#map .stage')))
        tab.open(moved / 'report.html')
        tab.run("document.querySelector('[data-object]').click()")
        tab.settle()
        left, top, width, _ = clip(tab, '#changes')
        height = bottom(tab, '#changes .legend') + 8 - top
        save('report_changes', tab.screenshot((left, top, width, height)))
        tab.resize(390, 844, phone=True, scale=2.0)
        tab.open(moved / 'report.html')
        save('report_phone', tab.screenshot((0, 0, 390, 844)))


def clip(tab, selector):
    """Left, top, width and height on the page."""
    left, top, width, height = tab.box(selector)
    return left, top + tab.run('scrollY'), width, height


def bottom(tab, selector):
    """Lower end on the page."""
    _, top, _, height = clip(tab, selector)
    return top + height


def save(name, png):
    """Write a picture, small enough for a repository."""
    path = FIGURES / f'{name}.png'
    with Image.open(io.BytesIO(png)) as image:
        image.convert('RGB').quantize(COLOURS, RARE_TOO).save(path, optimize=True)
    assert path.stat().st_size < LARGEST_BYTES, path
    print(path.relative_to(ROOT), path.stat().st_size)


if __name__ == '__main__':
    main()
