import pytest

from rsjax.tools.sim import gl


def machine_with(monkeypatch: pytest.MonkeyPatch, *libraries: str) -> None:
    monkeypatch.setattr(gl, "_loads", lambda library: library in libraries)


@pytest.mark.parametrize(("libraries", "choice"), [(("EGL", "OSMesa"), "egl"), (("OSMesa",), "osmesa")])
def test_takes_what_there_is(monkeypatch: pytest.MonkeyPatch, libraries: tuple[str, ...], choice: str) -> None:
    monkeypatch.setenv("MUJOCO_GL", "")
    machine_with(monkeypatch, *libraries)
    assert gl.choose_gl() == gl.os.environ["MUJOCO_GL"] == choice


def test_respects_the_users_choice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    machine_with(monkeypatch, "EGL", "OSMesa")
    assert gl.choose_gl() == "osmesa"
    machine_with(monkeypatch, "EGL")
    with pytest.raises(gl.GLError, match=r"MUJOCO_GL is 'osmesa'.*apt-get install"):
        gl.choose_gl()


def test_none_names_the_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "")
    machine_with(monkeypatch)
    with pytest.raises(gl.GLError, match=r"make setup.*apt-get install libegl1 libgl1 libgl1-mesa-dri libosmesa6"):
        gl.choose_gl()
