from pathlib import Path

import numpy as np
import pytest

from rsjax.tools.sim.playback import Playback, PlaybackError, camera_names, local_model

SCENE = """<mujoco>
  <compiler meshdir="/etc" strippath="true"/>
  <asset>{asset}</asset>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="agentview" pos="0 0 2"/>
    <body name="ball"><joint type="slide" axis="1 0 0"/><geom group="1" size="0.1" rgba="1 0 0 1"/></body>
    <geom group="1" type="plane" size="2 2 .1" pos="0 0 -1" rgba="0 1 0 1"/>{more}
  </worldbody>
</mujoco>"""
FINGER = "/home/somebody/robosuite/models/assets/grippers/meshes/panda_gripper/finger.stl"


def scene(asset: str = "", more: str = "") -> str:
    return SCENE.format(asset=asset, more=more)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (scene('<mesh file="/etc/passwd"/>'), "names the file '/etc/passwd', which the installed robosuite does not"),
        (scene('<mesh file="/robosuite/models/assets/../../../../secret.stl"/>'), "names the file '/robosuite/models"),
        (scene('<texture type="cube" fileup="/x/models/assets/no.png"/>'), "names the file '/x/models/assets/no.png'"),
        (scene('<texture name="t" builtin="flat" width="100000" height="100000"/>'), "a texture of 100000 × 100000"),
        (scene('<hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/>'), "a hfield of 100000 × 100000"),
        (scene(more='<include file="/etc/passwd"/>'), "an element 'include'"),
        (scene().replace("<asset>", '<extension><plugin plugin="x"/></extension><asset>'), "an element 'extension'"),
        ('<!DOCTYPE x [<!ENTITY a "a">]><mujoco/>', "declares entities"),
        ("<mujoco>", "not XML"),
        ("<robot/>", "not MJCF"),
    ],
)
def test_a_model_loads_nothing_but_robosuites_own_files(text: str, message: str) -> None:
    with pytest.raises(PlaybackError, match=message):
        local_model(text)


def test_files_of_another_machines_robosuite_are_the_installed_ones() -> None:
    model = local_model(scene(f'<mesh name="finger" file="{FINGER}"/>'))
    assert "/home/somebody" not in model and "meshdir" not in model and "strippath" not in model
    (file,) = (part.split('"')[0] for part in model.split('file="')[1:])
    assert Path(file).is_file() and Path(file).name == "finger.stl"
    assert camera_names(model) == ("agentview",)


def test_states_are_rendered(gl: str) -> None:
    playback = Playback(local_model(scene()), "agentview", 32)
    try:
        left, right = (playback.render(np.array([0.0, x, 0.0])) for x in (-0.3, 0.3))
        for view, columns in ((left, slice(0, 16)), (right, slice(16, 32))):
            red = view.rgb[..., 0].astype(int) - view.rgb[..., 1]
            assert red[:, columns].max() > 50 and (np.argwhere(red > 50)[:, 1] // 16 == columns.start // 16).all()
            assert view.depth.min() == pytest.approx(1.9, abs=0.02) and view.depth.max() == pytest.approx(3, abs=0.02)
        with pytest.raises(PlaybackError, match="a state has 4 numbers, the model takes 3 finite ones"):
            playback.render(np.zeros(4))
    finally:
        playback.close()
    with pytest.raises(PlaybackError, match="MuJoCo refuses the model"):
        Playback(local_model(scene(more="<nonsense/>")), "agentview", 32)
