# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The report is one whole page, and every number in it is that of the summary."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from importlib import resources
from typing import Any

import numpy as np
import pytest

from mapmerge_ros.fusion import ErrorModel, Fusion, State, fuse
from mapmerge_ros.fusion.outcome import Contradiction
from mapmerge_ros.fusion.refusal import Quarantine
from mapmerge_ros.io.change_words import chance, nothing_moved, split_ids
from mapmerge_ros.io.drawing import density, price_and_expected
from mapmerge_ros.io.report import report_html
from mapmerge_ros.io.report_values import looked_up
from mapmerge_ros.io.scene import make_scene
from mapmerge_ros.io.summary import summarise

from reported import SECTIONS, moved_fusion, submaps  # isort: skip


@pytest.fixture(scope='module')
def fusion() -> Fusion:
    return fuse(submaps())


@pytest.fixture(scope='module')
def moved() -> Fusion:
    return moved_fusion()


class Page(HTMLParser):
    """Checks that tags match; collects text, numbers and where the page reaches out to."""

    def __init__(self, html: bytes) -> None:
        super().__init__()
        self.open: list[str] = []
        self.words: list[str] = []
        self.outside: list[str] = []
        self.ids: list[str] = []
        self.scripts: list[str] = []
        self.numbers: list[tuple[str, str, str]] = []
        self._number: tuple[str, str] | None = None
        self.feed(html.decode())
        assert not self.open

    @property
    def text(self) -> str:
        return ' '.join(' '.join(self.words).split())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = {key: value or '' for key, value in attrs}
        self.outside += [found[key] for key in ('src', 'href') if key in found]
        self.ids += [found['id']] if 'id' in found else []
        if tag == 'data':
            self._number = found['data-key'], found['value']
        if tag not in ('meta', 'link', 'br', 'input'):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == 'script':
            self.scripts.append(data)
        elif not self.open or self.open[-1] != 'style':
            self.words.append(data)
        if self._number:
            self.numbers.append((*self._number, data))
            self._number = None


def page_of(fusion: Fusion, title: str = 'bag') -> Page:
    return Page(report_html(fusion, summarise(fusion), title))


def scene_of(page: Page) -> Any:
    return json.loads(page.scripts[0])


def test_report_is_one_whole_page_that_says_the_verdict(fusion: Fusion) -> None:
    html = report_html(fusion, summarise(fusion), 'a <b> & c.mcap')
    page = Page(html)
    assert page.outside == []
    assert b'url(' not in html
    assert b'default-src &#39;none&#39;' in html
    assert 'a <b> & c.mcap' in page.text
    assert '2 of 4 sub-maps were merged into one map' in page.text
    assert 'The test believes it' in page.text
    assert 'r3/0001 stays apart: an announcement' in page.text
    assert 'not metres' in page.text


@pytest.mark.parametrize('name', ['fusion', 'moved'])
def test_every_number_is_that_of_the_summary(name: str, request: pytest.FixtureRequest) -> None:
    found: Fusion = request.getfixturevalue(name)
    summary = json.loads(json.dumps(summarise(found)))
    page = Page(report_html(found, summary, 'bag'))
    assert len(page.numbers) > 30
    for path, value, text in page.numbers:
        truth = looked_up(summary, path)
        assert json.loads(value) == truth, path
        if isinstance(truth, int) and 'bytes' not in path:
            assert text == str(truth), path
        shown = re.fullmatch(r'([\d.e+-]+)( ms| s| B| kB| MB|%)?', text)
        if isinstance(truth, float) and shown:
            unit = {' ms': 1e-3, '%': 1e-2}.get(shown[2] or '', 1.0)
            assert float(shown[1]) * unit == pytest.approx(truth, rel=0.06, abs=6e-5), path
    keys = {re.sub(r'\d+', '*', path) for path, _, _ in page.numbers}
    assert keys >= {
        'sub_maps.*.bytes', 'sub_maps.*.landmarks', 'sub_maps.*.sigma', 'test.p_value',
        'test.a_tilde', 'test.dof', 'timing_s.total', 'bytes_in', 'bytes_out',
    }  # fmt: skip
    assert f'p = {summary["test"]["p_value"]:.2g}' in page.text
    for row in summary['sub_maps']:
        assert row['map_id'] in page.text
        assert row['state'] in page.text
        assert row['reason'] in page.text


def test_all_sections_are_there(moved: Fusion) -> None:
    assert [name for name in page_of(moved).ids if name != 'scene'] == list(SECTIONS)


def test_names_from_outside_are_escaped() -> None:
    evil = '</script><script>alert(1)</script>'
    first = replace(submaps()[0], map_id=evil, robot_id=evil, sources=submaps()[0].sources)
    page = page_of(fuse([first, submaps()[1]]), evil)
    assert len(page.scripts) == 2
    assert scene_of(page)['maps'][0]['name'] == evil
    assert evil in page.text


def test_quarantine_is_told(fusion: Fusion) -> None:
    found = Quarantine(('r1/0001',), 8.0, 1e-9, 0.4, 0.02)
    first = replace(
        fusion.alignments[2], state=State.REFUSED, reason='wrong as a whole', quarantine=found
    )
    told = replace(fusion, alignments=(*fusion.alignments[:2], first, fusion.alignments[3]))
    text = page_of(told).text
    assert 'r2/0001 is in quarantine: wrong as a whole' in text
    assert 'quarantined' in text


def test_unknown_states_are_told_as_they_are(fusion: Fusion) -> None:
    summary = summarise(fusion)
    summary['sub_maps'][2] |= {'state': 'lost', 'reason': 'it was raining'}
    page = Page(report_html(fusion, summary, 'bag'))
    assert 'lost' in page.text
    assert 'it was raining' in page.text


def test_what_moved_is_told_and_drawn(moved: Fusion) -> None:
    page = page_of(moved)
    assert 'Nothing moved' not in page.text
    assert 'Object 1 : ' in page.text
    drawn = scene_of(page)['changes']
    assert len(drawn) == len(moved.changes)
    view = make_scene(moved).viewpoint
    for shown, change in zip(drawn, moved.changes, strict=True):
        shaft = (np.array(shown['to']) - shown['from']) * view.radius
        np.testing.assert_allclose(
            np.linalg.norm(shaft), np.linalg.norm(change.displacement_global), rtol=1e-6
        )
        np.testing.assert_allclose(
            np.linalg.eigvalsh(shown['covariance']) * view.radius**2,
            np.linalg.eigvalsh(change.covariance),
            rtol=1e-6,
            atol=1e-15,
        )
        assert shown['p'] == change.p_value


def test_nothing_moved_is_said_plainly_and_only_where_it_is_known(fusion: Fusion) -> None:
    assert nothing_moved(fusion).startswith('Nothing moved. ')
    assert nothing_moved(fusion) in page_of(fusion).text
    first = fusion.components[0]
    unseen = replace(first, examination=None)
    assert 'No single landmark was tested' in nothing_moved(replace(fusion, components=(unseen,)))
    refused = replace(first, verdict=replace(first.verdict, accepted=False))
    assert 'Nothing can be named' in nothing_moved(replace(fusion, components=(refused,)))
    alone = replace(fusion, alignments=(replace(fusion.alignments[0], state=State.DETACHED),))
    assert 'Nothing can be said' in nothing_moved(alone)


def test_ids_far_apart_are_not_called_unmoved(fusion: Fusion) -> None:
    far = tuple(Contradiction(k, 'r0/0001', 'r1/0001') for k in range(3))
    found = replace(fusion, contradictions=far)
    assert split_ids(fusion) == ''
    assert 'something was moved far' in split_ids(found)
    assert '3 of r0/0001 and r1/0001' in page_of(found).text
    assert 'Nothing moved' not in page_of(found).text


@pytest.mark.parametrize(
    ('p_value', 'words'),
    [
        (1.0, 'nearly always'),
        (0.5, '50 times in a hundred'),
        (0.02, '2 times in a hundred'),
        (0.001, '1 time in a thousand'),
        (2e-6, '2 times in a million'),
        (0.0, 'practically never'),
    ],
)
def test_chance_in_words(p_value: float, words: str) -> None:
    assert chance(p_value) == words


def test_density_marks_the_verdict(fusion: Fusion) -> None:
    verdict = fusion.verdict
    assert f'found {verdict.variance_factor * verdict.dof:.0f}' in density(verdict, 0)
    assert 'class="good"' in density(verdict, 0)
    refused = density(replace(verdict, variance_factor=900.0, accepted=False), 50)
    assert 'class="bad"' in refused
    assert '→' in refused
    assert density(replace(verdict, dof=0), 0) == ''
    for dof in (1, 2, 100_000):
        assert 'nan' not in density(replace(verdict, dof=dof), 3)


def test_density_is_of_the_price_that_the_p_value_is_about(fusion: Fusion) -> None:
    verdict = fusion.verdict
    assert price_and_expected(verdict) == (verdict.variance_factor * verdict.dof, verdict.dof)
    errors = ErrorModel(0.9, 0.0, 1e-3, 5.0, price=31.0, dof=30)
    fitted = replace(verdict, variance_factor=9.0, errors=errors)
    assert price_and_expected(fitted) == (31.0, 30)
    assert 'found 31' in density(fitted, 0)
    first = replace(fusion.components[0], verdict=fitted)
    page = page_of(replace(fusion, components=(first, *fusion.components[1:])))
    assert 'errors of the sizes that were fitted' in page.text
    assert {'test.errors.price', 'test.errors.dof'} <= {path for path, _, _ in page.numbers}


def luminance(colour: str) -> float:
    """Of `#rrggbb`, as the Web Content Accessibility Guidelines define it."""
    parts = np.array([int(colour[k : k + 2], 16) / 255.0 for k in (1, 3, 5)])
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_colours_of_the_page_can_be_read_by_day_and_night() -> None:
    style = (resources.files('mapmerge_ros.io') / 'templates' / 'report.css').read_text()
    light, dark = re.findall(r':root \{(.*?)\}', style, re.DOTALL)[:2]
    for scheme in (light, dark):
        colour = dict(re.findall(r'--([\w-]+): (#[0-9a-f]{6})', scheme))
        paper = luminance(colour['card'])
        for name in ('ink', 'soft', 'good', 'bad', 'open', 'several', 'p0', 'p1', 'p2', 'p3'):
            own = luminance(colour[name])
            contrast = (max(own, paper) + 0.05) / (min(own, paper) + 0.05)
            assert contrast >= (3.0 if name in ('p0', 'p1', 'several') else 4.5), name
