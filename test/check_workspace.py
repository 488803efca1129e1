# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A colcon workspace of both packages holds what `ros2 run` and other packages look for."""

import sys
from pathlib import Path


def main(install):
    """Check an install space whose setup.sh has been sourced."""
    root = Path(install).resolve()
    index = 'share/ament_index/resource_index/packages'
    wanted = [
        root / 'mapmerge_msgs' / index / 'mapmerge_msgs',
        root / 'mapmerge_ros' / index / 'mapmerge_ros',
        root / 'mapmerge_ros/share/mapmerge_ros/package.xml',
        root / 'mapmerge_ros/lib/mapmerge_ros/fusion_node',
    ]
    missing = [str(path) for path in wanted if not path.exists()]
    if missing:
        print('not installed:', *missing, sep='\n  ')
        return 1
    import mapmerge_msgs.msg

    import mapmerge_ros.io.typestore

    for module in (mapmerge_msgs.msg, mapmerge_ros.io.typestore):
        if root not in Path(module.__file__).resolve().parents:
            print(f'{module.__name__} is taken from {module.__file__}, not from the workspace')
            return 1
    mapmerge_ros.io.typestore.typestore()
    message = mapmerge_msgs.msg.SubMap(map_id='drone1/0001', landmark_ids=[1, 2])
    print(f'workspace {root}: both packages are there, {type(message).__name__} works')
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1]))
