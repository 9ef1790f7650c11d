#!/usr/bin/env bash
# Sees that the simulator can draw without a screen, with the environment $1; installs software OpenGL where it cannot.
# Where that fails too it says what to install and goes on: training from data that is already there needs no OpenGL.
set -euo pipefail
venv=$1
stamp=$venv/.rsjax-opengl
packages="libegl1 libgl1 libgl1-mesa-dri libosmesa6"

draws() { # whether MuJoCo can draw a lit sphere with the library that the simulator would choose
    "$venv/bin/python" - >/dev/null 2>&1 <<'PYTHON'
from rsjax.tools.sim.gl import choose_gl

choose_gl()

import mujoco

model = mujoco.MjModel.from_xml_string(
    '<mujoco><worldbody><light pos="0 0 3"/><geom size="1"/></worldbody></mujoco>'
)
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer = mujoco.Renderer(model, 32, 32)
renderer.update_scene(data)
lit = renderer.render().any()
renderer.close()
raise SystemExit(not lit)
PYTHON
}

if [ ! -e "$stamp" ] && ! draws; then
    echo "setup: no OpenGL library that works without a screen; installing $packages"
    # shellcheck disable=SC2086
    if ! "$(dirname "$0")/apt.sh" $packages || ! draws; then
        echo "warning: the simulator cannot draw; install OpenGL: apt-get install $packages" >&2
        exit 0
    fi
fi
touch "$stamp"
