"""ament_python package, installable by pip and by colcon; the metadata is in setup.cfg."""

from glob import glob

from setuptools import setup

NAME = 'autocalib_ros'

setup(
    name=NAME,
    python_requires='>=3.10',  # colcon cannot read it from setup.cfg
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/config', glob('config/*')),
        (f'share/{NAME}/policies', glob('policies/*')),
        (f'share/{NAME}/launch', glob('launch/*.launch.py')),
    ],
)
