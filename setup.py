"""ament_python package, installable by pip and by colcon; all metadata is in setup.cfg."""

from glob import glob

from setuptools import setup

NAME = 'autocalib_ros'

setup(
    name=NAME,
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/config', glob('config/*')),
        (f'share/{NAME}/launch', glob('launch/*.launch.py')),
    ],
)
