#!/usr/bin/env bash
# Compiles tf2_msgs/TFMessage into a virtual environment whose ROS 2 Jazzy comes from pip, where no wheel of it
# exists: build.sh VENV. Half a minute; with ROS from apt it is not needed.
# Exit status: 0 done, 3 no compiler or no headers of Python here, anything else is a failure.
set -euo pipefail

here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
venv=$(cd "${1:?usage: build.sh VENV}" && pwd)
python=$venv/bin/python
headers=$("$python" -c 'import sysconfig; print(sysconfig.get_path("include"))')
if ! command -v c++ >/dev/null || [ ! -e "$headers/Python.h" ]; then
    echo "tf2_msgs cannot be compiled: it needs a C++ compiler and $headers/Python.h (apt: g++ python3-dev)" >&2
    exit 3
fi

"$python" -m pip install -q -r "$here/requirements.txt"
command -v cmake >/dev/null || "$python" -m pip install -q 'cmake>=3.20'

# The wheels' CMake files name the folders of the machine that built them.
"$python" - "$venv" "$headers" <<'PY'
import re
import sys
from pathlib import Path

import numpy

venv, headers = sys.argv[1:]
built_in = r'/opt/python/cp\d+-cp\d+'
for file in Path(venv, 'share').rglob('*.cmake'):
    text = file.read_text(encoding='utf-8')
    moved = re.sub(built_in + r'/lib/python[\d.]+/site-packages/numpy/_?core/include', numpy.get_include(), text)
    moved = re.sub(built_in + r'/include/python[\d.]+', headers, moved)
    if moved != text:
        file.write_text(moved, encoding='utf-8')
PY

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
export AMENT_PREFIX_PATH=$venv PATH="$venv/bin:$PATH"
quietly() { "$@" >"$work/log" 2>&1 || { tail -n 40 "$work/log" >&2; exit 1; }; }
# Installed into the environment itself, so that its libraries are found like those of the wheels.
quietly cmake -S "$here" -B "$work/build" -DCMAKE_BUILD_TYPE=Release -DCMAKE_PREFIX_PATH="$venv" \
    -DCMAKE_INSTALL_PREFIX="$venv" -DPython3_EXECUTABLE="$python"
quietly cmake --build "$work/build" --parallel 2 --target install

"$python" -c 'from rclpy.serialization import serialize_message
from tf2_msgs.msg import TFMessage
serialize_message(TFMessage())'
echo "tf2_msgs is compiled into $venv"
