# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Every package.xml is valid: by `ament_xmllint`, and by what colcon itself reads it with."""

import shutil
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = (ROOT, ROOT / 'msg_schemas', ROOT / 'test' / 'interfaces' / 'tf2_msgs')


@pytest.mark.xmllint
@pytest.mark.linter
def test_xmllint():
    linter = pytest.importorskip('ament_xmllint.main', reason='ament_xmllint is not installed')
    if shutil.which('xmllint') is None:
        pytest.skip('xmllint is not installed')
    assert linter.main([str(folder / 'package.xml') for folder in PACKAGES]) == 0


@pytest.mark.xmllint
@pytest.mark.linter
@pytest.mark.parametrize('folder', PACKAGES, ids=lambda folder: folder.name)
def test_what_colcon_reads_is_valid(folder):
    reader = pytest.importorskip('catkin_pkg.package', reason='catkin_pkg is not installed')
    warnings = []
    package = reader.parse_package(str(folder), warnings=warnings)
    package.validate(warnings=warnings)
    assert warnings == []
    assert package.package_format == 3
    assert package.licenses == ['Apache-2.0']
