"""Foxglove sees the shapes and poses that MuJoCo has."""

import mujoco
import numpy as np
import pytest

from imfvla.recording.scene import at_time, body_names, frame_transforms, scene_update

XML = """
<mujoco>
  <asset><material name="blue" rgba="0 0 1 1"/></asset>
  <worldbody>
    <geom type="plane" size="1 2 .1" rgba="1 1 1 1"/>
    <body name="arm/hand" pos="1 2 3" quat="0 1 0 0">
      <geom type="box" size=".1 .2 .3" material="blue"/>
      <geom type="capsule" size=".05 .2" pos="1 0 0" euler="0 90 0" rgba="1 0 0 1"/>
      <geom type="cylinder" size=".05 .2" rgba="1 0 0 .5"/>
      <geom type="sphere" size=".05" group="3"/>
      <geom type="sphere" size=".05" rgba="0 0 0 0"/>
      <geom type="ellipsoid" size=".1 .2 .3" rgba="1 0 0 1"/>
    </body>
    <body pos="0 0 1"/>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML)


def test_every_visible_geom_becomes_a_primitive_in_its_bodys_frame(model):
    world, hand = scene_update(model)["entities"]
    assert (world["frame_id"], hand["frame_id"]) == ("world", "arm/hand")
    (ground,) = world["cubes"]
    assert (ground["size"]["x"], ground["size"]["y"]) == (2, 4)
    (box,) = hand["cubes"]
    assert box["size"] == pytest.approx({"x": 0.2, "y": 0.4, "z": 0.6})
    assert box["color"] == {"r": 0, "g": 0, "b": 1, "a": 1}
    assert [cylinder["color"]["a"] for cylinder in hand["cylinders"]] == [1, 0.5]
    assert hand["cylinders"][0]["size"] == pytest.approx({"x": 0.1, "y": 0.1, "z": 0.4})
    first, second, ellipsoid = hand["spheres"]
    assert first["pose"]["position"] == pytest.approx({"x": 0.8, "y": 0, "z": 0}, abs=1e-6)
    assert second["pose"]["position"] == pytest.approx({"x": 1.2, "y": 0, "z": 0}, abs=1e-6)
    assert ellipsoid["size"] == pytest.approx({"x": 0.2, "y": 0.4, "z": 0.6})


def test_transforms_are_world_poses_with_xyzw(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    names = body_names(model)
    assert names == ["world", "arm/hand", "body_2"]
    message = at_time(frame_transforms(names, data), 5_000_000_007)
    hand, unnamed = message["transforms"]
    assert hand["timestamp"] == {"sec": 5, "nsec": 7}
    assert (hand["parent_frame_id"], hand["child_frame_id"]) == ("world", "arm/hand")
    assert hand["translation"] == {"x": 1, "y": 2, "z": 3}
    assert hand["rotation"] == {"x": 1, "y": 0, "z": 0, "w": 0}
    assert unnamed["translation"] == {"x": 0, "y": 0, "z": 1}


def test_capsule_ends_lie_where_mujoco_puts_them(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    geom = 2
    axis = data.geom_xmat[geom].reshape(3, 3)[:, 2]
    expected = data.geom_xpos[geom] + 0.2 * axis
    hand = scene_update(model)["entities"][1]
    local = np.array(list(hand["spheres"][1]["pose"]["position"].values()))
    found = data.xpos[1] + data.xmat[1].reshape(3, 3) @ local
    np.testing.assert_allclose(found, expected, atol=1e-6)
