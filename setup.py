"""ament_python package, installable by pip and by colcon."""

from glob import glob

from setuptools import find_packages, setup

NAME = 'autocalib_ros'

setup(
    name=NAME,
    version='0.1.0',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['report/templates/*']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/config', glob('config/*')),
        (f'share/{NAME}/launch', glob('launch/*.launch.py')),
    ],
    python_requires='>=3.10',
    install_requires=[
        'numpy>=1.26',
        'scipy>=1.11',
        'opencv-python-headless>=4.6',
        'PyYAML>=6',
        'rosbags>=0.11.9',
        'tqdm>=4.64',
        'jinja2>=3',
        'matplotlib>=3.7',
    ],
    extras_require={
        'detector': ['onnxruntime>=1.17'],
        'ros': ['ros-jazzy-rclpy[fastrtps]', 'ros-jazzy-common-interfaces'],
        'test': ['pytest>=7', 'pytest-xdist>=3', 'hypothesis>=6', 'ruff>=0.4'],
    },
    zip_safe=True,
    maintainer='autocalib_ros developers',
    maintainer_email='autocalib_ros@example.com',
    description='Calibrates a fixed roadside wide-angle camera from the traffic that it sees.',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            'autocalib = autocalib_ros.cli:main',
            'autocalib_node = autocalib_ros.ros.node:main',
            'ground_points_node = autocalib_ros.ros.ground_points_node:main',
        ]
    },
)
