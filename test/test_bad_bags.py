# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings that are broken, and disks that are full: one line, and nothing half written."""

from __future__ import annotations

import os
import resource
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer
from recordings import entries, rosbag2_folder
from rosbags.rosbag2 import StoragePlugin
from submaps import random_bundle

from mapmerge_ros.errors import MapMergeError
from mapmerge_ros.io import (
    BagError,
    OutputError,
    Recording,
    encode_bundle,
    read_submaps,
    record,
    write_submaps,
)
from mapmerge_ros.io.typestore import BUNDLE, SUBMAP


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    path = tmp_path / 'bag.mcap'
    write_submaps(path, entries(0))
    return path


def not_a_bag(path: Path) -> Path:
    path.write_text('Hello, this is not a recording at all.')
    return path


def empty(path: Path) -> Path:
    path.touch()
    return path


def without_submaps(path: Path) -> Path:
    raw = encode_bundle(random_bundle(np.random.default_rng(0)))
    with record(path) as recorder:
        recorder.write_bytes('/b', 1, BUNDLE, raw)
    return path


def folder(path: Path) -> Path:
    path.mkdir()
    return path


def broken_metadata(path: Path) -> Path:
    rosbag2_folder(path, entries(9), StoragePlugin.MCAP)
    (path / 'metadata.yaml').write_text('rosbag2_bagfile_information: [')
    return path


def lost_file(path: Path) -> Path:
    rosbag2_folder(path, entries(9), StoragePlugin.MCAP)
    next(path.glob('*.mcap')).unlink()
    return path


def broken_database(path: Path) -> Path:
    rosbag2_folder(path, entries(9, 40), StoragePlugin.SQLITE3)
    file = next(path.glob('*.db3'))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    return path


def foreign_profile(path: Path) -> Path:
    with path.open('wb') as stream:
        writer = Writer(stream)
        writer.start(profile='ros1')
        writer.finish()  # type: ignore[no-untyped-call]
    return path


BAD_BAGS: dict[str, tuple[str, Callable[[Path], Path], str]] = {
    'missing': ('x.mcap', lambda path: path, 'No such file or directory: check the path'),
    'text as mcap': ('x.mcap', not_a_bag, 'not a .mcap file'),
    'text as db3': ('x.db3', not_a_bag, 'not a .db3 file'),
    'other suffix': ('x.txt', not_a_bag, 'not a bag: give an .mcap file'),
    'empty': ('x.mcap', empty, 'empty file'),
    'folder': ('x', folder, 'no metadata.yaml'),
    'no submaps': ('x.mcap', without_submaps, f'no topic of type {SUBMAP}, only {BUNDLE}'),
    'metadata': ('x', broken_metadata, 'truncated or damaged'),
    'lost file': ('x', lost_file, 'truncated or damaged: Some database files are missing'),
    'database': ('x', broken_database, 'truncated or damaged'),
    'profile': ('x.mcap', foreign_profile, 'truncated or damaged: Profile is not ros2'),
}


@pytest.mark.parametrize('case', BAD_BAGS)
def test_bad_bags_are_one_line(tmp_path: Path, case: str) -> None:
    name, make, reason = BAD_BAGS[case]
    path = make(tmp_path / name)
    with pytest.raises(BagError) as caught:
        list(read_submaps(path))
    assert str(caught.value).startswith(f'{path}: {reason}')
    assert '\n' not in str(caught.value)


def test_a_truncated_file_is_an_error_wherever_it_ends(bag: Path) -> None:
    data = bag.read_bytes()
    for length in np.linspace(1, len(data) - 1, 60, dtype=int):
        bag.write_bytes(data[:length])
        with pytest.raises(BagError) as caught:
            list(read_submaps(bag))
        assert str(caught.value).startswith(f'{bag}: ')


@pytest.mark.parametrize('seed', range(3))
def test_damaged_files_raise_nothing_else(bag: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    data = bag.read_bytes()
    for _ in range(60):
        damaged = bytearray(data)
        for place in rng.integers(8, len(damaged), 3):
            damaged[place] = rng.integers(256)
        bag.write_bytes(damaged)
        try:
            list(read_submaps(bag))
        except BagError as err:
            assert '\n' not in str(err)


def test_one_bad_bag_among_good_ones_is_named_at_once(bag: Path, tmp_path: Path) -> None:
    other = not_a_bag(tmp_path / 'other.mcap')
    with pytest.raises(BagError, match=r'other\.mcap'):
        Recording([bag, other]).__enter__()


def test_failure_leaves_nothing_and_keeps_what_was_there(tmp_path: Path) -> None:
    target = tmp_path / 'bag.mcap'
    write_submaps(target, entries(10))
    before = target.read_bytes()

    def failing() -> Any:
        yield entries(11)[0]
        raise RuntimeError('the simulation broke')

    with pytest.raises(RuntimeError, match='broke'):
        write_submaps(target, failing())
    assert target.read_bytes() == before
    assert os.listdir(tmp_path) == ['bag.mcap']  # noqa: PTH208


@pytest.mark.parametrize('name', ['missing/bag.mcap', 'folder', '/dev/null/bag.mcap'])
def test_unwritable_paths_are_one_line(tmp_path: Path, name: str) -> None:
    (tmp_path / 'folder').mkdir()
    with pytest.raises(OutputError) as caught:
        write_submaps(tmp_path / name, entries(12, 1))
    assert str(caught.value).startswith(f'{tmp_path / name}: ')
    assert '\n' not in str(caught.value)
    assert isinstance(caught.value, MapMergeError)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ['folder']


def test_a_full_disk_is_one_line(tmp_path: Path) -> None:
    _, hard = limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        with pytest.raises(OutputError, match=r'bag\.mcap: File too large'):
            write_submaps(tmp_path / 'bag.mcap', entries(13, 60))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list(tmp_path.iterdir())


def test_errors_of_other_files_keep_their_name(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), record(tmp_path / 'bag.mcap'):
        (tmp_path / 'other').read_bytes()
    assert not list(tmp_path.iterdir())
