# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The ament_python package valveflow_ros; its metadata stand in package.xml, once."""

import os
import sys
from glob import glob
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

PACKAGE = 'valveflow_ros'
# colcon and pip both run this file from the folder it stands in, and data_files
# must be relative to it.
MANIFEST = ElementTree.parse(Path(__file__).with_name('package.xml')).getroot()
MAINTAINER = MANIFEST.find('maintainer')
# colcon runs a link to this file from a folder that has no README.
README = Path(__file__).resolve().with_name('README.md')

COMMAND = ['valveflow = valveflow_ros.cli.main:main']
NODES = [
    f'{name} = valveflow_ros.ros:{name}'
    for name in ('monitor', 'opcua_gateway', 'page', 'plant_simulator', 'replay', 'watch')
]
# pip would put the nodes beside the command, under names as plain as `monitor`, also
# where there is no ROS. ros2 looks for them in lib/valveflow_ros, where colcon puts them.
BY_PIP = {'bdist_wheel', 'dist_info', 'editable_wheel'}.intersection(sys.argv)


def files(pattern: str) -> list[str]:
    """Return the files that match, none if the folder is empty or absent."""
    return sorted(name for name in glob(pattern) if Path(name).is_file())


def warn_without_messages() -> None:
    """Say while colcon builds that valveflow_msgs is not there: without it no node can run.

    colcon does not look for packages below another one, and so not into msg/.
    """
    marker = Path('share/ament_index/resource_index/packages/valveflow_msgs')
    prefixes = filter(None, os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep))
    if not any((prefix / marker).is_file() for prefix in map(Path, prefixes)):
        print(
            'WARNING: the message package valveflow_msgs is not built, so no node of '
            'valveflow_ros can run. In the workspace: colcon build --base-paths src '
            'src/valveflow_ros/msg',
            file=sys.stderr,
        )


# What colcon calls, with and without --symlink-install.
if not BY_PIP and {'develop', 'install'}.intersection(sys.argv):
    warn_without_messages()

setup(
    name=PACKAGE,
    version=MANIFEST.findtext('version'),
    description=MANIFEST.findtext('description'),
    long_description=README.read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    classifiers=[
        'Development Status :: 4 - Beta',
        'Environment :: Console',
        'Intended Audience :: Manufacturing',
        'Intended Audience :: Science/Research',
        'Operating System :: POSIX :: Linux',
        'Programming Language :: Python :: 3',
        'Programming Language :: Python :: 3.10',
        'Programming Language :: Python :: 3.11',
        'Programming Language :: Python :: 3.12',
        'Programming Language :: Python :: 3.13',
        'Topic :: Scientific/Engineering',
        'Topic :: System :: Monitoring',
    ],
    keywords=['ROS', 'steam turbine', 'valve', 'flow characteristic', 'system identification'],
    maintainer=MAINTAINER.text,
    maintainer_email=MAINTAINER.get('email'),
    license=MANIFEST.findtext('license'),
    python_requires='>=3.10',
    packages=find_packages(include=[PACKAGE, f'{PACKAGE}.*']),
    package_data={'': ['py.typed', '*.css', '*.html', '*.js', '*.yaml']},
    zip_safe=False,
    # The oldest versions are those of Ubuntu 24.04 (`make test-versions`).
    install_requires=[
        'argcomplete',
        'lz4',
        'mcap>=1.5',
        'numba>=0.59',
        'numpy>=1.26',
        'pandas>=2.1',
        'plotly',
        'pyyaml',
        'scipy>=1.11',
        'zstandard',
    ],
    # What only some need: reading .xlsx, pictures as files, the page in the browser. By `test`
    # colcon knows that pytest runs the tests.
    extras_require={
        'excel': ['python-calamine'],
        'figures': ['matplotlib'],
        'fleet': ['dask', 'distributed', 'pyarrow'],
        'gateway': ['asyncua'],
        'page': ['dash>=3', 'prometheus-client', 'waitress>=3'],
        'parquet': ['pyarrow'],
        'test': ['hypothesis', 'psutil', 'pytest'],
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        (f'share/{PACKAGE}/config', files('config/*')),
        (f'share/{PACKAGE}/launch', files('launch/*')),
        # Recordings carry the definitions of what they hold, also where valveflow_msgs is
        # not built.
        (f'share/{PACKAGE}/msg', files('msg/*.msg')),
    ],
    entry_points={'console_scripts': COMMAND if BY_PIP else NODES + COMMAND},
)
