# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What benchmarks print goes to its place in a document, and nothing else of it changes."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / 'benchmarks'))

from data_sets import data_sets
from documents import published, put

from mapmerge_ros.errors import MapMergeError

PAGE = (
    'before\n<!-- one -->\nold\n<!-- end of one -->\nmiddle\n<!-- two -->\n<!-- end of two -->\n'
)


def test_lines_are_printed_and_replace_what_stood_at_their_place(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / 'page.md'
    page.write_text(PAGE)
    assert published(lambda: ['a', 'b'], page, 'one') == 0
    assert capsys.readouterr().out == 'a\nb\n'
    assert page.read_text() == PAGE.replace('old', 'a\nb')
    put(page, 'two', 'c')
    assert page.read_text().endswith('<!-- two -->\nc\n<!-- end of two -->\n')


@pytest.mark.parametrize('page', ['nothing', '<!-- end of one -->\n<!-- one -->\n'])
def test_a_document_without_the_place_is_left_as_it_is(tmp_path: Path, page: str) -> None:
    document = tmp_path / 'page.md'
    document.write_text(page)
    with pytest.raises(MapMergeError, match=r"page\.md has no place marked 'one'"):
        put(document, 'one', 'text')
    assert document.read_text() == page


def test_a_known_error_is_one_line_and_leaves_the_document(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / 'page.md'
    page.write_text(PAGE)

    def lines() -> Iterator[str]:
        yield 'first'
        yield str(data_sets(tmp_path))

    assert published(lines, page, 'one') == 1
    printed = capsys.readouterr()
    assert printed.out == 'first\n'
    assert printed.err == f'{tmp_path}: no data set with a gold bundle\n'
    assert page.read_text() == PAGE
