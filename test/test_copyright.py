# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Every source file says whose it is, and under which licence.

`ament_copyright` knows the long header of Apache-2.0 only (ament_lint, issue 246); where it is
installed it is taught the short one, with the SPDX identifier.
"""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
HEADER = re.compile(
    r'# Copyright \d{4} mapmerge_ros contributors\n# SPDX-License-Identifier: Apache-2\.0\n'
)
SOURCES = ('*.py', '*.cmake', 'CMakeLists.txt')
FOLDERS = ('mapmerge_ros', 'launch', 'test', 'benchmarks', 'docs', 'msg_schemas')


@pytest.mark.copyright
@pytest.mark.linter
def test_every_file_has_the_header():
    found = [path for name in FOLDERS for kind in SOURCES for path in (ROOT / name).rglob(kind)]
    assert len(found) > 200
    files = (path for path in (ROOT / 'setup.py', *found) if path.stat().st_size)
    assert [str(path) for path in files if not HEADER.match(path.read_text())] == []
    assert 'Apache License' in (ROOT / 'LICENSE').read_text()


@pytest.mark.copyright
@pytest.mark.linter
def test_copyright(monkeypatch):
    linter = pytest.importorskip('ament_copyright.main', reason='ament_copyright is not installed')
    from ament_copyright import licenses, parser

    short = licenses.apache2._replace(
        name='Apache-2.0', file_headers=['{copyright}\nSPDX-License-Identifier: Apache-2.0']
    )
    monkeypatch.setattr(parser, 'get_licenses', lambda: {'apache2': short})
    monkeypatch.setattr(linter, 'get_licenses', lambda: {'apache2': short})
    monkeypatch.chdir(ROOT)
    assert linter.main(['setup.py', *FOLDERS]) == 0
