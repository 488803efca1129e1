# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Build of the ament_python package; works with colcon and with pip alike."""

from pathlib import Path

from setuptools import find_packages, setup

package_name = 'mapmerge_ros'


def files(folder, pattern):
    """Paths that an installation copies, relative to this file."""
    return sorted(str(path) for path in Path(folder).glob(pattern))


setup(
    name=package_name,
    version='0.1.0',
    packages=find_packages(include=[package_name, f'{package_name}.*']),
    package_data={
        f'{package_name}': ['py.typed'],
        f'{package_name}.io': ['schemas/*.msg', 'templates/*'],
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{package_name}']),
        (f'share/{package_name}', ['package.xml']),
        (f'share/{package_name}/config', files('config', '*.*')),
        (f'share/{package_name}/launch', files('launch', '*.launch.py')),
        (f'share/{package_name}/rviz', files('rviz', 'fusion.*')),
    ],
    python_requires='>=3.10',
    install_requires=[
        'jinja2>=3.1.2',
        'lz4>=4.3.2',
        'mcap>=1.2.1',
        'numpy>=1.26.4',
        'rich>=13',
        'rosbags>=0.11.6',
        'scipy>=1.11.4',
        'threadpoolctl>=3.2',
    ],
    extras_require={
        'colmap': ['pycolmap>=4.2'],
        'docs': ['myst-parser>=3', 'sphinx>=7'],
        'experiments': ['matplotlib>=3.7', 'pycolmap>=4.2'],
        'ros': ['ros-jazzy-rclpy[fastrtps]', 'ros-jazzy-common-interfaces'],
        'test': [
            'catkin-pkg',
            'mcap-ros2-support>=0.5',
            'mypy>=1.11',
            'pytest>=8',
            'pytest-xdist>=3',
            'ruff>=0.6',
            'scipy-stubs',
            # The linters of ROS 2 Jazzy and what they check with; ament_copyright and
            # ament_xmllint are not on the package index.
            'flake8-builtins',
            'flake8-comprehensions',
            'flake8-docstrings',
            'flake8-import-order',
            'flake8-quotes',
            'ros-ament-flake8==0.17.3',
            'ros-ament-lint==0.17.3',
            'ros-ament-pep257==0.17.3',
        ],
    },
    zip_safe=False,
    maintainer='mapmerge_ros maintainers',
    maintainer_email='maintainers@mapmerge.invalid',
    description='Fusion of compressed visual maps of several robots.',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            'mapmerge = mapmerge_ros.cli.main:main',
            'compressor_node = mapmerge_ros.nodes.compressor_node:main',
            'fusion_node = mapmerge_ros.nodes.fusion_node:main',
            'record_node = mapmerge_ros.nodes.record_node:main',
            'robot_node = mapmerge_ros.nodes.robot_node:main',
        ],
    },
)
